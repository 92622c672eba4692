"""Cell search on the CPU: a counting sort, then queries on every core, 8 or 16 candidates at a time.

`build` sorts few sources (and the queries, if they are others) by cell; many are sorted by all threads, in steps of their own
(`native/cells/cells_cpu.h`). Threads hand themselves chunks of particles, or of places, from an atomic counter.
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import Kind, declare_kind, place_parts, table_cells
from jfrnn.kernels._program import Kernel

CHUNK = 2048  # places that a thread takes at a time, where it puts them in order
QUERY_CHUNK = 256  # and where it serves queries
_HEADER_WORDS = 64
MANY = 1 << 15  # sources or queries from which several threads sort them
SORT_CHUNK = 4096  # of them, that a thread takes at a time
BUCKETS = 256  # of cells, into which they are dealt before each bucket is sorted
FEW = 160  # sources up to which all are candidates of all queries
ENTRIES = 16  # of the table, for each system with a box of its own, beyond those for its sources
TOGETHER = 12  # queries that cells of a row are served for at once
CANDIDATES = {False: 1536, True: 1024}  # by width: what fits into a first-level cache beside a row
STEPS = ("find_keys", "deal", "settle")  # in which many are sorted
GRID = {"FEW": FEW, "REACH": 1, "REACH_X": 2}  # finer cells along x alone: fewer candidates, but no more rows that are copied
CHUNKS = {"CHUNK": CHUNK, "QUERY_CHUNK": QUERY_CHUNK, "MANY": MANY, "SORT_CHUNK": SORT_CHUNK}


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool, systems: int = 0) -> int:
    """Return the int32 words of scratch that a sort and queries need.

    `width` is 1 for float32 and 2 for float64; `systems` is how many there are with boxes of their own.
    """
    table = table_cells(sources) + ENTRIES * systems
    most = max(sources, queries)
    parts = [_HEADER_WORDS, *[width * sources] * dim, sources, table + 2, most]
    parts += [(BUCKETS + 1) * -(-most // SORT_CHUNK)] * (most >= MANY)  # how many each chunk has for each bucket
    if not own:
        parts += [queries, table + 2, most, most]
    return place_parts(parts)


def grid_words(systems: int, width: int) -> int:
    """Return the int32 words in which `build` keeps the grids of systems with boxes of their own (SystemGrid)."""
    return systems * (6 * width + 10)


class SortKernels(NamedTuple):
    """What sorts: `build`; where there are many, `steps`, whose work threads share; then `more`, and whether threads share each."""

    build: Kernel
    steps: tuple[Kernel, ...]
    more: tuple[tuple[Kernel, bool], ...] = ()


@functools.lru_cache(128)
def sort_kernels(kind: Kind) -> SortKernels:
    """Return what sorts, in programs of their own: sums take no others, and rows, or steps for many, take long to compile."""
    kind, constants = kind.only("scaled", "periodic", "batched"), {**GRID, "SUMS": 0, "LIST": 0, **CHUNKS}
    build = declare_kind(kind, "sort_cpu", "cells_cpu.h", "Sort.build", constants=constants)[0]
    steps = declare_kind(kind, "sort_many_cpu", "cells_cpu.h", *(f"Sort.{step}" for step in STEPS), constants=constants)
    return SortKernels(build, tuple(steps))


@functools.lru_cache(512)
def query_kernel(kind: Kind) -> Kernel:
    """Return what lists or counts, whose work threads share."""
    constants = {**GRID, "SUMS": 0, "LIST": kind.lists, **CHUNKS, "TOGETHER": TOGETHER, "CANDIDATES": CANDIDATES[kind.double]}
    return declare_kind(kind.compiled(), "cells_cpu", "rows_cpu.h", "Rows.run", constants=constants)[0]
