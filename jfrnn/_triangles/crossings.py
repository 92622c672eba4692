"""Lines of sight: whether a triangle (2D: a segment) is between two particles, exactly.

With x_i = v_i - p the corners relative to one particle, and r = q - p the other one:

- s_i = r·(x_j × x_k) for each side; all have one sign, or are 0, if the line through both meets the triangle;
- h = x_0·(x_1 × x_2), and h - sum of s, tell on which side of the plane p and q are.

In 2D, s = (r × x_1, x_0 × r) and h = x_0 × x_1. The segment from p to q meets the closed triangle at one point if all s and their
sum S have one sign and h lies between 0 and S, ends included; S is 0 if the segment is parallel to the plane, or the triangle has
no area. Floats decide where these signs are beyond doubt (`jfrnn._triangles.winding` bounds the rounding), integers elsewhere.

Source: Möller & Trumbore (1997), doi:10.1080/10867651.1997.10487468, with the quotients multiplied out.
"""

import functools
import operator

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._tracing import set_places
from jfrnn._triangles.exact import refine, sum_of
from jfrnn._triangles.integers import Segments, is_crossed
from jfrnn._triangles.winding import line_products, sure_signs

_CHUNK = 1 << 13  # pairs at a time


def are_crossed(points: Array, corners: Array, good: Array, idx: Array, used: Array, pairs: Array) -> Array:
    """Say between which pairs of particles [e, 2] there is a triangle of the first one's row: [e] bool.

    Points are [n, d], rows idx [n, capacity] with so many slots `used` [n], triangles given by their corners [f, corner, d], of
    which `good` [f] are valid; n, f and e are above 0. Pairs with a number that no point has are not asked for.
    """
    n, e, chunk = len(points), len(pairs), min(_CHUNK, len(pairs))
    there = jnp.all((pairs >= 0) & (pairs < n), axis=1)
    known = jnp.where(there[:, None], pairs, 0)
    there &= (used[known[:, 0]] > 0) & jnp.all(jnp.all(jnp.isfinite(points), axis=1)[known], axis=1)
    queue, total = set_places(there, e + chunk), jnp.sum(there, dtype=jnp.int32)

    def look(b: Array, found: Array) -> Array:
        place = lax.dynamic_slice_in_dim(queue, b * chunk, chunk)
        first, second = known[jnp.minimum(place, e - 1)].T
        count = jnp.where(place < e, used[first], 0)

        def try_slot(state: tuple[Array, Array]) -> tuple[Array, Array]:
            slot, hit = state
            triangle = jnp.where(slot < count, idx.at[first, slot].get(mode="clip"), 0)
            asked = (slot < count) & ~hit & good[triangle]
            return slot + 1, hit | _is_between(points[first], points[second], corners[triangle], asked)

        start = jnp.int32(0), jnp.zeros(chunk, bool)
        _, hit = lax.while_loop(lambda state: state[0] < jnp.max(count), try_slot, start)
        return found.at[place].set(hit, mode="drop")

    return lax.fori_loop(0, -(-total // chunk), look, jnp.zeros(e, bool))


def _is_between(points: Array, ends: Array, shapes: Array, asked: Array) -> Array:
    """Say which segments [k, d] to [k, d] meet their shapes [k, corner, d], where asked: [k] bool."""
    dim = points.shape[1]
    raw, way = shapes - points[:, None], ends - points
    largest = jnp.maximum(jnp.max(jnp.abs(raw), axis=(1, 2)), jnp.max(jnp.abs(way), axis=1))
    unit = jnp.where(largest > 0, largest, 1)
    x = [[raw[:, c, k] / unit for k in range(dim)] for c in range(dim)]
    sides, doubts, height, doubt = line_products(x, [way[:, k] / unit for k in range(dim)])
    rest, rest_doubt = functools.reduce(operator.sub, sides, height), sum_of([doubt, *doubts])
    (above, left), (below, right) = sure_signs(sides, doubts)
    surely = above & (height > doubt) & (rest < -rest_doubt) | below & (height < -doubt) & (rest > rest_doubt)
    never = left & right | (height > doubt) & (rest > rest_doubt) | (height < -doubt) & (rest < -rest_doubt)
    doubtful = asked & ~surely & ~never
    decided = refine(doubtful, lambda at: Segments(points[at].T, ends[at].T, jnp.moveaxis(shapes[at], 0, -1)), is_crossed)
    return (surely & asked) | decided
