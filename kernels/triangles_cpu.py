"""Triangles on the CPU: `build` sorts them into cells, one by one; `query` lists those near each particle, on every core.

`query` looks for them in the cells, or in a tree of boxes (`jfrnn/_triangles_tree.py`); what it finds is decided by the same text.

`query` is launched once per thread: the threads hand themselves chunks of particles from an atomic counter.
"""

import functools
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._native import bind, program
from jfrnn.kernels._triangles import constants, pending

CHUNK = 1024  # particles that a thread takes at a time


class Kernels(NamedTuple):
    """The two kernels of a variant, both launched with dim = 1 (`query` once per thread); a tree is built by XLA."""

    build: wp.Kernel | None
    query: wp.Kernel


@functools.cache
def triangle_kernels(dim: int, double: bool, lists: bool, tree: bool, most_cells: int, lanes: int, node: int) -> Kernels:
    """Return the kernels for a dimension and dtype, for lists or counts alone, in cells or in a tree.

    `most_cells` and `lanes` are those of the cells, `node` is the number of children in the tree.
    """
    scalar = wp.float64 if double else wp.float32
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_list' * lists}{'_tree' * tree}"
    options = {"LIST": lists, "MOST_CELLS": most_cells, "MOST_ALONG": lanes, "CHUNK": CHUNK}
    options |= {"MOST_ALONG_LOG2": lanes.bit_length() - 1, "NODE": node, "PENDING": pending(node), "TREE": tree}
    options |= constants(dim, double, stride=1)
    reals, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    points, rows, shapes = wp.array2d(dtype=scalar), wp.array2d(dtype=wp.int32), wp.array3d(dtype=scalar)

    def build_native(
        corners: shapes, good: ints, cutoff: reals, start: ints, triangles: ints, levels: ints, level_count: ints, level_of: ints,
        scratch: ints, f: int, buckets: int,
    ): ...  # fmt: skip

    def query_native(
        positions: points, corners: shapes, boxes: points, cutoff: reals, start: ints, triangles: ints, levels: ints,
        level_count: ints, level_of: ints, idx: rows, count: ints, info: ints, n: int, f: int, buckets: int, capacity: int,
        stride: int,
    ): ...  # fmt: skip

    for native in (build_native, query_native):
        native.__name__ = native.__qualname__ = f"triangles_{native.__name__}_{variant}"
    module = wp.get_module(f"jfrnn.kernels.triangles_cpu.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    text = program(double, dim, "triangles_cpu.h", **options)
    build_function = bind(build_native, module, "TriangleSort.build", text)
    query_function = bind(query_native, module, "TriangleRows.run", text)

    def build(
        corners: shapes, good: ints, cutoff: reals, start: ints, triangles: ints, levels: ints, level_count: ints, level_of: ints,
        scratch: ints, f: int, buckets: int,
    ):  # fmt: skip
        build_function(corners, good, cutoff, start, triangles, levels, level_count, level_of, scratch, f, buckets)

    def query(
        positions: points, corners: shapes, boxes: points, cutoff: reals, start: ints, triangles: ints, levels: ints,
        level_count: ints, level_of: ints, idx: rows, count: ints, info: ints, n: int, f: int, buckets: int, capacity: int,
        stride: int,
    ):  # fmt: skip
        query_function(
            positions,
            corners,
            boxes,
            cutoff,
            start,
            triangles,
            levels,
            level_count,
            level_of,
            idx,
            count,
            info,
            n,
            f,
            buckets,
            capacity,
            stride,
        )

    return Kernels(None if tree else wp.kernel(build, module=module), wp.kernel(query, module=module))
