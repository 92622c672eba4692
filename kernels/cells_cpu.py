"""Cell search on the CPU: a serial counting sort, then queries on every core, 8 or 16 candidates at a time.

`build` sorts the sources (and the queries, if they are others) by cell. `gather` puts the coordinates of many sources into that
order: to read them from anywhere takes longer than all that `build` does. It and `query` are launched once per thread: the threads
hand themselves chunks of places from an atomic counter (see `native/walk_cpu.h`).
"""

import functools
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._native import SPACES, bind, program, table_cells

CHUNK = 2048  # places that a thread takes at a time
_HEADER_WORDS = 64
MANY = 1 << 15  # sources from which several threads gather their coordinates
GRID = {"REACH": 1, "REACH_X": 2}  # finer cells along x alone: fewer candidates, but no more rows of cells that are copied


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of scratch that `build` and `query` need; `width` is 1 for float32 and 2 for float64."""
    table = table_cells(sources)
    parts = [_HEADER_WORDS, *[width * sources] * dim, sources, table + 2, max(sources, queries)]
    if not own:
        parts += [queries, table + 2]
    return sum((words + 15) // 16 * 16 for words in parts)


class Kernels(NamedTuple):
    """The kernels of a variant, all launched with dim = 1: `gather`, for `MANY` sources, and `query` once per thread."""

    build: wp.Kernel
    gather: wp.Kernel
    query: wp.Kernel


@functools.cache
def cell_kernels(dim: int, double: bool, scaled: bool, lists: bool, periodic: int = 0, batched: bool = False) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts alone.

    `periodic` and `batched` are those of `jfrnn.kernels._native.program`.
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
    module = wp.get_module(f"jfrnn.kernels.cells_cpu.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    text = program(double, dim, "rows_cpu.h", **options)
    build_function = bind(build_native, module, "Sort.build", text)
    gather_function = bind(gather_native, module, "Gather.gather", text)
    query_function = bind(query_native, module, "Rows.run", text)

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

    return Kernels(*(wp.kernel(kernel, module=module) for kernel in (build, gather, query)))
