"""Whether a triangle lies within the cutoff of a point, in integers throughout: the last word, for what rounding leaves open.

All that decides is signs of polynomials in x_i = v_i - p, the corners as the particle sees them (d_i = x_(i+1) - x_i):

- a vertex is near:  |x_i|² < r²
- a side is near between its ends:  0 < t < |d|²  and  (|x_i|² - r²) |d|² < t²,  with t = -x_i·d
- the plane is near within the triangle:  (x_j × x_k)·n > 0 for each side  and  (x_0·n)² < r² |n|²,  with n = sum of x_j × x_k

The distance is below r if and only if one of these holds: each of the three gives a point of the triangle closer than r, and
the nearest point is a vertex, or inside a side, or inside the triangle. A nearest point on the border between two of them needs no
care: the smaller one covers it, hence `>`. For degenerate triangles n, or d, is 0, and what they do not have is never near.

Coordinates are written as whole multiples of one power of two, in limbs (`jfrnn._geometry.integers`): as many as a pair usually
takes, or, where exponents lie far apart, as the float format can take. The longest sum of products of carried limbs, of which one
takes up to 27 (float64: 82), is of 2·4·27 (2·4·82) of them: below 2^30.5 (2^61.5).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import GUARDS, carried_limbs, fields_of, full_count, limb_product, limb_sign, limbs_of

_NONE = 1 << 20  # beyond every place of a bit
_USUAL_LIMBS = {4: 5, 8: 4}  # by bytes of a float: 55 and 104 bits from the highest to the lowest one set


class Shapes(NamedTuple):
    """Points and the corners of what they are compared with.

    Attributes:
        points: [d, k].
        corners: [d, d, k]: corner, axis. Triangles in 3D, segments in 2D.
        radius: [] the cutoff.
    """

    points: Array
    corners: Array
    radius: Array


def limb_counts(dtype: np.dtype) -> tuple[int, int]:
    """Return how many limbs hold the numbers of a usual pair, and how many those of any pair."""
    return _USUAL_LIMBS[dtype.itemsize], full_count(dtype)


def bit_range(shapes: Shapes) -> tuple[Array, Array]:
    """Return the place of the lowest bit set in any number of a pair, and how many bits reach from it to the highest: [k]."""
    _, place, mantissa = fields_of(_numbers(shapes))
    lowest = place + _trailing_zeros(mantissa)
    highest = place + 8 * mantissa.dtype.itemsize - lax.clz(mantissa).astype(jnp.int32)
    zero = mantissa == 0
    origin = jnp.min(jnp.where(zero, _NONE, lowest), axis=0)
    return origin, jnp.max(jnp.where(zero, -_NONE, highest), axis=0) - origin


def is_near(shapes: Shapes, origin: Array, count: int) -> Array:
    """Decide [k] pairs whose bits lie within `count` limbs from `origin` [k] on: is the triangle closer than the cutoff?"""
    dim = shapes.points.shape[0]
    limbs = limbs_of(_numbers(shapes), count + 1, origin[None])  # one more for the sign
    points, radius = limbs[:dim], limbs[-1:, :, GUARDS:]
    corners = limbs[dim:-1].reshape(dim, dim, *points.shape[1:])
    x = corners - points[None]  # [corner, axis, k, limbs]
    vectors = carried_limbs(jnp.concatenate([x, jnp.roll(x, -1, axis=0) - x]))
    return _near_triangle(vectors[:3], vectors[3:], radius) if dim == 3 else _near_segment(vectors[:2], vectors[2], radius)


def _near_segment(x: Array, along: Array, radius: Array) -> Array:
    sums = _dots([(x[0], x[0]), (x[1], x[1]), (x[0], along), (along, along)])
    limit = limb_product(radius, radius)
    square = jnp.stack([sums[0], sums[1]]) - limit
    place, length = -sums[2:3], sums[3:]
    square, place, length, rest = _split(carried_limbs(jnp.concatenate([square, place, length, length - place])), 2, 1, 1, 1)
    beside = carried_limbs(limb_product(square[:1], length) - limb_product(place, place))
    return _any_near(square, place, rest, beside)


def _near_triangle(x: Array, along: Array, radius: Array) -> Array:
    """Stack what is alike: three rounds of products, which compile in less time than a dozen."""
    after, last = jnp.roll(x, -1, axis=0), jnp.roll(x, -2, axis=0)
    one, two = [1, 2, 0], [2, 0, 1]
    left = [x, x, along, after[:, one], after[:, two]]
    right = [x, along, along, last[:, two], last[:, one]]
    products = limb_product(jnp.stack(left), jnp.stack(right))  # [5, corner, axis, k, limbs]
    sums = products[:3].sum(axis=2, dtype=x.dtype)
    crosses = products[3] - products[4]
    normal = crosses.sum(axis=0, dtype=x.dtype)
    limit = limb_product(radius, radius)
    parts = [sums[0] - limit, -sums[1], sums[2], sums[2] + sums[1], crosses.reshape(9, *limit.shape[1:]), normal, limit]
    square, place, length, rest, crosses, normal, limit = _split(carried_limbs(jnp.concatenate(parts)), 3, 3, 3, 3, 9, 3, 1)
    normals = jnp.concatenate([normal] * 3)
    left = [square, place, crosses, normal, _widened(x[0], normal)]
    right = [length, place, normals, normal, normal]
    products = limb_product(jnp.concatenate(left), jnp.concatenate(right))
    ahead, behind, inside, area, height = _split(products, 3, 3, 9, 3, 3)
    inside = inside.reshape(3, 3, *inside.shape[1:]).sum(axis=1, dtype=x.dtype)
    parts = [ahead - behind, inside, area.sum(axis=0, keepdims=True, dtype=x.dtype)]
    parts.append(height.sum(axis=0, keepdims=True, dtype=x.dtype))
    beside, inside, area, height = _split(carried_limbs(jnp.concatenate(parts)), 3, 3, 1, 1)
    products = limb_product(jnp.concatenate([height, _widened(limit, area)]), jnp.concatenate([height, area]))
    above = carried_limbs(products[:1] - products[1:])
    *signs, inside, above = _signs(square, place, rest, beside, inside, above)
    return _near_parts(*signs) | (jnp.all(inside > 0, axis=0) & (above[0] < 0))


def _any_near(*parts: Array) -> Array:
    return _near_parts(*_signs(*parts))


def _near_parts(square: Array, place: Array, rest: Array, beside: Array) -> Array:
    """Say where a vertex is near, or a side between its ends, of the signs of what decides it: [parts, k]."""
    return jnp.any(square < 0, axis=0) | jnp.any((place > 0) & (rest > 0) & (beside < 0), axis=0)


def _numbers(shapes: Shapes) -> Array:
    points, corners, radius = shapes
    return jnp.concatenate([points, corners.reshape(-1, points.shape[1]), jnp.broadcast_to(radius, (1, points.shape[1]))])


def _trailing_zeros(word: Array) -> Array:
    one = np.ones((), word.dtype)
    return lax.population_count((word & (~word + one)) - one).astype(jnp.int32)


def _dots(pairs: list[tuple[Array, Array]]) -> Array:
    """Multiply pairs of vectors [axis, k, limbs]: [pairs, k, limbs]."""
    left, right = (jnp.stack(vectors) for vectors in zip(*pairs, strict=True))
    return limb_product(left, right).sum(axis=1, dtype=left.dtype)


def _split(rows: Array, *sizes: int) -> list[Array]:
    return jnp.split(rows, np.cumsum(sizes)[:-1])


def _widened(x: Array, like: Array) -> Array:
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, like.shape[-1] - x.shape[-1])])


def _signs(*parts: Array) -> list[Array]:
    """Return the signs of numbers [rows, k, limbs], carried and of any widths: [rows, k] each."""
    widest = max(parts, key=lambda part: part.shape[-1])
    rows = jnp.concatenate([_widened(part, widest) for part in parts])
    rows = jnp.pad(rows, ((0, 0), (0, 0), (GUARDS, 0)))
    return _split(limb_sign(rows), *(part.shape[0] for part in parts))
