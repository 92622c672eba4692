"""Triangles with Warp's kernels inside JAX, on the CPU and on CUDA: what they are given, and how they are launched.

They look for triangles in cells, which on CUDA are those of `jfrnn._triangles.cells`, or in the tree of `jfrnn._triangles.tree`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine import (
    Command,
    Kernel,
    WarpArray,
    WarpKernel,
    ask_for_huge_pages,
    kernel,
    kernels_of,
    load_warp,
    multiprocessors_of,
    on_every_core,
    on_one_core,
)
from jfrnn._engine import on_cpu as launch_on_cpu
from jfrnn._engine import on_cuda as launch_on_cuda
from jfrnn._geometry import Cutoff
from jfrnn._triangles.cells import LANES, MOST_CELLS, TriangleCells, bucket_count, entry_count, level_limit
from jfrnn._triangles.cells import sort_triangles as sort_by_jax
from jfrnn._triangles.rows import decide_pairs as decide_by_jax
from jfrnn._triangles.tree import WIDTH, TriangleTree, boxes_around, level_starts

TriangleKernels = Any  # what `triangle_kernels` of a module of `jfrnn.kernels` returns

_LONGEST_VECTOR = 16
_PARTICLES_PER_THREAD = 1024  # below, a second thread costs more than it saves


class _Variant(NamedTuple):
    """All that is static about a call, apart from shapes."""

    dim: int
    double: bool
    lists: bool
    tree: bool = False


def sort_triangles(corners: Array, good: Array, cutoff: Cutoff) -> TriangleCells:
    """Sort triangles [f, corner, axis] with f > 0 into cells, as `jfrnn._triangles.cells.sort_triangles` does."""
    faces, dim = corners.shape[:2]
    sizes = {"start": bucket_count(faces) + 1, "triangles": entry_count(faces, dim), "levels": level_limit(np.dtype(corners.dtype))}
    sizes |= {"level_count": 1, "level_of": faces, "scratch": max(entry_count(faces, dim), 2048)}

    def build(corners: Array, good: Array, cutoff: Cutoff) -> TriangleCells:
        radius = jnp.reshape(jnp.asarray(cutoff.radius), 1)
        call = _build_callable(_Variant(dim, corners.dtype == jnp.float64, lists=True))
        start, triangles, levels, level_count, level_of, _ = call(corners, good.astype(jnp.int32), radius, output_dims=sizes)
        return TriangleCells(start, triangles, levels, level_count[0], level_of)

    return lax.platform_dependent(corners, good, cutoff, cpu=build, cuda=sort_by_jax)


def list_triangles(
    positions: Array, corners: Array, cells: TriangleCells | TriangleTree, cutoff: Cutoff, capacity: int | None
) -> tuple[Array, Array]:
    """List the triangles near every particle, as `jfrnn._triangles.rows.list_triangles` does."""
    tree = isinstance(cells, TriangleTree)
    variant = _Variant(positions.shape[1], positions.dtype == jnp.float64, capacity is not None, tree)
    on_cpu, on_cuda = (functools.partial(call, variant, capacity or 0) for call in (_query_on_cpu, _query_on_cuda))
    return lax.platform_dependent(*query_inputs(positions, corners, cells, cutoff), cpu=on_cpu, cuda=on_cuda)


def query_inputs(positions: Array, corners: Array, cells: TriangleCells | TriangleTree, cutoff: Cutoff) -> tuple[Array, ...]:
    """Return what a query is given: beside these arrays the boxes of triangles, [f, 2 d], that hold all particles near them.

    A tree has boxes, [2 d, entries], and in place of the buckets' first entries those of its levels; it knows no sizes of cells.
    """
    radius = jnp.reshape(jnp.asarray(cutoff.radius), 1)
    if isinstance(cells, TriangleTree):
        starts, none = jnp.asarray(level_starts(len(corners))), jnp.zeros(1, jnp.int32)
        return positions, corners, cells.boxes, radius, starts, cells.triangles, none, none, none
    boxes = jnp.concatenate(boxes_around(corners, cutoff), axis=1)
    return positions, corners, boxes, radius, *cells._replace(level_count=jnp.reshape(cells.level_count, 1))


def _query_on_cpu(variant: _Variant, slots: int, *inputs: Array) -> tuple[Array, Array]:
    positions, corners, boxes, radius, start, triangles, *of_cells = inputs
    if not variant.tree:
        entries = jnp.pad(triangles, (0, _LONGEST_VECTOR), constant_values=corners.shape[0])  # vectors reach over the end
        boxes = boxes.T.at[:, entries].get(mode="fill", fill_value=jnp.inf)  # side by side, as a bucket holds them
    sizes = {"idx": (len(positions), max(slots, 1)), "count": len(positions), "info": 4}
    query = _query_callable(variant)
    idx, count, _ = query(positions, corners, boxes, radius, start, triangles, *of_cells, output_dims=sizes)
    return idx[:, :slots], count


def _query_on_cuda(variant: _Variant, slots: int, *inputs: Array) -> tuple[Array, Array]:
    n, dim = inputs[0].shape
    words = kernels_of("triangles_cuda").scratch_words(n, *sizes_on_cuda(variant, inputs), dim, variant.double)
    sizes = {"idx": (n, slots) if variant.lists else (1, 1), "count": n, "scratch": words}
    idx, count, _ = _cuda_callable(variant)(*inputs, output_dims=sizes)
    return idx if variant.lists else jnp.zeros((n, 0), jnp.int32), count


def sizes_on_cuda(variant: _Variant, inputs: Sequence[Any]) -> tuple[int, int]:
    """Return the number of buckets, into which particles are sorted, and of entries."""
    if variant.tree:
        return bucket_count(inputs[1].shape[0]), inputs[2].shape[1]
    return inputs[4].shape[0] - 1, inputs[5].shape[0]


def _name(name: str, variant: _Variant) -> str:
    options = "_list" * variant.lists + "_tree" * variant.tree
    return f"jfrnn_triangles_{name}_{variant.dim}d_{'f64' if variant.double else 'f32'}{options}"


def _kernels(variant: _Variant) -> TriangleKernels:
    return kernels_of("triangles_cpu").triangle_kernels(*variant, MOST_CELLS[variant.dim], LANES[variant.dim], WIDTH)


@kernel
def _build_callable(variant: _Variant) -> Kernel:
    wp = load_warp()
    scalar, ints = wp.float64 if variant.double else wp.float32, wp.array(dtype=wp.int32)
    types = {"corners": wp.array3d(dtype=scalar), "good": ints, "cutoff": wp.array(dtype=scalar), "start": ints, "triangles": ints}
    types |= {"levels": ints, "level_count": ints, "level_of": ints, "scratch": ints}

    def run(*arrays: WarpArray) -> None:
        named = dict(zip(types, arrays, strict=True))
        sizes = [named["corners"].shape[0], named["start"].shape[0] - 1]
        on_one_core(_kernels(variant).build, [*arrays, *sizes])

    return launch_on_cpu(_name("build", variant), run, types, 6)


def _query_types(variant: _Variant) -> dict[str, Any]:
    """Return Warp's types of what a query is given, and of what it returns, but for its last output."""
    wp = load_warp()
    scalar, ints = wp.float64 if variant.double else wp.float32, wp.array(dtype=wp.int32)
    points = wp.array2d(dtype=scalar)
    types = {"positions": points, "corners": wp.array3d(dtype=scalar), "boxes": points, "cutoff": wp.array(dtype=scalar)}
    types |= {"start": ints, "triangles": ints, "levels": ints, "level_count": ints, "level_of": ints}
    return types | {"idx": wp.array2d(dtype=wp.int32), "count": ints}


