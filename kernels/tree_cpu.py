"""Search on the CPU where cutoffs differ: in cells where they are alike, else in a tree of boxes around sources along a curve.

A sample decides which (`cutoffs_cpu.h`): cells find the candidates of queries in half the time, if what they hold beyond
what is near is not many times as much. Sources and queries are sorted by cell, or along a curve below the tree
(`tree_cpu.h`). Then threads hand themselves chunks of queries: those that follow each
other, and whose cutoffs are alike, find the cells (`cell_walk_cpu.h`) or the leaves (`tree_walk_cpu.h`) that are near
all of them, and meet their sources (`walk_cpu.h`). So time follows pairs and particles, whatever the spread of cutoffs is,
and whatever the density.
"""

import functools
import itertools

from jfrnn.kernels import cells_cpu
from jfrnn.kernels._native import Kind, declare_kind, place_parts
from jfrnn.kernels._program import Kernel

LEAF = 16  # sources of a leaf
FANOUT = 16  # nodes of a node
CLASS_BITS = 1  # of cutoffs that are alike, behind the leading one
# Queries of a group: a cube as wide as their cutoff is doubled along an axis where it holds fewer, halved where it holds more.
LEAST_TOGETHER, MOST_TOGETHER = 6, 32
MOST_DOUBLED, MOST_HALVED = 6, 9  # times
_MOST_LANES = 16


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool, systems: int = 0) -> int:
    """Return the int32 words of scratch that a sort and queries need, as `jfrnn.kernels.cells_cpu.scratch_words` does."""
    del own  # queries have an order of their own, by their cutoffs
    cells = cells_cpu.scratch_words(sources, queries, dim, width, own=False, systems=systems)
    nodes, count = 0, -(-sources // LEAF)
    for _ in itertools.repeat(None, 12):
        nodes += -(-count // FANOUT) * FANOUT
        if count <= FANOUT:
            break
        count = -(-count // FANOUT)
    parts = [width * (sources + _MOST_LANES), sources + _MOST_LANES, sources, width * queries]
    parts += [width * (nodes + _MOST_LANES)] * (2 * dim + 1)
    return cells + place_parts(parts)


PROVIDER = {"places_cpu.h": '#include "cutoffs_cpu.h"\n', "query_walk_cpu.h": '#include "cutoff_walk_cpu.h"\n'}  # in place of cells
# What is launched of many after the steps of a sort by cell, and whether threads share its work.
MORE = {"CutoffSort.choose": False, "CutoffSort.refine": True, "CutoffSort.end": False, "TreePlaces.gather": True}
TREE = {"LEAF": LEAF, "FANOUT": FANOUT, "CLASS_BITS": CLASS_BITS, "LEAST_TOGETHER": LEAST_TOGETHER}
TREE |= {"MOST_TOGETHER": MOST_TOGETHER, "MOST_DOUBLED": MOST_DOUBLED, "MOST_HALVED": MOST_HALVED}


def _constants(kind: Kind) -> dict[str, int]:
    lists = {"SUMS": 0, "LIST": kind.lists}
    return {**cells_cpu.GRID, **lists, **TREE, **cells_cpu.CHUNKS, "TOGETHER": cells_cpu.TOGETHER}


@functools.lru_cache(128)
def sort_kernels(kind: Kind) -> cells_cpu.SortKernels:
    """Return what sorts, as `jfrnn.kernels.cells_cpu.sort_kernels` does, and what goes on with a tree."""
    kind, constants = kind.only("scaled", "periodic", "batched", "rule"), _constants(kind)
    build, *more = declare_kind(kind, "sort_tree_cpu", "cutoffs_cpu.h", "CutoffSort.build", *MORE, constants=constants)
    names = (f"CutoffSort.{step}" for step in cells_cpu.STEPS)
    steps = declare_kind(kind, "sort_many_tree_cpu", "cutoffs_cpu.h", *names, constants=constants)
    return cells_cpu.SortKernels(build, tuple(steps), tuple(zip(more, MORE.values(), strict=True)))


@functools.lru_cache(512)
def query_kernel(kind: Kind) -> Kernel:
    """Return what lists or counts, whose work threads share."""
    constants = {**_constants(kind), "CANDIDATES": cells_cpu.CANDIDATES[kind.double]}
    return declare_kind(kind.compiled(), "tree_cpu", "rows_cpu.h", "Rows.run", given=PROVIDER, constants=constants)[0]
