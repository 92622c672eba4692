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

from jfrnn import _geometry as geometry
from jfrnn._engine.candidates import NOWHERE, Candidates, Excluded, Points, Span, Torus
from jfrnn._engine.problem import Features, Options, Room, Rows, Search, largest_radius
from jfrnn._engine.runs import State, count_neighbors, fill_neighbors, list_neighbors
from jfrnn._engine.tuning import Tuning, by_platform
from jfrnn._engine.words import CHUNK, LANES
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
        cutoff, keep, (n, m) = search.cutoff, options.filter, search.sizes
        by_cells = self.by_cells and not is_few(search, tuning)
        counts = jnp.zeros(m, jnp.int32)
        if capacity is None:

            def count(candidates: Candidates, state: list[Array]) -> list[Array]:
                return count_neighbors(candidates, cutoff, keep, tuning, state)

            (counts,) = fold_candidates(search, by_cells, tuning, count, [counts])
            return complete_rows(search, None, counts, None)

        def fill(candidates: Candidates, state: list[Array]) -> list[Array]:
            return list_neighbors(candidates, cutoff, keep, capacity, tuning, state)

        images = 1 if search.lattice is None or search.lattice.images.nearest else search.lattice.images.total
        unused = jnp.full((m, capacity), n * images, jnp.int32)
        idx, counts = fold_candidates(search, by_cells, tuning, fill, [unused, counts])
        return complete_rows(search, idx, counts, capacity)

    def _flat_rows(self, search: Search, options: Options, room: Room) -> Rows:
        def on(tuning: Tuning) -> Callable[[tuple[Search, Array]], Array]:
            def fill(operands: tuple[Search, Array]) -> Array:
                (search, starts), keep = operands, options.filter
                whole = Room(starts, room.total)

                def step(candidates: Candidates, state: list[Array]) -> list[Array]:
                    return fill_neighbors(candidates, search.cutoff, keep, whole, tuning, state)

                by_cells = self.by_cells and not is_few(search, tuning)
                return fold_candidates(search, by_cells, tuning, step, [jnp.zeros(room.total, jnp.int32), starts[:-1]])[0]

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
    status = jnp.where(overflow, geometry.Status.ROW_OVERFLOW.value, 0) | jnp.where(finite, 0, geometry.Status.NONFINITE.value)
    return Rows(idx, count, required, status.astype(jnp.int32))


def fold_candidates(
    search: Search, by_cells: bool, tuning: Tuning, step: Callable[[Candidates, State], State], state: State
) -> State:
    """Return the state after state = step(candidates, state): once or, where cutoffs differ, for the candidates of each octave.

    Candidates are all sources (brute force), or those of cells.
    """
    if search.per_system:
        return step(_complete(search, find_in_boxes(search, by_cells)), state)
    if not by_cells:
        return step(_complete(search, _all_sources(search)), state)
    if isinstance(search.cutoff, geometry.Cutoff):
        return step(_complete(search, _cell_stencil(search, tuning)), state)
    there = (search.sources, search.sources if search.queries is None else search.queries)
    parts = geometry.parts_of(search.cutoffs.of_cells, *(jnp.isfinite(x).all(axis=1) for x in there))

    def take(now: tuple[Array, State]) -> tuple[Array, State]:
        number, state = now
        candidates = _cell_stencil(search, tuning, parts.part(number, search.sources.dtype))
        return parts.after(number), step(_complete(search, candidates), state)

    return lax.while_loop(lambda now: now[0] < parts.end, take, (parts.after(-1), state))[1]


def _complete(search: Search, found: Candidates) -> Candidates:
    """Add to candidates what is excluded, and the points as they were given."""
    if search.exclude is not None:
        starts, others, codes = search.exclude
        places = _places_of(found)[others]
        if codes is not None and found.torus is None:  # those that stand nowhere are placed before all others
            places, codes = jnp.where(codes < 0, NOWHERE, places), None
        found = found._replace(excluded=Excluded(starts, places, codes))
    return found._replace(given=(search.sources, search.sources if search.queries is None else search.queries))


def _places_of(candidates: Candidates) -> Array:
    """Return where each source stands among the candidates, for the first time; NOWHERE if it does not."""
    n, place = candidates.size, lax.iota(jnp.int32, candidates.size)
    ids = candidates.sources.ids[:n]
    if candidates.again is not None:
        ids = jnp.where(place < candidates.again, ids, n)
    return jnp.full(n, NOWHERE, jnp.int32).at[ids].set(place, mode="drop")


