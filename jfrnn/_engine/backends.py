"""The engines of a search: which one answers, and how the array engines find candidates.

What a pair is, and how rows are filled, the array engines share (`_exact`, `_runs`); the Warp engines live in `_warp`.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.levels_warp import level_neighbors
from jfrnn._engine.runs import Candidates, Filter, Points, State, Torus, Visit, count_neighbors, fold_neighbors, list_neighbors
from jfrnn._engine.warp import Rows, hashgrid_neighbors, neighbors
from jfrnn._geometry import (
    NOT_FINITE,
    TOO_FAR,
    Axes,
    Batch,
    Box,
    CellAxes,
    Cutoff,
    Cutoffs,
    Images,
    Lattice,
    Levels,
    Radii,
    Status,
    Wrapped,
    build_grid,
    cell_edge,
    cell_order,
    fractions_of,
    grid_coordinates,
    is_radius,
    is_valid,
    level_runs,
    make_cutoffs,
    make_lattice,
    open_axes,
    ranked,
    sort_by_levels,
    stencil_runs,
    translation,
    unpacked_turns,
    wrap,
)
from jfrnn._tracing import compiled


class Options(NamedTuple):
    """What is static about a search, apart from its capacity."""

    filter: Filter
    backend: str
    closed: bool
    skin: float = 0.0  # that cutoffs of particles grow by; one cutoff for all holds it already
    images: Images | None = None  # of a box
    radius: float | None = None  # of the cutoff, for the one engine that builds its grid from the host: hashgrid


class Inputs(NamedTuple):
    """The operands of a search; a pytree."""

    sources: Array
    queries: Array | None
    active: Array | None
    box: Box | None
    cutoff: Cutoff | Radii  # of the list: one for all, with the skin; of each particle, without
    batch: Batch | None = None


class Found(NamedTuple):
    """What a search finds: the rows, and of which images of the sources they tell.

    `images` [m, capacity] codes and `turns`, packed, [n] and [m] int32 (or None), stand only where images must be told apart.
    """

    rows: Rows
    images: Array | None
    turns: tuple[Array, Array | None] | None


@functools.partial(compiled, static_argnames=("options", "capacity"))
def list_rows(inputs: Inputs, options: Options, capacity: int) -> Found:
    """List the neighbors of every query: the compiled program of `search`."""
    return _find(inputs, options, capacity)


@functools.partial(compiled, static_argnames="options")
def count_rows(inputs: Inputs, options: Options) -> tuple[Array, Array]:
    """Count the neighbors of every query, [m] int32, and return the largest number with them: the compiled program of `count`."""
    rows = _find(inputs, options, None).rows
    return rows.counts, rows.required


def without_inactive(positions: Array, active: Array | None) -> Array:
    """Return positions that are infinite where a particle is inactive: no engine gives such a one neighbors, or to others.

    The mark is not NaN, because JAX's mode `jax_debug_nans` takes every NaN that leaves a program for an error.
    """
    return positions if active is None else jnp.where(active[:, None], positions, jnp.inf)


class _Prepared(NamedTuple):
    """The operands of a search as engines take them: not finite where a particle takes no part."""

    sources: Array
    queries: Array | None
    cutoff: Cutoff | Cutoffs
    batch: Batch | None
    torus: tuple[Lattice, Wrapped] | None
    checks: dict[Status, Array]


def prepared(inputs: Inputs, options: Options) -> _Prepared:
    """Prepare a search. No gradient flows through."""
    given, queries, active, box, cutoff, batch = lax.stop_gradient(inputs)
    sources, images = without_inactive(given, active), options.images
    batch = None if batch is None else ranked(batch)
    checks: dict[Status, Array] = {}
    if isinstance(cutoff, Radii):
        sources, queries, checks = _with_valid_radii(sources, queries, active, cutoff)
        cutoff = make_cutoffs(cutoff, options.closed, options.skin)
    if box is None or images is None:
        return _Prepared(sources, queries, cutoff, batch, None, checks)
    lattice = make_lattice(box, images, np.dtype(sources.dtype))
    wrapped = wrap(sources, queries, lattice, _largest(cutoff))
    checks[Status.BOX_TOO_SMALL] = wrapped.enough & is_valid(lattice)
    checks[Status.OUT_OF_RANGE] = (wrapped.met & TOO_FAR) == 0
    return _Prepared(sources, queries, cutoff, batch, (lattice, wrapped), checks)


def _find(inputs: Inputs, options: Options, capacity: int | None) -> Found:
    """List the neighbors of every query, or only count them (capacity=None). Integers: no gradient flows through."""
    given, given_queries, active = lax.stop_gradient(inputs[:3])
    sources, queries, cutoff, batch, torus, checks = prepared(inputs, options)
    rows = _rows_of_engine(sources, queries, cutoff, options, capacity, batch, torus)
    if torus is not None and active is None and isinstance(cutoff, Cutoff):  # else positions are not finite for other reasons, too
        checks = checks | {Status.NONFINITE: (torus[1].met & NOT_FINITE) == 0}
    rows = _with_status(rows, given, given_queries, active, checks)
    images = options.images
    if rows.idx is None or torus is None or images is None or images.nearest:
        return Found(rows, None, None)
    n = max(sources.shape[0], 1)
    codes = (rows.idx // n).astype(images.dtype)
    idx = jnp.where(rows.idx == n * images.total, sources.shape[0], rows.idx % n)
    _, wrapped = torus
    return Found(rows._replace(idx=idx), codes, (wrapped.turns, None if queries is None else wrapped.query_turns))


def fold_pairs(inputs: Inputs, options: Options, elements: int, visit: Visit[State], out: State) -> State:
    """Walk over all pairs of a search, of which none is stored: see `fold_neighbors`. For the array engines."""
    sources, queries, cutoff, batch, torus, _ = prepared(inputs, options)
    if 0 in (sources.shape[0], (sources if queries is None else queries).shape[0]):
        return out
    candidates = _candidates(sources, queries, cutoff, options, batch, torus)
    return fold_neighbors(candidates, cutoff, options.filter, elements, visit, out)


@functools.partial(compiled, static_argnames="options")
def is_decidable(inputs: Inputs, options: Options) -> Array:
    """Say whether a search can answer for all particles that take part: cutoffs, box and positions are in range; [] bool."""
    return functools.reduce(jnp.logical_and, prepared(inputs, options).checks.values(), jnp.ones((), bool))


def _with_valid_radii(
    sources: Array, queries: Array | None, active: Array | None, radii: Radii
) -> tuple[Array, Array | None, dict[Status, Array]]:
    """Return positions and queries, infinite where the cutoff is none, and whether all those of particles that take part are."""
    of_sources, of_queries = (None if x is None else is_radius(x) for x in (radii.sources, radii.queries))
    right = [jnp.ones((), bool)]
    if queries is None:
        valid = next(x for x in (of_sources, of_queries) if x is not None)
        return _where_rows(valid, sources), None, {Status.INVALID_CUTOFF: (valid if active is None else valid | ~active).all()}
    if of_sources is not None:
        right.append((of_sources if active is None else of_sources | ~active).all())
        sources = _where_rows(of_sources, sources)
    if of_queries is not None:
        right.append(of_queries.all())
        queries = _where_rows(of_queries, queries)
    return sources, queries, {Status.INVALID_CUTOFF: functools.reduce(jnp.logical_and, right)}


def _where_rows(valid: Array, points: Array) -> Array:
    return jnp.where(valid[:, None], points, jnp.inf)


def _largest(cutoff: Cutoff | Cutoffs) -> np.floating | Array:
    return cutoff.largest if isinstance(cutoff, Cutoffs) else cutoff.radius


def _with_status(rows: Rows, sources: Array, queries: Array | None, active: Array | None, checks: dict[Status, Array]) -> Rows:
    """Set the bits of what the engine cannot know: positions are not finite where particles are inactive or out of range."""
    if active is None and not checks:
        return rows
    if Status.NONFINITE not in checks:
        finite = (jnp.isfinite(sources).all(axis=1) | (False if active is None else ~active)).all()
        checks = checks | {Status.NONFINITE: finite & (True if queries is None else jnp.isfinite(queries).all())}
    status = rows.status & ~Status.NONFINITE.value
    for bit, right in checks.items():
        status = status | jnp.where(right, 0, bit.value).astype(jnp.int32)
    return rows._replace(status=status)


def _rows_of_engine(
    sources: Array,
    queries: Array | None,
    cutoff: Cutoff | Cutoffs,
    options: Options,
    capacity: int | None,
    batch: Batch | None,
    torus: tuple[Lattice, Wrapped] | None = None,
) -> Rows:
    n, m = sources.shape[0], (sources if queries is None else queries).shape[0]
    if options.backend == "warp" and isinstance(cutoff, Cutoffs) and 0 not in (n, m):
        levels = levels_of(sources, queries, cutoff, batch, torus)
        return level_neighbors(sources, queries, cutoff, levels, options.filter, capacity, batch, torus)
    if options.backend == "warp" and isinstance(cutoff, Cutoff) and 0 not in (n, m):
        return neighbors(sources, queries, cutoff, options.filter, capacity, batch, torus)
    if options.radius is not None and isinstance(cutoff, Cutoff) and 0 not in (n, m):
        return hashgrid_neighbors(sources, queries, cutoff, options.radius, options.filter, capacity)
    if 0 in (n, m):
        fill = n if options.images is None or options.images.nearest else max(n, 1) * options.images.total
        idx, count = None if capacity is None else jnp.full((m, capacity), fill, jnp.int32), jnp.zeros(m, jnp.int32)
    else:
        candidates = _candidates(sources, queries, cutoff, options, batch, torus)
        if capacity is None:
            idx, count = None, count_neighbors(candidates, cutoff, options.filter)
        else:
            idx, count = list_neighbors(candidates, cutoff, options.filter, capacity)
    required = jnp.max(count, initial=0)
    finite = jnp.isfinite(sources).all() & (True if queries is None else jnp.isfinite(queries).all())
    overflow = False if capacity is None else required > capacity
    status = jnp.where(overflow, Status.ROW_OVERFLOW.value, 0) | jnp.where(finite, 0, Status.NONFINITE.value)
    return Rows(idx, count, required, status.astype(jnp.int32))


def _candidates(
    sources: Array,
    queries: Array | None,
    cutoff: Cutoff | Cutoffs,
    options: Options,
    batch: Batch | None,
    given: tuple[Lattice, Wrapped] | None,
) -> Candidates:
    """Say where the candidates of a query lie, in particle order (brute force), by cells, or by cells of many sizes."""
    torus = None if given is None else _torus(sources, queries, *given)
    clouds = (sources, queries) if given is None else (given[1].sources, None if queries is None else given[1].queries)
    if options.backend == "brute":
        return _all_sources(*clouds, cutoff, batch, torus)
    if isinstance(cutoff, Cutoff):
        along, axes = _cells_along(sources, queries, cutoff, given)
        return _cell_stencil(*clouds, along, axes.cells, batch, torus)
    images, levels = None if torus is None else torus.images, levels_of(sources, queries, cutoff, batch, given)
    points = _in_order(clouds[0], levels.order, cutoff.sources)
    rows = _in_order(clouds[0] if clouds[1] is None else clouds[1], levels.query_order, cutoff.queries)
    return Candidates(points, rows, level_runs(levels, cutoff, images), torus, levels.passes)


def levels_of(
    sources: Array, queries: Array | None, cutoff: Cutoffs, batch: Batch | None, torus: tuple[Lattice, Wrapped] | None
) -> Levels:
    """Sort a prepared search with a cutoff per particle into cells of many sizes."""
    along, axes = _cells_along(sources, queries, cutoff, torus)
    return sort_by_levels(along, axes, cutoff, sources.shape[0], queries is None, None if batch is None else batch.of_all)


def _cells_along(
    sources: Array, queries: Array | None, cutoff: Cutoff | Cutoffs, torus: tuple[Lattice, Wrapped] | None
) -> tuple[Array, Axes]:
    """Return the coordinates [d, n + m] that are cut into cells, those of the queries last, and how."""
    if torus is not None:
        return _cells_of_lattice(sources, queries, _largest(cutoff), *torus)
    points = sources if queries is None else jnp.concatenate([sources, queries])
    one = jnp.ones(points.shape[1], points.dtype)
    return points.T, Axes(open_axes(cell_edge(_largest(cutoff)), points.shape[1]), one, 0 * one)


def _torus(sources: Array, queries: Array | None, lattice: Lattice, wrapped: Wrapped) -> Torus:
    raw = (sources, sources if queries is None else queries)
    turns = tuple(unpacked_turns(x, lattice.dim).astype(sources.dtype) for x in (wrapped.turns, wrapped.query_turns))
    shifts = jnp.asarray(lattice.images.shifts).astype(sources.dtype)
    return Torus(lattice.images, translation(shifts, lattice), lattice.given, raw, (turns[0], turns[1]), wrapped.slack)


def _all_sources(
    sources: Array, queries: Array | None, cutoff: Cutoff | Cutoffs, batch: Batch | None, torus: Torus | None
) -> Candidates:
    """Brute force: a run of all sources, or of those of the query's system, O(n·m), for each image."""
    images = 1 if torus is None else torus.images.total
    order = query_order = None
    first = end = jnp.zeros((), jnp.int32)
    if batch is not None:
        order = jnp.argsort(batch.sources).astype(jnp.int32)
        query_order = order if batch.queries is None else lax.iota(jnp.int32, batch.queries.size)
        systems, wanted = batch.sources[order], batch.of_queries[query_order]
        first, end = (jnp.searchsorted(systems, wanted, side=side).astype(jnp.int32) for side in ("left", "right"))

    def runs(place: Array, _: Array) -> tuple[Array, Array, Array | None]:
        start, stop = jnp.zeros((place.size, images), jnp.int32), jnp.int32(sources.shape[0])
        if batch is not None:
            start, stop = start + first[place][:, None], end[place][:, None]
        codes = None if torus is None else jnp.zeros_like(start) + lax.iota(jnp.int32, images)[None]
        return start, jnp.broadcast_to(stop, start.shape), codes

    of_sources, of_queries = (cutoff.sources, cutoff.queries) if isinstance(cutoff, Cutoffs) else (None, None)
    points = _in_order(sources, order, of_sources)
    return Candidates(points, _in_order(sources if queries is None else queries, query_order, of_queries), runs, torus)


