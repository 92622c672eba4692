"""Candidates of array programs where each system of a batch has a box of its own (`jfrnn._geometry.box_cells`)."""

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine.candidates import Candidates, Points, Span, Torus
from jfrnn._engine.problem import Search
from jfrnn._engine.words import LANES
from jfrnn._geometry import Cutoffs, box_runs, passes_of, sort_into_boxes, unpack_turns

_WIDTH = 27  # runs of a pass
_WORDS = 64  # of candidates that a query tests at a time


def find_in_boxes(search: Search, by_cells: bool) -> Candidates:
    """Return as candidates of a query the sources in the cells around it, or all of its system, in the images within its reach."""
    sources, queries, batch, torus = search.sources, search.queries, search.batch, search.torus
    if batch is None or torus is None:
        raise TypeError("a search with a box per system has a batch and a lattice.")
    lattice, wrapped = torus
    cells = sort_into_boxes(sources, queries, lattice, wrapped, batch, by_cells)
    padded = jnp.pad(cells.order, (0, LANES))
    order = cells.order if queries is None else lax.iota(jnp.int32, len(queries))
    systems = batch.of_queries[order]
    cells = cells._replace(from_cell=cells.from_cell[order], visited=cells.visited[order])

    def runs(span: Span, which: Array) -> tuple[Array, Array, Array]:
        return box_runs(cells, systems, lattice, span.places, which, _WIDTH)

    def passes(span: Span) -> Array:
        return passes_of(cells, systems, span.places, _WIDTH)

    own = lattice.of_rows(systems)
    shifts = jnp.asarray(lattice.images.shifts)
    turns = tuple(unpack_turns(x, lattice.dim).astype(sources.dtype) for x in (wrapped.turns, wrapped.query_turns))
    matrix = jnp.concatenate([own.matrix, own.given], axis=1) if lattice.images.short else own.matrix  # the short vectors first
    matrix = jnp.moveaxis(matrix, 0, -1)
    images = Torus(lattice.images, shifts.astype(sources.dtype), matrix, (turns[0], turns[1]), wrapped.slack[systems])
    radii = search.cutoff.of_points if isinstance(search.cutoff, Cutoffs) else (None, None)
    points, rows = (
        Points([x[at] for x in of.T], at, None if each is None else each[at])
        for of, at, each in ((wrapped.sources, padded, radii[0]), (wrapped.queries, order, radii[1]))
    )
    return Candidates(points, rows, runs, images, len(sources), lambda _: _WORDS, passes)