@kernel
def _query_callable(variant: _Variant) -> Kernel:
    wp = load_warp()
    types = _query_types(variant) | {"info": wp.array(dtype=wp.int32)}

    def run(*arrays: WarpArray) -> None:
        named = dict(zip(types, arrays, strict=True))
        n, capacity = named["positions"].shape[0], named["idx"].shape[1]
        sizes = [n, named["corners"].shape[0], named["start"].shape[0] - 1, capacity, named["boxes"].shape[1]]
        named["info"].numpy()[:] = 0
        ask_for_huge_pages(named["idx"].ptr, 4 * n * capacity)
        on_every_core(_kernels(variant).query, [*arrays, *sizes], -(-n // _PARTICLES_PER_THREAD))

    return launch_on_cpu(_name("query", variant), run, types, 3)


@kernel
def _cuda_callable(variant: _Variant) -> Kernel:
    wp = load_warp()
    if wp.is_cuda_available():
        _cuda_kernels(variant).load(wp.get_cuda_device())
    types = _query_types(variant) | {"scratch": wp.array(dtype=wp.int32)}
    return launch_on_cuda(_name("cuda", variant), types, 3, functools.partial(_commands, variant))


def _cuda_kernels(variant: _Variant) -> TriangleKernels:
    return kernels_of("triangles_cuda").triangle_kernels(*variant, WIDTH)


def _commands(variant: _Variant, *arrays: WarpArray) -> list[Command]:
    (n, _), faces, capacity = arrays[0].shape, arrays[1].shape[0], arrays[9].shape[1]
    sizes, workers = sizes_on_cuda(variant, arrays), kernels_of("triangles_cuda").workers_for(n, variant.double)
    launches = _cuda_kernels(variant).launches(n, *sizes, capacity, variant.double, multiprocessors_of(arrays[0]))
    arguments = [*arrays, n, faces, *sizes, capacity, workers]
    return [Command(x.kernel, [*arguments, x.threads], x.threads, x.block, x.beside) for x in launches]


def cast_rays(
    tree: TriangleTree, corners: Array, points: Array, rays: Array, asked: Array, least: Array, cutoff: Cutoff
) -> tuple[Array, Array]:
    """Say which points are inside and which no ray tells, as `jfrnn._triangles.winding.cast_rays` does, in float64."""
    radius, starts = jnp.reshape(jnp.asarray(cutoff.radius), 1), jnp.asarray(level_starts(len(corners)))
    inputs = points, corners, tree.boxes, radius, rays, starts, tree.triangles, asked.astype(jnp.int32), jnp.reshape(least, 1)

    def call(of: Callable[[int, bool], Callable[..., Sequence[Array]]], *given: Array) -> Array:
        return of(points.shape[1], bool(points.dtype == jnp.float64))(*given, output_dims={"side": len(points), "info": 1})[0]

    on_cpu, on_cuda = (functools.partial(call, of) for of in (_rays_on_cpu, _rays_on_cuda))
    side = lax.platform_dependent(*inputs, cpu=on_cpu, cuda=on_cuda)
    return side == 1, side == 2


def decide_pairs(own: Array, corners: Array, particle: Array, triangle: Array, cutoff: Cutoff, asked: Array) -> Array:
    """Decide which particles are near which triangles: [q] bool, as `jfrnn._triangles.rows.decide_pairs` does.

    On the CPU by a kernel, whose integers XLA would compile anew, for seconds, wherever pairs are decided.
    """
    radius = jnp.reshape(jnp.asarray(cutoff.radius), 1)

    def on_cpu(own: Array, corners: Array, particle: Array, triangle: Array, asked: Array) -> Array:
        call = _pairs_on_cpu(own.shape[1], bool(own.dtype == jnp.float64))
        sizes = {"near": len(particle), "info": 1}
        return call(own, corners, radius, particle, triangle, asked.astype(jnp.int32), output_dims=sizes)[0] > 0

    def elsewhere(own: Array, corners: Array, particle: Array, triangle: Array, asked: Array) -> Array:
        return decide_by_jax(own, corners, particle, triangle, cutoff, asked)

    return lax.platform_dependent(own, corners, particle, triangle, asked, cpu=on_cpu, default=elsewhere)


@kernel
def _pairs_on_cpu(dim: int, double: bool) -> Kernel:
    wp = load_warp()
    scalar, ints = wp.float64 if double else wp.float32, wp.array(dtype=wp.int32)
    types = {"positions": wp.array2d(dtype=scalar), "corners": wp.array3d(dtype=scalar), "cutoff": wp.array(dtype=scalar)}
    types |= {"particle": ints, "triangle": ints, "asked": ints, "near": ints, "info": ints}

    def run(*arrays: WarpArray) -> None:
        arrays[-1].numpy()[:] = 0
        kernels, n = kernels_of("triangle_pairs_cpu"), arrays[3].shape[0]
        on_every_core(kernels.pairs_kernel(dim, double), [*arrays, n], -(-n // kernels.CHUNK))

    return launch_on_cpu(f"jfrnn_triangle_pairs_{dim}d_{'f64' if double else 'f32'}", run, types, 2)


def _ray_types(double: bool) -> dict[str, Any]:
    wp = load_warp()
    scalar, ints = wp.float64 if double else wp.float32, wp.array(dtype=wp.int32)
    points = wp.array2d(dtype=scalar)
    types = {"positions": points, "corners": wp.array3d(dtype=scalar), "boxes": points, "cutoff": wp.array(dtype=scalar)}
    types |= {"rays": points, "start": ints, "triangles": ints, "asked": ints, "least": ints}
    return types | {"side": ints, "info": ints}


def _ray_sizes(arrays: Sequence[Any]) -> list[int]:
    """Return the numbers of points, of levels and of entries."""
    return [arrays[0].shape[0], arrays[5].shape[0] - 1, arrays[2].shape[1]]


def _ray_kernel(dim: int, double: bool, cuda: bool) -> WarpKernel:
    return kernels_of("winding").side_kernel(dim, double, WIDTH, cuda)


def _ray_name(dim: int, double: bool, where: str) -> str:
    return f"jfrnn_winding_{where}_{dim}d_{'f64' if double else 'f32'}"


@kernel
def _rays_on_cpu(dim: int, double: bool) -> Kernel:
    def run(*arrays: WarpArray) -> None:
        arrays[-1].numpy()[:] = 0
        sizes = _ray_sizes(arrays)
        most = -(-sizes[0] // kernels_of("winding").CHUNK)
        on_every_core(_ray_kernel(dim, double, cuda=False), [*arrays, *sizes], most)

    return launch_on_cpu(_ray_name(dim, double, "cpu"), run, _ray_types(double), 2)


@kernel
def _rays_on_cuda(dim: int, double: bool) -> Kernel:
    wp, block = load_warp(), kernels_of("winding").BLOCK
    if wp.is_cuda_available():
        kernels_of("_load").load_module(_ray_kernel(dim, double, cuda=True).module, wp.get_cuda_device(), block)

    def commands(*arrays: WarpArray) -> list[Command]:
        sizes = _ray_sizes(arrays)
        return [Command(_ray_kernel(dim, double, cuda=True), [*arrays, *sizes], -(-sizes[0] // block) * block, block)]

    return launch_on_cuda(_ray_name(dim, double, "cuda"), _ray_types(double), 2, commands)
