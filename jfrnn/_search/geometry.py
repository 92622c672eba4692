"""The geometry of a list: displacements, lattice shifts, and which pairs are within the cutoff at present."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn import _geometry as geometry
from jfrnn._engine import KeptList, kept_mask
from jfrnn._search.present import ImageCodes, ImagesMade, Present, one_each
from jfrnn._tracing import call_apart, compile_program, own_transfers


def _of_rows(vectors: Array, systems: Array, native: bool) -> Array:
    """Return the vectors of the box of each row; rows without a box get any. Differentiable by gathers."""
    from jfrnn._search.gathers import gather

    boxes, nearest = len(vectors), jnp.clip(systems, 0, len(vectors) - 1)
    return gather(vectors.reshape(boxes, -1), one_each(nearest, boxes, native)).reshape(-1, *vectors.shape[1:])


def lattice_of_rows(
    box: geometry.Box, kind: geometry.Images, dtype: np.dtype, systems: Array | None, native: bool
) -> geometry.Lattice:
    """Return the lattice of a box or, where each system has one, that of each row; differentiable by gathers.

    `systems` [rows] are those of the rows, of which some may have no box: these get any.
    """
    lattice = geometry.make_lattice(box, kind, dtype)
    if not kind.per_system or systems is None:
        return lattice
    fixed = lax.stop_gradient(lattice).of_rows(jnp.clip(systems, 0, len(lattice.origin) - 1))
    return dataclasses.replace(fixed, matrix=_of_rows(lattice.matrix, systems, native))


def real_points(
    sources: Array, queries: Array | None, box: geometry.Box, batch: geometry.Batch | None, native: bool
) -> tuple[Array, Array | None]:
    """Return sources and queries as lengths, of coordinates that count the vectors of a box: coordinates @ vectors.

    Each component is computed in twice the precision and rounded once, the same on every device; all that follows, such as the
    exact decision about pairs, is about these numbers. Differentiable in coordinates and vectors, by gathers. `native`: Warp's
    kernels run where the points are.
    """
    with own_transfers():
        return _multiply(sources, queries, box.vectors, batch, box.orthogonal, box.per_system, native)


@functools.partial(compile_program, static_argnames=("orthogonal", "per_system", "native"))
def _multiply(
    sources: Array,
    queries: Array | None,
    vectors: Array,
    batch: geometry.Batch | None,
    orthogonal: bool,
    per_system: bool,
    native: bool,
) -> tuple[Array, Array | None]:
    vectors = jnp.asarray(vectors).astype(sources.dtype)

    def real(points: Array, systems: Array | None) -> Array:
        rows = _of_rows(vectors, systems, native) if per_system and systems is not None else vectors
        return geometry.rounded_scaled(points, rows) if orthogonal else geometry.rounded_product(points, rows)

    of_sources, of_queries = (None, None) if batch is None else (batch.sources, batch.of_queries)
    return real(sources, of_sources), None if queries is None else real(queries, of_queries)


class Ends(NamedTuple):
    """Sources and rows near the box, and the lattice of each; or of all of them."""

    sources: geometry.Near
    rows: geometry.Near
    of_sources: geometry.Lattice
    of_rows: geometry.Lattice

    def shifts_of_given(self, whole: Array, senders: Array, receivers: Array) -> Array:
        """Return shifts [..., d], whole floats between near points, as whole numbers between points as they are given, int32.

        `senders` and `receivers` [...] say whose they are; the lattice of a receiver has an axis more where each has one.
        """
        turns = (x.turns.astype(jnp.int32) for x in (self.rows, self.sources))
        of_rows, of_sources = (x.at[named].get(mode="clip") for x, named in zip(turns, (receivers, senders), strict=True))
        return geometry.given_shifts(whole, self.of_rows) + of_rows - of_sources


def find_ends(
    sources: Array, rows: Array, box: geometry.Box, kind: geometry.Images, batch: geometry.Batch | None, native: bool
) -> Ends:
    """Return sources and rows near the box, or each near the box of its system; differentiable in points and box."""
    of_rows, of_sources = (None, None) if batch is None else (batch.of_queries, batch.sources)
    lattice = lattice_of_rows(box, kind, np.dtype(sources.dtype), of_rows, native)
    also = lattice if of_rows is of_sources else lattice_of_rows(box, kind, np.dtype(sources.dtype), of_sources, native)
    near = geometry.bring_near(sources, also)
    return Ends(near, near if rows is sources else geometry.bring_near(rows, lattice), also, lattice)


def ends_of(present: Present) -> Ends | None:
    """Return where a list is in its box, as `find_ends` does; None in open space."""
    if present.box is None or present.kind is None:
        return None
    return find_ends(present.sources, present.rows, present.box, present.kind, present.batch, present.topology.native)


class _Slots(NamedTuple):
    """Whether each slot is used, its source, x_j - x_i, and in a box its lattice shift in whole floats, 0 in unused slots."""

    used: Array
    neighbor: Array
    difference: Array
    shifts: Array | None


def _find_slots(present: Present, ends: Ends | None) -> _Slots:
    from jfrnn._search.gathers import gather

    topology, idx = present.topology, present.topology.idx
    sources, rows = (present.sources, present.rows) if ends is None else (ends.sources.points, ends.rows.points)
    used = lax.broadcasted_iota(jnp.int32, idx.shape, 1) < present.count[:, None]
    neighbor = jnp.where(used, idx, 0)
    difference = gather(sources, topology) - rows[:, None, :]
    if ends is None:
        return _Slots(used, neighbor, difference, None)
    lattice, (codes, made) = ends.of_rows, present.images
    if codes is None:
        shifts = geometry.nearest_shifts(difference, lattice)
    else:
        turns, query_turns = _turns_now(codes, made, ends)
        shifts = _shifts_of_codes(codes.codes, used, lattice.images, query_turns[:, None], turns[neighbor])
    if present.forward:  # in the given vectors
        own = neighbor == lax.broadcasted_iota(jnp.int32, idx.shape, 0)
        shifts = jnp.where(own[..., None], geometry.forward_shifts(shifts, lattice), shifts)
    most = 2 * geometry.LARGEST_TURN + max(lattice.images.reach)  # at larger distances no pair is decided exactly
    used = used & (jnp.abs(shifts) <= most).all(axis=-1)
    return _Slots(used, neighbor, difference, jnp.where(used[..., None], shifts, 0))


def edge_shifts(difference: Array, real: Array, present: Present, receivers: Array, ends: Ends, lattice: geometry.Lattice) -> Array:
    """Return the lattice shifts [total, 1, d], whole floats, of edges between near points; `lattice` is that of all, or of each."""
    codes, made = present.images
    if codes is None:
        return geometry.nearest_shifts(difference, lattice)
    senders, receivers = (jnp.where(real, named, 0) for named in (present.topology.idx[:, 0], receivers))
    turns, query_turns = _turns_now(codes, made, ends)
    return _shifts_of_codes(codes.codes, real, lattice.images, query_turns[receivers], turns[senders])[:, None]


@compile_program
def lattice_shifts(present: Present) -> Array:
    """Return the lattice shift of each slot between points as they are given, [m, capacity, d] int32; 0 in unused slots."""
    ends = ends_of(present)
    assert ends is not None  # no list in open space is asked
    slots = _find_slots(present, ends)
    assert slots.shifts is not None
    return _given_shifts(slots, slots.shifts, ends)


def _given_shifts(slots: _Slots, whole: Array, ends: Ends) -> Array:
    row = lax.broadcasted_iota(jnp.int32, slots.neighbor.shape, 0)
    shifts = ends.shifts_of_given(lax.stop_gradient(whole), slots.neighbor, row)
    return jnp.where(slots.used[..., None], shifts, 0)


@functools.partial(compile_program, static_argnames="as_given")
def vectors_of(present: Present, as_given: bool = False) -> tuple[Array, Array, Array | None]:
    """Return the displacements of a list, its mask and, in a box, the shifts of its slots.

    Shifts are whole floats between near points or, `as_given`, what `lattice_shifts` returns.
    """
    ends = ends_of(present)
    slots = _find_slots(present, ends)
    shifts = slots.shifts
    pairs = None if ends is None or shifts is None else geometry.shift_pairs(slots.difference, shifts, ends.of_rows)
    vectors = slots.difference if pairs is None else pairs.vectors
    if present.native:
        mask = call_apart(kept_mask, kept_list(present))
    else:
        rows, sources = (present.rows, present.sources) if ends is None else (ends.rows.points, ends.sources.points)
        fixed = None if pairs is None else pairs._replace(vectors=lax.stop_gradient(pairs.vectors))
        points = lax.stop_gradient((rows, sources))
        mask = call_apart(geometry.is_pair_of, *points, slots.neighbor, slots.used, present.cutoffs, fixed)
    if as_given and ends is not None and shifts is not None:
        shifts = _given_shifts(slots, shifts, ends)
    return jnp.where(mask[..., None], vectors, 0), mask, shifts


def kept_list(present: Present) -> KeptList:
    """Return a list as Warp's kernels take it: points near the box, and one lattice, or one per system; all are constants."""
    topology, systems, turns, lattice = present.topology, None, None, None
    sources, rows = lax.stop_gradient((present.sources, present.queries))
    if present.box is not None and present.kind is not None:
        sources, rows, turns, lattice, systems = _near_box(sources, rows, present.box, present.batch, present.images, present.kind)
    fixed = lax.stop_gradient((sources, rows, turns, present.cutoffs, lattice))
    return KeptList(topology.idx, present.count, topology.codes, *fixed, topology.order, None, systems)


