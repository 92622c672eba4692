"""The engines of a search: which one answers, and how the array engines find candidates.

What a pair is, and how rows are filled, the array engines share (`_exact`, `_runs`); the Warp engines live in `_warp`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn import _warp
from jfrnn._box import Box, Images, Lattice, Wrapped, fractions_of, is_valid, make_lattice, translation, unpacked_turns, wrap
from jfrnn._cells import CellAxes, build_grid, cell_edge, cell_order, grid_coordinates, open_axes, stencil_runs
from jfrnn._exact import Cutoff, widened
from jfrnn._runs import Candidates, Filter, Points, Torus, count_neighbors, list_neighbors
from jfrnn._status import Status
from jfrnn._warp import Rows


class Options(NamedTuple):
    """What is static about a search, apart from its capacity."""

    filter: Filter
    backend: str
    images: Images | None = None  # of a box
    radius: float | None = None  # of the cutoff, for the one engine that builds its grid from the host: hashgrid


class Inputs(NamedTuple):
    """The operands of a search; a pytree."""

    sources: Array
    queries: Array | None
    active: Array | None
    box: Box | None
    cutoff: Cutoff  # of the list: with the skin


class Found(NamedTuple):
    """What a search finds: the rows, and of which images of the sources they tell.

    `images` [m, capacity] codes and `turns`, packed, [n] and [m] int32 (or None), stand only where images must be told apart.
    """

    rows: Rows
    images: Array | None
    turns: tuple[Array, Array | None] | None


@functools.partial(jax.jit, static_argnames=("options", "capacity"))
def list_rows(inputs: Inputs, options: Options, capacity: int) -> Found:
    """List the neighbors of every query: the compiled program of `search`."""
    return _find(inputs, options, capacity)


@functools.partial(jax.jit, static_argnames="options")
def count_rows(inputs: Inputs, options: Options) -> Array:
    """Count the neighbors of every query, [m] int32: the compiled program of `count`."""
    return _find(inputs, options, None).rows.counts


def without_inactive(positions: Array, active: Array | None) -> Array:
    """Return positions with NaN where a particle is inactive: no engine gives such a one neighbors, or to others."""
    return positions if active is None else jnp.where(active[:, None], positions, jnp.nan)


def _find(inputs: Inputs, options: Options, capacity: int | None) -> Found:
    """List the neighbors of every query, or only count them (capacity=None). Integers: no gradient flows through."""
    given, queries, active, box, cutoff = lax.stop_gradient(inputs)
    sources, images = without_inactive(given, active), options.images
    if box is None or images is None:
        rows = _rows_of_engine(sources, queries, cutoff, options, capacity)
        return Found(_with_status(rows, given, queries, active, {}), None, None)
    lattice = make_lattice(box, images, np.dtype(sources.dtype))
    wrapped = wrap(sources, queries, lattice, cutoff.radius)
    rows = _rows_of_engine(sources, queries, cutoff, options, capacity, (lattice, wrapped))
    in_range = _all_in_range(wrapped.turns, sources) & _all_in_range(wrapped.query_turns, sources if queries is None else queries)
    checks = {Status.BOX_TOO_SMALL: wrapped.enough & is_valid(lattice), Status.OUT_OF_RANGE: in_range}
    rows = _with_status(rows, given, queries, active, checks)
    if rows.idx is None or images.nearest:
        return Found(rows, None, None)
    n = max(sources.shape[0], 1)
    codes = (rows.idx // n).astype(images.dtype)
    idx = jnp.where(rows.idx == n * images.total, sources.shape[0], rows.idx % n)
    query_turns = None if queries is None else wrapped.query_turns
    return Found(rows._replace(idx=idx), codes, (wrapped.turns, query_turns))


def _all_in_range(turns: Array, points: Array) -> Array:
    return ((turns >= 0) | ~jnp.isfinite(points).all(axis=1)).all()


def _with_status(rows: Rows, sources: Array, queries: Array | None, active: Array | None, checks: dict[Status, Array]) -> Rows:
    """Set the bits of what the engine cannot know: it saw NaN where particles are inactive or out of range."""
    if active is None and not checks:
        return rows
    finite = (jnp.isfinite(sources).all(axis=1) | (False if active is None else ~active)).all()
    checks = checks | {Status.NONFINITE: finite & (True if queries is None else jnp.isfinite(queries).all())}
    status = rows.status & ~Status.NONFINITE.value
    for bit, right in checks.items():
        status = status | jnp.where(right, 0, bit.value).astype(jnp.int32)
    return rows._replace(status=status)


def _rows_of_engine(
    sources: Array,
    queries: Array | None,
    cutoff: Cutoff,
    options: Options,
    capacity: int | None,
    torus: tuple[Lattice, Wrapped] | None = None,
) -> Rows:
    n, m = sources.shape[0], (sources if queries is None else queries).shape[0]
    if options.backend == "warp" and 0 not in (n, m):
        return _warp.neighbors(sources, queries, cutoff, options.filter, capacity, torus)
    if options.radius is not None and 0 not in (n, m):
        return _warp.hashgrid_neighbors(sources, queries, cutoff, options.radius, options.filter, capacity)
    if 0 in (n, m):
        fill = n if options.images is None or options.images.nearest else max(n, 1) * options.images.total
        idx, count = None if capacity is None else jnp.full((m, capacity), fill, jnp.int32), jnp.zeros(m, jnp.int32)
    else:
        candidates = _candidates(sources, queries, cutoff, options, torus)
        bounds = cutoff if torus is None else widened(cutoff, torus[1].slack)
        if capacity is None:
            idx, count = None, count_neighbors(candidates, bounds, options.filter)
        else:
            idx, count = list_neighbors(candidates, bounds, options.filter, capacity)
    required = jnp.max(count, initial=0)
    finite = jnp.isfinite(sources).all() & (True if queries is None else jnp.isfinite(queries).all())
    overflow = False if capacity is None else required > capacity
    status = jnp.where(overflow, Status.ROW_OVERFLOW.value, 0) | jnp.where(finite, 0, Status.NONFINITE.value)
    return Rows(idx, count, required, status.astype(jnp.int32))


def _candidates(
    sources: Array, queries: Array | None, cutoff: Cutoff, options: Options, given: tuple[Lattice, Wrapped] | None
) -> Candidates:
    brute = options.backend == "brute"
    if given is None:
        if brute:
            return _all_sources(sources, queries, None)
        points = sources if queries is None else jnp.concatenate([sources, queries])
        axes = open_axes(cell_edge(cutoff.radius), sources.shape[1])
        return _cell_stencil(sources, queries, points.T, axes, None)
    lattice, wrapped = given
    raw = (sources, sources if queries is None else queries)
    turns = tuple(unpacked_turns(x, lattice.dim).astype(sources.dtype) for x in (wrapped.turns, wrapped.query_turns))
    shifts = jnp.asarray(lattice.images.shifts).astype(sources.dtype)
    torus = Torus(lattice.images, translation(shifts, lattice), lattice.matrix, raw, (turns[0], turns[1]))
    wrapped_queries = None if queries is None else wrapped.queries
    if brute:
        return _all_sources(wrapped.sources, wrapped_queries, torus)
    along, axes = _cells_of_lattice(sources, queries, cutoff, lattice, wrapped)
    return _cell_stencil(wrapped.sources, wrapped_queries, along, axes, torus)


def _all_sources(sources: Array, queries: Array | None, torus: Torus | None) -> Candidates:
    """Brute force: a run of all sources, O(n·m), for each image."""
    images = 1 if torus is None else torus.images.total

    def runs(place: Array) -> tuple[Array, Array, Array | None]:
        start = jnp.zeros((place.size, images), jnp.int32)
        return start, jnp.full_like(start, sources.shape[0]), None if torus is None else start + lax.iota(jnp.int32, images)

    points = _in_order(sources, None)
    return Candidates(points, points if queries is None else _in_order(queries, None), runs, torus)


def _cell_stencil(sources: Array, queries: Array | None, along: Array, axes: CellAxes, torus: Torus | None) -> Candidates:
    """Cells: sources and queries sorted by cell; the runs of a query are the rows of cells around its own.

    `along` [d, n + m] are the coordinates of the sources, then of the queries, that `axes` cuts into cells.
    """
    finite = jnp.isfinite(along).all(axis=0)
    coords, extent = grid_coordinates(along, axes, finite)
    n, total = sources.shape[0], along.shape[1]
    grid = build_grid(coords[:, :n], finite[:n], extent, total)
    if queries is None:
        order = grid.order
    else:
        coords, finite = coords[:, n:], finite[n:]
        order = cell_order(coords, finite, extent, grid.dense)
    query_coords = coords[:, order]
    images = None if torus is None else torus.images

    def runs(place: Array) -> tuple[Array, Array, Array | None]:
        return stencil_runs(grid, query_coords.at[:, place].get(mode="promise_in_bounds"), images)

    points = _in_order(sources, grid.order)
    return Candidates(points, points if queries is None else _in_order(queries, order), runs, torus)


def _cells_of_lattice(
    sources: Array, queries: Array | None, cutoff: Cutoff, lattice: Lattice, wrapped: Wrapped
) -> tuple[Array, CellAxes]:
    """Cut a lattice cell along its vectors; what is open, and not skewed, is cut as it is without a box."""
    points, packed = sources, wrapped.turns
    if queries is not None:
        points = jnp.concatenate([sources, queries])
        packed = jnp.concatenate([packed, wrapped.query_turns])
    units, turns = fractions_of(points, lattice), unpacked_turns(packed, lattice.dim).astype(points.dtype)
    along, edges, cells = [], [], []
    for k, periodic in enumerate(lattice.images.periodic):
        straight = lattice.images.orthogonal and not periodic
        x = points[:, k] if straight else jnp.clip(units[:, k] - turns[:, k], 0, 1) if periodic else units[:, k]
        along.append(jnp.where(packed >= 0, x, jnp.nan))
        edges.append(cell_edge(cutoff.radius if straight else wrapped.reach[k]))
        cells.append(jnp.clip(jnp.floor(1 / wrapped.reach[k]), 1, 2.0**23) if periodic else None)
    return jnp.stack(along), CellAxes(edges, cells)


def _in_order(positions: Array, order: Array | None) -> Points:
    if order is None:
        return Points(list(positions.T), lax.iota(jnp.int32, positions.shape[0]))
    return Points([x[order] for x in positions.T], order)