def _cell_stencil(
    sources: Array, queries: Array | None, along: Array, axes: CellAxes, batch: Batch | None, torus: Torus | None
) -> Candidates:
    """Cells: sources and queries sorted by cell; the runs of a query are the rows of cells around its own.

    `along` [d, n + m] are the coordinates of the sources, then of the queries, that `axes` cuts into cells.
    """
    finite = jnp.isfinite(along).all(axis=0)
    coords, extent = grid_coordinates(along, axes, finite, None if batch is None else batch.of_all)
    n, total = sources.shape[0], along.shape[1]
    grid = build_grid(coords[:, :n], finite[:n], extent, total)
    if queries is None:
        order = grid.order
    else:
        coords, finite = coords[:, n:], finite[n:]
        order = cell_order(coords, finite, extent, grid.dense)
    query_coords = coords[:, order]
    images = None if torus is None else torus.images

    def runs(place: Array, _: Array) -> tuple[Array, Array, Array | None]:
        return stencil_runs(grid, query_coords.at[:, place].get(mode="promise_in_bounds"), len(along), images)

    points = _in_order(sources, grid.order)
    return Candidates(points, points if queries is None else _in_order(queries, order), runs, torus)


def _cells_of_lattice(
    sources: Array, queries: Array | None, radius: np.floating | Array, lattice: Lattice, wrapped: Wrapped
) -> tuple[Array, Axes]:
    """Cut a lattice cell along its vectors; what is open, and not skewed, is cut as it is without a box."""
    points, packed = sources, wrapped.turns
    if queries is not None:
        points = jnp.concatenate([sources, queries])
        packed = jnp.concatenate([packed, wrapped.query_turns])
    units, turns = fractions_of(points, lattice), unpacked_turns(packed, lattice.dim).astype(points.dtype)
    along, edges, cells, scales, margins = [], [], [], [], []
    for k, periodic in enumerate(lattice.images.periodic):
        straight = lattice.images.orthogonal and not periodic
        x = points[:, k] if straight else jnp.clip(units[:, k] - turns[:, k], 0, 1) if periodic else units[:, k]
        along.append(jnp.where(packed >= 0, x, jnp.nan))
        edges.append(cell_edge(radius if straight else wrapped.reach[k]))
        cells.append(jnp.clip(jnp.floor(1 / wrapped.reach[k]), 1, 2.0**23) if periodic else None)
        scales.append(jnp.ones_like(wrapped.reach[k]) if straight else (wrapped.reach[k] - wrapped.margin[k]) / radius)
        margins.append(0 * wrapped.margin[k] if straight else wrapped.margin[k])
    scale = jnp.stack(scales) * (1 + 8 * jnp.finfo(points.dtype).eps)
    return jnp.stack(along), Axes(CellAxes(edges, cells), scale, jnp.stack(margins))


def _in_order(positions: Array, order: Array | None, radii: Array | None = None) -> Points:
    if order is None:
        return Points(list(positions.T), lax.iota(jnp.int32, positions.shape[0]), radii)
    return Points([x[order] for x in positions.T], order, None if radii is None else radii[order])