@functools.partial(compile_program, static_argnames="kind")
def _near_box(
    sources: Array, rows: Array | None, box: geometry.Box, batch: geometry.Batch | None, images: ImagesMade, kind: geometry.Images
) -> tuple[Array, Array | None, tuple[Array, Array] | None, geometry.Lattice, tuple[Array, Array] | None]:
    """Return sources and rows, if given, near a box, their turns, the lattice, and with a box per system whose they have."""
    lattice = of_sources = of_rows = geometry.make_lattice(box, kind, np.dtype(sources.dtype))
    systems, (codes, made) = None, images
    if batch is not None and kind.per_system:
        most = len(lattice.origin) - 1  # rows without a box get any
        systems = jnp.clip(batch.sources, 0, most), jnp.clip(batch.of_queries, 0, most)
        of_sources, of_rows = map(lattice.of_rows, systems)
    near = geometry.bring_near(sources, of_sources)
    ends = Ends(near, near if rows is None else geometry.bring_near(rows, of_rows), of_sources, of_rows)
    turns = None if codes is None else _turns_now(codes, made, ends)
    return ends.sources.points, None if rows is None else ends.rows.points, turns, lattice, systems


def kept_shifts(given: KeptList) -> Array:
    """Return the lattice shifts of the slots of a list in a box, [m, capacity, d] whole floats, 0 in unused slots."""
    assert given.lattice is not None  # no list in open space is asked
    lattice = given.lattice if given.systems is None else given.lattice.of_rows(given.systems[1])
    used = given.idx < given.sources.shape[0]
    neighbor = jnp.where(used, given.idx, 0)
    if given.codes is None or given.turns is None:
        sources, rows = given.ends
        shifts = geometry.nearest_shifts(sources[neighbor] - rows[:, None, :], lattice)
    else:
        shifts = _shifts_of_codes(given.codes, used, lattice.images, given.turns[1][:, None], given.turns[0][neighbor])
    return jnp.where(used[..., None], shifts, 0)


