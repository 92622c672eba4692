"""The operands and options of a search, and the protocol that every engine implements."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn import _geometry as geometry


class Filter(NamedTuple):
    """Which candidates may be neighbors, whatever their distance; static."""

    drop_self: bool
    later_only: bool


class Room(NamedTuple):
    """Where the rows of a flat list begin, which follow each other without gaps.

    Attributes:
        starts: Where each begins and the last one ends, shape [m + 1], int32, at most `total`.
        total: The slots of all. Static.
    """

    starts: Array
    total: int


class Rows(NamedTuple):
    """Neighbors of m queries: [m, capacity] int32 source indices, unused slots n (None if only counted), and [m] int32 true counts.

    In a flat list, `idx` [total] are the sources, and `receivers` [total] the rows; what stands behind the last pair is undefined.
    `required` [] int32 is the length of the longest row, `status` [] int32 the bits of `Status`. `order` [n] int32 are the sources
    as they follow each other in space, if that is asked for; -1 where their numbers do so already.
    """

    idx: Array | None
    counts: Array
    required: Array
    status: Array
    order: Array | None = None
    receivers: Array | None = None


class Search(NamedTuple):
    """The operands of a search as engines take them; positions of particles that do not take part are not finite."""

    sources: Array
    queries: Array | None
    cutoff: geometry.Cutoff | geometry.Cutoffs
    batch: geometry.Batch | None
    torus: tuple[geometry.Lattice, geometry.Wrapped] | None
    checks: dict[geometry.Status, Array]
    exclude: geometry.ExcludedCodes | None = None

    @property
    def cutoffs(self) -> geometry.Cutoffs:
        """The cutoffs of a search with cutoffs per particle."""
        if not isinstance(self.cutoff, geometry.Cutoffs):
            raise TypeError("this search has one cutoff for all particles.")
        return self.cutoff

    @property
    def lattice(self) -> geometry.Lattice | None:
        """The lattice of a periodic space, or one per system."""
        return None if self.torus is None else self.torus[0]

    @property
    def per_system(self) -> bool:
        """Whether each system of the batch has a box of its own."""
        return self.lattice is not None and self.lattice.images.per_system

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of sources and of queries."""
        return self.sources.shape[0], (self.sources if self.queries is None else self.queries).shape[0]


class Features(NamedTuple):
    """The features of a search that not every engine supports."""

    periodic: bool = False
    batch: bool = False
    radii: bool = False
    summed: bool = False
    excluding: bool = False


ANYTHING = Features()  # a search that every engine supports


class Engine(Protocol):
    """A way to find the pairs of a search. All engines find the same pairs.

    Attributes:
        name: The name that users pass as `backend`.
        static_radius: Whether it has to know the cutoff while tracing.
        translates: Whether it can sum a function over pairs, translated to native code.
        native: Whether compiled kernels serve the lists that it has found, and renew them: its searches are in the cells of CUDA.
        by_cells: Whether array programs that run in its place find candidates by cells instead of testing all sources.
    """

    @property
    def name(self) -> str: ...
    @property
    def static_radius(self) -> bool: ...
    @property
    def translates(self) -> bool: ...
    @property
    def native(self) -> bool: ...
    @property
    def by_cells(self) -> bool: ...

    def refuse(self, asked: Features) -> str | None:
        """Return why it cannot run such a search, or None if it can."""
        ...

    def missing(self, platform: str) -> str | None:
        """Return what it lacks on a JAX platform, or None if it can run there."""
        ...

    def rows(self, search: Search, options: "Options", capacity: int | Room | None) -> Rows:
        """List the neighbors of every query, or only count them (capacity=None). There is at least one source and one query.

        With `Room`, rows are those of a flat list.
        """
        ...

    def scratch_bytes(self, platform: str, n: int, m: int, dim: int, double: bool, own: bool, scaled: bool) -> int | None:
        """Return the scratch memory for n sources and m queries in open space [B]; None if only the program's compiler knows it.

        `double`: of float64; `own`: the sources are the queries; `scaled`: the cutoff is so small, or so large, that its square
        needs a unit.
        """
        ...


class Options(NamedTuple):
    """The static options of a search, without its capacity."""

    filter: Filter
    engine: Engine
    closed: bool
    skin: float = 0.0  # to be added to cutoffs per particle; a single cutoff includes it already
    images: geometry.Images | None = None  # the images that a search in a box considers
    radius: float | None = None  # the cutoff, for an engine that has to know it while tracing
    ordered: bool = False  # whether rows are told in which order sources follow each other in space
    may_change: bool = False  # whether the array engine may sum a term that this engine cannot translate


class Inputs(NamedTuple):
    """The operands of a search; a pytree."""

    sources: Array
    queries: Array | None
    active: Array | None
    box: geometry.Box | None
    cutoff: geometry.Cutoff | geometry.Radii  # of the list: a single one that includes the skin, or per-particle ones that do not
    batch: geometry.Batch | None = None
    exclude: geometry.Exclusions | None = None


