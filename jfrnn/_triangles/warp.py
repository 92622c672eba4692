"""Triangles with Warp's kernels inside JAX, on the CPU and on CUDA: what they are given, and how they are launched.

They look for triangles in cells, which on CUDA are those of `jfrnn._triangles.cells`, or in the tree of `jfrnn._triangles.tree`.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine import Call, Clear, Launch, Plan, Shapes, ask_for_huge_pages, kernel, share
from jfrnn._geometry import Cutoff
from jfrnn._tracing import on_platform
from jfrnn._triangles.cells import LANES, MOST_CELLS, TriangleCells, bucket_count, entry_count, level_limit
from jfrnn._triangles.cells import sort_triangles as sort_by_jax
from jfrnn._triangles.rows import decide_pairs as decide_by_jax
from jfrnn._triangles.tree import WIDTH, TriangleTree, boxes_around, level_starts
from jfrnn.kernels import triangles, triangles_cuda

_LONGEST_VECTOR = 16
_PARTICLES_PER_THREAD = 1024  # below, a second thread costs more than it saves


Shape = tuple[int, ...]


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

    return on_platform(corners, good, cutoff, cpu=build, cuda=sort_by_jax)


def list_triangles(
    positions: Array, corners: Array, cells: TriangleCells | TriangleTree, cutoff: Cutoff, capacity: int | None
) -> tuple[Array, Array]:
    """List the triangles near every particle, as `jfrnn._triangles.rows.list_triangles` does."""
    tree = isinstance(cells, TriangleTree)
    variant = _Variant(positions.shape[1], positions.dtype == jnp.float64, capacity is not None, tree)
    on_cpu, on_cuda = (functools.partial(call, variant, capacity or 0) for call in (_query_on_cpu, _query_on_cuda))
    return on_platform(*query_inputs(positions, corners, cells, cutoff), cpu=on_cpu, cuda=on_cuda)


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
    words = triangles_cuda.scratch_words(n, *sizes_on_cuda(variant, *(inputs[k].shape for k in (1, 2, 4, 5))), dim, variant.double)
    sizes = {"idx": (n, slots) if variant.lists else (1, 1), "count": n, "scratch": words}
    idx, count, _ = _cuda_callable(variant)(*inputs, output_dims=sizes)
    return idx if variant.lists else jnp.zeros((n, 0), jnp.int32), count


def sizes_on_cuda(variant: _Variant, corners: Shape, boxes: Shape, start: Shape, triangles: Shape) -> tuple[int, int]:
    """Return the number of buckets, into which particles are sorted, and of entries; given shapes of what a query is given."""
    return (bucket_count(corners[0]), boxes[1]) if variant.tree else (start[0] - 1, triangles[0])


def _name(name: str, variant: _Variant) -> str:
    options = "_list" * variant.lists + "_tree" * variant.tree
    return f"jfrnn_triangles_{name}_{variant.dim}d_{'f64' if variant.double else 'f32'}{options}"


def _kernels(variant: _Variant) -> triangles.Kernels:
    return triangles.triangle_kernels(*variant, MOST_CELLS[variant.dim], LANES[variant.dim], WIDTH)


_CELLS = ("start", "triangles", "levels", "level_count", "level_of")
_GIVEN = ("positions", "corners", "boxes", "cutoff", *_CELLS)  # those of `query_inputs`


@kernel
def _build_callable(variant: _Variant) -> Call:
    def plan(shapes: Shapes, multiprocessors: int) -> Plan:
        return Plan([Launch(_kernels(variant).build)], {"f": shapes["corners"][0], "buckets": shapes["start"][0] - 1})

    return Call(_name("build", variant), ("corners", "good", "cutoff"), dict.fromkeys((*_CELLS, "scratch"), np.int32), plan)


@kernel
def _query_callable(variant: _Variant) -> Call:
    def plan(shapes: Shapes, multiprocessors: int) -> Plan:
        n, capacity = shapes["idx"]
        numbers = {"n": n, "f": shapes["corners"][0], "buckets": shapes["start"][0] - 1, "capacity": capacity}
        query = share(_kernels(variant).query, n, _PARTICLES_PER_THREAD)
        rows = ask_for_huge_pages("idx", 4 * n * capacity)
        return Plan([Clear("info", 16), *rows, query], numbers | {"stride": shapes["boxes"][1]})

    return Call(_name("query", variant), _GIVEN, dict.fromkeys(("idx", "count", "info"), np.int32), plan)


@kernel
def _cuda_callable(variant: _Variant) -> Call:
    plan = functools.partial(plan_on_cuda, variant)
    return Call(_name("cuda", variant), _GIVEN, dict.fromkeys(("idx", "count", "scratch"), np.int32), plan)


def plan_on_cuda(variant: _Variant, shapes: Shapes, multiprocessors: int) -> Plan:
    """Return what is launched on CUDA."""
    n, capacity = shapes["positions"][0], shapes["idx"][1] if variant.lists else 0
    buckets, entries = sizes_on_cuda(variant, *(shapes[name] for name in ("corners", "boxes", "start", "triangles")))
    kernels = triangles_cuda.triangle_kernels(*variant, WIDTH)
    numbers = {"n": n, "f": shapes["corners"][0], "buckets": buckets, "entries": entries, "capacity": capacity}
    numbers |= {"workers": triangles_cuda.workers_for(n, variant.double), "first_thread": 0}
    launches = kernels.threads(n, buckets, entries, capacity, variant.double, multiprocessors)
    return Plan([Launch(x, threads, {"threads": threads}, x == kernels.fill) for x, threads in launches], numbers)


def cast_rays(
    tree: TriangleTree, corners: Array, points: Array, rays: Array, asked: Array, least: Array, cutoff: Cutoff
) -> tuple[Array, Array]:
    """Say which points are inside and which no ray tells, as `jfrnn._triangles.winding.cast_rays` does, in float64."""
    radius, starts = jnp.reshape(jnp.asarray(cutoff.radius), 1), jnp.asarray(level_starts(len(corners)))
    inputs = points, corners, tree.boxes, radius, rays, starts, tree.triangles, asked.astype(jnp.int32), jnp.reshape(least, 1)

    def call(cuda: bool, *given: Array) -> Array:
        find = _rays_callable(points.shape[1], bool(points.dtype == jnp.float64), cuda)
        return find(*given, output_dims={"side": len(points), "info": 1})[0]

    side = on_platform(*inputs, cpu=functools.partial(call, False), cuda=functools.partial(call, True))
    return side == 1, side == 2


def decide_pairs(own: Array, corners: Array, particle: Array, triangle: Array, cutoff: Cutoff, asked: Array) -> Array:
    """Decide which particles are near which triangles: [q] bool, as `jfrnn._triangles.rows.decide_pairs` does.

    On the CPU by a kernel, whose integers XLA would compile anew, for seconds, wherever pairs are decided.
    """

    def on_cpu(own: Array, corners: Array, particle: Array, triangle: Array, cutoff: Cutoff, asked: Array) -> Array:
        radius = jnp.reshape(jnp.asarray(cutoff.radius), 1)
        call = _pairs_on_cpu(own.shape[1], bool(own.dtype == jnp.float64))
        sizes = {"near": len(particle), "info": 1}
        return call(own, corners, radius, particle, triangle, asked.astype(jnp.int32), output_dims=sizes)[0] > 0

    return on_platform(own, corners, particle, triangle, cutoff, asked, late=True, cpu=on_cpu, default=decide_by_jax)


@kernel
def _pairs_on_cpu(dim: int, double: bool) -> Call:
    def plan(shapes: Shapes, multiprocessors: int) -> Plan:
        (n,) = shapes["particle"]
        query = share(triangles.pairs_kernel(dim, double), n, triangles.PAIRS_CHUNK)
        return Plan([Clear("info", 4), query], {"n": n})

    given = "positions", "corners", "cutoff", "particle", "triangle", "asked"
    name = f"jfrnn_triangle_pairs_{dim}d_{'f64' if double else 'f32'}"
    return Call(name, given, dict.fromkeys(("near", "info"), np.int32), plan)


@kernel
def _rays_callable(dim: int, double: bool, cuda: bool) -> Call:
    def plan(shapes: Shapes, multiprocessors: int) -> Plan:
        n, side = shapes["positions"][0], triangles.side_kernel(dim, double, WIDTH, cuda)
        numbers = {"n": n, "levels": shapes["start"][0] - 1, "entries": shapes["boxes"][1]}
        return Plan([Launch(side, n)] if cuda else [Clear("info", 4), share(side, n, triangles.POINTS_CHUNK)], numbers)

    given = "positions", "corners", "boxes", "cutoff", "rays", "start", "triangles", "asked", "least"
    name = f"jfrnn_winding_{'cuda' if cuda else 'cpu'}_{dim}d_{'f64' if double else 'f32'}"
    return Call(name, given, dict.fromkeys(("side", "info"), np.int32), plan)
