"""A hashed grid with cells of many sizes, in which triangles (in 2D: segments) are looked up.

A triangle is stored in every cell from which a particle may be closer to it than the cutoff. A particle thus visits only its own
cell, and meets no triangle twice. Triangles may differ in size by orders of magnitude: each uses the smallest cells, from about the
cutoff upwards in powers of two, of which it needs at most `MOST_CELLS`; at the largest level one cell is all of space. So the
number of entries depends on the number of triangles only, and nothing can overflow. A particle does one lookup per level in use.

No pair is missed: if a particle is closer than r to a triangle, each coordinate lies between fl(low - r') and fl(high + r'), with
r' slightly above r and the coordinates low, high of the corners, because rounding is monotonic and the particle's coordinate is a
float. Its cell, floor(x·2^k) in exact arithmetic, is therefore in the box of cells between theirs. A cell of that box is omitted
only if a direction separates it, widened by r', from the triangle by more than any rounding error.
"""

import functools
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import Cutoff
from jfrnn._tracing import portable
from jfrnn._triangles.exact import Vector, cross, dot, minus, sum_of

MOST_CELLS = {2: 8, 3: 16}  # most cells per triangle, by dimension
LANES = {2: 32, 3: 128}  # most cells of a box that are tested one by one; a larger box uses larger cells
_BLOCK = 1024  # triangles processed at a time
_FARTHEST = 2.0**22  # most cells between the origin and a cell, so that cell centers are floats
_BUCKETS_PER_TRIANGLE = 8
_FEWEST_BUCKETS = 1024


@portable
class TriangleCells(NamedTuple):
    """Triangles sorted by the hash bucket of their cells. A pytree.

    Attributes:
        start: First entry of each bucket, shape [buckets + 1], int32.
        triangles: Triangle indices by bucket, shape [entries], int32; the number of triangles marks repetitions within a bucket.
        levels: Cell sizes in use, smallest first, as biased exponents of the inverse edge, shape [levels], int32; padded with 0.
        level_count: Number of levels in use, shape [], int32.
        level_of: The level of each triangle, shape [f], int32, which tells entries of other levels in a bucket apart.
    """

    start: Array
    triangles: Array
    levels: Array
    level_count: Array
    level_of: Array


def entry_count(faces: int, dim: int) -> int:
    """Return the number of entries for this number of triangles."""
    return faces * MOST_CELLS[dim]


def bucket_count(faces: int) -> int:
    """Return the number of buckets for this number of triangles, a power of two."""
    return max(_FEWEST_BUCKETS, 1 << (_BUCKETS_PER_TRIANGLE * faces - 1).bit_length())


def level_limit(dtype: np.dtype) -> int:
    """Return the largest possible number of cell sizes."""
    return 256 if dtype == np.float32 else 2048


def scale_of(level: Array, dtype: np.dtype) -> Array:
    """Return the inverse cell edge of a level, 2^(level - bias), or 0 for level 0, whose single cell is all of space."""
    unsigned, nmant = (jnp.uint32, 23) if dtype == np.float32 else (jnp.uint64, 52)
    return lax.bitcast_convert_type(level.astype(unsigned) << unsigned(nmant), dtype)


def cells_of(x: Array, scale: Array) -> Array:
    """Return the cell index of each coordinate along an axis, int32; exact unless cells are too far away to resolve."""
    return jnp.clip(jnp.floor(x * scale), -(2.0**30), 2.0**30).astype(jnp.int32)


def bucket_of(level: Array, cells: list[Array], buckets: int) -> Array:
    """Return the hash of cells, int32. If cells collide, the triangles of one are additional candidates in the other."""
    word = level.astype(jnp.uint32) * np.uint32(0x9E3779B1)
    for cell in cells:
        word = (word ^ cell.astype(jnp.uint32)) * np.uint32(0x85EBCA6B)
        word = word ^ (word >> np.uint32(15))
    word = word * np.uint32(0xC2B2AE35)
    return ((word ^ (word >> np.uint32(16))) & np.uint32(buckets - 1)).astype(jnp.int32)


