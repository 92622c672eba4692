"""What padded and flat lists share: checks of what they are given later, updates in a loop, and growth after an overflow."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from types import FunctionType
from typing import ClassVar, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn import _geometry as geometry
from jfrnn._engine import BoxNumbers, Inputs, Options, can_ask, has_moved, hide_inactive, take_present
from jfrnn._search.culprits import name_culprits
from jfrnn._search.geometry import real_points
from jfrnn._search.present import ImageCodes, Present, Reverse, Topology
from jfrnn._search.problem import KeptOptions, Problem, fields_of_box, find_fields, radius_of
from jfrnn._search.verlet import Verlet, has_moved_too_far
from jfrnn._tracing import Flags, Given, Numbers, Points, Real, call_apart, call_late, compile_program, on_platform, own_transfers

Kept = TypeVar("Kept", bound="KeptSearch")


@dataclasses.dataclass(frozen=True, repr=False)
class KeptSearch(KeptOptions):
    """What a search has found, kept so that it can be updated in a loop: what padded and flat lists have in common."""

    status: Array
    required: Array
    verlet: Verlet | None
    box: geometry.Box | None
    known: Array | None
    images: ImageCodes | None
    radii: geometry.Radii | None
    batch: geometry.Batch | None
    exclude: geometry.Exclusions | None
    reverse: Reverse | None
    box_numbers: BoxNumbers | None
    problem: Problem = dataclasses.field(metadata={"static": True})
    _full = geometry.Status.ROW_OVERFLOW  # the bit that says that there is too little room
    _harmless = geometry.ROWS_ARE_WHOLE  # bits that do not mean missing pairs
    _room_name = "capacity"
    _round_room: ClassVar[Callable[[int], int]]  # rounds the room that is needed up, so that similar scenes share a program
    _count_room: ClassVar[Callable[[Inputs, Options, float], int]]  # the room that a search at concrete positions takes, with slack

    def __init_subclass__(cls, **options: object) -> None:
        """Give a class its inherited methods under its own name, which errors of Python tell: users know no other."""
        super().__init_subclass__(**options)
        inherited = {name: x for base in reversed(cls.__mro__[1:]) for name, x in vars(base).items() if not name.startswith("_")}
        for name, method in inherited.items():
            if isinstance(method, FunctionType) and name not in vars(cls):
                own = FunctionType(method.__code__, method.__globals__, name, method.__defaults__, method.__closure__)
                own.__kwdefaults__, own.__annotations__ = method.__kwdefaults__, method.__annotations__
                own.__doc__, own.__module__, own.__qualname__ = method.__doc__, cls.__module__, f"{cls.__name__}.{name}"
                setattr(cls, name, own)

    @property
    def _room(self) -> int:
        """How much room there is for pairs; static."""
        return getattr(self, self._room_name)

    @property
    def _row_count(self) -> int:
        raise NotImplementedError

    @property
    def _box_known(self) -> geometry.Box | None:
        """The box, with what is known of it."""
        known = self.known
        return self.box if self.box is None or known is None else geometry.KnownBox.of(self.box, known)

    def _may_renew(self, inputs: Inputs) -> bool:
        """Say whether on CUDA kernels decide whether the list is made anew, and make it."""
        del inputs
        return False

    def _renew(self, inputs: Inputs) -> Self:
        """Let kernels decide whether the list is made anew, and make it."""
        raise NotImplementedError

    def _find_box_numbers(self, inputs: Inputs) -> BoxNumbers | None:
        """Return what kernels are told of the box if the list may renew itself."""
        del inputs
        return None

    def _motion_limit(self) -> np.floating | Array:
        """Return the square of a motion below which a list in its own box holds."""
        half = geometry.make_cutoff(self.skin / 2, self.dtype, closed=False)
        return half.inside if self.box is None else geometry.widen(half, jnp.zeros((), self.dtype)).inside

    def _pairs_held(self) -> int:
        """Return how many pairs a padded list holds."""
        raise NotImplementedError

    def _check_known(self, spared: geometry.Status = geometry.Status.OK) -> None:
        """Raise what status bits report, except the spared ones; a traced list is not checked.

        A list with a skin names particles, where it was rebuilt.
        """
        status = (geometry.known_status(self.status) or geometry.Status.OK) & ~spared
        if not status:
            return
        if self._full in status:
            raise geometry.NeighborOverflowError(int(np.max(jax.device_get(self.required))), self._room, self._room_name)
        if geometry.Status.TOTAL_OVERFLOW in status:
            raise ValueError(f"{status.message} At present it holds {self._pairs_held()}.")
        verlet, problem, more = self.verlet, self.problem, ""
        if verlet is not None and verlet.positions.ndim == 2:
            cutoff = problem.listed_within(verlet.radii or self.radii)
            kept = Inputs(verlet.positions, verlet.queries, None, verlet.box, cutoff, self.batch, self.exclude)
            more = name_culprits(status & ~(geometry.Status.NONFINITE if self.masked else geometry.Status.OK), kept)
        geometry.refuse_status(status, self.box, self.box_kind, problem.reach(self.radii), more)

    def _mark(self, x: Array) -> Array:
        """Return what was computed of the pairs; where the list is traced, NaN or the smallest integer if pairs may be missing.

        Outside jit, `_check_known` has raised then.
        """
        return geometry.mark_rows(x, geometry.are_whole(self.status, self._harmless)) if isinstance(self.status, Tracer) else x

    def _describe(self, batch: Sequence[int], rows: int | None, room: str, found: str) -> str:
        """Summarize the list in a line: of how many rows, with how much room, and what it has found."""
        points = f"{rows} queries of {self.source_count} particles" if self.own_queries else f"{self.source_count} particles"
        points = f"batch of {[*batch]}, {points}" if batch else points
        kinds = self.radii is not None and self.radii.table is not None
        reach = f"per {'pair of species' if kinds else 'particle'}" if self.cutoff is None else f"{self.cutoff:.6g}"
        skin = f", skin {self.skin:.6g}" if self.skin else ""
        return f"{type(self).__name__}({points}, {room}, cutoff {reach}{skin}, engine {self.backend!r}, {found})"

    @property
    def overflow(self) -> Array:
        """Whether pairs may be missing for lack of room, or because a box needs more images, [] bool; `grow` fixes both."""
        with own_transfers():
            return (self.status & (self._full | geometry.Status.BOX_TOO_SMALL).value) != 0

    @property
    def rebuild_count(self) -> Array:
        """How often updates rebuilt the list, shape [], int32; only for a list with a skin."""
        if self.verlet is None:
            raise ValueError("this list was made without a skin: every update makes it anew, and nothing counts them.")
        return self.verlet.rebuild_count

    def check(self) -> None:
        """Raise what the status bits report; wait for the device. Not inside jit: there, read `status` and `overflow`.

        Raises:
            NeighborOverflowError: a row holds more neighbors than `capacity`, or a flat list more pairs than `total`; `.required`
                is what is needed.
            ValueError: positions or queries hold NaN or infinity, or do not fit the box; or there were more pairs than `require`
                allows.
            TypeError: called on a list that is being traced.
        """
        if isinstance(self.status, Tracer):
            raise TypeError("check() reads values and cannot run inside jax.jit: call it on the list that jit returns.")
        self._check_known()

    def update(
        self,
        positions: Points,
        box: geometry.Box | None = None,
        *,
        cutoff: Numbers | Points | tuple[Numbers, Numbers] | None = None,
        queries: Points | None = None,
        active: Flags | None = None,
    ) -> Self:
        """Rebuild the list if anything has moved skin/2 since the last time, or may have by rounding; without a skin, always.

        The returned list holds every pair within the cutoff at these positions, in the same shapes, so it can be a simulation step
        inside `jax.jit`, `lax.scan` or `lax.fori_loop`. Lattice translations do not count as motion: positions may be wrapped in
        every step. Status bits and `required` are kept over all updates; read `overflow` after a chunk of steps, then `grow` and
        run the chunk again (`run_chunk` does that).

        Args:
            positions: Sources [length], shape [n, d], where they are now.
            box: The present box, of the same kind; default: that of the list. The list keeps it. A change that may bring a new pair
                within the cutoff causes a rebuild.
            cutoff: Present cutoffs per particle or per pair of species, as `search` takes them, if the list was made with such;
                default: those of the list. The list keeps them. The growth of the largest one is subtracted from the skin.
            queries: Queries [length], shape [m, d], exactly if the list was made with queries.
            active: Which particles take part now, shape [n], bool, exactly if the list was made with `active`; a change causes a
                rebuild.

        Returns:
            A list of the same type, shapes and options.

        Raises:
            ValueError, TypeError: an argument does not fit the list.

        Cost: one pass over the positions, or a search. Differentiable: no gradient flows through. Jit: yes. vmap: yes; if any list
        of the batch is stale, others may be rebuilt with it.
        """
        sources, rows, now = self._geometry_inputs(positions, queries, box)
        rows = rows if self.own_queries else None
        radii, active = self._radii_now(cutoff, sources, rows), self._check_active(active, sources)
        with own_transfers():
            return call_apart(_update, self, sources, rows, active, None if box is None else now, radii)

    def grow(  # noqa: D417 (three arguments share a line)
        self,
        positions: Points,
        box: geometry.Box | None = None,
        *,
        cutoff: Numbers | Points | tuple[Numbers, Numbers] | None = None,
        queries: Points | None = None,
        active: Flags | None = None,
        slack: Real = 1.25,
    ) -> Self:
        """Make a list with more room at these positions, where it overflowed. Not inside jit: the room is a shape.

        What grows is `capacity`, or `total` of a flat list, and in a periodic box the number of images: to those that the cutoff
        needs in this box and in that of the list, or twice as many if updates met a smaller box in between.

        Args:
            positions: Sources [length], shape [n, d].
            box: The box at these positions; default: that of the list, which after a chunk is the last one.
            cutoff, queries, active: As in `update`.
            slack: Factor >= 1 on what was needed so far, including updates of this list.

        Returns:
            A list of the same type and options, with no less room than before, status bits cleared, and nothing to `check`.

        Raises:
            TypeError: positions or the list are traced.
            ValueError, TypeError: an argument does not fit the list, or the new list reports invalid data (`check`), which no
                room can fix: non-finite positions, or a degenerate box.
        """
        sources, rows, box = self._geometry_inputs(positions, queries, box)
        rows = rows if self.own_queries else None
        radii, slack = self._radii_now(cutoff, sources, rows), geometry.check_slack(slack)
        active = self._check_active(active, sources)
        if any(isinstance(x, Tracer) for x in jax.tree.leaves((sources, rows, active, box, radii, self.required))):
            raise TypeError("grow() changes the shape of the list and cannot run inside jax.jit: call it on what jit returns.")
        images, reach = self.box_kind, self.problem.reach(radii)
        if box is not None and self.box is not None and images is not None:
            short = bool(np.any(np.asarray(jax.device_get(self.status)) & geometry.Status.BOX_TOO_SMALL.value))
            images = geometry.grow_images(images, (box, self.box), reach, self.dtype, self.source_count, short)
        options = self.problem.options._replace(images=images)
        wider = _replace(self, problem=dataclasses.replace(self.problem, options=options), box_numbers=None)
        within = self.problem.listed_within(radii)
        if box is not None and images is not None:
            kept = geometry.box_of_list(box, images, reach)
            box = geometry.known_box(jax.device_get(kept), images, self.dtype, radius_of(within))
        inputs = Inputs(sources, rows, active, box, within, self.batch, self.exclude)
        with own_transfers():
            met = self._round_room(math.ceil(slack * int(np.max(np.asarray(self.required)))))
            made = _remake(wider, inputs, max(self._room, met, self._count_room(inputs, options, slack)))
            made = _replace(made, box_numbers=made._find_box_numbers(inputs))
        made.check()
        return made

    def _check_single(self) -> None:
        if self.status.ndim:
            raise ValueError(
                f"take one list at a time, got lists of shape {list(self.status.shape)}, as jax.vmap returns them: call this under "
                "jax.vmap, too, or index the batch first, jax.tree.map(lambda leaf: leaf[0], nbrs)."
            )

    def _check_active(self, active: Flags | None, sources: Array) -> Array | None:
        if self.masked != (active is not None):
            state = "with active: pass active=" if self.masked else "without active: leave active out"
            raise ValueError(f"this list was made {state}.")
        return None if active is None else geometry.check_active(active, sources)

    def _radii_now(self, cutoff: Given, sources: Array, queries: Array | None) -> geometry.Radii | None:
        if cutoff is None:
            return self.radii
        if self.radii is None:
            raise ValueError("this list was made with one cutoff for all particles: leave cutoff out.")
        if self.radii.table is not None:
            return dataclasses.replace(self.radii, table=geometry.check_table(cutoff, sources, self.radii.table.shape[0]))
        radii = geometry.check_radii(cutoff, self.radii.asked, sources, queries)
        if radii is None:
            raise ValueError("this list was made with a cutoff for each particle: pass such an array, or leave cutoff out.")
        return dataclasses.replace(radii, itself=self.radii.itself)

    def _present(
        self, topology: Topology, count: Array, sources: Array, rows: Array, box: geometry.Box | None, decided: bool = False
    ) -> Present:
        """Return the list at positions that are lengths, in the present box; `decided`: all of its pairs are pairs now."""
        problem, images, closed, cutoff = self.problem, self.images, self.problem.options.closed, None
        if not decided:
            cutoff = self.radii if problem.cutoff is None else geometry.make_cutoff(problem.cutoff, problem.dtype, closed)
        kind, batch, forward = None, None, False
        if box is not None:
            kind, batch = problem.options.images, self.batch
            forward = problem.options.filter.later_only and kind is not None and kind.counts_short
        made = None if images is None or self.verlet is None else (self.verlet.positions, self.verlet.queries)
        queries = rows if problem.own_queries else None
        return Present(topology, count, (images, made), sources, queries, box, batch, cutoff, kind, closed, forward)

    def _geometry_inputs(
        self, positions: Points, queries: Points | None, box: geometry.Box | None
    ) -> tuple[Array, Array, geometry.Box | None]:
        """Return the present positions of sources and rows, as lengths, and the present box, after checking that they fit."""
        self._check_single()
        problem, rows = self.problem, None
        sources = geometry.check_again("positions", positions, problem.dtype, problem.dim, problem.source_count, self.status)
        if problem.own_queries != (queries is not None):
            state = "with queries: pass queries=" if problem.own_queries else "without queries: leave queries out"
            raise ValueError(f"this list was made {state}.")
        if queries is not None:
            rows = geometry.check_again("queries", queries, problem.dtype, problem.dim, self._row_count, self.status)
        if box is None:
            box = self._box_known
        elif (box := geometry.check_box(box, sources, like=self.box)) is not None:
            if self.box is None:
                raise ValueError("this list was made without a periodic box: leave box out.")
            box = geometry.round_box(box.of_list(self.box.images_of_list, like=self.box), problem.dtype)
        if box is not None and box.fractional:
            sources, rows = real_points(sources, rows, box, self.batch, problem.options.engine.native)
        return sources, sources if rows is None else rows, box


def _replace(nbrs: Kept, **fields: object) -> Kept:
    return dataclasses.replace(nbrs, **fields)  # pyright: ignore[reportArgumentType, reportCallIssue, reportUnknownVariableType]


@compile_program
def _update(
    nbrs: Kept, sources: Array, queries: Array | None, active: Array | None, box: geometry.Box | None, radii: geometry.Radii | None
) -> Kept:
    """Make a list anew if it is stale; without a box, in its own."""
    nbrs, sources, queries, given, radii = lax.stop_gradient((nbrs, sources, queries, box, radii))
    stays, cutoff = given is None, nbrs.problem.listed_within(radii)
    box = nbrs._box_known if given is None else given
    if nbrs.known is not None:
        box = geometry.find_known(box, nbrs.box_kind, radius_of(cutoff))
    inputs = Inputs(sources, queries, active, box, cutoff, nbrs.batch, nbrs.exclude)
    if nbrs.verlet is None:
        return _make_again(nbrs, inputs)
    if not stays and nbrs.box_numbers is not None:
        nbrs = _replace(nbrs, box_numbers=nbrs._find_box_numbers(inputs))
    if stays and nbrs._may_renew(inputs):
        by = functools.partial(on_platform, cuda=type(nbrs)._renew, default=_make_again_if_stale)
        return call_late(by, (nbrs, inputs), nbrs)
    return _make_again_if_stale(nbrs, inputs, stays)


def _make_again(nbrs: Kept, inputs: Inputs) -> Kept:
    made, verlet = _remake(nbrs, inputs, nbrs._room), nbrs.verlet
    if made.verlet is not None and verlet is not None:
        made = _replace(made, verlet=dataclasses.replace(made.verlet, rebuild_count=verlet.rebuild_count + 1))
    return _replace(made, status=made.status | nbrs.status, required=jnp.maximum(made.required, nbrs.required))


def _has_moved_too_far(nbrs: KeptSearch, inputs: Inputs) -> Array:
    assert nbrs.verlet is not None
    sources, queries, _, box = inputs[:4]
    radii = inputs.cutoff if isinstance(inputs.cutoff, geometry.Radii) else None
    now = hide_inactive(sources, take_present(inputs).active)
    return has_moved_too_far(nbrs.verlet, now, queries, box, nbrs.box_kind, radii, nbrs.skin, nbrs.batch)


def _kernel_says_so(nbrs: KeptSearch, inputs: Inputs) -> Array:
    assert nbrs.verlet is not None
    return has_moved(inputs, nbrs.problem.options, nbrs.verlet.positions, nbrs.verlet.box, nbrs._motion_limit())


def _make_again_if_stale(nbrs: Kept, inputs: Inputs, stays: bool = False) -> Kept:
    """Let XLA decide: the host learns whether the list is stale. `stays`: no other box was given."""
    assert nbrs.verlet is not None
    box = inputs.box
    radii = inputs.cutoff if isinstance(inputs.cutoff, geometry.Radii) else None
    if stays and can_ask(inputs, nbrs.problem.options, nbrs.skin, "cpu"):
        by = functools.partial(on_platform, cpu=_kernel_says_so, default=_has_moved_too_far)
        moved = call_late(by, (nbrs, inputs), jax.ShapeDtypeStruct((), bool))
    else:
        moved = _has_moved_too_far(nbrs, inputs)
    fixed = {"box_numbers": nbrs.box_numbers, "radii": radii, "batch": nbrs.batch, "exclude": nbrs.exclude}
    fixed |= fields_of_box(box, moving=True)
    # what stays is no state of the loop, so that XLA derives from it once what steps of a scan need
    left_out = dict.fromkeys(fixed)
    state = moved, _replace(nbrs, **left_out)

    def body(state: tuple[Array, Kept]) -> tuple[Array, Kept]:
        return jnp.zeros_like(state[0]), _replace(_make_again(state[1], inputs), **left_out)

    # a loop of at most one iteration: XLA updates a loop's carry in place, but copies the results of a branch
    return _replace(lax.while_loop(lambda state: state[0], body, state)[1], **fixed)


def _remake(nbrs: Kept, inputs: Inputs, room: int) -> Kept:
    """Make a new list with the options of this one."""
    given = {"room": room, "moving": nbrs.skin > 0, "reversing": nbrs.reverse is not None, "flat": nbrs._room_name == "total"}
    return _replace(nbrs, **find_fields(inputs, options=nbrs.problem.options, **given))
