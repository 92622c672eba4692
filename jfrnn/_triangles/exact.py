"""The triangle test: decide whether a particle and a triangle (2D: segment) are closer than the cutoff, exactly.

Step 1, in working precision, looks for a proof of either answer that holds for any rounding of the nearest point:

- near: a point of the triangle, sum of w_i v_i with w_i >= 0, that is closer than r;
- far: a direction u along which all corners are at least r away, min of u·(v_i - p) >= r |u|.

At the exact nearest point q, with u = q - p, both bounds coincide (duality of convex distance). So only pairs within rounding of
the cutoff, or with thin triangles whose nearest point floats do not find, remain open. Integers decide them
(`jfrnn._triangles.integers`).

Let u = eps/2. A component of v_i - p has a relative error u, a product adds u and a sum of three 2u: in all at most 4u (1 + small)
of the sum of absolute values; 4 eps, twice as much, is used. Errors of weights and directions do not matter, as long as everything
uses the same floats. A compiler may, however, compute them once per use, and fuse a product and a sum in one place but not in
another; `steady` prevents that.
"""

import functools
import operator
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import Cutoff, limb_bits
from jfrnn._tracing import first_set, set_places
from jfrnn._triangles.integers import Segments, Shapes, bit_range, limb_counts

Asked = TypeVar("Asked", Shapes, Segments)
Found = TypeVar("Found", bound=tuple)
Vector = list[Array]

_USUAL, _WIDE = 2, 3  # open pairs: undecided yet, and too wide for the usual number of limbs
_USUAL_CHUNK = 256  # pairs per iteration
_WIDE_CHUNK = 8


def sure_pairs(points: Vector, corners: list[Vector], cutoff: Cutoff, zero: Array) -> tuple[Array, Array]:
    """Return which pairs of points and shapes, given axis by axis, are certainly near, and which are left open: [q] bool each.

    `zero` [q] is that of `steady`.
    """
    scale = cutoff.unit_scale if cutoff.scaled else 1
    x = [[(v - p) * scale if cutoff.scaled else v - p for v, p in zip(corner, points, strict=True)] for corner in corners]
    radius = jnp.asarray(cutoff.radius * scale)
    weights, direction = _nearest(x, zero)
    largest = sum_of([jnp.abs(component) for component in direction])
    unit = [component / largest for component in direction]  # so scaled, squares that underflow do not matter
    near = _is_surely_near(x, weights, radius)
    return near, ~near & ~_is_surely_far(x, unit, radius)


def _is_surely_near(x: list[Vector], weights: Vector, radius: Array) -> Array:
    eps = jnp.finfo(weights[0].dtype).eps
    foot = _combine(weights, x)
    size = sum_of([w * sum_of([jnp.abs(component) for component in corner]) for w, corner in zip(weights, x, strict=True)])
    reach = radius * sum_of(weights) * (1 - 8 * eps) - 4 * eps * size
    return (reach > 0) & (dot(foot, foot) * (1 + 16 * eps) < reach * reach)


def _is_surely_far(x: list[Vector], unit: Vector, radius: Array) -> Array:
    eps = jnp.finfo(unit[0].dtype).eps
    heights = [dot(unit, corner) - 4 * eps * dot([jnp.abs(c) for c in unit], [jnp.abs(c) for c in corner]) for corner in x]
    least = functools.reduce(jnp.minimum, heights)
    return (least > 0) & (least * least > radius * radius * dot(unit, unit) * (1 + 16 * eps))


def _nearest(x: list[Vector], zero: Array) -> tuple[Vector, Vector]:
    """Return corner weights of about the nearest point to the origin, and the direction to it."""
    sides = [(0, 1), (1, 2), (2, 0)] if len(x) == 3 else [(0, 1)]
    found: list[tuple[Array, Vector, Vector]] = []
    for i, j in sides:
        along = minus(x[j], x[i])
        length = dot(along, along, zero)
        place = jnp.where(length > 0, -dot(x[i], along, zero) / jnp.where(length > 0, length, 1), 0)
        place = jnp.clip(place, 0, 1)
        here = [jnp.zeros_like(place) for _ in x]
        here[i], here[j] = 1 - place, place
        point = _combine(here, x, zero)
        found.append((dot(point, point, zero), here, point))
    _, weights, foot = functools.reduce(nearer_of, found)
    if len(x) == 2:
        return weights, foot
    normal = cross(minus(x[1], x[0]), minus(x[2], x[0]), zero)
    parts = [dot(cross(x[i], x[j], zero), normal, zero) for i, j in ((1, 2), (2, 0), (0, 1))]
    inside = (parts[0] > 0) & (parts[1] > 0) & (parts[2] > 0)
    whole = jnp.where(inside, sum_of(parts), 1)
    toward = jnp.where(dot(x[0], normal, zero) < 0, -1, 1).astype(whole.dtype)
    weights = [jnp.where(inside, part / whole, w) for part, w in zip(parts, weights, strict=True)]
    return weights, [jnp.where(inside, toward * n, f) for n, f in zip(normal, foot, strict=True)]


