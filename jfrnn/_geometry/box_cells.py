"""Cells of many boxes: where each system of a batch has a lattice of its own, each is divided for itself.

A system has a whole number of cells along each axis, at most as many as its cutoff asks for and its particles fill. Its cells
follow those of the system before it, x fastest. A query visits the cells within reach of it along each axis, which are numbered on
beyond the ends of its box: behind an end begins the next image. So each system pays for its own images, however many another one
has. Open axes are folded: cells a whole number of turns apart have one number, and their particles are mere candidates of each
other.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.batch import Batch
from jfrnn._geometry.images import LARGEST_TURN
from jfrnn._geometry.lattice import Lattice, fractions_of
from jfrnn._geometry.wrapping import Wrapped, unpack_turns

_FILL = 4  # particles of a cell, at least, where cells are many
_COUNTERS = 32  # of a system
_FARTHEST = 2.0**22  # cells along an open axis, beyond which all are one: whole floats up to there are exact


class BoxCells(NamedTuple):
    """Sources sorted by system and cell, and what the queries visit.

    Attributes:
        order: [n] int32, the source at each place; those without a cell come last.
        start: [cells + 1] int32, the place at which each cell begins.
        counts: [systems, d] int32, cells along each axis.
        first: [systems] int32, the first cell of each system.
        from_cell: [m, d] int32, the lowest cell that a query visits along each axis, numbered on beyond the ends of its box.
        visited: [m, d] int32, how many it visits from there on; 0 for queries that are not finite.
    """

    order: Array
    start: Array
    counts: Array
    first: Array
    from_cell: Array
    visited: Array


def sort_into_boxes(
    sources: Array, queries: Array | None, lattice: Lattice, wrapped: Wrapped, batch: Batch, divided: bool = True
) -> BoxCells:
    """Sort sources [n, d] by system and cell, and say which cells the queries [m, d], or the sources, visit.

    Not `divided`, a system is one cell, and its queries visit all images that any pair of it may have.
    """
    n, (systems, dim) = len(sources), lattice.origin.shape
    packed = wrapped.turns if queries is None else wrapped.query_turns
    there, of_source = wrapped.turns >= 0, batch.sources
    counter = lax.iota(jnp.int32, n) % _COUNTERS * systems + of_source  # those of one system would wait for a single one
    members = jnp.zeros(_COUNTERS * systems, jnp.int32).at[counter].add(there.astype(jnp.int32))
    members = jnp.sum(members.reshape(_COUNTERS, systems), axis=0, dtype=jnp.int32)
    periodic = jnp.broadcast_to(lattice.spread(jnp.asarray(lattice.periodic), 2), (systems, dim))
    counts = _count_cells(wrapped.reach, members, periodic) if divided else jnp.ones((systems, dim), jnp.int32)
    totals = jnp.prod(counts, axis=1, dtype=jnp.int32)
    ends = jnp.cumsum(totals, dtype=jnp.int32)
    first, size = ends - totals, most_cells(n, systems)
    at = _cells_along(sources, wrapped.turns, of_source, lattice, wrapped.reach, counts, periodic)
    at = jnp.where(periodic[of_source], jnp.clip(at, 0, counts[of_source] - 1), at % counts[of_source])
    number = at[:, -1]
    for axis in range(dim - 2, -1, -1):
        number = number * counts[of_source, axis] + at[:, axis]
    number = first[of_source] + number
    key = jnp.where(there, number, size)
    key = key.astype(jnp.uint16 if size < 2**16 - 1 else jnp.uint32)  # half as many bits are sorted in half as many passes
    _, order = lax.sort((key, lax.iota(jnp.int32, n)), num_keys=1, is_stable=True)
    held = jnp.zeros(size + 1, jnp.int32).at[key.astype(jnp.int32) + 1].add(1, mode="drop")
    points, of_query = (sources, of_source) if queries is None else (queries, batch.of_queries)
    reach, many, turning = wrapped.reach[of_query], counts[of_query], periodic[of_query]
    most = np.array(lattice.images.reach, np.int32)[None]
    most = jnp.minimum(most, jnp.clip(jnp.ceil(reach), 0, LARGEST_TURN).astype(jnp.int32))  # those of its own system
    low, high = -most * many, (most + 1) * many - 1
    if divided:
        ways = [_cells_along(points, packed, of_query, lattice, wrapped.reach, counts, periodic, step * reach) for step in (-1, 1)]
        low, high = jnp.maximum(ways[0], jnp.where(turning, low, ways[0])), jnp.minimum(ways[1], jnp.where(turning, high, ways[1]))
    else:
        low, high = jnp.where(turning, low, 0), jnp.where(turning, high, 0)
    visited = jnp.maximum(high - low + 1, 0)
    visited = jnp.where(turning, visited, jnp.minimum(visited, many))
    return BoxCells(order, jnp.cumsum(held, dtype=jnp.int32), counts, first, low, jnp.where((packed >= 0)[:, None], visited, 0))


def most_cells(sources: int, systems: int) -> int:
    """Return how many cells so many systems have at most."""
    return sources // _FILL + systems


def _count_cells(reach: Array, members: Array, periodic: Array) -> Array:
    """Return the cells of each system along each axis, [systems, d] int32: their product is at most one per `_FILL` particles."""
    most = jnp.maximum(members // _FILL, 1).astype(reach.dtype)[:, None] * (1 - 1e-6)
    wanted = jnp.where(periodic, jnp.floor(1 / reach), most)
    cells = jnp.clip(jnp.where(jnp.isfinite(wanted), wanted, 1), 1, jnp.maximum(most, 1))
    for _ in range(reach.shape[1]):  # an axis that is down to one cell leaves the rest to the others
        longer = jnp.maximum(jnp.sum(cells > 1, axis=1, keepdims=True), 1).astype(reach.dtype)
        scale = jnp.minimum((most / jnp.prod(cells, axis=1, keepdims=True)) ** (1 / longer), 1)
        cells = jnp.where(cells > 1, jnp.maximum(jnp.floor(cells * scale), 1), 1)
    return cells.astype(jnp.int32)


def _cells_along(
    points: Array,
    packed: Array,
    systems: Array,
    lattice: Lattice,
    reach: Array,
    counts: Array,
    periodic: Array,
    off: Array | None = None,
) -> Array:
    """Return the cells [n, d] int32 of points, or of what lies `off` from them; from 0 on those of the box along periodic axes."""
    turning, own = periodic[systems], lattice.of_rows(systems)
    units = fractions_of(points, own)
    units = jnp.where(turning, jnp.clip(units - unpack_turns(packed, lattice.dim).astype(points.dtype), 0, 1), units)
    x = jnp.where(turning, units, points) if lattice.images.orthogonal else units
    x = jnp.where((packed >= 0)[:, None], x, 0)
    x = x if off is None else x + off
    cells = jnp.floor(jnp.where(turning, x * counts[systems].astype(x.dtype), x / reach[systems]))
    return jnp.clip(jnp.where(jnp.isfinite(cells), cells, 0), -_FARTHEST, _FARTHEST).astype(jnp.int32)


def box_runs(
    cells: BoxCells, systems: Array, lattice: Lattice, places: Array, which: Array, width: int
) -> tuple[Array, Array, Array]:
    """Return some runs of the queries at these places [b] of arrays: starts, ends and image codes, [b, width] int32.

    A run is what a query visits of a row of cells along x, in one image. `which` [] counts passes of `width` runs. `from_cell` and
    `visited` of the cells, and systems [m], are in the order of the places; the lattice is that of each system.
    """
    dim, of = len(lattice.images.reach), systems[places]
    low, visited, counts = (x[:, None] for x in (cells.from_cell[places], cells.visited[places], cells.counts[of]))
    turning = jnp.broadcast_to(lattice.spread(jnp.asarray(lattice.periodic), 2), cells.counts.shape)[of][:, None]
    rest = which * width + lax.broadcasted_iota(jnp.int32, (places.size, width), 1)
    there = rest < _runs_of(low[:, 0], visited[:, 0], counts[:, 0])[:, None]
    at, shift = [jnp.zeros_like(rest)] * dim, [jnp.zeros_like(rest)] * dim
    for axis in range(1, dim):
        cell = low[..., axis] + rest % jnp.maximum(visited[..., axis], 1)
        rest = rest // jnp.maximum(visited[..., axis], 1)
        shift[axis] = cell // counts[..., axis]
        at[axis] = cell - shift[axis] * counts[..., axis]
    shift[0] = low[..., 0] // counts[..., 0] + rest
    begin = jnp.maximum(low[..., 0] - shift[0] * counts[..., 0], 0)
    end = jnp.minimum(low[..., 0] + visited[..., 0] - shift[0] * counts[..., 0], counts[..., 0])
    row = jnp.zeros_like(rest)
    for axis in range(dim - 1, 0, -1):
        row = (row + at[axis]) * counts[..., axis - 1]
    row = row + cells.first[of][:, None]
    code = lattice.images.code_of(jnp.where(turning[..., axis], shift[axis], 0) for axis in range(dim))
    begin, end = (cells.start.at[jnp.where(there, row + x, 0)].get(mode="clip") for x in (begin, end))
    return begin, jnp.where(there, jnp.maximum(end, begin), begin), jnp.where(there, code, lattice.images.home)


def _runs_of(low: Array, visited: Array, counts: Array) -> Array:
    """Return how many runs queries have, [b] int32."""
    pieces = (low[:, 0] + visited[:, 0] - 1) // counts[:, 0] - low[:, 0] // counts[:, 0] + 1
    rows = jnp.prod(visited[:, 1:], axis=1, dtype=jnp.int32)
    return jnp.where(visited[:, 0] > 0, pieces * rows, 0)


def passes_of(cells: BoxCells, systems: Array, places: Array, width: int) -> Array:
    """Return the number of passes, each of `width` runs, that these queries take, [] int32."""
    runs = _runs_of(cells.from_cell[places], cells.visited[places], cells.counts[systems[places]])
    return (jnp.max(runs) + (width - 1)) // width
