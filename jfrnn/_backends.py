"""The engines of a search: which one answers, and how the array engines find candidates.

What a pair is, and how rows are filled, the array engines share (`_exact`, `_runs`); the Warp engines live in `_warp`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jfrnn import _warp
from jfrnn._cells import build_grid, cell_edge, cell_order, grid_coordinates, stencil_runs
from jfrnn._exact import Cutoff
from jfrnn._runs import Filter, Points, Runs, count_neighbors, list_neighbors
from jfrnn._status import Status
from jfrnn._warp import Rows


class Options(NamedTuple):
    """What is static about a search, apart from its capacity."""

    filter: Filter
    backend: str
    radius: float | None = None  # of the cutoff, for the one engine that builds its grid from the host: hashgrid


def neighbors(
    sources: Array, queries: Array | None, active: Array | None, cutoff: Cutoff, options: Options, capacity: int | None
) -> Rows:
    """List the neighbors of every query, or only count them (capacity=None). Integers: no gradient flows through."""
    sources = lax.stop_gradient(sources)
    queries = None if queries is None else lax.stop_gradient(queries)
    rows = _rows_of_engine(without_inactive(sources, active), queries, cutoff, options, capacity)
    if active is None:
        return rows
    finite = (jnp.isfinite(sources).all(axis=1) | ~active).all() & (True if queries is None else jnp.isfinite(queries).all())
    others = rows.status & ~Status.NONFINITE.value
    return rows._replace(status=others | jnp.where(finite, 0, Status.NONFINITE.value).astype(jnp.int32))


def without_inactive(positions: Array, active: Array | None) -> Array:
    """Return positions with NaN where a particle is inactive: no engine gives such a one neighbors, or to others."""
    return positions if active is None else jnp.where(active[:, None], positions, jnp.nan)


def _rows_of_engine(sources: Array, queries: Array | None, cutoff: Cutoff, options: Options, capacity: int | None) -> Rows:
    n, m = sources.shape[0], (sources if queries is None else queries).shape[0]
    if options.backend == "warp" and 0 not in (n, m):
        return _warp.neighbors(sources, queries, cutoff, options.filter, capacity)
    if options.radius is not None and 0 not in (n, m):
        return _warp.hashgrid_neighbors(sources, queries, cutoff, options.radius, options.filter, capacity)
    if 0 in (n, m):
        idx, count = None if capacity is None else jnp.full((m, capacity), n, jnp.int32), jnp.zeros(m, jnp.int32)
    elif capacity is None:
        idx, count = None, count_neighbors(*_candidates(sources, queries, cutoff, options), cutoff, options.filter)
    else:
        idx, count = list_neighbors(*_candidates(sources, queries, cutoff, options), cutoff, options.filter, capacity)
    required = jnp.max(count, initial=0)
    finite = jnp.isfinite(sources).all() & (True if queries is None else jnp.isfinite(queries).all())
    overflow = False if capacity is None else required > capacity
    status = jnp.where(overflow, Status.ROW_OVERFLOW.value, 0) | jnp.where(finite, 0, Status.NONFINITE.value)
    return Rows(idx, count, required, status.astype(jnp.int32))


@functools.partial(jax.jit, static_argnames=("options", "capacity"))
def list_rows(sources: Array, queries: Array | None, active: Array | None, cutoff: Cutoff, options: Options, capacity: int) -> Rows:
    """List the neighbors of every query: the compiled program of `search`."""
    return neighbors(sources, queries, active, cutoff, options, capacity)


@functools.partial(jax.jit, static_argnames="options")
def count_rows(sources: Array, queries: Array | None, active: Array | None, cutoff: Cutoff, options: Options) -> Array:
    """Count the neighbors of every query, [m] int32: the compiled program of `count`."""
    return neighbors(sources, queries, active, cutoff, options, None).counts


def _candidates(sources: Array, queries: Array | None, cutoff: Cutoff, options: Options) -> tuple[Points, Points, Runs]:
    find = _all_sources if options.backend == "brute" else _cell_stencil
    return find(sources, queries, cutoff)


def _all_sources(sources: Array, queries: Array | None, cutoff: Cutoff) -> tuple[Points, Points, Runs]:
    """Brute force: one run of all sources, O(n·m)."""

    def runs(place: Array) -> tuple[Array, Array]:
        start = jnp.zeros((place.size, 1), jnp.int32)
        return start, jnp.full_like(start, sources.shape[0])

    points = _in_order(sources, None)
    return points, points if queries is None else _in_order(queries, None), runs


def _cell_stencil(sources: Array, queries: Array | None, cutoff: Cutoff) -> tuple[Points, Points, Runs]:
    """Cells: sources and queries sorted by cell; the runs of a query are the rows of cells around its own."""
    points = sources if queries is None else jnp.concatenate([sources, queries])
    finite = jnp.isfinite(points).all(axis=1)
    coords, extent = grid_coordinates(points.T, cell_edge(cutoff.radius), finite)
    n, total = sources.shape[0], points.shape[0]
    grid = build_grid(coords[:, :n], finite[:n], extent, total)
    if queries is None:
        order = grid.order
    else:
        coords, finite = coords[:, n:], finite[n:]
        order = cell_order(coords, finite, extent, grid.dense)
    query_coords = coords[:, order]

    def runs(place: Array) -> tuple[Array, Array]:
        return stencil_runs(grid, query_coords.at[:, place].get(mode="promise_in_bounds"))

    points = _in_order(sources, grid.order)
    return points, points if queries is None else _in_order(queries, order), runs


def _in_order(positions: Array, order: Array | None) -> Points:
    if order is None:
        return Points(list(positions.T), lax.iota(jnp.int32, positions.shape[0]))
    return Points([x[order] for x in positions.T], order)