def sort_triangles(corners: Array, good: Array, cutoff: Cutoff) -> TriangleCells:
    """Sort triangles [f, corner, axis] with f > 0 into cells, except those that are not `good` [f] bool."""
    faces, dim = corners.shape[:2]
    entries, buckets, block = entry_count(faces, dim), bucket_count(faces), min(_BLOCK, faces)

    def add_block(b: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        bucket, triangle, level_of, filled = state
        first = jnp.minimum(b * block, faces - block)
        which = first + lax.iota(jnp.int32, block)
        fresh = good[which] & (which >= b * block)  # the last block overlaps, so that all have one length
        level, held, cells = _held_cells(jnp.where(fresh[:, None, None], corners[which], 0), cutoff)
        held = held & fresh[:, None]
        place = filled + (jnp.cumsum(held.reshape(-1), dtype=jnp.int32) - 1).reshape(held.shape)
        place = jnp.where(held, place, entries)
        bucket = bucket.at[place].set(bucket_of(level[:, None], cells, buckets), mode="drop")
        triangle = triangle.at[place].set(jnp.broadcast_to(which[:, None], held.shape), mode="drop")
        level_of = level_of.at[jnp.where(fresh, which, faces)].set(level, mode="drop")
        return bucket, triangle, level_of, filled + jnp.sum(held, dtype=jnp.int32)

    empty = jnp.full(entries, buckets, jnp.int32), jnp.full(entries, faces, jnp.int32)
    start = (*empty, jnp.zeros(faces, jnp.int32), jnp.int32(0))
    bucket, triangle, level_of, _ = lax.fori_loop(0, -(-faces // block), add_block, start)
    limit = level_limit(np.dtype(corners.dtype))
    used = jnp.zeros(limit, bool).at[jnp.where(good, level_of, limit)].set(True, mode="drop")
    key, triangle = lax.sort((bucket.astype(jnp.uint32), triangle), num_keys=1, is_stable=True)
    bucket = key.astype(jnp.int32)
    again = (bucket[1:] == bucket[:-1]) & (triangle[1:] == triangle[:-1])  # two cells of a triangle with the same hash
    triangle = jnp.where(jnp.concatenate([jnp.zeros(1, bool), again]), faces, triangle)
    start = jnp.cumsum(jnp.zeros(buckets + 1, jnp.int32).at[bucket + 1].add(1, mode="drop"), dtype=jnp.int32)
    levels = limit - 1 - jnp.nonzero(used[::-1], size=limit, fill_value=limit - 1)[0].astype(jnp.int32)
    return TriangleCells(start, triangle, levels, jnp.sum(used, dtype=jnp.int32), level_of)


def _held_cells(corners: Array, cutoff: Cutoff) -> tuple[Array, Array, list[Array]]:
    """Choose the cells of [b] triangles: return their levels [b], which of [b, lanes] cells are needed, and those cells."""
    dim, dtype = corners.shape[1], corners.dtype
    finfo = jnp.finfo(dtype)
    radius = jnp.asarray(cutoff.radius * (1 + 8 * finfo.eps))
    low = jnp.clip(jnp.min(corners, axis=1) - radius, -finfo.max, finfo.max)
    high = jnp.clip(jnp.max(corners, axis=1) + radius, -finfo.max, finfo.max)

    start = _finest_level(low, high, cutoff)
    state = (start, jnp.zeros((start.size, LANES[dim]), bool), jnp.ones(start.size, bool))

    def try_level(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        level, _, undecided = state
        cells, there, complete = _box_cells(level, low, high)
        held = there & ~_is_apart(cells, corners, scale_of(level, np.dtype(corners.dtype)), radius) & complete[:, None]
        too_many = undecided & (~complete | (jnp.sum(held, axis=1, dtype=jnp.int32) > MOST_CELLS[dim])) & (level > 0)
        return level - too_many.astype(jnp.int32), held, too_many

    level, held, _ = lax.while_loop(lambda state: jnp.any(state[2]), try_level, state)
    return level, held, _box_cells(level, low, high)[0]


def _finest_level(low: Array, high: Array, cutoff: Cutoff) -> Array:
    """Return the level [b] of the smallest cells allowed: about a cutoff, and neither too many nor too far away."""
    bias = 127 if low.dtype == jnp.float32 else 1023
    lanes = LANES[low.shape[1]]
    farthest = _exponent(jnp.max(jnp.maximum(jnp.abs(low), jnp.abs(high)), axis=1))
    extent = _exponent(jnp.max(high - low, axis=1))
    level = jnp.minimum(2 * bias + int(np.log2(_FARTHEST)) - 1 - farthest, 2 * bias + int(np.log2(lanes)) - extent)
    return jnp.clip(level, 0, _exponent(jnp.asarray(cutoff.unit_scale)))


def _exponent(x: Array) -> Array:
    """Return the biased exponent of floats >= 0, int32; for infinity that of the largest float."""
    unsigned, nmant, most = (jnp.uint32, 23, 0xFE) if x.dtype == jnp.float32 else (jnp.uint64, 52, 0x7FE)
    return jnp.minimum((lax.bitcast_convert_type(x, unsigned) >> unsigned(nmant)).astype(jnp.int32), most)


def _box_cells(level: Array, low: Array, high: Array) -> tuple[list[Array], Array, Array]:
    """Return the cells of boxes [b, lanes] per axis, which lanes hold one, and which boxes have no further cells."""
    dim = low.shape[1]
    scale = scale_of(level, np.dtype(low.dtype))
    first, last = (cells_of(x, scale[:, None]) for x in (low, high))
    lanes, span = LANES[dim], last - first + 1
    lane, cells = lax.iota(jnp.int32, lanes)[None], []
    for k in range(dim - 1):
        width = jnp.minimum(span[:, k, None], lanes)
        cells.append(first[:, k, None] + lane % width)
        lane = lane // width
    cells.append(first[:, dim - 1, None] + lane)
    return cells, lane < span[:, dim - 1, None], jnp.prod(span.astype(jnp.float32), axis=1) <= lanes


def _is_apart(cells: list[Array], corners: Array, scale: Array, radius: Array) -> Array:
    """Say which cells [b, lanes] a direction separates from their triangle by the radius, in units of a cell.

    Directions are the normal of the triangle and the cross products of a side and an axis; in 2D the normal of the segment. The
    axes themselves are covered by the box. A direction need not be exact: whichever floats it has, it separates or not.
    """
    dim, dtype = corners.shape[1], corners.dtype
    x = [[(corners[:, c, k] * scale)[:, None] - (cells[k].astype(dtype) + 0.5) for k in range(dim)] for c in range(dim)]
    reach = (radius * scale)[:, None]
    fixed = [[(corners[:, c, k] * scale)[:, None] for k in range(dim)] for c in range(dim)]
    apart = jnp.zeros(cells[0].shape, bool)
    nowhere = jnp.any(corners != corners, axis=(1, 2))[:, None]  # always False, but the compiler cannot know
    for direction in _directions(fixed, nowhere.astype(jnp.uint32 if dtype == jnp.float32 else jnp.uint64)):
        apart = apart | _separates(direction, x, reach)
    return apart


def _directions(corners: list[Vector], zero: Array) -> list[Vector]:
    if len(corners) == 2:
        along = minus(corners[1], corners[0])
        return [[-along[1], along[0]]]
    sides = [minus(corners[(i + 1) % 3], corners[i]) for i in range(3)]
    directions = [cross(sides[0], sides[1], zero)]
    for side, axis in product(sides, range(3)):
        across = [jnp.zeros_like(side[0]) for _ in range(3)]
        across[(axis + 1) % 3], across[(axis + 2) % 3] = -side[(axis + 2) % 3], side[(axis + 1) % 3]
        directions.append(across)
    return directions


def _separates(direction: Vector, x: list[Vector], reach: Array) -> Array:
    eps, size = jnp.finfo(reach.dtype).eps, [jnp.abs(component) for component in direction]
    whole = sum_of(size)
    heights = [dot(direction, corner) for corner in x]
    doubt = [dot(size, [jnp.abs(component) for component in corner]) for corner in x]
    least, (most, largest) = functools.reduce(jnp.minimum, heights), (functools.reduce(jnp.maximum, x) for x in (heights, doubt))
    room = (0.5 * whole + reach * jnp.sqrt(dot(direction, direction))) * (1 + 8 * eps) + 8 * eps * largest
    sound = (whole > 2.0**-60) & (room < jnp.finfo(reach.dtype).max)  # squares neither underflow nor overflow
    return sound & ((least > room) | (most < -room))


def gather_corners(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    """Return triangle corners [f, corner, axis], which triangles are finite, and which have only valid indices: [f] bool each."""
    there = jnp.all((faces >= 0) & (faces < vertices.shape[0]), axis=1)
    if vertices.shape[0] == 0:
        return jnp.zeros((*faces.shape, vertices.shape[1]), vertices.dtype), jnp.ones_like(there), there
    corners = vertices[jnp.where(there[:, None], faces, 0)]
    finite = jnp.all(jnp.isfinite(corners), axis=(1, 2))
    return jnp.where((finite & there)[:, None, None], corners, 0), finite | ~there, there