def hide_inactive(positions: Array, active: Array | None) -> Array:
    """Return positions with inactive particles moved to infinity.

    Inactive particles have no neighbors and are never listed as neighbors, on any engine. NaN is not used, because JAX's mode
    `jax_debug_nans` reports every NaN that leaves a program as an error.
    """
    return positions if active is None else jnp.where(active[:, None], positions, jnp.inf)


def take_present(inputs: Inputs) -> Inputs:
    """Return the operands without the particles that have no system, or no box where each system has one: they are not active.

    Queries have no mask; those that have none are moved to infinity.
    """
    if inputs.batch is None:
        return inputs
    there, asking = _have_system(inputs)
    if there is None:
        return inputs
    active, queries = inputs.active, inputs.queries
    if queries is not None and asking is not None:
        queries = jnp.where(asking[:, None], queries, jnp.inf)
    return inputs._replace(active=there if active is None else active & there, queries=queries)


def _have_system(inputs: Inputs) -> tuple[Array | None, Array | None]:
    """Say which sources and which queries belong to a system, [n] and [m] bool; None where all do, and without queries."""
    batch, box = inputs.batch, inputs.box
    if batch is None:
        return None, None
    if box is not None and box.per_system:
        there, asking = (geometry.has_box(x, len(box.vectors)) for x in (batch.sources, batch.of_queries))
    elif batch.fit is not None:
        there, asking = batch.fit
    else:
        return None, None
    return there, None if inputs.queries is None else asking


def rows_asked(inputs: Inputs) -> tuple[Array, Array | None]:
    """Return the points of the rows of a search, and which of these take part (None: all): queries have no mask but their boxes."""
    if inputs.queries is not None:
        return inputs.queries, _have_system(inputs)[1]
    return inputs.sources, take_present(inputs).active


Bring = Callable[[Array, geometry.Lattice], geometry.NearRows]  # points near a box


def prepare_search(inputs: Inputs, options: Options, bring: Bring | None = None) -> Search:
    """Prepare the operands for engines. No gradient flows through.

    `bring` brings particles near a box, if there is one for all, whose vectors are those that were given; array programs do else.
    """
    asked = lax.stop_gradient(inputs)
    given, queries, active, box, cutoff, batch, exclude = take_present(asked)
    sources, images = hide_inactive(given, active), options.images
    per_system = box is not None and box.per_system and batch is not None
    batch = None if batch is None or per_system else geometry.rank_systems(batch)
    checks = {} if exclude is None or exclude.valid is None else {geometry.Status.EXCLUDED_OUT_OF_RANGE: exclude.valid}
    checks |= {} if asked.batch is None else _check_systems(asked, asked.batch)
    if isinstance(cutoff, geometry.Radii):
        asking = None if asked.queries is None else rows_asked(asked)[1]
        sources, queries, checks[geometry.Status.INVALID_CUTOFF] = _with_valid_radii(sources, queries, active, asking, cutoff)
        cutoff = geometry.make_cutoffs(cutoff, options.closed, options.skin)
    if per_system:
        return _prepare_boxes(asked, active, Search(sources, queries, cutoff, asked.batch, None, checks), options)
    if box is None or images is None:
        excluded = None if exclude is None else geometry.exclude_in_space(exclude.rows)
        return Search(sources, queries, cutoff, batch, None, checks, excluded)
    lattice = geometry.make_lattice(box, images, np.dtype(sources.dtype))
    clouds, moved = [x for x in (sources, queries) if x is not None], None
    named = exclude is not None and exclude.rows.shifts is not None  # images, between points that were not moved
    brought = None
    if bring is not None and not named and not images.counts_short:
        # with the origin as it was given: XLA sees then that a search and its checks ask for the same
        box_as_given = dataclasses.replace(lattice, origin=jnp.asarray(box.origin).astype(sources.dtype))
        brought = [bring(x, box_as_given) for x in clouds]
        points = [x.points for x in brought]
    else:
        near = [geometry.bring_near(x, lattice) for x in clouds]
        points, moved = [x.points for x in near], (near[0].turns, near[-1].turns)
    sources, queries = points[0], None if queries is None else points[1]
    wrapped = geometry.wrap(sources, queries, lattice, largest_radius(cutoff), brought=brought, box=box)
    excluded = None if exclude is None else geometry.exclude_in_lattice(exclude.rows, lattice, wrapped, moved, None)
    checks[geometry.Status.BOX_TOO_SMALL] = wrapped.enough
    checks[geometry.Status.OUT_OF_RANGE] = (wrapped.met & geometry.TOO_FAR) == 0
    return Search(sources, queries, cutoff, batch, (lattice, wrapped), checks, excluded)


