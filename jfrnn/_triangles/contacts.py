"""Which triangles near a particle are contacts of their own: those that only go on across a shared side or corner are not."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

_SIDE, _FACE = 3, 6  # as in `jfrnn._triangles.closest`
_ROUNDING = 32  # of the largest coordinate as seen from the particle: distances are within 4, points on flat neighbors within a few


class _Slots(NamedTuple):
    """What is known of each slot.

    Attributes:
        mask: It holds a pair, shape [n, k], bool.
        triangle: Shape [n, k], int32.
        named: Vertices of the triangle, shape [n, k, corner], int32.
        start, end: Vertices of the corner (twice the same) or side on which the nearest point lies, shape [n, k]; -1: on neither.
        order: 0 where the nearest point lies on a face, 1 on a side, 2 on a corner, shape [n, k], int32.
        vectors: To the nearest points, shape [n, k, d].
        distance: Shape [n, k].
        error: Up to how far apart nearest points may be by rounding alone, shape [n, k].
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
    """Say which slots are contacts of their own, [n, k] bool.

    A slot gives way where the triangle of another slot holds the corner or side on which its nearest point lies, or where rounding
    does not tell that their nearest points are two, and the other comes first: by distance, by what is met (a face before a side
    before a corner), then by index. The first of those that give way to one another remains.

    Args:
        mask: Slots that hold a pair, shape [n, k], bool.
        triangle: Shape [n, k], int32, 0 where masked.
        faces: Vertices of triangles, shape [f, corner], int32.
        seen: Corners as seen from the particle, shape [n, k, corner, d].
        vectors: To the nearest points, shape [n, k, d].
        distance: Their lengths, shape [n, k].
        feature: Where the nearest point lies, shape [n, k], as in `jfrnn._triangles.closest`.
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

    def without(j: Array, left: Array) -> Array:
        one = _Slots(*(lax.dynamic_slice_in_dim(x, j, 1, axis=1) for x in slots))
        return left & ~(one.mask & _is_first(one, slots) & (_holds(one, slots) | _is_same(one, slots)))

    return lax.fori_loop(0, longest, without, mask)


def _holds(one: _Slots, others: _Slots) -> Array:
    """Say whether the triangle of a slot of each row, k = 1, holds the corners or sides on which nearest points of others lie."""
    start, end = (jnp.any(one.named == x[..., None], axis=2) for x in (others.start, others.end))
    return start & end


def _is_same(one: _Slots, others: _Slots) -> Array:
    """Say whether nearest points are one as far as rounding tells.

    Feet on faces are as precise as coordinates. Which side or corner of touching triangles is nearest is told by distances alone,
    whose error moves the nearest point by its root: sqrt(2 e r) at the distance r.
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
