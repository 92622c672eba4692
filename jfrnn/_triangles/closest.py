"""Nearest points on triangles (in 2D: segments), pseudonormals there, and contacts.

Contacts are, among the triangles near a particle, one per wall; others only continue it across a side or corner.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._tracing import set_places
from jfrnn._triangles.exact import Vector, cross, dot, minus, nearer_of

# The feature on which the nearest point lies: corners 0, 1, 2; sides _SIDE + 0, 1, 2, from that corner to the next; _FACE.
_SIDE, _FACE = 3, 6
_BLOCK = 1 << 16  # slots processed at a time
_ROUNDING = 32  # error bound in eps of the largest relative coordinate: distances have 4, nearest points a few


def nearest_of(points: Array, corners: Array) -> tuple[Array, Array]:
    """Return vectors [..., d] from points to the nearest points of closed shapes [..., corner, d], and features [...] int32.

    A feature is the corner, side or face on which a nearest point lies.

    The candidates are the foot of the point on each side and on the face. Each is exact for a shape whose corners are moved by a
    few roundings of the largest coordinate relative to the point, so distances have that accuracy, even for slivers.
    Differentiable: to any order, also for degenerate shapes. Source: Ericson (2005), Real-Time Collision Detection, sect. 5.1, for
    the feet.
    """
    raw = corners - points[..., None, :]
    largest = lax.stop_gradient(jnp.max(jnp.abs(raw), axis=(-2, -1)))
    unit = jnp.where(largest > 0, largest, 1)  # lengths around 1, whose squares stay within the float range
    dim = points.shape[-1]
    x = [[raw[..., c, k] / unit for k in range(dim)] for c in range(dim)]
    found: list[tuple[Array, Vector, Array]] = []
    for i in range(3 if dim == 3 else 1):
        j = (i + 1) % dim
        along = minus(x[j], x[i])
        length = dot(along, along)
        free = jnp.where(length > 0, -dot(x[i], along) / jnp.where(length > 0, length, 1), 0)
        place = jnp.where(free > 0, jnp.where(free < 1, free, 1), 0)  # `clip` has half a derivative at its bounds
        here = [a + place * b for a, b in zip(x[i], along, strict=True)]
        here = [jnp.where(place < 1, h, b) for h, b in zip(here, x[j], strict=True)]
        what = jnp.where(place <= 0, i, jnp.where(place >= 1, j, _SIDE + i))
        found.append((dot(here, here), here, what.astype(jnp.int32)))
    if dim == 3:
        found.append((*_foot_on_face(x), jnp.full(unit.shape, _FACE, jnp.int32)))
    _, foot, feature = functools.reduce(nearer_of, found)
    return jnp.stack(foot, axis=-1) * unit[..., None], feature


def _foot_on_face(x: list[Vector]) -> tuple[Array, Vector]:
    """Return the squared distance of the foot of the origin on a triangle, infinite if the foot lies outside, and the foot.

    The plane is spanned by one side and the height on it, orthogonalized twice. So all results are exact for a triangle whose
    corners are a few roundings from the given ones, however thin; one as thin as a rounding error is left to its sides.
    Source: Giraud et al. (2005), doi:10.1007/s00211-005-0615-4, for the second orthogonalization.
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
    return jnp.where(inside, dot(foot, foot), jnp.inf), foot


