"""Inside or outside a closed wall, by its winding number, for walls that may consist of several overlapping parts.

A pseudonormal tells the sides of a single surface that does not intersect itself. If closed parts overlap, touch, nest or are
doubled, some faces lie inside the solid, and only the winding number decides: the number of faces through which a ray leaves, minus
those through which it enters; outside everything it is 0.

The faces that a ray hits are found in a tree of boxes. With bounds on all rounding, each face is hit, not hit, or undecided (the
ray passes a side, or starts on the face, within rounding). So each ray gives bounds on the winding number; if these leave the side
open, another ray is cast. Points that no ray decides are within rounding of a face.

With u = eps/2, components of corners, relative to the point and divided by the largest, have an error of 2u, and triple products at
most 11u of the sum of absolute values; 8 eps is used.
Source: Ericson (2005), Real-Time Collision Detection, sect. 5.3.4, for the products.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._geometry import Cutoff
from jfrnn._tracing import Given, on_device, own_transfers, set_places
from jfrnn._triangles.exact import Vector, cross, dot, sum_of
from jfrnn._triangles.tree import WIDTH, TriangleTree, level_starts

_CHUNK = 1024  # nodes processed at a time
_SHARES = 4  # parts in which the triangles of a chunk of nodes are processed
_BEHIND = 64  # eps, relative to the largest coordinate, beyond which a corner is surely behind the start of a ray
# Rays run roughly along an axis, either way, but not exactly, as meshes often do; no component is 0.
_TILTS = {
    2: np.array([[1.0, 0.08371], [-0.11293, 1.0]]),
    3: np.array([[1.0, 0.08371, -0.13117], [-0.11293, 1.0, 0.07159], [0.09767, -0.12409, 1.0]]),
}


def is_closed(faces: Array) -> Array:
    """Say whether faces [f, d] bound a solid: each side (2D: vertex) is run through equally often in both directions. [] bool.

    Concrete faces are sorted while tracing, so that no compiled program sorts them again.
    """
    if isinstance(faces, Tracer):
        start, end = _sides(faces)
        one, two = (lax.sort(both, num_keys=len(both)) for both in (start, end))
        return jnp.all(jnp.stack([jnp.all(a == b) for a, b in zip(one, two, strict=True)]))
    start, end = _sides(np.asarray(jax.device_get(faces)).astype(np.int64))
    one, two = (np.sort(sum_of([part << 32 * k for k, part in enumerate(both)])) for both in (start, end))
    with own_transfers():
        return on_device(np.array_equal(one, two))


def _sides(faces: Given) -> tuple[list[Given], list[Given]]:
    """Return both ends of each side, and both ends in reverse order."""
    if faces.shape[1] == 2:
        return [faces[:, 0]], [faces[:, 1]]
    start, end = faces.reshape(-1), faces[:, np.array([1, 2, 0])].reshape(-1)
    return [start, end], [end, start]


def least_winding(corners: Array, good: Array) -> Array:
    """Return the least winding number of inside points, [] int32: 1, or 0 for a wall around the outside.

    Such a wall, a container for example, encloses a signed volume (2D: area) that is below 0 by more than rounding.
    """
    raw = corners - corners[:1, :1]
    raw = raw / jnp.maximum(jnp.max(jnp.abs(raw)), jnp.finfo(raw.dtype).tiny)
    x = [[raw[:, c, k] for k in range(raw.shape[2])] for c in range(raw.shape[1])]
    parts = jnp.where(good, _determinant(x), 0)
    doubt = 16 * jnp.finfo(parts.dtype).eps * np.sqrt(len(corners)).astype(parts.dtype)
    return jnp.where(jnp.sum(parts) < -doubt * jnp.sum(jnp.abs(parts)), 0, 1).astype(jnp.int32)


def ray_ways(dim: int, dtype: np.dtype) -> Array:
    """Return the directions of rays, [2 dim, dim]: those along axes first, then the opposite ones."""
    return jnp.asarray(np.concatenate([_TILTS[dim], -_TILTS[dim]]), dtype)


def cast_rays(
    tree: TriangleTree, corners: Array, points: Array, rays: Array, asked: Array, least: Array, cutoff: Cutoff
) -> tuple[Array, Array]:
    """Say which of the points [n, d] asked for [n] are inside a closed wall, and which of them no ray decides: [n] bool each.

    The wall's triangles, f > 0, are given by their corners [f, corner, d], and by a tree of boxes widened by the cutoff; the rays
    are directions from `ray_ways`. The winding number of inside points is at least `least` [].
    """
    dim = points.shape[1]
    top = tree.boxes[:, int(level_starts(len(corners))[-2]) :]
    exits = jnp.concatenate([jnp.max(top[dim:], axis=1)[None] - points, points - jnp.min(top[:dim], axis=1)[None]], axis=1)
    ways = jnp.argsort(exits, axis=1)  # the shortest way out hits the fewest boxes

    def cast(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        tried, inside, undecided = state
        way = lax.dynamic_index_in_dim(ways, tried, axis=1, keepdims=False)
        low, high = _bounds(tree, corners, points, rays[way], undecided, cutoff)
        return tried + 1, inside | (undecided & (low >= least)), undecided & (low < least) & (high >= least)

    start = (jnp.int32(0), jnp.zeros_like(asked), asked)
    _, inside, undecided = lax.while_loop(lambda state: (state[0] < 2 * dim) & jnp.any(state[2]), cast, start)
    return inside, undecided


def _determinant(x: list[Vector]) -> Array:
    return dot(x[0], cross(x[1], x[2])) if len(x) == 3 else x[0][0] * x[1][1] - x[0][1] * x[1][0]


def _bounds(tree: TriangleTree, corners: Array, points: Array, rays: Array, asked: Array, cutoff: Cutoff) -> tuple[Array, Array]:
    """Return the least and largest winding number, [n] int32, that are possible after rays [n, d]; 0 where not asked for.

    Nodes wait on a stack, lower levels above higher ones, and are taken from its top a chunk at a time. So it never holds more
    nodes of one level than the children of one chunk. Triangles whose boxes are hit are decided before the next chunk. The function
    is long because its loops share that stack.
    """
    (n, dim), levels = points.shape, level_starts(len(corners))
    chunk, starts = min(_CHUNK, n), tuple(int(x) // WIDTH for x in levels)
    boxes, lanes = tree.boxes.reshape(2 * dim, -1, WIDTH), lax.iota(jnp.int32, WIDTH)
    queue, total = set_places(asked, n + chunk), jnp.sum(asked, dtype=jnp.int32)
    room = chunk * WIDTH * (len(starts) - 1)  # size of the stack, which entries of triangles follow

    def open_nodes(state: tuple[Array, ...]) -> tuple[Array, ...]:
        stack, height, low, high = state
        place = height - chunk + lax.iota(jnp.int32, chunk)
        owner, group = stack[:, jnp.maximum(place, 0)]
        met = (place >= 0)[:, None] & _meets_boxes(boxes[:, group], points[owner], rays[owner], cutoff)
        is_leaf, below = (group < starts[1])[:, None], group[:, None] * WIDTH + lanes[None]
        for start, end, first in zip(starts[1:-1], starts[2:], starts, strict=False):
            here = (group >= start) & (group < end)
            below = jnp.where(here[:, None], below - start * WIDTH + first, below)
        waits, found, height = (met & ~is_leaf).reshape(-1), (met & is_leaf).reshape(-1), jnp.maximum(height - chunk, 0)
        place = jnp.where(waits, height + jnp.cumsum(waits, dtype=jnp.int32) - 1, room + chunk * WIDTH)
        place = jnp.where(found, room + jnp.cumsum(found, dtype=jnp.int32) - 1, place)
        pairs = jnp.stack([jnp.broadcast_to(owner[:, None], met.shape), below]).reshape(2, -1)
        stack = stack.at[:, place].set(pairs, mode="drop")
        low, high = decide(stack, jnp.sum(found, dtype=jnp.int32), low, high)
        return stack, height + jnp.sum(waits, dtype=jnp.int32), low, high

    def decide(stack: Array, count: Array, low: Array, high: Array) -> tuple[Array, Array]:
        size = chunk * WIDTH // _SHARES

        def add(state: tuple[Array, ...]) -> tuple[Array, ...]:
            done, low, high = state
            owner, entry = lax.dynamic_slice_in_dim(stack, room + done, size, axis=1)
            triangle = jnp.where(done + lax.iota(jnp.int32, size) < count, tree.triangles[entry], len(corners))
            least, most = _crossings(corners, triangle, points[owner], rays[owner])
            return done + size, low.at[owner].add(least), high.at[owner].add(most)

        _, low, high = lax.while_loop(lambda state: state[0] < count, add, (jnp.int32(0), low, high))
        return low, high

    def follow(b: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        owner = jnp.minimum(lax.dynamic_slice_in_dim(queue, b * chunk, chunk), n - 1)
        stack = jnp.zeros((2, room + chunk * WIDTH), jnp.int32).at[0, :chunk].set(owner).at[1, :chunk].set(starts[-2])
        start = stack, jnp.minimum(total - b * chunk, chunk), *bounds
        _, _, low, high = lax.while_loop(lambda state: state[1] > 0, open_nodes, start)
        return low, high

    return lax.fori_loop(0, -(-total // chunk), follow, (jnp.zeros(n, jnp.int32), jnp.zeros(n, jnp.int32)))


def _meets_boxes(boxes: Array, points: Array, rays: Array, cutoff: Cutoff) -> Array:
    """Say which boxes [2 d, k, WIDTH], shrunk by the cutoff, rays [k, d] may hit: [k, WIDTH] bool. No hit is missed."""
    dim, eps = points.shape[1], jnp.finfo(points.dtype).eps
    inner = jnp.asarray(cutoff.radius) * (1 - 8 * eps)
    low = [(boxes[k] - points[:, k, None]) + (inner - 4 * eps * (jnp.abs(boxes[k]) + inner)) for k in range(dim)]
    high = [(boxes[dim + k] - points[:, k, None]) - (inner - 4 * eps * (jnp.abs(boxes[dim + k]) + inner)) for k in range(dim)]
    largest = functools.reduce(jnp.maximum, map(jnp.abs, (*low, *high)))
    first, last = jnp.zeros_like(largest), jnp.full_like(largest, jnp.inf)
    for k in range(dim):
        one, two = (side / rays[:, k, None] for side in (low[k] - 16 * eps * largest, high[k] + 16 * eps * largest))
        first, last = jnp.maximum(first, jnp.minimum(one, two)), jnp.minimum(last, jnp.maximum(one, two))
    return (boxes[0] <= boxes[dim]) & ~(last < first)  # NaN, from overflow, counts as a hit


def _crossings(corners: Array, triangle: Array, points: Array, rays: Array) -> tuple[Array, Array]:
    """Return bounds on the number of times rays [k, d] leave triangles [k], minus those they enter: [k] int32 each."""
    dim, finfo = points.shape[1], jnp.finfo(points.dtype)
    there = triangle < len(corners)
    raw = corners[jnp.where(there, triangle, 0)] - points[:, None]
    largest = jnp.max(jnp.abs(raw), axis=(1, 2))
    unit = jnp.where(largest > 0, largest, 1)
    x = [[raw[:, c, k] / unit for k in range(dim)] for c in range(dim)]
    ray = [rays[:, k] for k in range(dim)]
    sides, doubts, height, doubt = line_products(x, ray)
    behind = functools.reduce(jnp.logical_and, (dot(ray, corner) < -_BEHIND * finfo.eps for corner in x))
    leaves, enters, (all_left, left), (all_right, right) = height > doubt, height < -doubt, *sure_signs(sides, doubts)
    may_leave, may_enter = there & ~(behind | right | enters), there & ~(behind | left | leaves)
    sure_left, sure_right = may_leave & leaves & all_left, may_enter & enters & all_right
    least = sure_left.astype(jnp.int32) - may_enter.astype(jnp.int32)
    return least, may_leave.astype(jnp.int32) - sure_right.astype(jnp.int32)


def line_products(x: list[Vector], ray: Vector) -> tuple[Vector, Vector, Array, Array]:
    """Return triple products of a line through the origin with each side of a shape; all have one sign if it crosses the shape.

    Further results are bounds on their rounding errors, a number that has the same sign if the shape is ahead, and the bound on
    its error.
    """
    finfo = jnp.finfo(ray[0].dtype)

    def bound(size: Array) -> Array:
        return 8 * finfo.eps * size + 64 * finfo.tiny

    if len(x) == 2:
        flat = [ray[0] * corner[1] - ray[1] * corner[0] for corner in x]
        doubts = [bound(jnp.abs(ray[0] * corner[1]) + jnp.abs(ray[1] * corner[0])) for corner in x]
        size = jnp.abs(x[0][0] * x[1][1]) + jnp.abs(x[0][1] * x[1][0])
        return [-flat[0], flat[1]], doubts, _determinant(x), bound(size)
    sizes_of = [[jnp.abs(component) for component in corner] for corner in (*x, ray)]
    crosses = [cross(x[i], x[j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    permanents = [
        [sizes_of[i][a] * sizes_of[j][b] + sizes_of[i][b] * sizes_of[j][a] for a, b in ((1, 2), (2, 0), (0, 1))]
        for i, j in ((1, 2), (2, 0), (0, 1))
    ]
    sides, doubts = [dot(ray, c) for c in crosses], [bound(dot(sizes_of[3], p)) for p in permanents]
    return sides, doubts, dot(x[0], crosses[0]), bound(dot(sizes_of[0], permanents[0]))


def sure_signs(numbers: Vector, doubts: Vector) -> list[tuple[Array, Array]]:
    """Say whether all of the numbers, and whether any of them, are surely above 0; and likewise below."""
    above, below = ([sign * x > doubt for x, doubt in zip(numbers, doubts, strict=True)] for sign in (1, -1))
    return [(functools.reduce(jnp.logical_and, x), functools.reduce(jnp.logical_or, x)) for x in (above, below)]
