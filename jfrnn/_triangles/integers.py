"""Whether a triangle lies within the cutoff of a point, in integers throughout: the last word, for what rounding leaves open.

All that decides is signs of polynomials in x_i = v_i - p, the corners as the particle sees them (d_i = x_(i+1) - x_i):

- a vertex is near:  |x_i|² < r²
- a side is near between its ends:  0 < t < |d|²  and  (|x_i|² - r²) |d|² < t²,  with t = -x_i·d
- the plane is near within the triangle:  (x_j × x_k)·n > 0 for each side  and  (x_0·n)² < r² |n|²,  with n = sum of x_j × x_k

The distance is below r if and only if one of these holds: each of the three gives a point of the triangle closer than r, and
the nearest point is a vertex, or inside a side, or inside the triangle. A nearest point on the border between two of them needs no
care: the smaller one covers it, hence `>`. For degenerate triangles n, or d, is 0, and what they do not have is never near.

Coordinates are written as whole multiples of one power of two, in limbs of 11 bits, in int32: as many as a pair usually takes,
or, where exponents lie far apart, as the float format can take. Limbs are kept within [-2^10 - 1, 2^10 + 1]: the longest sum, of
6·192 or 3·384 products (float64), stays below 2^31.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import LIMB_BITS, fields_of, limb_of, shift_right, sign_of_limbs

_HALF = 1 << (LIMB_BITS - 1)
_NONE = 1 << 20  # beyond every place of a bit
_USUAL_LIMBS = {4: 5, 8: 8}  # by bytes of a float: 55 and 88 bits from the highest to the lowest one set


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
    finfo = np.finfo(dtype)
    return _USUAL_LIMBS[dtype.itemsize], -(-(finfo.maxexp - finfo.minexp + finfo.nmant + 1) // LIMB_BITS)


def bit_range(shapes: Shapes) -> tuple[Array, Array]:
    """Return the place of the lowest bit set in any number of a pair, and how many bits reach from it to the highest: [k]."""
    numbers = _numbers(shapes)
    _, exponent, high, low = fields_of(numbers)
    place = jnp.maximum(exponent, 1) - 1
    lowest = place + jnp.where(low != 0, _trailing_zeros(low), 32 + _trailing_zeros(high))
    highest = place + jnp.where(high != 0, 64 - lax.clz(high).astype(jnp.int32), 32 - lax.clz(low).astype(jnp.int32))
    zero = (high | low) == 0
    origin = jnp.min(jnp.where(zero, _NONE, lowest), axis=0)
    return origin, jnp.max(jnp.where(zero, -_NONE, highest), axis=0) - origin


def is_near(shapes: Shapes, origin: Array, count: int) -> Array:
    """Decide [k] pairs whose bits lie within 11·count places from `origin` [k] on: is the triangle closer than the cutoff?"""
    dim = shapes.points.shape[0]
    limbs = _limbs(_numbers(shapes), origin, count)
    limbs = jnp.pad(limbs, ((0, 0), (0, 0), (0, 1)))  # room for a sign
    points, radius = limbs[:dim], limbs[-1:]
    corners = limbs[dim:-1].reshape(dim, dim, *points.shape[1:])
    x = _balanced(corners - points[None])  # [corner, axis, k, limbs]
    return _near_triangle(x, radius) if dim == 3 else _near_segment(x, radius)


def _near_segment(x: Array, radius: Array) -> Array:
    along = _balanced(x[1] - x[0])
    sums = _dots([(x[0], x[0]), (x[1], x[1]), (x[0], along), (along, along)])
    limit = _product(radius, radius)
    square = jnp.stack([sums[0], sums[1]]) - limit
    place, length = -sums[2:3], sums[3:]
    square, place, length, rest = _split(_balanced(jnp.concatenate([square, place, length, length - place])), 2, 1, 1, 1)
    beside = _product(square[:1], length) - _product(place, place)
    return _any_near(square, place, rest, beside)


def _near_triangle(x: Array, radius: Array) -> Array:
    """Stack what is alike: three rounds of products, whose programs take seconds to compile, instead of a dozen."""
    after, last = jnp.roll(x, -1, axis=0), jnp.roll(x, -2, axis=0)
    along, one, two = _balanced(after - x), [1, 2, 0], [2, 0, 1]
    left = [x, x, along, after[:, one], after[:, two]]
    right = [x, along, along, last[:, two], last[:, one]]
    products = _product(jnp.stack(left), jnp.stack(right))  # [5, corner, axis, k, limbs]
    sums = products[:3].sum(axis=2, dtype=jnp.int32)
    crosses = products[3] - products[4]
    normal = crosses.sum(axis=0, dtype=jnp.int32)
    limit = _product(radius, radius)
    parts = [sums[0] - limit, -sums[1], sums[2], sums[2] + sums[1], crosses.reshape(9, *limit.shape[1:]), normal, limit]
    square, place, length, rest, crosses, normal, limit = _split(_balanced(jnp.concatenate(parts)), 3, 3, 3, 3, 9, 3, 1)
    normals = jnp.concatenate([normal] * 3)
    left = [square, place, crosses, normal, _widened(x[0], normal)]
    right = [length, place, normals, normal, normal]
    products = _product(jnp.concatenate(left), jnp.concatenate(right))
    ahead, behind, inside, area, height = _split(products, 3, 3, 9, 3, 3)
    inside = inside.reshape(3, 3, *inside.shape[1:]).sum(axis=1, dtype=jnp.int32)
    parts = [ahead - behind, inside, area.sum(axis=0, keepdims=True, dtype=jnp.int32)]
    parts.append(height.sum(axis=0, keepdims=True, dtype=jnp.int32))
    beside, inside, area, height = _split(_balanced(jnp.concatenate(parts)), 3, 3, 1, 1)
    products = _product(jnp.concatenate([height, _widened(limit, area)]), jnp.concatenate([height, area]))
    above = products[:1] - products[1:]
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
    return lax.population_count((word & (~word + np.uint32(1))) - np.uint32(1)).astype(jnp.int32)


def _limbs(x: Array, origin: Array, count: int) -> Array:
    """Write floats [v, k] as signed limbs [v, k, count] in units of the bit at place `origin` [k], lowest limb first."""
    sign, exponent, high, low = fields_of(x)
    place = jnp.maximum(exponent, 1) - 1 - origin[None]
    shift = (jnp.arange(count, dtype=jnp.int32) * LIMB_BITS)[None, None] - place[..., None]
    limbs = shift_right(high[..., None], low[..., None], shift) & np.uint32((1 << LIMB_BITS) - 1)
    return jnp.where(sign[..., None], -1, 1) * limbs.astype(jnp.int32)


def _balanced(limbs: Array) -> Array:
    """Bring limbs below 2^31 into [-2^10 - 1, 2^10 + 1], the number staying the same; the top one keeps what is left."""
    top = np.arange(limbs.shape[-1]) == limbs.shape[-1] - 1

    def carry_on(_: Array, limbs: Array) -> Array:  # carries are below 2^20 + 1, then 2^9 + 1, then 2
        carry = jnp.where(top, 0, (limbs + _HALF) >> LIMB_BITS)
        return limbs - (carry << LIMB_BITS) + jnp.pad(carry[..., :-1], [(0, 0)] * (limbs.ndim - 1) + [(1, 0)])

    return lax.fori_loop(0, 3, carry_on, limbs)


def _product(a: Array, b: Array) -> Array:
    """Multiply numbers [..., la] and [..., lb]: limbs [..., la + lb] that are not carried yet."""
    shape = jnp.broadcast_shapes(a.shape[:-1], b.shape[:-1])
    width = b.shape[-1]

    def add_shifted(i: Array, total: Array) -> Array:
        window = lax.dynamic_slice_in_dim(total, i, width, axis=-1)
        return lax.dynamic_update_slice_in_dim(total, window + limb_of(a, i) * b, i, axis=-1)

    return lax.fori_loop(0, a.shape[-1], add_shifted, jnp.zeros((*shape, a.shape[-1] + width), jnp.int32))


def _dots(pairs: list[tuple[Array, Array]]) -> Array:
    """Multiply pairs of vectors [axis, k, limbs]: [pairs, k, limbs]."""
    left, right = (jnp.stack(vectors) for vectors in zip(*pairs, strict=True))
    return _product(left, right).sum(axis=1, dtype=jnp.int32)


def _split(rows: Array, *sizes: int) -> list[Array]:
    return jnp.split(rows, np.cumsum(sizes)[:-1])


def _widened(x: Array, like: Array) -> Array:
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, like.shape[-1] - x.shape[-1])])


def _signs(*parts: Array) -> list[Array]:
    """Return the signs of numbers [rows, k, limbs], of any widths: [rows, k] each."""
    widest = max(parts, key=lambda part: part.shape[-1])
    rows = jnp.concatenate([_widened(part, widest) for part in parts])
    signs = sign_of_limbs(rows.reshape(-1, rows.shape[-1])).reshape(rows.shape[:-1])
    return _split(signs, *(part.shape[0] for part in parts))
