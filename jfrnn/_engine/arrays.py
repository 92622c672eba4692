"""The array engines "jax" and "brute": four steps of array programming, wherever XLA runs.

1. Sort: particles are sorted by the number of their cell, and a table tells where each number begins (`jfrnn._geometry.cell_line`).
2. Stencil: the rows of cells around a query are runs of sorted particles, its candidates (`line_runs`; `find_candidates` below).
3. Gather: runs are read as words of 16 particles and compared with the cutoff, a bit each (`jfrnn._engine.blocks`, `_test`). What
   rounding leaves open is decided exactly (`_decide_by_rounds` on a CPU; elsewhere `_decide_first` and `_decide_in_rows`, which do
   without a loop, and `_decide_rest`).
4. Compaction: the k-th neighbor of a query is its k-th set bit (`jfrnn._engine.words.BitRows`).

"brute" has no sorting: all particles are one run; few of them are read without gathers (`_test_all`). What is chosen by
platform stands in `jfrnn._engine.tuning`.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.boxes import find_in_boxes
from jfrnn._engine.candidates import Candidates, Excluded, Points, Span, Torus
from jfrnn._engine.problem import Features, Options, Room, Rows, Search, largest_radius
from jfrnn._engine.runs import count_neighbors, fill_neighbors, list_neighbors
from jfrnn._engine.tuning import Tuning, by_platform
from jfrnn._engine.words import CHUNK, LANES
from jfrnn._geometry import (
    FINE,
    Axes,
    Batch,
    CellAxes,
    Cells,
    Cutoff,
    Cutoffs,
    ExcludedCodes,
    Lattice,
    Levels,
    Status,
    Wrapped,
    cell_edge,
    fractions_of,
    level_runs,
    line_runs,
    open_axes,
    sort_along_line,
    sort_by_levels,
    sort_queries,
    translation,
    unpack_turns,
)
from jfrnn._tracing import call_late, largest_of

_MOST_SOURCES = 2**30 - LANES  # whose places are int32, as runs read the sources twice in a row


@dataclasses.dataclass(frozen=True)
class ArrayEngine:
    """Tests candidates from cells, or all sources, by array programming, wherever XLA runs.

    Attributes:
        name: "jax" or "brute".
        by_cells: Whether candidates are the sources in the cells around a query instead of all sources.
    """

    name: str
    by_cells: bool
    static_radius = False
    translates = False
    native = False

    def refuse(self, asked: Features) -> str | None:
        """Return None: it supports every search."""
        return None

    def missing(self, platform: str) -> str | None:
        """Return None: it runs on every platform."""
        return None

    def rows(self, search: Search, options: Options, capacity: int | Room | None) -> Rows:
        """Find the candidates of every query, and keep those that are neighbors."""
        refuse_many(search)
        m = search.sizes[1]
        if isinstance(capacity, Room):
            return self._flat_rows(search._replace(checks={}), options, capacity)

        def on(tuning: Tuning) -> Callable[[Search], Rows]:
            return functools.partial(self._rows, options, capacity, tuning)

        count, one = jax.ShapeDtypeStruct((m,), np.int32), jax.ShapeDtypeStruct((), np.int32)
        idx = None if capacity is None else jax.ShapeDtypeStruct((m, capacity), np.int32)
        return Rows(*call_late(functools.partial(by_platform, on), (search._replace(checks={}),), (idx, count, one, one)))

    def _rows(self, options: Options, capacity: int | None, tuning: Tuning, search: Search) -> Rows:
        candidates = find_candidates(search, self.by_cells and not is_few(search, tuning), tuning)
        if capacity is None:
            return complete_rows(search, None, count_neighbors(candidates, search.cutoff, options.filter, tuning), None)
        return complete_rows(search, *list_neighbors(candidates, search.cutoff, options.filter, capacity, tuning), capacity)

    def _flat_rows(self, search: Search, options: Options, room: Room) -> Rows:
        def on(tuning: Tuning) -> Callable[[tuple[Search, Array]], Array]:
            def fill(operands: tuple[Search, Array]) -> Array:
                search, starts = operands
                candidates = find_candidates(search, self.by_cells and not is_few(search, tuning), tuning)
                return fill_neighbors(candidates, search.cutoff, options.filter, Room(starts, room.total), tuning)

            return fill

        like = jax.ShapeDtypeStruct((room.total,), np.int32)
        idx = call_late(lambda *operands: by_platform(on, operands), (search, room.starts), like)
        begun = jnp.zeros(room.total, jnp.int32).at[room.starts[1:-1]].add(1, mode="drop", indices_are_sorted=True)
        receivers = jnp.cumsum(begun, dtype=jnp.int32)
        return complete_rows(search, idx, jnp.diff(room.starts), None)._replace(receivers=receivers)

    def scratch_bytes(self, platform: str, n: int, m: int, dim: int, double: bool, own: bool, scaled: bool) -> int | None:
        """Return None: only the compiler knows."""
        return None


def refuse_many(search: Search) -> None:
    """Raise an error if there are more sources than runs have places for."""
    if (n := search.sizes[0]) > _MOST_SOURCES:
        raise ValueError(
            f"positions: backend='jax' looks for neighbors among at most {_MOST_SOURCES} particles, got {n}: pass "
            "backend='warp', or divide the particles over devices with jfrnn.distributed."
        )


def is_few(search: Search, tuning: Tuning) -> bool:
    """Say whether testing all pairs takes less time than sorting."""
    images = 1 if search.torus is None or search.per_system else search.torus[0].images.total
    plain = search.torus is None and search.batch is None and not search.per_system
    most = tuning.plain_pairs if plain and search.sizes[0] <= CHUNK else tuning.few_pairs
    return math.prod(search.sizes) * images <= most


def complete_rows(search: Search, idx: Array | None, count: Array, capacity: int | None) -> Rows:
    """Return rows with the length of the longest, and status bits for overflow and non-finite positions."""
    required = largest_of(count)
    finite = jnp.isfinite(search.sources).all() & (True if search.queries is None else jnp.isfinite(search.queries).all())
    overflow = False if capacity is None else required > capacity
    status = jnp.where(overflow, Status.ROW_OVERFLOW.value, 0) | jnp.where(finite, 0, Status.NONFINITE.value)
    return Rows(idx, count, required, status.astype(jnp.int32))


def find_candidates(search: Search, by_cells: bool, tuning: Tuning) -> Candidates:
    """Return the candidates of each query: all sources (brute force), by cells, or by cells of many sizes."""
    found = find_in_boxes(search, by_cells) if search.per_system else _find_candidates(search, by_cells, tuning)
    if search.exclude is not None:
        found = found._replace(excluded=_place_excluded(found, search.exclude))
    return found._replace(given=(search.sources, search.sources if search.queries is None else search.queries))


def _place_excluded(candidates: Candidates, exclude: ExcludedCodes) -> Excluded:
    """Return where excluded sources stand among the candidates; those that stand nowhere are placed before all others."""
    n, place = candidates.size, lax.iota(jnp.int32, candidates.size)
    ids = candidates.sources.ids[:n]
    if candidates.again is not None:
        ids = jnp.where(place < candidates.again, ids, n)
    places = jnp.full(n, -(1 << 30), jnp.int32).at[ids].set(place, mode="drop")
    found = places[exclude.others]
    if exclude.codes is None or candidates.torus is not None:
        return Excluded(exclude.starts, found, exclude.codes)
    return Excluded(exclude.starts, jnp.where(exclude.codes < 0, -(1 << 30), found))


def _find_candidates(search: Search, by_cells: bool, tuning: Tuning) -> Candidates:
    sources, queries, cutoff, batch, given = search[:5]
    torus = None if given is None else _torus(*given, sources.dtype)
    clouds = (sources, queries) if given is None else (given[1].sources, None if queries is None else given[1].queries)
    if not by_cells:
        return _all_sources(*clouds, cutoff, batch, torus)
    if isinstance(cutoff, Cutoff):
        along, axes = _cells_along(sources, queries, cutoff, given)
        return _cell_stencil(*clouds, along, axes.cells, batch, torus, tuning)
    images, levels = None if torus is None else torus.images, levels_of(search)
    of_sources, of_queries = cutoff.of_points
    points = _in_order(clouds[0], jnp.pad(levels.order, (0, LANES)), of_sources)
    rows = _in_order(clouds[0] if clouds[1] is None else clouds[1], levels.query_order, of_queries)
    words, runs = {2: 16, 3: 64}[sources.shape[1]], level_runs(levels, cutoff.of_cells, images)

    def runs_of(span: Span, which: Array) -> tuple[Array, Array, Array | None]:
        return runs(span.places, which)

    return Candidates(points, rows, runs_of, torus, len(sources), lambda _: words, levels.passes)


def levels_of(search: Search) -> Levels:
    """Sort a search with cutoffs per particle into cells of many sizes."""
    cutoff = search.cutoffs
    along, axes = _cells_along(search.sources, search.queries, cutoff, search.torus)
    systems = None if search.batch is None else search.batch.of_all
    return sort_by_levels(along, axes, cutoff, search.sources.shape[0], search.queries is None, systems)


def _cells_along(
    sources: Array, queries: Array | None, cutoff: Cutoff | Cutoffs, torus: tuple[Lattice, Wrapped] | None
) -> tuple[Array, Axes]:
    """Return coordinates [d, n + m] along the axes that cells divide, sources first, and how the axes are divided."""
    if torus is not None:
        return _cells_of_lattice(sources, queries, largest_radius(cutoff), *torus)
    points = sources if queries is None else jnp.concatenate([sources, queries])
    one = jnp.ones(points.shape[1], points.dtype)
    return points.T, Axes(open_axes(cell_edge(largest_radius(cutoff)), points.shape[1]), one, 0 * one)


def _torus(lattice: Lattice, wrapped: Wrapped, dtype: np.dtype) -> Torus:
    turns = tuple(unpack_turns(x, lattice.dim).astype(dtype) for x in (wrapped.turns, wrapped.query_turns))
    shifts = jnp.asarray(lattice.images.shifts).astype(dtype)
    return Torus(lattice.images, translation(shifts, lattice), lattice.given, (turns[0], turns[1]), wrapped.slack)


def _all_sources(
    sources: Array, queries: Array | None, cutoff: Cutoff | Cutoffs, batch: Batch | None, torus: Torus | None
) -> Candidates:
    """Return as candidates of a query all sources, or those of its system, once per image: brute force, O(n·m)."""
    images = 1 if torus is None else torus.images.total
    order = query_order = None
    first = end = jnp.zeros((), jnp.int32)
    if batch is not None:
        order = jnp.argsort(batch.sources).astype(jnp.int32)
        query_order = order if batch.queries is None else lax.iota(jnp.int32, batch.queries.size)
        systems, wanted = batch.sources[order], batch.of_queries[query_order]
        first, end = (jnp.searchsorted(systems, wanted, side=side).astype(jnp.int32) for side in ("left", "right"))

    def runs(span: Span, _: Array) -> tuple[Array, Array, Array | None]:
        start, stop = jnp.zeros((span.size, images), jnp.int32), jnp.int32(len(sources))
        if batch is not None:
            start, stop = start + span.of(first)[:, None], span.of(end)[:, None]
        codes = None if torus is None else jnp.zeros_like(start) + lax.iota(jnp.int32, images)[None]
        return start, jnp.broadcast_to(stop, start.shape), codes

    of_sources, of_queries = cutoff.of_points if isinstance(cutoff, Cutoffs) else (None, None)
    words, ids = images * -(-len(sources) // LANES), lax.iota(jnp.int32, len(sources)) if order is None else order
    whole = batch is None and torus is None
    gap = (0, max(LANES, CHUNK - len(sources)) if whole else LANES)
    ids = jnp.pad(ids, gap)
    if order is None:
        radii = None if of_sources is None else jnp.pad(of_sources, gap)
        points = Points(list(jnp.pad(sources.T, ((0, 0), gap), constant_values=jnp.inf)), ids, radii)  # no neighbors
    else:
        points = _in_order(sources, ids, of_sources)
    rows = _in_order(sources if queries is None else queries, query_order, of_queries)
    if queries is None:  # their positions come first among those of the sources
        rows = rows._replace(axes=points.axes)
    unordered = query_order is None
    n, of_capacity = len(sources), lambda _: words
    return Candidates(points, rows, runs, torus, n, of_capacity, in_order=unordered, most_words=words, whole=whole)


def _cell_stencil(
    sources: Array,
    queries: Array | None,
    along: Array,
    axes: CellAxes,
    batch: Batch | None,
    torus: Torus | None,
    tuning: Tuning,
) -> Candidates:
    """Sort sources and queries by cell; the runs of a query are the rows of cells around its own.

    `along` [d, n + m] are the coordinates of the sources, then of the queries, which `axes` divides into cells.
    """
    n, systems = len(sources), None if batch is None else batch.of_all
    line, cells = sort_along_line(along, axes, n, systems, tuning.sorting)
    numbers, order = (line.numbers, line.order) if queries is None else sort_queries(cells, n, tuning.sorting)
    images = None if torus is None else torus.images
    ordered = None if images is None else cells.of(order if queries is None else order + n)

    def runs(span: Span, _: Array) -> tuple[Array, Array, Array | None]:
        along = cells.along if ordered is None else span.of(ordered.along)  # in open space, the number says all
        return line_runs(line, Cells(along, span.of(numbers)), images)

    twice = line.twice(more=LANES)
    points = _in_order(sources, twice)._replace(systems=None if batch is None else batch.sources[twice])
    rows = points._replace(ids=order) if queries is None else _in_order(queries, order)
    if batch is not None:
        rows = rows._replace(systems=batch.of_queries[order])
    return Candidates(points, rows, runs, torus, n, functools.partial(_stencil_words, sources.shape[1]), again=line.inside)


def _stencil_words(dim: int, slots: int | None) -> int:
    """Return the words around a query that has as many neighbors as slots, in a uniform density: a multiple of 8 or 16.

    Cells whose walls stand where a lattice has its sites hold up to a fifth more than the average; that fits, too.
    """
    runs, many = 3 ** (dim - 1), {2: 8, 3: 16}[dim]
    share = (2 + 1 / FINE) * runs / {2: np.pi, 3: 4 * np.pi / 3}[dim]  # candidates per neighbor
    slots = {2: 32, 3: 128}[dim] if slots is None else slots
    words = math.ceil(share * slots / LANES + runs)
    return min(-(-words // many) * many, {2: 32, 3: 64}[dim])


def _cells_of_lattice(
    sources: Array, queries: Array | None, radius: np.floating | Array, lattice: Lattice, wrapped: Wrapped
) -> tuple[Array, Axes]:
    """Divide a lattice cell along its vectors; open axes of an orthogonal box are divided as without a box."""
    points, packed = sources, wrapped.turns
    if queries is not None:
        points = jnp.concatenate([sources, queries])
        packed = jnp.concatenate([packed, wrapped.query_turns])
    units, turns = fractions_of(points, lattice), unpack_turns(packed, lattice.dim).astype(points.dtype)
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
