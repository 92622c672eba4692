"""The problem: the arguments that all public functions share, checked, the static part that a list keeps, and its search."""

import dataclasses
import functools
import math
from fractions import Fraction
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn import _engine as engine
from jfrnn import _geometry as geometry
from jfrnn._search.culprits import name_culprits
from jfrnn._search.geometry import real_points
from jfrnn._search.present import ImageCodes, make_topology, one_each
from jfrnn._search.verlet import first_verlet
from jfrnn._tracing import Given, Real, at_once, compile_program, own_transfers

_CAPACITY_STEP = 8


def list_radius(cutoff: float, skin: float, dtype: np.dtype) -> float:
    """Return cutoff + skin, both of this dtype, rounded up, so that no pair within the exact sum is lost."""
    if skin == 0:
        return float(cutoff)
    exact = Fraction(cutoff) + Fraction(skin)
    radius = dtype.type(cutoff) + dtype.type(skin)
    while math.isfinite(radius) and Fraction(float(radius)) < exact:
        radius = np.nextafter(radius, dtype.type(np.inf))
    return float(radius)


@dataclasses.dataclass(frozen=True)
class Problem:
    """The static options of a search and its list, without the capacity.

    Attributes:
        options: The options for engines.
        cutoff: Cutoff of a pair [length], rounded to the dtype, without the skin; None with cutoffs per particle.
        skin: Verlet skin [length].
        own_queries: Whether rows belong to separate queries instead of the sources.
        masked: Whether particles may be inactive.
        source_count: Number of sources.
        dim: Dimension of the positions.
        dtype: Dtype of the positions.
    """

    options: engine.Options
    cutoff: float | None
    skin: float
    own_queries: bool
    masked: bool
    source_count: int
    dim: int
    dtype: np.dtype

    def reach(self, radii: geometry.Radii | None) -> float | None:
        """Return the largest distance of listed pairs, skin included; None if it is not known while tracing."""
        largest = self.cutoff if radii is None else geometry.largest_known(radii)
        return None if largest is None else list_radius(largest, self.skin, self.dtype)

    def listed_within(self, radii: geometry.Radii | None) -> geometry.Cutoff | geometry.Radii:
        """Return the cutoff of the list, skin included, as engines are given it; or cutoffs per particle."""
        if radii is not None:
            return radii
        assert self.cutoff is not None  # without radii there is one
        return geometry.make_cutoff(list_radius(self.cutoff, self.skin, self.dtype), self.dtype, self.options.closed)

    def refuse(self, status: geometry.Status | None, inputs: engine.Inputs) -> None:
        """Raise what bits report of a search of concrete particles, if any is set; None: they are not known.

        Raises:
            ValueError: a bit is set.
        """
        if status:
            reach = self.reach(inputs.cutoff if isinstance(inputs.cutoff, geometry.Radii) else None)
            known = not any(isinstance(x, Tracer) for x in jax.tree.leaves(inputs))
            geometry.refuse_status(status, inputs.box, self.options.images, reach, name_culprits(status, inputs) if known else "")


class KeptOptions:
    """The options of a search, read from the problem that a list holds. They do not change."""

    problem: Problem

    @property
    def cutoff(self) -> float | None:
        """Interaction radius [length], rounded to the dtype of the positions; None with cutoffs per particle."""
        return self.problem.cutoff

    @property
    def skin(self) -> float:
        """Verlet skin [length]."""
        return self.problem.skin

    @property
    def half(self) -> bool:
        """Whether each unordered pair is listed once, in the row of its smaller index."""
        return self.problem.options.filter.later_only

    @property
    def include_self(self) -> bool:
        """Whether each particle is its own neighbor."""
        return not self.own_queries and not self.problem.options.filter.drop_self

    @property
    def closed(self) -> bool:
        """Whether pairs at exactly the cutoff count."""
        return self.problem.options.closed

    @property
    def own_queries(self) -> bool:
        """Whether rows belong to separate `queries` instead of the positions."""
        return self.problem.own_queries

    @property
    def masked(self) -> bool:
        """Whether particles may be inactive."""
        return self.problem.masked

    @property
    def box_kind(self) -> geometry.Images | None:
        """The periodic axes and the images that the search considers; None in open space."""
        return self.problem.options.images

    @property
    def source_count(self) -> int:
        """n, the fill value of unused slots."""
        return self.problem.source_count

    @property
    def dim(self) -> int:
        """Dimension of the positions, 2 or 3."""
        return self.problem.dim

    @property
    def dtype(self) -> np.dtype:
        """Dtype of the positions."""
        return self.problem.dtype

    @property
    def backend(self) -> str:
        """Name of the engine that made the list."""
        return self.problem.options.engine.name