def _check_systems(asked: Inputs, batch: geometry.Batch) -> dict[geometry.Status, Array]:
    """Check that all particles that take part have a number of a system, where each system has a box of one there is, or -1."""
    box = asked.box
    if box is not None and box.per_system:
        named = [(x >= -1) & (x < len(box.vectors)) for x in (batch.sources, batch.queries) if x is not None]
    elif batch.fit is not None:
        named = [x for x in batch.fit if x is not None]
    else:
        return {}
    named[0] = named[0] if asked.active is None else named[0] | ~asked.active
    return {geometry.Status.SYSTEM_WITHOUT_BOX: functools.reduce(jnp.logical_and, (x.all() for x in named))}


def _prepare_boxes(asked: Inputs, present: Array | None, search: Search, options: Options) -> Search:
    """Prepare the operands of a search with a box per system; system numbers become those of the nearest box that there is.

    `present` [n] are the particles that take part, which have a box (`take_present`).
    """
    box, batch, images = asked.box, search.batch, options.images
    if box is None or batch is None or images is None or present is None:
        raise TypeError("a search with a box per system needs boxes and a batch.")
    boxes = len(box.vectors)
    nearest = jax.tree.map(lambda x: jnp.clip(x, 0, boxes - 1), batch._replace(fit=None))
    lattice = geometry.make_lattice(box, images, np.dtype(search.sources.dtype))
    clouds = zip((search.sources, search.queries), (nearest.sources, nearest.of_queries), strict=True)
    near = [geometry.bring_near(x, lattice.of_rows(systems)) for x, systems in clouds if x is not None]
    sources, queries, moved = near[0].points, None if search.queries is None else near[1].points, (near[0].turns, near[-1].turns)
    wrapped = geometry.wrap(sources, queries, lattice, _radius_of_systems(search, nearest, boxes), nearest)
    right = wrapped.enough[nearest.sources]
    checks = {
        geometry.Status.BOX_TOO_SMALL: (right | ~present).all(),
        geometry.Status.OUT_OF_RANGE: (wrapped.met & geometry.TOO_FAR) == 0,
    } | search.checks
    excluded = None
    if asked.exclude is not None:
        excluded = geometry.exclude_in_lattice(asked.exclude.rows, lattice, wrapped, moved, nearest.of_queries)
    found = {"sources": sources, "queries": queries, "batch": nearest, "torus": (lattice, wrapped), "checks": checks}
    return search._replace(**found, exclude=excluded)


def _radius_of_systems(search: Search, batch: geometry.Batch, boxes: int) -> np.floating | Array:
    """Return an upper bound on the cutoff of any pair, or on that of each system [systems, 1, 1], where cutoffs differ."""
    if isinstance(search.cutoff, geometry.Cutoff):
        return search.cutoff.radius
    rule, found = search.cutoff.rule, []
    for of_points, systems, points in (
        (search.cutoff.sources, batch.sources, search.sources),
        (search.cutoff.queries, batch.of_queries, search.sources if search.queries is None else search.queries),
    ):
        if of_points is not None:
            known = jnp.where(jnp.isfinite(points[:, 0]), of_points, 0)
            found.append(jnp.zeros(boxes, known.dtype).at[systems].max(known))
    largest = functools.reduce(jnp.minimum if rule in ("both", "table") else jnp.maximum, found)
    return jnp.where(largest > 0, largest, search.cutoff.largest)[:, None, None]


def bits_of(checks: dict[geometry.Status, Array]) -> Array:
    """Return the bits of what is not right, [] int32."""
    bits = (jnp.where(right, 0, bit.value).astype(jnp.int32) for bit, right in checks.items())
    return functools.reduce(jnp.bitwise_or, bits, jnp.int32(0))


def _with_valid_radii(
    sources: Array, queries: Array | None, active: Array | None, asking: Array | None, radii: geometry.Radii
) -> tuple[Array, Array | None, Array]:
    """Return positions and queries, moved to infinity if their cutoff is invalid, and whether all active ones have valid ones.

    `asking` says which queries take part; None: all.
    """
    of_sources, of_queries = geometry.are_valid(radii)
    right = [jnp.ones((), bool)]
    if queries is None:
        valid = next(x for x in (of_sources, of_queries) if x is not None)
        return _where_rows(valid, sources), None, (valid if active is None else valid | ~active).all()
    if of_sources is not None:
        right.append((of_sources if active is None else of_sources | ~active).all())
        sources = _where_rows(of_sources, sources)
    if of_queries is not None:
        right.append((of_queries if asking is None else of_queries | ~asking).all())
        queries = _where_rows(of_queries, queries)
    return sources, queries, functools.reduce(jnp.logical_and, right)


def _where_rows(valid: Array, points: Array) -> Array:
    return jnp.where(valid[:, None], points, jnp.inf)


def largest_radius(cutoff: geometry.Cutoff | geometry.Cutoffs) -> np.floating | Array:
    """Return an upper bound on the cutoff of any pair."""
    return cutoff.largest if isinstance(cutoff, geometry.Cutoffs) else cutoff.radius
