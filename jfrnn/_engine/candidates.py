"""Candidates: sources and queries in the order in which array programs visit them, and the runs that each query has to test."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._geometry import Images

NOWHERE = -(1 << 30)  # the place of what stands nowhere among the candidates: before all words


class Span(NamedTuple):
    """Queries at consecutive positions of their order.

    Attributes:
        first: [] int32, the first position.
        size: How many. Static.
    """

    first: Array | int
    size: int

    @property
    def places(self) -> Array:
        """The positions, [size] int32."""
        return self.first + lax.iota(jnp.int32, self.size)

    def of(self, x: Array) -> Array:
        """Return the values of these queries from an array whose last axis is their order."""
        return lax.dynamic_slice_in_dim(x, self.first, self.size, axis=-1)


# (queries, number of the pass over the sources) -> starts, ends and image codes of runs [b, r]
Runs = Callable[[Span, Array], tuple[Array, Array, Array | None]]


class Points(NamedTuple):
    """Particles in the order in which the engine visits them. Sources are followed by at least 15 others, so that words end.

    Attributes:
        axes: d coordinate arrays [n].
        ids: [n] int32, their indices.
        radii: [n] cutoffs per particle, or species with a table of cutoffs; None with one cutoff or if the rule does not use them.
        systems: [n] systems of a batch, or None if runs meet no other system than that of their query.
        places: For queries that are sources [m] int32, where each stands among these, or NOWHERE; None: as it is visited.
    """

    axes: list[Array]
    ids: Array
    radii: Array | None = None
    systems: Array | None = None
    places: Array | None = None


class Torus(NamedTuple):
    """What a lattice adds: periodic images of the sources, which wrapped coordinates decide up to doubtful pairs.

    Attributes:
        images: The images that the search considers. Static.
        translations: [images, d] lattice translation of each image, up to rounding; with a box per system the shift itself.
        matrix: [d, d] lattice vectors as given; with a box per system [d, d, m], those of each query in the order of visits.
        turns: [n, d] and [m, d] whole floats, the lattice vectors that wrapping subtracted.
        slack: [] bound on the error of a component of a displacement of wrapped coordinates; [m] with a box per system.
    """

    images: Images
    translations: Array
    matrix: Array
    turns: tuple[Array, Array]
    slack: Array


class Excluded(NamedTuple):
    """Where the sources that queries exclude stand in the order of visits.

    Attributes:
        starts: [m + 1] int32, where the row of each query begins, by the queries' ids, and where the last one ends.
        places: [k] int32, positions of excluded sources, row after row; NOWHERE for those that have none.
        codes: [k] int32, the images that are excluded; None: all are.
    """

    starts: Array
    places: Array
    codes: Array | None = None


class Candidates(NamedTuple):
    """Sources and queries in the order in which they are visited, and a function that finds the candidates of queries.

    Attributes:
        sources: The sources as runs read them.
        queries: The queries; if these are the sources, their positions come first among `sources`.
        runs: The function that finds the runs of queries.
        torus: What a lattice adds.
        size: Number of sources. Static.
        most_words: How many words of candidates a query has at most, if known. Static.
        whole: Whether the candidates of each query are all sources, in the order of their indices, once. Static.
        given: [n, d] sources and [m, d] queries, by their indices and as they were given.
        words: From slots per query (None: unknown) to the words of candidates that are tested at a time. Static.
        passes: Number of passes over the sources, [] int32, of all queries or from some of them; None for one.
        again: [] int32, after how many positions the sources start again; None if each has one position.
        excluded: The sources that queries exclude, or None.
        in_order: Whether queries are visited by their indices. Static.
        active: [] int32, how many queries have candidates, the first ones in the order of visits; None: all may.
    """

    sources: Points
    queries: Points
    runs: Runs
    torus: Torus | None
    size: int
    words: Callable[[int | None], int]
    passes: Array | Callable[[Span], Array] | None = None
    again: Array | None = None
    excluded: Excluded | None = None
    in_order: bool = False
    active: Array | None = None
    most_words: int | None = None
    whole: bool = False
    given: tuple[Array, ...] = ()