class Asked(NamedTuple):
    """The arguments that all public functions share, as users give them; see `jfrnn.search`."""

    positions: Given
    cutoff: Given
    queries: Given = None
    box: Given = None
    batch: Given = None
    radius_rule: Given = "gather"
    species: Given = None
    exclude: Given = None
    half: Given = False
    include_self: Given = False
    closed: Given = False
    backend: Given = "auto"
    skin: Given = 0.0
    active: Given = None


def check_problem(asked: Asked) -> tuple["Problem", engine.Inputs]:
    """Check what is asked; return its static part and the operands."""
    sources, queries = geometry.check_positions("positions", asked.positions), None
    if asked.queries is not None:
        queries = geometry.check_positions("queries", asked.queries, like=sources)
        for name, value in (("half", asked.half), ("include_self", asked.include_self)):
            if geometry.check_flag(name, value):
                raise ValueError(f"{name}=True pairs particles with themselves or each other: it cannot be used with queries.")
    active, dtype = None if asked.active is None else geometry.check_active(asked.active, sources), np.dtype(sources.dtype)
    drop_self = queries is None and not geometry.check_flag("include_self", asked.include_self)
    keep = engine.Filter(drop_self, later_only=geometry.check_flag("half", asked.half))
    closed = geometry.check_flag("closed", asked.closed)
    if asked.species is None:
        radii = geometry.check_radii(asked.cutoff, asked.radius_rule, sources, queries)
    else:
        masked = asked.active is not None or (isinstance(asked.box, geometry.Box) and asked.box.per_system)
        radii = geometry.check_species(asked.cutoff, asked.species, asked.radius_rule, sources, queries, masked)
    if radii is not None and keep.later_only and radii.rule in geometry.EXCHANGED:
        raise ValueError(f"half=True keeps pairs without direction, which radius_rule={radii.rule!r} gives: pass 'either'.")
    radii = dataclasses.replace(radii, itself=True) if radii is not None and queries is None and not drop_self else radii
    excluded = None if asked.exclude is None else geometry.check_exclusions(asked.exclude, sources, queries)
    instead = ", or pass an array with one per particle, which may be traced"
    radius = geometry.check_cutoff(asked.cutoff, dtype, instead) if radii is None else None
    largest = radius if radii is None else geometry.largest_known(radii)
    skin = geometry.check_skin(asked.skin, largest or 0.0, dtype)
    reach = None if largest is None else list_radius(largest, skin, dtype)
    box = None if asked.box is None else geometry.check_box(asked.box, sources)
    if box is not None and box.per_system and asked.batch is None:
        raise ValueError("box holds a box per system: pass batch=, the system of each particle (from 0 on; -1: in none of them).")
    images = None if box is None else geometry.images_of(box, reach, dtype, sources.shape[0])
    features = engine.Features(box is not None, asked.batch is not None, radii is not None, excluding=asked.exclude is not None)
    chosen = engine.choose_engine(engine.parse_backend(asked.backend, engine.ENGINES), sources, queries, features)
    systems = None if asked.batch is None else geometry.check_batch(asked.batch, sources, queries)
    ordered = engine.has_order(chosen, engine.platform_of(sources), sources.shape[0], queries is None and radii is None)
    static_reach = reach if chosen.static_radius else None
    if box is not None and box.fractional:
        sources, queries = real_points(sources, queries, box, systems, chosen.native)
    options = engine.Options(keep, chosen, closed, 0.0 if radii is None else skin, images, static_reach, ordered)
    shape = {"own_queries": queries is not None, "masked": active is not None, "source_count": sources.shape[0]}
    problem = Problem(options, radius, skin, **shape, dim=sources.shape[1], dtype=dtype)
    cutoff = problem.listed_within(radii)
    if box is not None and images is not None:
        box = geometry.known_box(geometry.box_of_list(box, images, reach), images, dtype, radius_of(cutoff))
    return problem, engine.Inputs(sources, queries, active, box, cutoff, systems, excluded)


