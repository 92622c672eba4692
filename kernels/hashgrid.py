"""Neighbor search with `wp.HashGrid` as Warp ships it, made exact: one thread per query.

The grid is built from the positions as they are, and that loses no pair. It finds the cell of a coordinate by a product with the
inverse cell width, a floor and a clamp to 32 bits; each of these never decreases where the coordinate grows, and neither does
rounding. A source within the cutoff r of a query q lies, on each axis, between q - r and q + r and, being a float itself, between
fl(q - r) and fl(q + r). So its cell lies between the cells of those two: the very range that `hash_grid_query` walks. No bound on
rounding errors is needed, however far from the origin; and any cell width would do, the cutoff is merely a good one.

Cells are numbered modulo the grid's dimensions, so distant cells share a bucket: their particles are candidates that the exact
test rejects. A range longer than a dimension is cut to one round of it, so no bucket is met twice and no pair listed twice. (Warp
1.18 clamped all cells below -2^20 to one bucket, which a query out there met again and again: it cannot be used.)

The grid files NaN under cell 0 and infinities under the cells at either end, where the test of distances refuses them. Queries that
are not finite ask nothing, and sources that are not finite are strewn over the cells: padding would else crowd the one cell 0.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from jfrnn.kernels._native import program

_CELLS_PER_PARTICLE = 2  # at least, and less than twice that; 8 B each
_SMALLEST_BITS = 4  # per axis: 16 cells
_LARGEST_BITS = 24  # in all: 256^3 or 4096^2 cells


class Kernels(NamedTuple):
    """The kernels of a variant: `pack` is launched over the sources, `query` over the queries."""

    pack: wp.Kernel
    query: wp.Kernel


def grid_shape(sources: int, dim: int) -> tuple[int, int, int]:
    """Return the dimensions of the grid, powers of two: memory follows the particles."""
    bits = (_CELLS_PER_PARTICLE * sources - 1).bit_length()
    bits = min(max(bits, dim * _SMALLEST_BITS), _LARGEST_BITS)
    x, y, z = (2 ** ((bits + dim - 1 - axis) // dim) if axis < dim else 1 for axis in range(3))
    return x, y, z


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of the positions that `pack` writes; `width` is 1 for float32 and 2 for float64."""
    del queries, dim, own
    return 3 * width * sources


@functools.cache
def hashgrid_kernels(dim: int, double: bool, scaled: bool, lists: bool) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts alone."""
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_list' * lists}"
    module = wp.get_module(f"jfrnn.kernels.hashgrid.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False}, module)
    point_at = _point_function(dim, double)
    text = f"namespace {{\n{program(double, dim, 'hashgrid.h', SCALED=scaled)}\n}}\n"
    wp.set_module_options({"extra_build_options": wp.ModuleBuildOptions(extra_cpu_preamble=text, extra_cuda_preamble=text)}, module)
    is_pair = _exact_function(dim, double, scaled)
    return Kernels(
        wp.kernel(_pack_kernel(double, point_at), module=module),
        wp.kernel(_query_kernel(double, scaled, lists, point_at, is_pair), module=module),
    )


def _types(double: bool) -> tuple[Any, Any]:
    return (wp.float64, wp.vec3d) if double else (wp.float32, wp.vec3f)


def _named(function: Any, variant: str) -> Any:
    """Name a function after its variant: Warp tells functions apart by name."""
    function.__name__ = function.__qualname__ = f"{function.__name__}_{variant}"
    return function


@functools.cache
def _point_function(dim: int, double: bool) -> wp.Function:
    scalar, vector = _types(double)

    def point_at(points: wp.array2d(dtype=scalar), i: int):
        point = vector(points[i, 0], points[i, 1], scalar(0.0))
        if wp.static(dim == 3):
            point[2] = points[i, 2]
        return point

    return wp.func(_named(point_at, f"{dim}d_{'f64' if double else 'f32'}"))


class _Variant(NamedTuple):
    """Names a native function after its variant. Warp looks for its result type only where a decorator is called `func_native`."""

    name: str

    def func_native(self, text: str) -> Any:
        return lambda function: wp.func_native(text)(_named(function, self.name))


@functools.cache
def _exact_function(dim: int, double: bool, scaled: bool) -> wp.Function:
    scalar, vector = _types(double)
    variant = _Variant(f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}")

    @variant.func_native("return decide_pair(query, source, cutoff.data, closed);")
    def is_pair(query: vector, source: vector, cutoff: wp.array(dtype=scalar), closed: int) -> bool: ...

    return is_pair


def _pack_kernel(double: bool, point_at: wp.Function) -> Any:
    scalar, vector = _types(double)

    def pack(
        positions: wp.array2d(dtype=scalar),
        cutoff: wp.array(dtype=scalar),
        shape: wp.vec3i,
        packed_out: wp.array(dtype=vector),
        info_out: wp.array(dtype=wp.int32),
    ):
        """Copy the positions as vectors (launch: dim = n sources); 2 is or-ed to info_out[1] where one is not finite."""
        i = wp.tid()
        point = point_at(positions, i)
        if not wp.isfinite(point):
            wp.atomic_or(info_out, 1, 2)
            row = i // shape[0]
            cell = vector(scalar(i % shape[0]), scalar(row % shape[1]), scalar(row // shape[1]))
            point = cutoff[0] * cell
        packed_out[i] = point

    return pack


def _query_kernel(double: bool, scaled: bool, lists: bool, point_at: wp.Function, is_pair: wp.Function) -> Any:
    scalar, _ = _types(double)

    def query(
        grid: wp.uint64,
        positions: wp.array2d(dtype=scalar),
        queries: wp.array2d(dtype=scalar),
        cutoff: wp.array(dtype=scalar),
        inside: scalar,
        outside: scalar,
        unit_scale: scalar,
        own: int,
        closed: int,
        drop_self: int,
        later_only: int,
        idx_out: wp.array2d(dtype=wp.int32),
        count_out: wp.array(dtype=wp.int32),
        info_out: wp.array(dtype=wp.int32),
    ):
        """Fill the row of one query (launch: dim = m queries); info_out takes the longest row and the status bits atomically.

        `inside` and `outside` bound the squared distances, scaled by unit_scale squared, that are surely those of a pair or not.
        """
        i = wp.tid()
        if own != 0:
            i = wp.hash_grid_point_id(grid, i)  # neighboring threads read the same cells
        point = point_at(queries, i)
        found = wp.int32(0)
        if wp.isfinite(point):
            candidates = wp.hash_grid_query(grid, point, cutoff[0])
            j = wp.int32(0)
            while wp.hash_grid_query_next(candidates, j):
                if (drop_self != 0 and j == i) or (later_only != 0 and j < i):
                    continue
                source = point_at(positions, j)
                step = source - point
                if wp.static(scaled):
                    step = unit_scale * step
                square = wp.dot(step, step)
                pair = square < inside
                if not pair and square <= outside:
                    pair = is_pair(point, source, cutoff, closed)
                if pair:
                    if wp.static(lists) and found < idx_out.shape[1]:
                        idx_out[i, found] = j
                    found += 1
        else:
            wp.atomic_or(info_out, 1, 2)
        if wp.static(lists):
            for slot in range(found, idx_out.shape[1]):
                idx_out[i, slot] = positions.shape[0]
            if found > idx_out.shape[1]:
                wp.atomic_or(info_out, 1, 1)
        count_out[i] = found
        if found > info_out[0]:  # rarely true, and it spares an atomic operation
            wp.atomic_max(info_out, 0, found)

    return query
