"""Search with cutoffs that differ widely on CUDA: the walk of `cells_cuda` over a tree of boxes, in place of cells.

XLA sorts the particles along a curve (`jfrnn._geometry.order_for_tree`). `fit` puts the sources into that order, 32 to a leaf, and
finds the boxes of leaves, then of 32 leaves, and so on, one launch for each level. A warp serves 32 queries that come one after the
other, or fewer where these have fewer leaves near them in all; it finds these leaves from the root on, 32 boxes at a time, a lane
each. Candidates are then met as those of cells are.

Time follows pairs and particles: boxes are as small as 32 sources are close to each other, whatever the cutoffs of others.
"""

import functools

from jfrnn.kernels._native import Kind, declare_kind, place_parts
from jfrnn.kernels._program import Entry, Kernel
from jfrnn.kernels.cells_cuda import BLOCK, GRID, HEADER_WORDS, QUERY_BLOCK, query_blocks, walking_blocks

HEADER_BYTES = 4 * HEADER_WORDS  # of the scratch, which are cleared first
_NODE_WORDS = 12  # of the box of a node, at most, in float32
_LEAF = 32


def levels(sources: int) -> list[int]:
    """Return how many nodes each level of a tree has, from the leaves to the root."""
    counts = [-(-max(sources, 1) // _LEAF)]
    while counts[-1] > 1:
        counts.append(-(-counts[-1] // _LEAF))
    return counts


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of scratch that the kernels need; `width` is 1 for float32 and 2 for float64."""
    del dim
    parts = [HEADER_WORDS, 4 * width * sources, 0 if own else queries, _NODE_WORDS * width * sum(levels(sources))]
    return place_parts(parts)


@functools.lru_cache(512)
def fit_kernel(kind: Kind) -> Kernel:
    """Return the kernel that fits the boxes of a level."""
    kind = kind.only("scaled", "periodic", "batched", "rule")._replace(tree=True)
    return declare_kind(kind, "fit_tree_cuda", "fit_tree.cuh", Entry("FitTree.run", BLOCK), cuda=True, constants=GRID)[0]


def fit_threads(sources: int, queries: int, own: bool) -> list[int]:
    """Return the threads of the launch for each level; those of the first put queries in their order, too."""
    threads = [_LEAF * count for count in levels(sources)]
    return [threads[0] if own else max(threads[0], min(queries, 1 << 20)), *threads[1:]]


def walk_threads(queries: int) -> int:
    """Return the threads that serve so many queries."""
    return query_blocks(queries) * QUERY_BLOCK


@functools.lru_cache(512)
def query_kernel(kind: Kind, lanes: int = 1) -> Kernel:
    """Return the kernel that lists or counts, with so many `lanes_of_query`."""
    lanes = lanes if kind.lists else 1
    constants = {**GRID, "CROSSING": kind.periodic > 0, "LIST": kind.lists, "SUMS": 0, "QUERY_LANES": lanes, "PARTED": False}
    entry = Entry("Rows.run", QUERY_BLOCK, walking_blocks(kind), "Rows_of_tree")
    of_tree = kind.compiled()._replace(tree=True)
    return declare_kind(of_tree, f"tree_cuda_{lanes}l", "rows.cuh", entry, cuda=True, constants=constants)[0]
