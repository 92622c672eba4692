"""Few particles on CUDA: a search or a sum is one launch, in which all queries meet all sources, bit by bit.

To sort particles by cell takes six launches, of which each waits for the one before: longer than to meet a few thousand sources. In
a box that stands along the axes, and in which no pair has two images, the nearest image of each source is met.
"""

import functools

from jfrnn.kernels._native import Kind, declare_kind
from jfrnn.kernels._program import Entry, Kernel
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
    """Return the blocks of a launch."""
    return -(-queries // warps(queries))


def threads(queries: int) -> int:
    """Return the threads of a launch."""
    return 32 * warps(queries) * blocks(queries)


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return warps(queries) * blocks(queries)


@functools.lru_cache(64)
def rows_kernel(kind: Kind, warps: int) -> Kernel:
    """Return the kernel that lists or counts, for warps of a block."""
    constants, entry = {"SUMS": 0, "LIST": kind.lists, **_sizes(warps)}, Entry("FewRows.run", 32 * warps)
    return declare_kind(kind.compiled("later"), f"few_cuda_{warps}w", "few_rows.cuh", entry, cuda=True, constants=constants)[0]


@functools.lru_cache(512)
def sum_kernel(kind: Kind, warps: int, term: TermText, key: str) -> Kernel:
    """Return the kernel that sums a term, for warps of a block, as `jfrnn.kernels.pair_sum_cuda.sum_kernels` does."""
    constants, given = {"LIST": 0, **_sizes(warps), **constants_of(term, kind)}, term_header(term, kind.double)
    name, entry = f"few_sums_cuda_{key}_{warps}w", Entry("FewSums.run", 32 * warps)
    return declare_kind(kind.compiled(), name, "few_sums.cuh", entry, cuda=True, given=given, constants=constants)[0]


def _sizes(warps: int) -> dict[str, int]:
    return {"FEW_MOST": MOST, "FEW_WARPS": warps}
