"""Few particles on CUDA: a search or a sum is one launch, in which all queries meet all sources, bit by bit.

To sort particles by cell takes six launches, of which each waits for the one before: longer than to meet a few thousand sources. In
a box that stands along the axes, and in which no pair has two images, the nearest image of each source is met.
"""

import functools

from jfrnn.kernels._native import program
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels.cells_cuda import GRID
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

MOST = 4096  # sources, and queries, up to which all of them meet
_WARPS = 8, 16, 32  # of a block, which serves as many queries
_BLOCKS = 128  # beyond, blocks become larger rather than more: about as many as are at work at once


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return that the kernels need no scratch."""
    del sources, queries, dim, width, own
    return 0


def warps(queries: int) -> int:
    """Return the warps of a block, which serves as many queries."""
    return next((count for count in _WARPS if count * _BLOCKS >= queries), _WARPS[-1])


def blocks(queries: int) -> int:
    """Return the blocks of a launch: of so many, `info` has a row each."""
    return -(-queries // warps(queries))


def threads(queries: int) -> int:
    """Return the threads of a launch."""
    return 32 * warps(queries) * blocks(queries)


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return warps(queries) * blocks(queries)


@functools.lru_cache(64)
def rows_kernel(
    warps: int,
    dim: int,
    double: bool,
    lists: bool,
    batched: bool,
    boxed: bool = False,
    excluding: int = 0,
    flat: bool = False,
) -> Kernel:
    """Return the kernel for warps of a block, a dimension and a dtype, for lists or counts alone."""
    variant = f"{warps}w_{dim}d_{'f64' if double else 'f32'}{'_list' * lists}{'_nearest' * boxed}{'_batched' * batched}"
    variant += "_excluding" * excluding + "_flat" * flat
    options = {"EXCLUDING": excluding, "FLAT": flat, **_constants(warps, lists, batched, boxed)}
    text = program(double, dim, "few_rows.cuh", SUMS=0, **options)
    return declare(f"few_cuda_{variant}", text, Entry("FewRows.run", 32 * warps), cuda=True, fused=True)[0]


@functools.lru_cache(512)
def sum_kernel(
    warps: int,
    term: TermText,
    key: str,
    dim: int,
    double: bool,
    compensated: bool,
    batched: bool = False,
    extremes: bool = False,
    boxed: bool = False,
    excluding: int = 0,
) -> Kernel:
    """Return the kernel that sums a term.

    But for the warps of a block, the arguments are those of `jfrnn.kernels.pair_sum_cuda.sum_kernels`.
    """
    variant = f"{warps}w_{dim}d_{'f64' if double else 'f32'}{'_compensated' * compensated}{'_nearest' * boxed}"
    variant += f"{'_batched' * batched}{'_extremes' * extremes}{'_excluding' * excluding}"
    constants = (
        GRID | {"EXCLUDING": excluding} | _constants(warps, False, batched, boxed) | constants_of(term, compensated, extremes)
    )
    text = program(double, dim, "few_sums.cuh", given=term_header(term, double), **constants)
    return declare(f"few_sums_cuda_{variant}_{key}", text, Entry("FewSums.run", 32 * warps), cuda=True, fused=True)[0]


def _constants(warps: int, lists: bool, batched: bool, boxed: bool) -> dict[str, int]:
    return {"LIST": lists, "PERIODIC": boxed, "BATCHED": batched, "FEW_MOST": MOST, "FEW_WARPS": warps}
