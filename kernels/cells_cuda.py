"""Cell search on CUDA: seven to ten launches, no host synchronization, nothing allocated beside the scratch it is given.

bounds   lowest and highest coordinate per block
lay_out  every block reduces those bounds to the grid, and clears its part of what the others count in; where a box of all sources
         has too many cells, one without a few that are far from all others is taken, and these are sorted into its border
count    every particle counts itself in its cell
scan     counts to first places, in one pass (Merrill & Garland 2016, decoupled look-back)
scatter  indices into their cells, in the order in which they came
gather   positions into cell order, ranked by index within a cell: the same order in every run
long     where few queries have longer cutoffs than cells are made for, what is near these is marked, 32 places in a bit
query    a warp serves up to 32 neighboring queries, one per lane: candidates within reach of their box meet all of them, 32 in a
         block, float32 on tensor cores first; a neighbor is a bit, until the rows are written. Those that are far from each other
         it serves one after the other: where queries are few, they are shared among more warps
         Where cutoffs differ, but are alike: a row of tensor cores has a cutoff of its own, and up to four species theirs with each
         other; by other rules, candidates are met one by one, each with what is known of its cutoff beside its coordinates
crossing the same in a periodic box, for queries whose reach leaves it: images take registers, which the others have no use for
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import Kind, declare_kind, place_parts, table_cells
from jfrnn.kernels._program import Entry, Kernel

BLOCK = 256
QUERY_BLOCK = 32  # one warp: others need not wait for it to end
_PARTS = 256  # blocks of `bounds`; one thread of a block reads one part
_PART = 9  # numbers of a part
_LEFT_OUT = 16  # parts whose sources may lie outside of the box of cells on each side, where it would be too large else
_TILE = 2048  # cells that a block of `scan` takes
# How many warps few queries are shared among, at most. In which groups queries walk decides the order of rows and of sums, and the
# number of shares the size of buffers that are laid out when a program is traced, maybe on another machine. So this is a property
# of programs, not of the device: one with more or fewer multiprocessors runs as many warps, and gets the same bits. It is about 32
# per multiprocessor of large GPUs; half and twice as many took longer on one of 132.
_WARPS = 4096
MOST_LONG = 16  # queries whose cutoffs are longer than that for which cells are made: all sources are asked whether they are near
MOST_KINDS = 4  # species whose cutoffs tensor cores know; among more, a tree is searched
# what all kernels of a search must agree on
GRID = {
    "REACH": 1,
    "REACH_X": 6,
    "PARTS": _PARTS,
    "PART": _PART,
    "TILE": _TILE,
    "BLOCK": BLOCK,
    "WARPS": _WARPS,
    "MOST_KINDS": MOST_KINDS,
    "MOST_LONG": MOST_LONG,
    "LEFT_OUT": _LEFT_OUT,
}
# Of blocks with more queries than 2 to the first there are parts, among so many queries (`native/cells/shares.h`).
_PART_BITS, _MOST_PARTED = 2, 64 * _WARPS
HEADER_WORDS = 64  # of the scratch
# Blocks of kernels that walk in strides, per multiprocessor: no result depends on how many there are.
_SWEEP = 8  # over all particles
_CROSSING = 64  # over queries whose reach leaves a box: how many there are is known to the device only
_RESIDENT = 1  # over the cells
_GATHERING = (8, 6)  # of `gather`, in open space and in a box: all are at work at once


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of scratch that the kernels need; `width` is 1 for float32 and 2 for float64."""
    del dim
    table = table_cells(sources)
    tiles = 2 * ((table + 1) // _TILE + 1)
    longest = max(sources, queries)
    parts = [*_before_places(width), 4 * width * sources, table + 2, tiles, longest, longest, sources]
    if not own:
        parts += [table + 2, tiles, queries]
    return place_parts(parts)


def place_words(width: int) -> tuple[int, int, int]:
    """Return where sources in the order of cells begin in the scratch, how many words each has, and which one is its number."""
    return place_parts(_before_places(width)), 4 * width, 3 * width


def _before_places(width: int) -> list[int]:
    return [HEADER_WORDS, _PART * _PARTS * width]


class Launch(NamedTuple):
    """A kernel, its threads in all, and its last argument: whether it works on the queries.

    One that may run `beside` the launch before it needs nothing that this one computes.
    """

    kernel: Kernel
    threads: int
    of_queries: bool
    beside: bool = False


class Kernels(NamedTuple):
    """The kernels of a variant, all with the same arguments."""

    bounds: Kernel
    lay_out: Kernel
    count_cells: Kernel
    scan: Kernel
    scatter: Kernel
    gather: Kernel
    find_long: Kernel | None
    mark_long: Kernel | None
    query: Kernel
    crossing: Kernel | None

    def launches(self, n: int, m: int, own: bool, multiprocessors: int) -> list[Launch]:
        """Return what is launched, in order, for n sources and m queries, on a device of so many multiprocessors."""
        return self.stages(n, m, own, multiprocessors) + walks(self.query, self.crossing, m, own, multiprocessors)

    def stages(self, n: int, m: int, own: bool, multiprocessors: int) -> list[Launch]:
        """Return those that sort sources and queries by cell."""
        table, resident = table_cells(n), _RESIDENT * multiprocessors
        tiles = min((table + 1) // _TILE + 1, resident)
        clearing = min(-(-table // (8 * BLOCK)), resident) * BLOCK
        launches = [Launch(self.bounds, _PARTS * BLOCK, False), Launch(self.lay_out, clearing, False)]
        for of_queries in (False,) if own else (False, True):
            size = m if of_queries else n
            sweep = min(-(-size // BLOCK), _SWEEP * multiprocessors) * BLOCK
            launches += [
                Launch(self.count_cells, sweep, of_queries),
                Launch(self.scan, tiles * BLOCK, of_queries),
                Launch(self.scatter, sweep, of_queries),
            ]
            if not of_queries or self.crossing is not None:
                most = multiprocessors * _GATHERING[self.crossing is not None]
                launches.append(Launch(self.gather, min(-(-size // BLOCK), most) * BLOCK, of_queries))
        if self.find_long is not None and self.mark_long is not None:
            launches.append(Launch(self.find_long, min(-(-max(m, n // 1024) // BLOCK), _SWEEP * multiprocessors) * BLOCK, False))
            launches.append(Launch(self.mark_long, min(-(-n // BLOCK), _SWEEP * multiprocessors) * BLOCK, False))
        return launches


def share_bits(m: int) -> int:
    """Return the binary logarithm of how many of m queries a warp serves: fewer than 32 while warps are few."""
    return next((bits for bits in range(5) if _shares(m, bits) <= GRID["WARPS"]), 5)


def lanes_of_query(m: int) -> int:
    """Return how many lanes of a warp a query has once its pairs are known: several where a warp serves few."""
    return min(QUERY_BLOCK >> share_bits(m), 4)


def has_parts(m: int, own: bool) -> bool:
    """Say whether blocks of m queries that are scattered may be served in parts: where they are the sources, and not very many."""
    return own and share_bits(m) > _PART_BITS and m <= _MOST_PARTED


def query_blocks(m: int) -> int:
    """Return how many warps m queries are shared among."""
    return _shares(m, share_bits(m))


def _shares(m: int, bits: int) -> int:
    return -(-m >> bits)


def walks(query: Kernel, crossing: Kernel | None, m: int, own: bool, multiprocessors: int) -> list[Launch]:
    """Return the launches that walk over m queries: those whose reach leaves a periodic box have a kernel of their own.

    Where blocks `has_parts`, warps to spare serve parts of those that are scattered (`native/walk/walk.cuh`).
    """
    blocks = query_blocks(m)
    walk = Launch(query, (blocks // 8 * has_parts(m, own) + blocks) * QUERY_BLOCK, False, beside=crossing is not None)
    if crossing is None:
        return [walk]
    return [Launch(crossing, min(blocks, _CROSSING * multiprocessors) * QUERY_BLOCK, False), walk]  # first what takes longest


def walking_blocks(kind: Kind) -> int:
    """Return how many blocks that list or count share a multiprocessor: registers against occupancy, as cells on an H200 want."""
    return 24 if not kind.lists else 16 if kind.double else 20


@functools.lru_cache(512)
def cell_kernels(kind: Kind, lanes: int = 1, parted: bool = False) -> Kernels:
    """Return the kernels that sort by cell, and that list or count, with so many `lanes_of_query`; `parted`: it `has_parts`."""
    compiled, lanes = kind.compiled(), lanes if kind.lists else 1
    constants = {"LIST": kind.lists, "SUMS": 0, "QUERY_LANES": lanes, "PARTED": parted, **GRID}

    def query_kernel(name: str, crossing: bool = False) -> Kernel:
        entry = Entry("Rows.run", QUERY_BLOCK, walking_blocks(kind), "Rows_cross" * crossing)
        own = constants | {"CROSSING": crossing}
        called = f"{name}_cuda_{lanes}l{'_parted' * parted}"
        return declare_kind(compiled, called, "rows.cuh", entry, cuda=True, constants=own)[0]

    methods = ("find_bounds", "lay_out_grid", "count_cells", "scan_counts", "scatter_ids", "gather_places")
    stages = [Entry(f"Search.{method}", BLOCK) for method in methods]
    stages[-1] = stages[-1]._replace(blocks=_GATHERING[kind.periodic > 0])
    sorting = declare_kind(kind.only("periodic", "batched"), "cells_cuda", "cells.cuh", *stages, cuda=True, constants=GRID)
    bounds, lay_out, count, scan, scatter, gather = sorting
    find_long = mark_long = None
    if kind.long:
        steps = [Entry(f"LongQueries.{method}", BLOCK) for method in ("find", "mark")]
        of_rule = kind.only("scaled", "rule")
        find_long, mark_long = declare_kind(of_rule, "long_cuda", "long.cuh", *steps, cuda=True, constants=GRID)
    crossing = query_kernel("crossing", crossing=True) if kind.periodic else None
    return Kernels(bounds, lay_out, count, scan, scatter, gather, find_long, mark_long, query_kernel("query"), crossing)
