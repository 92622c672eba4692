"""The tests of triangles in integers, without any rounding, for pairs that floats leave undecided: is it near, is it crossed?

The first decision needs only signs of polynomials in x_i = v_i - p, the corners relative to the particle (d_i = x_(i+1) - x_i):

- a vertex is near:  |x_i|² < r²
- a side is near between its ends:  0 < t < |d|²  and  (|x_i|² - r²) |d|² < t²,  with t = -x_i·d
- the plane is near within the triangle:  (x_j × x_k)·n > 0 for each side  and  (x_0·n)² < r² |n|²,  with n = sum of x_j × x_k

The distance is below r if and only if one of these holds: each implies a point of the triangle closer than r, and the nearest point
is a vertex, or inside a side, or inside the triangle. A nearest point on the border between two of these belongs to the smaller
one, hence `>`. For degenerate triangles n or d is 0, and the conditions with it are false.

Coordinates are whole multiples of one power of two, in limbs (`jfrnn._geometry.integers`): as many as pairs usually need or, if
exponents lie far apart, as the float format may need. The longest sum of products of carried limbs has 2·4·27 (float64: 2·4·82)
terms and stays below 2^30.5 (2^61.5).
"""

import functools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import GUARDS, carry_limbs, fields_of, full_count, limb_sign, limbs_of

_NONE = 1 << 20  # larger than any bit position
_MOST_PRODUCTS = 64  # most products per round
_USUAL_LIMBS = {4: 5, 8: 4}  # by bytes of a float; enough for 55 and 104 bits between the highest and lowest set bit


class Shapes(NamedTuple):
    """Points and the corners of the shapes they are compared with.

    Attributes:
        points: [d, k] coordinates.
        corners: [d, d, k]: corner, axis; triangles in 3D, segments in 2D.
        radius: [] the cutoff.
    """

    points: Array
    corners: Array
    radius: Array

    @property
    def numbers(self) -> Array:
        """All of them, [m, k]."""
        size = self.points.shape[1]
        return jnp.concatenate([self.points, self.corners.reshape(-1, size), jnp.broadcast_to(self.radius, (1, size))])


class Segments(NamedTuple):
    """Segments, and the corners of the shapes that they may meet.

    Attributes:
        points: [d, k] coordinates where they begin.
        ends: [d, k] where they end.
        corners: As in `Shapes`.
    """

    points: Array
    ends: Array
    corners: Array

    @property
    def numbers(self) -> Array:
        """All of them, [m, k]."""
        return jnp.concatenate([self.points, self.ends, self.corners.reshape(-1, self.points.shape[1])])


def limb_counts(dtype: np.dtype) -> tuple[int, int]:
    """Return how many limbs the numbers of a usual pair need, and those of any pair."""
    return _USUAL_LIMBS[dtype.itemsize], full_count(dtype)


def bit_range(numbers: Array) -> tuple[Array, Array]:
    """Return the position of the lowest set bit in any number [m, k] of a pair, and the number of bits to the highest: [k]."""
    _, place, mantissa = fields_of(numbers)
    one = np.ones((), mantissa.dtype)
    lowest = place + lax.population_count((mantissa & (~mantissa + one)) - one).astype(jnp.int32)
    highest = place + 8 * mantissa.dtype.itemsize - lax.clz(mantissa).astype(jnp.int32)
    zero = mantissa == 0
    origin = jnp.min(jnp.where(zero, _NONE, lowest), axis=0)
    return origin, jnp.max(jnp.where(zero, -_NONE, highest), axis=0) - origin


def is_near(shapes: Shapes, origin: Array, count: int) -> Array:
    """Decide [k] pairs whose bits lie within `count` limbs from position `origin` [k]: is the shape closer than the cutoff?"""
    dim = shapes.points.shape[0]
    numbers = shapes.numbers
    points, corners, radius = np.tile(np.arange(dim), dim), np.arange(dim, dim + dim * dim), len(numbers) - 1
    after = np.roll(corners.reshape(dim, dim), -1, axis=0).reshape(-1)
    ends, starts = np.concatenate([corners, after, [radius, radius]]), np.concatenate([points, corners, [radius, radius]])
    limbs, lower = (limbs_of(_rows(numbers, rows), count + 1, origin[None]) for rows in (ends, starts))  # and one for the sign
    times = (np.arange(len(ends)) != len(ends) - 2).astype(limbs.dtype)[:, None, None]  # nothing is subtracted from the cutoff
    vectors = carry_limbs(limbs - lower * times)
    one = np.zeros((len(ends), 1, count + 1), limbs.dtype)
    one[-1, 0, 0] = 1
    vectors = vectors + one  # relative corners, sides, the cutoff and 1: [rows, k, limbs]
    return _near_triangle(vectors) if dim == 3 else _near_segment(vectors)


