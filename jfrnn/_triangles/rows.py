"""The array engine for triangles: tests each particle against the triangles of its cells, in chunks of candidates."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import Cutoff
from jfrnn._search import norms
from jfrnn._triangles.cells import TriangleCells, bucket_of, cells_of, scale_of
from jfrnn._triangles.closest import nearest_of
from jfrnn._triangles.exact import refine, sure_pairs, zero_of
from jfrnn._triangles.integers import Shapes, is_near

Decide = Callable[[Array, Array, Array, Array, Cutoff, Array], Array]  # the type of `decide_pairs`

_BLOCK = 1 << 16  # particles processed at a time
_CHUNK = 1 << 14  # candidates processed at a time
_MOST_PAIRS = 2**31  # int32 numbers fewer pairs than this


class _Run(NamedTuple):
    """Candidates of a block of particles at one cell level; those of particle i end at place[i]."""

    level: Array  # [] int32
    place: Array  # [b] int32, cumulative number of candidates
    start: Array  # [b] first entry of the particle's bucket
    size: Array  # [b] number of entries


def list_triangles(
    positions: Array, corners: Array, cells: TriangleCells, cutoff: Cutoff, capacity: int | None
) -> tuple[Array, Array]:
    """List the triangles near n > 0 particles of f > 0: [n, capacity] int32, unused slots f, and true counts [n] int32.

    Rows are ordered by cell level, then by triangle. With capacity=None only the counts are made, and rows are [n, 0].
    """
    (n, dim), faces, slots = positions.shape, corners.shape[0], capacity or 0
    block = max(min(_BLOCK, n, (_MOST_PAIRS - _CHUNK) // (faces + 1)), 1)
    buckets = cells.start.shape[0] - 1

    def add_block(b: Array, out: tuple[Array, Array]) -> tuple[Array, Array]:
        first = jnp.minimum(b * block, n - block)
        own = lax.dynamic_slice_in_dim(positions, first, block)
        finite = jnp.all(jnp.isfinite(own), axis=1)

        def add_level(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            which, rows, found = state
            level = cells.levels[which]
            scale = scale_of(level, np.dtype(positions.dtype))
            bucket = bucket_of(level, [cells_of(own[:, k], scale) for k in range(dim)], buckets)
            start = cells.start[bucket]
            count = jnp.where(finite, cells.start[bucket + 1] - start, 0)
            run = _Run(level, jnp.cumsum(count, dtype=jnp.int32), start, count)
            return which + 1, *_add_run(run, own, corners, cells, cutoff, first, (rows, found))

        start = (jnp.int32(0), out[0], jnp.zeros(block, jnp.int32))
        _, rows, found = lax.while_loop(lambda state: state[0] < cells.level_count, add_level, start)
        return rows, lax.dynamic_update_slice_in_dim(out[1], found, first, axis=0)

    empty = (jnp.full((n, slots), faces, jnp.int32), jnp.zeros(n, jnp.int32))
    return lax.fori_loop(0, -(-n // block), add_block, empty)


def _add_run(
    run: _Run, own: Array, corners: Array, cells: TriangleCells, cutoff: Cutoff, first: Array, found: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Decide the candidates of a run, and append those that are near to the rows of their particles."""
    block, faces, total = own.shape[0], corners.shape[0], run.place[-1]

    def add_chunk(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        chunk, rows, count = state
        begin = chunk * _CHUNK
        at = begin + lax.iota(jnp.int32, _CHUNK)
        particle = jnp.minimum(jnp.searchsorted(run.place, at, side="right").astype(jnp.int32), block - 1)
        before = run.place[particle] - run.size[particle]
        triangle = cells.triangles.at[run.start[particle] + at - before].get(mode="clip")
        there = (at < total) & (triangle < faces)
        known = jnp.minimum(triangle, faces - 1)
        near = decide_pairs(own, corners, particle, known, cutoff, there & (cells.level_of[known] == run.level))
        hits = jnp.cumsum(near, dtype=jnp.int32) - near.astype(jnp.int32)
        rank = hits - hits[jnp.maximum(before - begin, 0)]  # rank among the hits of its particle in this chunk
        slot = jnp.where(near, count[particle] + rank, rows.shape[1])
        rows = rows.at[first + particle, slot].set(triangle, mode="drop")
        return chunk + 1, rows, count.at[particle].add(near.astype(jnp.int32))

    return lax.while_loop(lambda state: state[0] * _CHUNK < total, add_chunk, (jnp.int32(0), *found))[1:]


def decide_pairs(own: Array, corners: Array, particle: Array, triangle: Array, cutoff: Cutoff, asked: Array) -> Array:
    """Decide which particles are near which triangles: [q] bool."""
    dim = own.shape[1]
    points, shapes = own[particle], corners[triangle]
    axes = [points[:, k] for k in range(dim)]
    corner_axes = [[shapes[:, c, k] for k in range(dim)] for c in range(dim)]

    def shapes_at(at: Array) -> Shapes:
        radius = lax.optimization_barrier(jnp.asarray(cutoff.radius))
        return Shapes(own[particle[at]].T, jnp.moveaxis(corners[triangle[at]], 0, -1), radius)

    surely, open_pairs = sure_pairs(axes, corner_axes, cutoff, zero_of(triangle, np.dtype(own.dtype)))
    return (surely & asked) | refine(open_pairs & asked, shapes_at, is_near)


def nearest_slots(
    points: Array, corners: Array, idx: Array, count: Array, good: Array, cutoff: Cutoff, decide: Decide = decide_pairs
) -> tuple[Array, Array]:
    """Find the nearest triangle in each row, for n > 0 and f > 0, in chunks of one pair per particle of a block.

    Points are [n, d], rows idx [n, capacity] with so many slots [n] in use, triangles given by their corners [f, corner, d], of
    which `good` [f] are valid. `decide` says which pairs are closer than the cutoff, exactly; only those count. Return the slot of
    the nearest triangle, of equally near ones the first, [n] int32, and whether there is one, [n] bool.
    """
    n, capacity = idx.shape
    block = max(min(n, (_MOST_PAIRS - n) // capacity), 1)
    finite = jnp.all(jnp.isfinite(points), axis=1)

    def of_block(b: Array, slots: Array) -> Array:
        first = jnp.minimum(b * block, n - block)
        own, rows, used, fine = (lax.dynamic_slice_in_dim(x, first, block) for x in (points, idx, count, finite))
        until = jnp.cumsum(jnp.where(fine, used, 0), dtype=jnp.int32)

        def look(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            begin, least, slots = state
            at = begin + lax.iota(jnp.int32, block)
            particle = jnp.minimum(jnp.searchsorted(until, at, side="right").astype(jnp.int32), block - 1)
            slot = jnp.where(at < until[-1], at - (until[particle] - used[particle]), 0)
            triangle = jnp.where(at < until[-1], rows[particle, slot], 0)
            near = decide(own, corners, particle, triangle, cutoff, (at < until[-1]) & good[triangle])
            lengths = norms(nearest_of(own[particle], corners[triangle])[0])
            now = least.at[particle].min(jnp.where(near, lengths, jnp.inf))
            wins = jnp.where(near & (lengths == now[particle]), particle, block)
            return begin + block, now, jnp.where(now < least, capacity, slots).at[wins].min(slot, mode="drop")

        none = jnp.full(block, jnp.inf, points.dtype), jnp.full(block, capacity, jnp.int32)
        found = lax.while_loop(lambda state: state[0] < until[-1], look, (jnp.int32(0), *none))[2]
        return lax.dynamic_update_slice_in_dim(slots, found, first, axis=0)

    slots = lax.fori_loop(0, -(-n // block), of_block, jnp.zeros(n, jnp.int32))
    return jnp.minimum(slots, capacity - 1), slots < capacity


def are_near(points: Array, corners: Array, triangle: Array, cutoff: Cutoff, asked: Array, decide: Decide = decide_pairs) -> Array:
    """Decide for points [n, d] which triangles [n, k] of their rows are closer than the cutoff: [n, k] bool."""
    particle = lax.broadcasted_iota(jnp.int32, triangle.shape, 0)
    near = decide(points, corners, particle.reshape(-1), triangle.reshape(-1), cutoff, asked.reshape(-1))
    return near.reshape(triangle.shape)
