"""Triangles with Warp's kernels inside JAX, on the CPU: what they are given, and how they are launched."""

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn import _warp
from jfrnn._exact import Cutoff
from jfrnn._triangles_cells import LANES, MOST_CELLS, TriangleCells, bucket_count, entry_count, level_limit

_LONGEST_VECTOR = 16
_PARTICLES_PER_THREAD = 1024  # below, a second thread costs more than it saves


class _Variant(NamedTuple):
    """All that is static about a call, apart from shapes."""

    dim: int
    double: bool
    lists: bool


def sort_triangles(corners: Array, good: Array, cutoff: Cutoff) -> TriangleCells:
    """Sort triangles [f, corner, axis] with f > 0 into cells, as `jfrnn._triangles_cells.sort_triangles` does."""
    faces, dim = corners.shape[:2]
    sizes = {"start": bucket_count(faces) + 1, "triangles": entry_count(faces, dim), "levels": level_limit(np.dtype(corners.dtype))}
    sizes |= {"level_count": 1, "level_of": faces, "scratch": max(entry_count(faces, dim), 2048)}
    radius = jnp.reshape(jnp.asarray(cutoff.radius), 1)
    build = _build_callable(_Variant(dim, corners.dtype == jnp.float64, lists=True))
    call = functools.partial(build, output_dims=sizes)
    start, triangles, levels, level_count, level_of, _ = lax.platform_dependent(corners, good.astype(jnp.int32), radius, cpu=call)
    return TriangleCells(start, triangles, levels, level_count[0], level_of)


def list_triangles(
    positions: Array, corners: Array, cells: TriangleCells, cutoff: Cutoff, capacity: int | None
) -> tuple[Array, Array]:
    """List the triangles near every particle, as `jfrnn._triangles_rows.list_triangles` does."""
    (n, dim), slots = positions.shape, capacity or 0
    finfo = jnp.finfo(corners.dtype)
    radius = jnp.asarray(cutoff.radius)
    wide = radius * (1 + 8 * finfo.eps)  # no particle that is nearer than r lies beyond: subtraction rounds monotonously
    boxes = jnp.concatenate([jnp.min(corners, axis=1) - wide, jnp.max(corners, axis=1) + wide], axis=1)
    entries = jnp.pad(cells.triangles, (0, _LONGEST_VECTOR), constant_values=corners.shape[0])  # vectors reach over the end
    boxes = boxes.T.at[:, entries].get(mode="fill", fill_value=jnp.nan)  # side by side, as a bucket holds them
    query = _query_callable(_Variant(dim, positions.dtype == jnp.float64, capacity is not None))
    inputs = (positions, corners, boxes, jnp.reshape(radius, 1), cells.start, cells.triangles, cells.levels)
    inputs += (jnp.reshape(cells.level_count, 1), cells.level_of)
    call = functools.partial(query, output_dims={"idx": (n, max(slots, 1)), "count": n, "info": 4})
    idx, count, _ = lax.platform_dependent(*inputs, cpu=call)
    return idx[:, :slots], count


def _name(name: str, variant: _Variant) -> str:
    return f"jfrnn_triangles_{name}_{variant.dim}d_{'f64' if variant.double else 'f32'}{'_list' * variant.lists}"


def _kernels(variant: _Variant) -> Any:  # noqa: ANN401
    return _warp.kernels_of("triangles_cpu").triangle_kernels(*variant, MOST_CELLS[variant.dim], LANES[variant.dim])


@functools.cache
def _build_callable(variant: _Variant) -> Any:  # noqa: ANN401
    wp = _warp.load_warp()
    scalar, ints = wp.float64 if variant.double else wp.float32, wp.array(dtype=wp.int32)
    types = {"corners": wp.array3d(dtype=scalar), "good": ints, "cutoff": wp.array(dtype=scalar), "start": ints, "triangles": ints}
    types |= {"levels": ints, "level_count": ints, "level_of": ints, "scratch": ints}

    def run(*arrays: Any) -> None:  # noqa: ANN401
        named = dict(zip(types, arrays, strict=True))
        sizes = [named["corners"].shape[0], named["start"].shape[0] - 1]
        _warp.on_one_core(_kernels(variant).build, [*arrays, *sizes])

    return _warp.callable_of(_name("build", variant), run, types, 6)


@functools.cache
def _query_callable(variant: _Variant) -> Any:  # noqa: ANN401
    wp = _warp.load_warp()
    scalar, ints = wp.float64 if variant.double else wp.float32, wp.array(dtype=wp.int32)
    points = wp.array2d(dtype=scalar)
    types = {"positions": points, "corners": wp.array3d(dtype=scalar), "boxes": points, "cutoff": wp.array(dtype=scalar)}
    types |= {"start": ints, "triangles": ints, "levels": ints, "level_count": ints, "level_of": ints}
    types |= {"idx": wp.array2d(dtype=wp.int32), "count": ints, "info": ints}

    def run(*arrays: Any) -> None:  # noqa: ANN401
        named = dict(zip(types, arrays, strict=True))
        n, capacity = named["positions"].shape[0], named["idx"].shape[1]
        sizes = [n, named["corners"].shape[0], named["start"].shape[0] - 1, capacity, named["boxes"].shape[1]]
        named["info"].numpy()[:] = 0
        _warp.ask_for_huge_pages(named["idx"].ptr, 4 * n * capacity)
        _warp.on_every_core(_kernels(variant).query, [*arrays, *sizes], -(-n // _PARTICLES_PER_THREAD))

    return _warp.callable_of(_name("query", variant), run, types, 3)