def nearer_of(one: Found, other: Found) -> Found:
    """Return the one of two candidates, pytrees of arrays of one shape, whose first array, a squared distance, is smaller."""
    nearer = jax.tree.leaves(other)[0] < jax.tree.leaves(one)[0]
    return jax.tree.map(lambda old, new: jnp.where(nearer, new, old), one, other)


def sum_of(parts: Vector) -> Array:
    """Add arrays in the given order."""
    return functools.reduce(operator.add, parts)


def steady(x: Array, zero: Array | None) -> Array:
    """Return x such that no compiler can fuse or recompute it differently: a product stays a rounded product.

    `zero` [q] is an unsigned integer as wide as x that the data always make 0, for example the sign bit of indices.
    """
    if zero is None:
        return x
    return lax.bitcast_convert_type(lax.bitcast_convert_type(x, zero.dtype) ^ zero, x.dtype)


def zero_of(indices: Array, dtype: np.dtype) -> Array:
    """Return the `zero` of `steady` from indices >= 0 in memory, for floats of this dtype."""
    return (indices < 0).astype(jnp.uint32 if dtype == np.float32 else jnp.uint64)


def dot(a: Vector, b: Vector, zero: Array | None = None) -> Array:
    """Return the scalar product of vectors given axis by axis."""
    return sum_of([steady(x * y, zero) for x, y in zip(a, b, strict=True)])


def cross(a: Vector, b: Vector, zero: Array | None = None) -> Vector:
    """Return the cross product of vectors in 3D."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return [steady(a[i] * b[j], zero) - steady(a[j] * b[i], zero) for i, j in pairs]


def minus(a: Vector, b: Vector) -> Vector:
    """Subtract vectors."""
    return [x - y for x, y in zip(a, b, strict=True)]


def _combine(weights: Vector, x: list[Vector], zero: Array | None = None) -> Vector:
    return [dot(weights, [corner[k] for corner in x], zero) for k in range(len(x[0]))]


def refine(open_pairs: Array, asked_at: Callable[[Array], Asked], test: Callable[[Asked, Array, int], Array]) -> Array:
    """Decide the open pairs [q] bool, which floats left, a few at a time; False elsewhere. Does nothing if no pair is open.

    `asked_at` returns what is asked of the pairs at indices [k], and `test` decides it in integers, as `is_near`.
    """

    def decide(open_pairs: Array) -> Array:
        state = jnp.where(open_pairs, _USUAL, 0).astype(jnp.int32)
        for waiting, chunk in ((_USUAL, _USUAL_CHUNK), (_WIDE, _WIDE_CHUNK)):
            state = _decide(state, waiting, min(chunk, state.size), asked_at, test)
        return state == 1

    return lax.cond(jnp.any(open_pairs), decide, jnp.zeros_like, open_pairs)


def _decide(
    state: Array, waiting: int, chunk: int, asked_at: Callable[[Array], Asked], test: Callable[[Asked, Array, int], Array]
) -> Array:
    """Decide [q] waiting pairs by integers: 0 no, 1 yes, or _WIDE if the integers are not wide enough."""
    size = len(state)

    def decide_chunk(carried: tuple[Array, Array]) -> tuple[Array, Array]:
        state, first = carried
        if waiting == _USUAL:
            at = set_places(state == waiting, chunk)
        else:  # so rare that gathering more than those near the first one is not worth its kernels
            at = jnp.minimum(first, size - chunk) + lax.iota(jnp.int32, chunk)
            at = jnp.where(lax.dynamic_slice_in_dim(state, at[0], chunk) == waiting, at, size)
        asked = asked_at(jnp.minimum(at, size - 1))
        usual, most = limb_counts(asked.points.dtype)
        count = usual if waiting == _USUAL else most
        origin, width = bit_range(asked.numbers)
        found = test(asked, origin, count).astype(jnp.int32)
        fits = width <= limb_bits(np.dtype(asked.points.dtype)) * count
        state = state.at[at].set(jnp.where(fits, found, _WIDE), mode="drop")
        return state, first_set(state == waiting)

    start = state, first_set(state == waiting)
    return lax.while_loop(lambda carried: carried[1] < size, decide_chunk, start)[0]
