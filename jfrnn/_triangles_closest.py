"""Nearest points on triangles (in 2D: segments), and on which side of a closed mesh a particle is."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._triangles_exact import Vector, cross, dot, minus

# where the nearest point lies: corners are 0, 1, 2, sides (from that corner to the next) _SIDE + 0, 1, 2, the face _FACE
_SIDE, _FACE = 3, 6


class Nearest(NamedTuple):
    """Where the nearest points of shapes are, as seen from points.

    Attributes:
        vectors: From the point to its nearest, [..., d].
        feature: On which corner, side or face it lies, [...] int32.
    """

    vectors: Array
    feature: Array


def nearest_of(points: Array, corners: Array) -> Nearest:
    """Compute the nearest points of closed shapes [..., corner, d] to points [..., d].

    What is compared are a foot on each side and one on the face, each right for a shape whose corners are a few roundings of the
    largest coordinate seen from the point away, so that distances are, too, even of slivers. Differentiable: to any order, also
    where shapes are degenerate.
    Source: Ericson (2005), Real-Time Collision Detection, sect. 5.1, for the feet.
    """
    raw = corners - points[..., None, :]
    largest = lax.stop_gradient(jnp.max(jnp.abs(raw), axis=(-2, -1)))
    unit = jnp.where(largest > 0, largest, 1)  # lengths around 1: no square leaves the float range
    dim = points.shape[-1]
    x = [[raw[..., c, k] / unit for k in range(dim)] for c in range(dim)]
    best, foot, feature = None, [], jnp.zeros(unit.shape, jnp.int32)
    for i in range(3 if dim == 3 else 1):
        j = (i + 1) % dim
        along = minus(x[j], x[i])
        length = dot(along, along)
        place = jnp.clip(jnp.where(length > 0, -dot(x[i], along) / jnp.where(length > 0, length, 1), 0), 0, 1)
        here = [a + place * b for a, b in zip(x[i], along, strict=True)]
        here = [jnp.where(place < 1, h, b) for h, b in zip(here, x[j], strict=True)]
        what = jnp.where(place <= 0, i, jnp.where(place >= 1, j, _SIDE + i))
        best, foot, feature = _nearer(best, foot, feature, dot(here, here), here, what)
    if dim == 3:
        on_face, square = _foot_on_face(x)
        best, foot, feature = _nearer(best, foot, feature, square, on_face, jnp.full_like(feature, _FACE))
    return Nearest(jnp.stack(foot, axis=-1) * unit[..., None], feature)


def _nearer(
    best: Array | None, foot: Vector, feature: Array, square: Array, here: Vector, what: Array
) -> tuple[Array, Vector, Array]:
    if best is None:
        return square, here, what.astype(jnp.int32)
    nearer = square < best
    foot = [jnp.where(nearer, new, old) for new, old in zip(here, foot, strict=True)]
    return jnp.where(nearer, square, best), foot, jnp.where(nearer, what, feature).astype(jnp.int32)


def _foot_on_face(x: list[Vector]) -> tuple[Vector, Array]:
    """Return the foot of the origin on a triangle, and its squared distance: infinite where it lies outside.

    Its plane is spanned by one side and the height on it, made orthogonal twice, so that all is exact for a triangle whose corners
    are a few roundings from the given ones, however thin; one as thin as a rounding is left to its sides.
    Source: Giraud et al. (2005), doi:10.1007/s00211-005-0615-4, for the second time.
    """
    side, slant = minus(x[1], x[0]), minus(x[2], x[0])
    length, thinnest = dot(side, side), (4 * jnp.finfo(side[0].dtype).eps) ** 2
    is_line = length > thinnest
    height, along = slant, jnp.zeros_like(length)
    for _ in range(2):
        step = dot(height, side) / jnp.where(is_line, length, 1)
        height, along = [h - step * s for h, s in zip(height, side, strict=True)], along + step
    square = dot(height, height)
    is_face = is_line & (square > thinnest)
    of_third = -dot(x[0], height) / jnp.where(is_face, square, 1)
    of_second = -dot(x[0], side) / jnp.where(is_line, length, 1) - along * of_third
    inside = is_face & (of_third > 0) & (of_second > 0) & (of_second + of_third < 1)
    normal = cross(side, height)
    area = jnp.where(inside, dot(normal, normal), 1)
    along_normal = jnp.where(inside, dot(x[0], normal) / area, 0)
    foot = [along_normal * n for n in normal]
    return foot, jnp.where(inside, dot(foot, foot), jnp.inf)


class Normals(NamedTuple):
    """Outward normals of faces, sides and vertices, as far as they tell inside from outside.

    Attributes:
        faces: [f, d], of unit length; 0 where the shape has no area (2D: length).
        sides: [f, 3, d], sums of those of the faces that share a side; [f, 0, 2] in 2D.
        vertices: [v, d], sums of those of the faces around it, times their angles; in 2D of both segments.
        watertight: [] bool: each side belongs to two faces that run through it in opposite directions; in 2D each
            vertex to two segments.
    """

    faces: Array
    sides: Array
    vertices: Array
    watertight: Array


def make_normals(vertices: Array, faces: Array, corners: Array, good: Array) -> Normals:
    """Sum angle-weighted pseudonormals of shapes [f, corner, d], of those that are `good`.

    Faces run counterclockwise as seen from outside; so do segments around what they enclose.
    Source: Baerentzen & Aanaes (2005), doi:10.1109/TVCG.2005.49.
    """
    count, dim = vertices.shape
    named = jnp.where(good[:, None], faces, count)
    if dim == 2:
        along = corners[:, 1] - corners[:, 0]
        normal = _unit(jnp.stack([along[:, 1], -along[:, 0]], axis=1)) * good[:, None].astype(corners.dtype)
        sums = jnp.zeros_like(vertices).at[named].add(normal[:, None], mode="drop")
        ends = jnp.zeros((count, 2), jnp.int32).at[named, jnp.arange(2)].add(1, mode="drop")
        whole = jnp.all((ends == 1) | (ends.sum(axis=1) == 0)[:, None])
        return Normals(normal, jnp.zeros((faces.shape[0], 0, 2), vertices.dtype), sums, whole)
    after, before = jnp.roll(corners, -1, axis=1), jnp.roll(corners, 1, axis=1)
    across = jnp.cross(_unit(corners[:, 1] - corners[:, 0]), _unit(corners[:, 2] - corners[:, 0]))
    normal = _unit(across) * good[:, None].astype(corners.dtype)
    one, two = _unit(after - corners), _unit(before - corners)
    angle = jnp.arctan2(jnp.linalg.norm(jnp.cross(one, two), axis=-1), jnp.sum(one * two, axis=-1))
    sums = jnp.zeros_like(vertices).at[named].add(angle[..., None] * normal[:, None], mode="drop")
    sides, watertight = _sum_over_sides(named, normal, good)
    return Normals(normal, sides, sums, watertight)


def _sum_over_sides(named: Array, normal: Array, good: Array) -> tuple[Array, Array]:
    """Sum what faces [f, d] have over all that share a side: [f, 3, d]; say whether each side has two, in opposite directions."""
    faces = named.shape[0]
    start, end = named.reshape(-1), jnp.roll(named, -1, axis=1).reshape(-1)
    place = lax.iota(jnp.int32, 3 * faces)
    low, high, order = lax.sort((jnp.minimum(start, end), jnp.maximum(start, end), place), num_keys=2)
    fresh = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    group = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(fresh, dtype=jnp.int32)])
    of_side = jnp.zeros(3 * faces, jnp.int32).at[order].set(group)
    there = jnp.repeat(good, 3)
    sums = jnp.zeros((3 * faces, 3), normal.dtype).at[of_side].add(jnp.repeat(normal, 3, axis=0))
    runs = jnp.zeros((3 * faces, 2), jnp.int32).at[of_side, (start > end).astype(jnp.int32)].add(there.astype(jnp.int32))
    whole = jnp.all((runs == 1) | (runs.sum(axis=1) == 0)[:, None]) & ~jnp.any(there & (start == end))
    return sums[of_side].reshape(faces, 3, 3), whole


def _unit(vectors: Array) -> Array:
    largest = jnp.max(jnp.abs(vectors), axis=-1, keepdims=True)
    scaled = vectors / jnp.where(largest > 0, largest, 1)
    square = jnp.sum(scaled * scaled, axis=-1, keepdims=True)
    return jnp.where(largest > 0, scaled / jnp.sqrt(jnp.where(largest > 0, square, 1)), 0)


def normal_at(normals: Normals, faces: Array, triangle: Array, feature: Array) -> Array:
    """Return the unit normals [m, d] of the features of triangles [m] on which nearest points lie; 0 where there is none."""
    corner = faces[triangle, jnp.clip(feature, 0, faces.shape[1] - 1)]
    normal = jnp.where((feature < _SIDE)[:, None], normals.vertices[corner], normals.faces[triangle])
    if faces.shape[1] == 3:
        side = normals.sides[triangle, jnp.clip(feature - _SIDE, 0, 2)]
        normal = jnp.where(((feature >= _SIDE) & (feature < _FACE))[:, None], side, normal)
    return _unit(normal)