def _shifts_of_codes(codes: Array, used: Array, images: geometry.Images, of_rows: Array, of_sources: Array) -> Array:
    """Return the lattice shifts of slots that are used, by their image codes and the turns of both ends."""
    image = jnp.where(used, codes.astype(jnp.int32), images.home)
    return jnp.asarray(images.shifts).astype(of_rows.dtype)[image] + of_rows - of_sources


def _turns_now(codes: ImageCodes, made: tuple[Array, Array | None] | None, ends: Ends) -> tuple[Array, Array]:
    """Return the lattice vectors between the cell and near sources [n, d] and rows [m, d], in whole floats.

    They are those of the time when the list was made, plus the translations since then.
    So an image code denotes the same image after positions have been wrapped.
    """
    sources, rows, lattice = ends.sources.points, ends.rows.points, ends.of_rows
    both = [codes.turns] if codes.query_turns is None else [codes.turns, codes.query_turns]
    turns = [geometry.unpack_turns(x, lattice.dim).astype(sources.dtype) for x in both]
    if made is not None:
        since = zip(turns, made, (sources, rows), (ends.of_sources, lattice), strict=False)
        turns = [x if before is None else x + geometry.turns_between(before, now, each) for x, before, now, each in since]
    return turns[0], turns[-1]


@jax.custom_jvp
@compile_program
def norms(vectors: Array) -> Array:
    """Return the lengths of vectors [..., d]; the derivative of a length of 0 is 0."""
    columns = [vectors[..., k] for k in range(vectors.shape[-1])]  # reductions over so short an axis are slow
    largest = functools.reduce(jnp.maximum, map(jnp.abs, columns))
    apart = largest != 0  # also of what is no number
    unit = jnp.where(apart, largest, 1)  # unscaled squares of tiny or huge lengths would leave the float range
    square = functools.reduce(jnp.add, ((x / unit) ** 2 for x in columns))
    return jnp.where(apart, unit * jnp.sqrt(jnp.where(apart, square, 1)), 0)


@norms.defjvp
def _norms_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (vectors,), (moved,) = primals, tangents
    lengths = norms(vectors)
    apart = jnp.where(lengths != 0, lengths, 1)
    along = (vectors[..., k] / apart * moved[..., k] for k in range(vectors.shape[-1]))
    return lengths, functools.reduce(jnp.add, along)
