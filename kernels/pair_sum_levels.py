"""Sums over pairs on the CPU, without a list, where cutoffs differ from particle to particle.

Queries meet their candidates one by one, as in `jfrnn.kernels.levels`. What the term reads of the pairs is put down until there are
ROOM of them, or the query has no more; then the term is evaluated for 16 of them at a time.
"""

import functools

from jfrnn.kernels._native import SPACES
from jfrnn.kernels._program import Kernel, declare
from jfrnn.kernels.levels import CHUNK, level_program
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

ROOM = 256  # a multiple of 16


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // CHUNK)


@functools.lru_cache(512)
def query_kernel(
    term: TermText, key: str, dim: int, double: bool, rule: str, groups: int, halvings: int, compensated: bool, periodic: int = 0,
    batched: bool = False, extremes: bool = False, excluding: bool = False,
) -> Kernel:  # fmt: skip
    """Return the kernel that sums a term, the work of which threads share; `info` is zeros at first.

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
    given = term_header(term, double)
    text = level_program(dim, double, rule, groups, halvings, "level_sums.h", given, **constants)
    return declare(f"pair_sum_levels_{variant}", text, "LevelSumsKernel.run")[0]