def pseudonormals(
    idx: Array, used: Array, triangle: Array, feature: Array, faces: Array, corners: Array, good: Array, asked: Array
) -> Array:
    """Return unit pseudonormals at the nearest points of the rows asked for [n] bool, [n, d]; 0 if shapes have no area.

    The pseudonormal of a face is its normal, that of a side the sum of the normals of the faces sharing it, and that of a vertex
    the sum over the faces around it, weighted with their angles; in 2D a vertex has the sum of both segments. All these faces are
    equally near, so they are in the same row. Where normals cancel, as those of parts that touch, it is that of the nearest face.
    Faces [f, corner] int32 run counterclockwise as seen from outside, so do segments around what they enclose; their corners are
    [f, corner, d], and those that are valid `good` [f]. Rows idx [n, capacity] have so many slots `used` [n]; the nearest point of
    each lies on a `feature` [n] of a `triangle` [n].
    Source: Baerentzen & Aanaes (2005), doi:10.1109/TVCG.2005.49.
    """
    n, capacity = idx.shape
    block = min(max(_BLOCK // capacity, 1), n)
    queue, total = set_places(asked, n + block), jnp.sum(asked, dtype=jnp.int32)

    def add_block(b: Array, normals: Array) -> Array:
        place = lax.dynamic_slice_in_dim(queue, b * block, block)
        own = jnp.minimum(place, n - 1)
        slots, features = idx[own], feature[own]
        shape = jnp.where(lax.broadcasted_iota(jnp.int32, slots.shape, 1) < used[own, None], slots, len(faces))
        known = jnp.minimum(shape, len(faces) - 1)
        there = (shape < len(faces)) & good[known]
        weights = _weights(faces[known], faces[triangle[own]], corners[known], features)
        alone = features >= (_FACE if faces.shape[1] == 3 else _SIDE)
        weights = jnp.where(alone[:, None], (slots == triangle[own, None]).astype(weights.dtype), weights)
        weights = jnp.where(there, weights, 0)
        sums = jnp.sum(weights[..., None] * _face_normals(corners[known]), axis=1)
        cancel = jnp.max(jnp.abs(sums), axis=1) <= 16 * jnp.finfo(sums.dtype).eps * jnp.sum(weights, axis=1)
        sums = jnp.where(cancel[:, None], _face_normals(corners[triangle[own]]), sums)
        return normals.at[place].set(_unit(sums), mode="drop")

    none = jnp.zeros((n, corners.shape[2]), corners.dtype)
    return lax.fori_loop(0, -(-total // block), add_block, none)


def _weights(named: Array, nearest: Array, corners: Array, feature: Array) -> Array:
    """Return the weights [b, k] of faces [b, k, corner] at the corners or sides [b] of the nearest faces [b, corner]."""
    dim = named.shape[2]
    start = jnp.take_along_axis(nearest, jnp.minimum(feature % _SIDE, dim - 1)[:, None], axis=1)
    has_start = named == start[..., None]
    if dim == 2:
        return jnp.any(has_start, axis=2).astype(corners.dtype)
    end = jnp.take_along_axis(nearest, ((feature + 1) % _SIDE)[:, None], axis=1)
    one = _unit(jnp.roll(corners, -1, axis=2) - corners)
    two = _unit(jnp.roll(corners, 1, axis=2) - corners)
    angle = jnp.arctan2(jnp.linalg.norm(jnp.cross(one, two), axis=-1), jnp.sum(one * two, axis=-1))
    around = jnp.sum(jnp.where(has_start, angle, 0), axis=2)
    beside = jnp.any(has_start, axis=2) & jnp.any(named == end[..., None], axis=2)
    return jnp.where((feature < _SIDE)[:, None], around, beside.astype(around.dtype))


def _face_normals(corners: Array) -> Array:
    """Return unit normals of shapes [..., corner, d]; 0 for shapes without area (2D: length)."""
    along = corners[..., 1, :] - corners[..., 0, :]
    if corners.shape[-1] == 2:
        return _unit(jnp.stack([along[..., 1], -along[..., 0]], axis=-1))
    return _unit(jnp.cross(_unit(along), _unit(corners[..., 2, :] - corners[..., 0, :])))


def _unit(vectors: Array) -> Array:
    largest = jnp.max(jnp.abs(vectors), axis=-1, keepdims=True)
    scaled = vectors / jnp.where(largest > 0, largest, 1)
    square = jnp.sum(scaled * scaled, axis=-1, keepdims=True)
    return jnp.where(largest > 0, scaled / jnp.sqrt(jnp.where(largest > 0, square, 1)), 0)


# --- contacts ---------------------------------------------------------------------------------------------------------


class _Slots(NamedTuple):
    """The data of each slot.

    Attributes:
        mask: Whether the slot holds a pair, shape [n, k], bool.
        triangle: Index of the triangle, shape [n, k], int32.
        named: Vertex indices of the triangle, shape [n, k, corner], int32.
        start, end: Vertices of the corner (twice the same) or side on which the nearest point lies, shape [n, k]; -1 for neither.
        order: 0 if the nearest point lies on a face, 1 on a side, 2 on a corner, shape [n, k], int32.
        vectors: Vectors to the nearest points, shape [n, k, d].
        distance: Their lengths, shape [n, k].
        error: Bound on the distance that rounding may put between equal nearest points, shape [n, k].
    """

    mask: Array
    triangle: Array
    named: Array
    start: Array
    end: Array
    order: Array
    vectors: Array
    distance: Array
    error: Array


def are_contacts(mask: Array, triangle: Array, faces: Array, seen: Array, vectors: Array, distance: Array, feature: Array) -> Array:
    """Say which slots are separate contacts, [n, k] bool, of those in the mask [n, k] that hold a pair.

    A slot yields to another one that comes first if the other's triangle has the corner or side on which the slot's nearest point
    lies, or if both nearest points are equal within rounding. Slots are ordered by distance, then by feature (face, side, corner),
    then by index. The first of several such slots remains.

    Of each slot, `triangle` [n, k] is the index of its triangle, 0 where masked, in faces [f, corner]; `seen` [n, k, corner, d] are
    the corners relative to the particle, and `vectors` [n, k, d] lead to the nearest point, over a `distance` [n, k], on a
    `feature` [n, k], as `nearest_of` says.
    """
    dim = faces.shape[1]
    named, alone = faces[triangle], feature >= (_FACE if dim == 3 else _SIDE)
    first = feature % _SIDE
    last = jnp.where(feature < _SIDE, first, (first + 1) % dim)
    start, end = (jnp.take_along_axis(named, jnp.minimum(x, dim - 1)[..., None], axis=2)[..., 0] for x in (first, last))
    order = jnp.where(alone, 0, jnp.where(feature < _SIDE, 2, 1)).astype(jnp.int32)
    error = _ROUNDING * float(jnp.finfo(distance.dtype).eps) * jnp.max(jnp.abs(seen), axis=(-2, -1))
    start, end = (jnp.where(alone, -1, x) for x in (start, end))
    slots = _Slots(mask, triangle, named, start, end, order, vectors, distance, error)
    longest = jnp.max(jnp.where(mask, lax.broadcasted_iota(jnp.int32, mask.shape, 1) + 1, 0), initial=0)

    def drop_yielding(j: Array, left: Array) -> Array:
        one = _Slots(*(lax.dynamic_slice_in_dim(x, j, 1, axis=1) for x in slots))
        start, end = (jnp.any(one.named == x[..., None], axis=2) for x in (slots.start, slots.end))  # it has their side or corner
        return left & ~(one.mask & _is_first(one, slots) & (start & end | _is_same(one, slots)))

    return lax.fori_loop(0, longest, drop_yielding, mask)


def _is_same(one: _Slots, others: _Slots) -> Array:
    """Say whether nearest points are equal within rounding.

    Feet on faces are as accurate as coordinates. The choice of a side or corner of touching triangles depends on distances alone,
    whose error e at the distance r moves the nearest point by up to sqrt(2 e r).
    """
    apart = jnp.max(jnp.abs(one.vectors - others.vectors), axis=2)
    error = jnp.maximum(one.error, others.error)
    touch = jnp.any(one.named[..., None] == others.named[..., None, :], axis=(2, 3))
    told_by_distance = touch & ((one.order > 0) | (others.order > 0))
    return (apart <= error) | (told_by_distance & (apart <= jnp.sqrt(error) * jnp.sqrt(others.distance)))


def _is_first(one: _Slots, others: _Slots) -> Array:
    first = one.triangle < others.triangle
    first = (one.order < others.order) | ((one.order == others.order) & first)
    return (one.distance < others.distance) | ((one.distance == others.distance) & first)
