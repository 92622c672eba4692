"""Sums over pairs, without a list, where cutoffs differ from particle to particle.

Queries meet their candidates one by one, as in `jfrnn.kernels.levels`. On the CPU, what the term reads of the pairs is put down
until there are ROOM of them, or the query has no more; then the term is evaluated for 16 of them at a time. On CUDA, each thread
has a query, and evaluates the term for one pair after the other.
"""

import functools

from jfrnn.kernels._native import SPACES
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels.cells_cuda import GRID
from jfrnn.kernels.levels import BLOCK, CHUNK, level_program
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

ROOM = 256  # a multiple of 16
WARP = 32  # threads of CUDA


def slots(queries: int, cuda: bool) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // (WARP if cuda else CHUNK))


@functools.lru_cache(512)
def query_kernel(
    term: TermText, key: str, dim: int, double: bool, rule: str, groups: int, halvings: int, compensated: bool, periodic: int = 0,
    batched: bool = False, extremes: bool = False, excluding: int = 0, cuda: bool = False,
) -> Kernel:  # fmt: skip
    """Return the kernel that sums a term. On the CPU threads share the work, and `info` is zeros at first.

    `key` and `extremes` are those of `jfrnn.kernels.pair_sum_cpu.query_kernel`, the rest those of `jfrnn.kernels.levels`.
    """
    variant = f"{dim}d_{'f64' if double else 'f32'}_{rule}{'_compensated' * compensated}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}{'_extremes' * extremes}{'_excluding' * excluding}_{key}"
    constants = {
        "PERIODIC": periodic,
        "BATCHED": batched,
        "CANDIDATES": ROOM,
        "EXCLUDING": excluding,
        **constants_of(term, compensated, extremes),
    }
    constants |= {"LIST": 0, **GRID} if cuda else {}
    header, entry = (
        ("level_sums.cuh", Entry("LevelSums.run", BLOCK)) if cuda else ("level_sums_cpu.h", Entry("LevelSumsKernel.run"))
    )
    text = level_program(dim, double, rule, groups, halvings, header, term_header(term, double), **constants)
    return declare(f"pair_sum_levels_{'cuda' if cuda else 'cpu'}_{variant}", text, entry, cuda=cuda, fused=cuda)[0]
