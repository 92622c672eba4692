"""Cell search on the CPU: a serial counting sort, then queries on every core, 8 or 16 candidates at a time.

`build` sorts the sources (and the queries, if they are others) by cell. `gather` puts the coordinates of many sources into that
order: to read them from anywhere takes longer than all that `build` does. Threads that run it or `query` hand
themselves chunks of places from an atomic counter (see `native/walk_cpu.h`).
"""

import functools

from jfrnn.kernels._native import BATCHES, SPACES, place_parts, program, table_cells
from jfrnn.kernels._program import Kernel, declare

CHUNK = 2048  # places that a thread takes at a time, where it puts them in order
QUERY_CHUNK = 256  # and where it serves queries
_HEADER_WORDS = 64
MANY = 1 << 15  # sources from which several threads gather their coordinates
FEW = 160  # sources up to which all are candidates of all queries
ENTRIES = 16  # of the table, for each system with a box of its own, beyond those for its sources
TOGETHER = 12  # queries that cells of a row are served for at once
GRID = {
    "FEW": FEW,
    "REACH": 1,
    "REACH_X": 2,
}  # finer cells along x alone: fewer candidates, but no more rows of cells that are copied


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool, systems: int = 0) -> int:
    """Return the int32 words of scratch that `build` and `query` need.

    `width` is 1 for float32 and 2 for float64; `systems` is how many there are with boxes of their own.
    """
    table = table_cells(sources) + ENTRIES * systems
    parts = [_HEADER_WORDS, *[width * sources] * dim, sources, table + 2, max(sources, queries)]
    if not own:
        parts += [queries, table + 2]
    return place_parts(parts)


def grid_words(systems: int, width: int) -> int:
    """Return the int32 words in which `build` keeps the grids of systems with boxes of their own (SystemGrid)."""
    return systems * (6 * width + 8)


@functools.lru_cache(128)
def sort_kernels(dim: int, double: bool, scaled: bool, periodic: int = 0, batched: int = 0) -> tuple[Kernel, Kernel]:
    """Return what sorts: `build`, and `gather`, which is for `MANY` sources and more, and whose work threads share.

    They are a program of their own: sums take no others, and to compile rows takes long.
    """
    text = program(double, dim, "cells_cpu.h", **_options(scaled, periodic, batched))
    build, gather = declare(f"sort_cpu_{_variant(dim, double, scaled, periodic, batched)}", text, "Sort.build", "Sort.gather")
    return build, gather


@functools.lru_cache(512)
def query_kernel(
    dim: int, double: bool, scaled: bool, lists: bool, periodic: int = 0, batched: int = 0, excluding: int = 0,
    flat: bool = False,
) -> Kernel:  # fmt: skip
    """Return what lists or counts, whose work threads share.

    It is for a dimension and dtype, and for cutoffs that need scaling or not; the other options are those of
    `jfrnn.kernels._native.program`.
    """
    options = {**_options(scaled, periodic, batched), "LIST": lists, "FLAT": flat, "EXCLUDING": excluding}
    options |= {"TOGETHER": TOGETHER, "CANDIDATES": 1024 if double else 1536}  # what fits into a first-level cache beside a row
    variant = f"{_variant(dim, double, scaled, periodic, batched)}{'_list' * lists}{'_flat' * flat}{'_excluding' * excluding}"
    return declare(f"cells_cpu_{variant}", program(double, dim, "rows_cpu.h", **options), "Rows.run")[0]


def _variant(dim: int, double: bool, scaled: bool, periodic: int, batched: int) -> str:
    return f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{SPACES[periodic]}{BATCHES[batched]}"


def _options(scaled: bool, periodic: int, batched: int) -> dict[str, int]:
    options = {"SCALED": scaled, **GRID, "PERIODIC": periodic, "BATCHED": batched, "SUMS": 0, "LIST": 0}
    return options | {"CHUNK": CHUNK, "QUERY_CHUNK": QUERY_CHUNK, "MANY": MANY}