def _clouds(search: Search) -> tuple[Array, Array | None, Torus | None]:
    """Return sources and queries, near the cell if there is a lattice, and what a lattice adds."""
    if search.torus is None:
        return search.sources, search.queries, None
    (lattice, wrapped), dtype = search.torus, search.sources.dtype
    turns = tuple(geometry.unpack_turns(x, lattice.dim).astype(dtype) for x in (wrapped.turns, wrapped.query_turns))
    shifts = geometry.translation(jnp.asarray(lattice.images.shifts).astype(dtype), lattice)
    torus = Torus(lattice.images, shifts, lattice.given, (turns[0], turns[1]), wrapped.slack)
    return wrapped.sources, None if search.queries is None else wrapped.queries, torus


def _cells_along(search: Search, scale: Array | None) -> tuple[Array, geometry.CellAxes]:
    """Return coordinates [d, n + m] along the axes that cells divide, sources first, and how the axes are divided.

    Cells are as wide as the cutoff, or as the largest cutoff times `scale`.
    """
    sources, queries, radius = search.sources, search.queries, largest_radius(search.cutoff)
    radius = radius if scale is None else radius * scale
    if search.torus is not None:
        lattice, wrapped = search.torus
        if scale is not None:
            reach = (wrapped.reach - wrapped.margin) * scale * (1 + 8 * jnp.finfo(sources.dtype).eps) + wrapped.margin
            wrapped = wrapped._replace(reach=reach)
        return _cells_of_lattice(sources, queries, radius, lattice, wrapped)
    points = sources if queries is None else jnp.concatenate([sources, queries])
    return points.T, geometry.open_axes(geometry.cell_edge(radius), points.shape[1])


def _all_sources(search: Search) -> Candidates:
    """Return as candidates of a query all sources, or those of its system, once per image: brute force, O(n·m)."""
    (sources, queries, torus), cutoff, batch = _clouds(search), search.cutoff, search.batch
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

    of_sources, of_queries = cutoff.of_points if isinstance(cutoff, geometry.Cutoffs) else (None, None)
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


def _cell_stencil(search: Search, tuning: Tuning, part: geometry.Part | None = None) -> Candidates:
    """Sort sources and queries by cell; the runs of a query are the rows of cells around its own.

    With a part, cells are as wide as its cutoffs ask for, and hold its sources and queries alone.
    """
    (sources, queries, torus), batch, n = _clouds(search), search.batch, search.sizes[0]
    along, axes = _cells_along(search, None if part is None else part.scale)
    systems, own = None if batch is None else batch.of_all, queries is None
    if part is not None:
        if own:
            queries, along = sources, jnp.concatenate([along, along], axis=1)
            systems = None if systems is None else jnp.concatenate([systems, systems])
        along = jnp.where(jnp.concatenate([part.sources, part.queries]), along, jnp.nan)
    line, cells = geometry.sort_along_line(along, axes, n, systems, tuning.sorting)
    numbers, order = (line.numbers, line.order) if queries is None else geometry.sort_queries(cells, n, tuning.sorting)
    images = None if torus is None else torus.images
    ordered = None if images is None else cells.of(order if queries is None else order + n)

    def runs(span: Span, _: Array) -> tuple[Array, Array, Array | None]:
        along = cells.along if ordered is None else span.of(ordered.along)  # in open space, the number says all
        return geometry.line_runs(line, geometry.Cells(along, span.of(numbers)), images)

    twice = line.twice(more=LANES)
    points = _in_order(sources, twice)._replace(systems=None if batch is None else batch.sources[twice])
    rows = points._replace(ids=order) if queries is None else _in_order(queries, order)
    if batch is not None:
        rows = rows._replace(systems=batch.of_queries[order])
    words = functools.partial(_stencil_words, sources.shape[1])
    found = Candidates(points, rows, runs, torus, n, words, again=line.inside)
    return found if part is None else _of_part(found, search.cutoffs, part, own)


def _of_part(found: Candidates, cutoffs: geometry.Cutoffs, part: geometry.Part, own: bool) -> Candidates:
    """Add to the candidates of a part the cutoffs, and where queries that are sources stand."""
    of_sources, of_queries = cutoffs.of_points
    points, rows = found.sources, found.queries
    points = points._replace(radii=None if of_sources is None else of_sources[points.ids])
    rows = rows._replace(radii=None if of_queries is None else of_queries[rows.ids])
    if own:
        rows = rows._replace(places=_places_of(found)[rows.ids])
    return found._replace(sources=points, queries=rows, active=jnp.sum(part.queries, dtype=jnp.int32))


