"""Cell search on the CPU: a serial counting sort, then queries on every core, 8 or 16 candidates at a time.

`build` sorts the sources (and the queries, if they are others) by cell. `gather` puts the coordinates of many sources into that
order: to read them from anywhere takes longer than all that `build` does. It and `query` are launched once per thread: the threads
hand themselves chunks of places from an atomic counter (see `jfrnn.kernels._walk_cpu`).
"""

import functools
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._native import CELLS, ENTER, EXACT, LEAVE, SPACES, snippet, table_cells
from jfrnn.kernels._text import read_part
from jfrnn.kernels._walk_cpu import CHUNK, walk

_HEADER_WORDS = 64
MANY = 1 << 15  # sources from which several threads gather their coordinates
GRID = {"REACH": 1, "REACH_X": 2}  # finer cells along x alone: fewer candidates, but no more rows of cells that are copied

# Where things lie in the scratch: one text, so that `build` and `query` agree; `scratch_words` below is its sum.
LAYOUT = read_part("cells_cpu.h", "layout")


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of scratch that `build` and `query` need; `width` is 1 for float32 and 2 for float64."""
    table = table_cells(sources)
    parts = [_HEADER_WORDS, *[width * sources] * dim, sources, table + 2, max(sources, queries)]
    if not own:
        parts += [queries, table + 2]
    return sum((words + 15) // 16 * 16 for words in parts)


_BUILD = read_part("cells_cpu.h", "build")

_GATHER = read_part("cells_cpu.h", "gather")

_BEGIN_ROWS = read_part("cells_cpu.h", "begin_rows")
_ADD_TO_ROW = read_part("cells_cpu.h", "add_to_row")
_NO_ROW = read_part("cells_cpu.h", "no_row")
_END_ROWS = read_part("cells_cpu.h", "end_rows")

_QUERY = walk(
    begin=_BEGIN_ROWS,
    meet="const int hits = later_only ? scan(q, id, filled, Later{}) : scan(q, id, filled, All{});",
    met=_ADD_TO_ROW,
    none=_NO_ROW,
    end=_END_ROWS,
)


class Kernels(NamedTuple):
    """The kernels of a variant, all launched with dim = 1: `gather`, for `MANY` sources, and `query` once per thread."""

    build: wp.Kernel
    gather: wp.Kernel
    query: wp.Kernel


@functools.cache
def cell_kernels(dim: int, double: bool, scaled: bool, lists: bool, periodic: int = 0, batched: bool = False) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts alone.

    `periodic` and `batched` are those of `jfrnn.kernels._native.snippet`.
    """
    scalar = wp.float64 if double else wp.float32
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_list' * lists}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}"
    options = {"SCALED": scaled, "LIST": lists, **GRID, "PERIODIC": periodic}
    options |= {"BATCHED": batched, "SUMS": 0, "CHUNK": CHUNK, "MANY": MANY}
    options |= {"CANDIDATES": 1024 if double else 1536}  # what fits into a first-level cache beside a row
    points = wp.array2d(dtype=scalar)
    reals, ints, rows = wp.array(dtype=scalar), wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)

    def build_native(
        positions: points, queries: points, cutoff: reals, info: ints, scratch: ints, n: int, m: int, own: int, table: int
    ): ...

    def gather_native(positions: points, cutoff: reals, scratch: ints, n: int, m: int, own: int, table: int): ...

    def query_native(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, later_only: int,
    ): ...  # fmt: skip

    for native in (build_native, gather_native, query_native):
        native.__name__ = native.__qualname__ = f"{native.__name__}_{variant}"
    native_text = functools.partial(snippet, "double" if double else "float", dim, CELLS, LAYOUT, **options)
    build_function = wp.func_native(ENTER + native_text(_BUILD) + LEAVE)(build_native)
    gather_function = wp.func_native(ENTER + native_text(_GATHER) + LEAVE)(gather_native)
    query_function = wp.func_native(ENTER + native_text(EXACT, _QUERY) + LEAVE)(query_native)

    def build(positions: points, queries: points, cutoff: reals, info: ints, scratch: ints, n: int, m: int, own: int, table: int):
        build_function(positions, queries, cutoff, info, scratch, n, m, own, table)

    def gather(positions: points, cutoff: reals, scratch: ints, n: int, m: int, own: int, table: int):
        gather_function(positions, cutoff, scratch, n, m, own, table)

    def query(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, later_only: int,
    ):  # fmt: skip
        query_function(
            positions, queries, cutoff, idx, count, info, scratch, n, m, own, table, capacity, closed, drop_self, later_only
        )

    module = wp.get_module(f"jfrnn.kernels.cells_cpu.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    return Kernels(*(wp.kernel(kernel, module=module) for kernel in (build, gather, query)))
