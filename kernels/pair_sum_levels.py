"""Sums over pairs on CUDA, without a list, where cutoffs differ from particle to particle.

Queries meet their candidates one by one, as in `jfrnn.kernels.levels`: each thread has a query, and evaluates the term for one pair
after the other.
"""

import functools

from jfrnn.kernels._native import SPACES
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels.cells_cuda import GRID
from jfrnn.kernels.levels import BLOCK, level_program
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

WARP = 32  # threads of CUDA


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // WARP)


@functools.lru_cache(512)
def query_kernel(
    term: TermText, key: str, dim: int, double: bool, rule: str, groups: int, halvings: int, compensated: bool, periodic: int = 0,
    batched: bool = False, extremes: bool = False, excluding: int = 0,
) -> Kernel:  # fmt: skip
    """Return the kernel that sums a term.

    `key` and `extremes` are those of `jfrnn.kernels.pair_sum_cpu.query_kernel`, the rest those of `jfrnn.kernels.levels`.
    """
    variant = f"{dim}d_{'f64' if double else 'f32'}_{rule}{'_compensated' * compensated}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}{'_extremes' * extremes}{'_excluding' * excluding}_{key}"
    constants = {"PERIODIC": periodic, "BATCHED": batched, "EXCLUDING": excluding, "LIST": 0, **GRID}
    constants |= constants_of(term, compensated, extremes)
    text = level_program(dim, double, rule, groups, halvings, "level_sums.cuh", term_header(term, double), **constants)
    entry = Entry("LevelSums.run", BLOCK)
    return declare(f"pair_sum_levels_cuda_{variant}", text, entry, cuda=True, fused=True)[0]