def is_crossed(segments: Segments, origin: Array, count: int) -> Array:
    """Decide [k] pairs whose bits lie within `count` limbs from position `origin` [k]: does the segment meet the shape?

    As `jfrnn._triangles.crossings` says, from the signs of h, of each s and of h - sum of s.
    """
    dim, numbers = segments.points.shape[0], segments.numbers
    ends, starts = np.arange(dim, len(numbers)), np.tile(np.arange(dim), dim + 1)
    limbs, lower = (limbs_of(_rows(numbers, rows), count + 1, origin[None]) for rows in (ends, starts))  # and one for the sign
    vectors = carry_limbs(limbs - lower)  # the segment, then the corners, from where it begins: [rows, k, limbs]
    ray, x = np.arange(dim), np.arange(dim, dim * (dim + 1)).reshape(dim, dim)
    table = _Table()
    if dim == 2:
        pairs = ((x[0], x[1]), (ray, x[1]), (x[0], ray))
        left, right, sums = table.make([table.dot(a, b[::-1], (1, -1)) for a, b in pairs])
        found = carry_limbs(_sum_rows(sums, _product(_rows(vectors, left), _rows(vectors, right))))
    else:
        both = ((x[1], x[2]), (x[2], x[0]), (x[0], x[1]))
        crosses = [table.dot(a[[j, k]], b[[k, j]], (1, -1)) for a, b in both for j, k in ((1, 2), (2, 0), (0, 1))]
        left, right, sums = table.make(crosses)
        cross = carry_limbs(_sum_rows(sums, _product(_rows(vectors, left), _rows(vectors, right))))
        table = _Table()
        left, right, sums = table.make([table.dot(x[0], range(3)), *(table.dot(ray, range(3 * c, 3 * c + 3)) for c in range(3))])
        found = carry_limbs(_sum_rows(sums, _product(_rows(vectors, left), _rows(cross, right))))
    across = jnp.sum(found[1:], axis=0, keepdims=True, dtype=found.dtype)
    height, *sides, whole, rest = _signs(jnp.concatenate([found, across, found[:1] - across]))
    above = (whole > 0) & (height >= 0) & (rest <= 0)
    below = (whole < 0) & (height <= 0) & (rest >= 0)
    for side in sides:
        above, below = above & (side >= 0), below & (side <= 0)
    return above | below


def _near_segment(vectors: Array) -> Array:
    x, along, radius = vectors[:4].reshape(2, 2, *vectors.shape[1:]), vectors[4:6], vectors[-2:-1]
    left, right = jnp.stack([x[0], x[1], x[0], along]), jnp.stack([x[0], x[1], along, along])
    sums = _product(left, right).sum(axis=1, dtype=left.dtype)  # scalar products
    limit = _product(radius, radius)
    square = jnp.stack([sums[0], sums[1]]) - limit
    place, length = -sums[2:3], sums[3:]
    square, place, length, rest = jnp.split(carry_limbs(jnp.concatenate([square, place, length, length - place])), (2, 3, 4))
    beside = _product(square[:1], length) - _product(place, place)
    return _near_parts(_signs(square), _signs(place), _signs(rest), limb_sign(beside))


def _near_triangle(vectors: Array) -> Array:
    """Decide in three rounds, each computing products of the previous round's rows and sums of them, as given by tables.

    With tables, each round is one kernel instead of dozens, which took XLA seconds to compile.
    """
    found, signs = vectors, []
    for left, right, table in _triangle_rounds():
        found = carry_limbs(_sum_rows(table, _product(_rows(found, left), _rows(found, right))))
        signs.append(_signs(found))
    first, second, third = signs
    near = _near_parts(first[0:3], first[3:6], first[9:12], second[:3])
    return near | (jnp.all(second[3:6] > 0, axis=0) & (third[0] < 0))


def _rows(x: Array, which: np.ndarray) -> Array:
    return x.at[which.astype(np.int32)].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _sum_rows(table: np.ndarray, products: Array) -> Array:
    """Return sums [rows, k, limbs] of products [n, k, limbs] with the coefficients 1, -1 and 0 of a table [rows, n]."""
    terms = int(np.abs(table).sum(axis=1).max())
    which = np.argsort(table == 0, axis=1, kind="stable")[:, :terms]  # nonzero coefficients first
    signs = np.take_along_axis(table, which, axis=1).astype(products.dtype)[:, :, None, None]
    return (_rows(products, which) * signs).sum(axis=1, dtype=products.dtype)


