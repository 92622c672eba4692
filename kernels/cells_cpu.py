"""Cell search on the CPU: a serial counting sort, then queries on every core, 8 or 16 candidates at a time.

`build` sorts the sources (and the queries, if they are others) by cell. `gather` puts the coordinates of many sources into that
order: to read them from anywhere takes longer than all that `build` does. Threads that run it or `query` hand
themselves chunks of places from an atomic counter (see `native/walk_cpu.h`).
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import SPACES, program, table_cells
from jfrnn.kernels._program import Kernel, declare

CHUNK = 2048  # places that a thread takes at a time, where it puts them in order
QUERY_CHUNK = 256  # and where it serves queries
_HEADER_WORDS = 64
MANY = 1 << 15  # sources from which several threads gather their coordinates
FEW = 160  # sources up to which all are candidates of all queries
TOGETHER = 12  # queries that cells of a row are served for at once
GRID = {
    "FEW": FEW,
    "REACH": 1,
    "REACH_X": 2,
}  # finer cells along x alone: fewer candidates, but no more rows of cells that are copied


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of scratch that `build` and `query` need; `width` is 1 for float32 and 2 for float64."""
    table = table_cells(sources)
    parts = [_HEADER_WORDS, *[width * sources] * dim, sources, table + 2, max(sources, queries)]
    if not own:
        parts += [queries, table + 2]
    return sum((words + 15) // 16 * 16 for words in parts)


class Kernels(NamedTuple):
    """The kernels of a variant, `gather` (of `MANY` sources and more) and `query` share their work among threads."""

    build: Kernel
    gather: Kernel
    query: Kernel


@functools.lru_cache(512)
def cell_kernels(
    dim: int,
    double: bool,
    scaled: bool,
    lists: bool,
    periodic: int = 0,
    batched: bool = False,
    excluding: bool = False,
    flat: bool = False,
) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts alone.

    `periodic`, `batched`, `excluding` and `flat` are those of `jfrnn.kernels._native.program`.
    """
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_list' * lists}{'_flat' * flat}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}{'_excluding' * excluding}"
    options = {"SCALED": scaled, "LIST": lists, "FLAT": flat, **GRID, "PERIODIC": periodic}
    options |= {"BATCHED": batched, "EXCLUDING": excluding, "SUMS": 0, "CHUNK": CHUNK, "QUERY_CHUNK": QUERY_CHUNK, "MANY": MANY}
    options |= {"TOGETHER": TOGETHER, "CANDIDATES": 1024 if double else 1536}  # what fits into a first-level cache beside a row
    text = program(double, dim, "rows_cpu.h", **options)
    return Kernels(*declare(f"cells_cpu_{variant}", text, "Sort.build", "Gather.gather", "Rows.run"))
