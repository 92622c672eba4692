"""Contacts: select, among the triangles near a particle, one per wall; others only continue it across a side or corner."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

_SIDE, _FACE = 3, 6  # as in `jfrnn._triangles.closest`
_ROUNDING = 32  # error bound in eps of the largest relative coordinate: distances have 4, nearest points a few


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
    """Say which slots are separate contacts, [n, k] bool.

    A slot yields to another one that comes first if the other's triangle has the corner or side on which the slot's nearest point
    lies, or if both nearest points are equal within rounding. Slots are ordered by distance, then by feature (face, side, corner),
    then by index. The first of several such slots remains.

    Args:
        mask: Slots that hold a pair, shape [n, k], bool.
        triangle: Index of the triangle, shape [n, k], int32, 0 where masked.
        faces: Vertex indices of triangles, shape [f, corner], int32.
        seen: Corners relative to the particle, shape [n, k, corner, d].
        vectors: Vectors to the nearest points, shape [n, k, d].
        distance: Their lengths, shape [n, k].
        feature: The feature on which the nearest point lies, shape [n, k], as in `jfrnn._triangles.closest`.
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
        return left & ~(one.mask & _is_first(one, slots) & (_holds(one, slots) | _is_same(one, slots)))

    return lax.fori_loop(0, longest, drop_yielding, mask)


def _holds(one: _Slots, others: _Slots) -> Array:
    """Say whether the triangle of one slot per row (k = 1) has the corners or sides on which the nearest points of others lie."""
    start, end = (jnp.any(one.named == x[..., None], axis=2) for x in (others.start, others.end))
    return start & end


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