def radius_of(cutoff: geometry.Cutoff | geometry.Radii) -> np.floating | Array | None:
    """Return the one cutoff of a search, None where cutoffs differ."""
    return cutoff.radius if isinstance(cutoff, geometry.Cutoff) else None


# --- its search -----------------------------------------------------------------------------------------------------------


def round_capacity(slots: int) -> int:
    """Round a capacity up, so that similar scenes share one compiled program."""
    return -(-slots // _CAPACITY_STEP) * _CAPACITY_STEP


def count_capacity(inputs: engine.Inputs, options: engine.Options, slack: Real) -> int:
    """Count the neighbors of concrete positions; return a capacity of `slack` times the longest row.

    Where kernels were compiled by no process before, it lists, by the kernels that the list itself needs: those that count would
    have to be compiled, too.
    """
    with at_once(), own_transfers():
        known = engine.count_few(inputs, options)
        if known is not None:
            longest = int(known.max())
        elif options.engine.native and engine.begins_cold():
            longest = int(engine.list_rows(inputs, options=options, capacity=1).rows.required)
        else:
            longest = int(engine.count_rows(inputs, options=options)[1])
    wanted = math.ceil(max(longest, 1) * slack)
    return min(round_capacity(wanted), max(wanted, inputs.sources.shape[0]))


@functools.partial(compile_program, static_argnames=("options", "room", "moving", "reversing", "flat"))
def find_fields(
    inputs: engine.Inputs, options: engine.Options, room: int, moving: bool, reversing: bool, flat: bool
) -> dict[str, Any]:
    """Search, and return the list's fields that come from data: the compiled program of `search` and, if `flat`, `search_edges`.

    `room` is the capacity or the total, `moving` says that the list has a skin, `reversing` that it keeps where pairs stand the
    other way round. All are given by name: what JAX keeps of a call depends on it.

    As results of one program, they share no memory with the caller's arrays or each other, so either may be donated.
    """
    if moving:  # others are made anew in each step, and what would be kept of a box is not worth finding
        box = geometry.find_known(lax.stop_gradient(inputs.box), options.images, radius_of(inputs.cutoff))
        inputs = inputs._replace(box=box)
    offsets, found = engine.list_flat(inputs, options, room) if flat else (None, engine.find_rows(inputs, options, room))
    rows, n, verlet, reverse = found.rows, len(inputs.sources), None, None
    images = None if found.images is None or found.turns is None else ImageCodes(found.images, found.turns[0], found.turns[1])
    radii = None
    if isinstance(inputs.cutoff, geometry.Radii):  # as if no table were known: where it is not, a loop may hand on another list
        radii = dataclasses.replace(lax.stop_gradient(inputs.cutoff), alike=False)
    if moving:
        sources = engine.hide_inactive(inputs.sources, engine.take_present(inputs).active)
        verlet = first_verlet(sources, inputs.queries, inputs.box, options.images, radii, inputs.batch)
    if reversing and rows.idx is not None and flat:
        reverse = one_each(rows.idx, n, options.engine.native).with_reverse()
    elif reversing and rows.idx is not None:
        codes = None if images is None else images.codes
        topology = make_topology(options, n, inputs.queries is not None, radii, rows.idx, codes, None, rows.order)
        reverse = topology.with_reverse()
    fields = {"status": rows.status, "required": rows.required, "verlet": verlet, **fields_of_box(inputs.box, moving)}
    fields |= {"images": images, "radii": radii, "batch": inputs.batch, "exclude": inputs.exclude, "reverse": reverse}
    if flat:
        return fields | {"senders": rows.idx, "receivers": rows.receivers, "offsets": offsets}
    return fields | {"idx": rows.idx, "count": rows.counts, "order": rows.order}


def fields_of_box(box: geometry.Box | None, moving: bool) -> dict[str, Any]:
    """Return what a list keeps of its box and, with a skin, of what is known of that, in memory of its own."""
    box = lax.stop_gradient(box)
    known = lax.optimization_barrier(box.found) if moving and isinstance(box, geometry.KnownBox) else None
    return {"box": geometry.plain_box(box), "known": known}