class _Table:
    """Products of two rows each, and sums of products, as vectors of the coefficients 1, -1 and 0."""

    def __init__(self) -> None:
        self.left: list[int] = []
        self.right: list[int] = []

    def dot(self, left: Iterable[int], right: Iterable[int], signs: Sequence[int] = (1, 1, 1)) -> np.ndarray:
        """Return the coefficients of the sum of products of these rows."""
        total = np.zeros(_MOST_PRODUCTS, np.int32)
        for a, b, sign in zip(left, right, signs, strict=False):
            total[len(self.left)] = sign
            self.left.append(int(a))
            self.right.append(int(b))
        return total

    def make(self, sums: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the first and the second factor of each product, and the table of sums."""
        return np.array(self.left), np.array(self.right), np.stack(sums)[:, : len(self.left)]


@functools.cache
def _triangle_rounds() -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]:
    """Return the products and sums of `_near_triangle`, whose 20 input rows are x, sides, the cutoff r and 1, axis by axis.

    The first round computes |x|² - r², t, |d|², |d|² - t, x_j × x_k, n, r², x_0 and 1; the second the conditions of sides and of
    the inside, |n|², x_0·n and r²; the third (x_0·n)² - r² |n|².
    """
    x, along, axes = np.arange(9).reshape(3, 3), np.arange(9, 18).reshape(3, 3), ((1, 2), (2, 0), (0, 1))
    table, of_corners = _Table(), range(3)
    squares, places, lengths = ([table.dot(a[i], b[i]) for i in of_corners] for a, b in ((x, x), (x, along), (along, along)))
    (limit,), one, seen = [table.dot([18], [18])], table.dot([19], [19]), [table.dot([row], [19]) for row in x[0]]
    one_two = [(x[(i + 1) % 3], x[(i + 2) % 3]) for i in of_corners]
    crosses = [[table.dot(a[[j, k]], b[[k, j]], (1, -1)) for j, k in axes] for a, b in one_two]
    normal = [crosses[0][k] + crosses[1][k] + crosses[2][k] for k in range(3)]
    sums = [*(s - limit for s in squares), *(-p for p in places), *lengths, *(q + p for q, p in zip(lengths, places, strict=True))]
    first = table.make([*sums, *crosses[0], *crosses[1], *crosses[2], *normal, limit, *seen, one])
    table, cross, normal = _Table(), np.arange(12, 21).reshape(3, 3), np.arange(21, 24)
    beside = [table.dot([i, 3 + i], [6 + i, 3 + i], (1, -1)) for i in of_corners]
    inside = [table.dot(cross[i], normal) for i in of_corners]
    area, height = table.dot(normal, normal), table.dot(range(25, 28), normal)
    second = table.make([*beside, *inside, area, height, table.dot([24], [28])])
    table = _Table()
    return first, second, table.make([table.dot([7, 8], [7, 6], (1, -1))])


def _near_parts(square: Array, place: Array, rest: Array, beside: Array) -> Array:
    """Say which vertices, and which sides between their ends, are near, from the signs of their conditions: [parts, k]."""
    return jnp.any(square < 0, axis=0) | jnp.any((place > 0) & (rest > 0) & (beside < 0), axis=0)


def _product(a: Array, b: Array) -> Array:
    """Multiply like `limb_product`, limb by limb: a fifth of its time for many rows, but a loop to compile."""
    shape, width = jnp.broadcast_shapes(a.shape[:-1], b.shape[:-1]), b.shape[-1]

    def add_moved(i: Array, total: Array) -> Array:
        window = lax.dynamic_slice_in_dim(total, GUARDS + i, width, axis=-1)
        more = lax.dynamic_slice_in_dim(a, i, 1, axis=-1) * b
        return lax.dynamic_update_slice_in_dim(total, window + more, GUARDS + i, axis=-1)

    return lax.fori_loop(0, a.shape[-1], add_moved, jnp.zeros((*shape, GUARDS + a.shape[-1] + width), a.dtype))


def _signs(rows: Array) -> Array:
    """Return the signs of carried numbers [rows, k, limbs]: [rows, k]."""
    return limb_sign(jnp.pad(rows, ((0, 0), (0, 0), (GUARDS, 0))))