def _stencil_words(dim: int, slots: int | None) -> int:
    """Return the words around a query that has as many neighbors as slots, in a uniform density: a multiple of 8 or 16.

    Cells whose walls stand where a lattice has its sites hold up to a fifth more than the average; that fits, too.
    """
    runs, many = 3 ** (dim - 1), {2: 8, 3: 16}[dim]
    share = (2 + 1 / geometry.FINE) * runs / {2: np.pi, 3: 4 * np.pi / 3}[dim]  # candidates per neighbor
    slots = {2: 32, 3: 128}[dim] if slots is None else slots
    words = math.ceil(share * slots / LANES + runs)
    return min(-(-words // many) * many, {2: 32, 3: 64}[dim])


def _cells_of_lattice(
    sources: Array, queries: Array | None, radius: np.floating | Array, lattice: geometry.Lattice, wrapped: geometry.Wrapped
) -> tuple[Array, geometry.CellAxes]:
    """Divide a lattice cell along its vectors; open axes of an orthogonal box are divided as without a box."""
    points, packed = sources, wrapped.turns
    if queries is not None:
        points = jnp.concatenate([sources, queries])
        packed = jnp.concatenate([packed, wrapped.query_turns])
    units, turns = geometry.fractions_of(points, lattice), geometry.unpack_turns(packed, lattice.dim).astype(points.dtype)
    along, edges, cells = [], [], []
    for k, periodic in enumerate(lattice.images.periodic):
        straight = lattice.images.orthogonal and not periodic
        x = points[:, k] if straight else jnp.clip(units[:, k] - turns[:, k], 0, 1) if periodic else units[:, k]
        along.append(jnp.where(packed >= 0, x, jnp.nan))
        edges.append(geometry.cell_edge(radius if straight else wrapped.reach[k]))
        cells.append(jnp.clip(jnp.floor(1 / wrapped.reach[k]), 1, 2.0**23) if periodic else None)
    return jnp.stack(along), geometry.CellAxes(edges, cells)


def _in_order(positions: Array, order: Array | None, radii: Array | None = None) -> Points:
    if order is None:
        return Points(list(positions.T), lax.iota(jnp.int32, positions.shape[0]), radii)
    return Points([x[order] for x in positions.T], order, None if radii is None else radii[order])


# --- where each system has a box of its own (`jfrnn._geometry.box_cells`) ---------------------------------------------

_WIDTH = 27  # runs of a pass
_WORDS = 64  # of candidates that a query tests at a time


def find_in_boxes(search: Search, by_cells: bool) -> Candidates:
    """Return as candidates of a query the sources in the cells around it, or all of its system, in the images within its reach."""
    sources, queries, batch, torus = search.sources, search.queries, search.batch, search.torus
    if batch is None or torus is None:
        raise TypeError("a search with a box per system has a batch and a lattice.")
    lattice, wrapped = torus
    cells = geometry.sort_into_boxes(sources, queries, lattice, wrapped, batch, by_cells)
    padded = jnp.pad(cells.order, (0, LANES))
    order = cells.order if queries is None else lax.iota(jnp.int32, len(queries))
    systems = batch.of_queries[order]
    cells = cells._replace(from_cell=cells.from_cell[order], visited=cells.visited[order])

    def runs(span: Span, which: Array) -> tuple[Array, Array, Array]:
        return geometry.box_runs(cells, systems, lattice, span.places, which, _WIDTH)

    def passes(span: Span) -> Array:
        return geometry.passes_of(cells, systems, span.places, _WIDTH)

    own = lattice.of_rows(systems)
    shifts = jnp.asarray(lattice.images.shifts)
    turns = tuple(geometry.unpack_turns(x, lattice.dim).astype(sources.dtype) for x in (wrapped.turns, wrapped.query_turns))
    matrix = jnp.concatenate([own.matrix, own.given], axis=1) if lattice.images.short else own.matrix  # the short vectors first
    matrix = jnp.moveaxis(matrix, 0, -1)
    images = Torus(lattice.images, shifts.astype(sources.dtype), matrix, (turns[0], turns[1]), wrapped.slack[systems])
    radii = search.cutoff.of_points if isinstance(search.cutoff, geometry.Cutoffs) else (None, None)
    points, rows = (
        Points([x[at] for x in of.T], at, None if each is None else each[at])
        for of, at, each in ((wrapped.sources, padded, radii[0]), (wrapped.queries, order, radii[1]))
    )
    return Candidates(points, rows, runs, images, len(sources), lambda _: _WORDS, passes)
