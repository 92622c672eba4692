"""The geometry of a list: displacements, lattice shifts, and which pairs are within the cutoff at present."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine import KeptList, kept_mask
from jfrnn._geometry import (
    LARGEST_TURN,
    Batch,
    Box,
    Cutoff,
    Cutoffs,
    Images,
    Lattice,
    Near,
    Radii,
    bring_near,
    forward_shifts,
    given_shifts,
    is_pair_of,
    make_cutoffs,
    make_lattice,
    nearest_shifts,
    shift_pairs,
    turns_between,
    unpack_turns,
)
from jfrnn._search.topology import Topology
from jfrnn._tracing import call_apart, compile_program


class ImageCodes(NamedTuple):
    """The periodic image that each slot refers to, for lists with more than the minimum image.

    Attributes:
        codes: Index among the shifts within reach, for wrapped positions, shape [m, capacity]: uint8 for up to 256 images, int16
            for up to 32 768, else int32. Shifts and turns count the vectors of `Images.basis`, or of `Box.numbers`.
        turns: How many lattice vectors each source was from the box when the list was made, packed, shape [n], int32.
        query_turns: Likewise for queries, shape [m], int32; None if the sources are the queries.
    """

    codes: Array
    turns: Array
    query_turns: Array | None


def lattice_of_rows(box: Box, kind: Images, dtype: np.dtype, systems: Array | None, native: bool) -> Lattice:
    """Return the lattice of a box or, where each system has one, that of each row; differentiable by gathers.

    `systems` [rows] are those of the rows, of which some may have no box: these get any.
    """
    from jfrnn._search.gathers import gather

    lattice = make_lattice(box, kind, dtype)
    if not kind.per_system or systems is None:
        return lattice
    boxes, nearest = len(lattice.origin), jnp.clip(systems, 0, len(lattice.origin) - 1)
    topology = Topology(nearest[:, None], None, None, None, boxes, 1, False, native)
    matrix = gather(lattice.matrix.reshape(boxes, -1), topology).reshape(-1, lattice.dim, lattice.dim)
    return dataclasses.replace(lax.stop_gradient(lattice).of_rows(nearest), matrix=matrix)


ImagesMade = tuple[ImageCodes | None, tuple[Array, Array | None] | None]  # and the positions at which a list with a skin was made


class Ends(NamedTuple):
    """Sources and rows near the box, and the lattice of each; or of all of them."""

    sources: Near
    rows: Near
    of_sources: Lattice
    of_rows: Lattice

    def shifts_of_given(self, whole: Array, senders: Array, receivers: Array) -> Array:
        """Return shifts [..., d], whole floats between near points, as whole numbers between points as they are given, int32.

        `senders` and `receivers` [...] say whose they are; the lattice of a receiver has an axis more where each has one.
        """
        turns = (x.turns.astype(jnp.int32) for x in (self.rows, self.sources))
        of_rows, of_sources = (x.at[named].get(mode="clip") for x, named in zip(turns, (receivers, senders), strict=True))
        return given_shifts(whole, self.of_rows) + of_rows - of_sources


def find_ends(sources: Array, rows: Array, box: Box, kind: Images, batch: Batch | None, native: bool) -> Ends:
    """Return sources and rows near the box, or each near the box of its system; differentiable in points and box."""
    of_rows, of_sources = (None, None) if batch is None else (batch.of_queries, batch.sources)
    lattice = lattice_of_rows(box, kind, np.dtype(sources.dtype), of_rows, native)
    also = lattice if of_rows is of_sources else lattice_of_rows(box, kind, np.dtype(sources.dtype), of_sources, native)
    near = bring_near(sources, also)
    return Ends(near, near if rows is sources else bring_near(rows, lattice), also, lattice)


def pair_cutoff(cutoff: Cutoff | Radii | None, closed: bool) -> Cutoff | Cutoffs:
    """Return the cutoff of pairs, with the constants of its test."""
    if isinstance(cutoff, Cutoff):
        return cutoff
    if cutoff is None:
        raise TypeError("a list has a cutoff or radii.")
    return make_cutoffs(lax.stop_gradient(cutoff), closed)


@functools.partial(compile_program, static_argnames="closed")
def open_vectors(
    topology: Topology, count: Array, sources: Array, rows: Array, given: Cutoff | Radii | None, closed: bool
) -> tuple[Array, Array]:
    from jfrnn._search.gathers import gather

    cutoff, idx = pair_cutoff(given, closed), topology.idx
    used = lax.broadcasted_iota(jnp.int32, idx.shape, 1) < count[:, None]
    neighbor = jnp.where(used, idx, 0)
    fixed_rows, fixed_sources = lax.stop_gradient((rows, sources))
    if topology.native:
        given_list = kept_list(topology, count, (None, None), fixed_sources, fixed_rows, given, closed, None, None)
        mask = call_apart(kept_mask, given_list)
    else:
        mask = call_apart(is_pair_of, fixed_rows, fixed_sources, neighbor, used, cutoff)
    return jnp.where(mask[..., None], gather(sources, topology) - rows[:, None, :], 0), mask


class _Slots(NamedTuple):
    """Of every slot: whether it is used, its source, x_j - x_i, and its lattice shift in whole floats; 0 in unused slots."""

    used: Array
    neighbor: Array
    difference: Array
    shifts: Array


def _find_slots(topology: Topology, count: Array, images: ImagesMade, ends: Ends, half: bool) -> _Slots:
    from jfrnn._search.gathers import gather

    idx, sources, rows, lattice = topology.idx, ends.sources.points, ends.rows.points, ends.of_rows
    used = lax.broadcasted_iota(jnp.int32, idx.shape, 1) < count[:, None]
    neighbor = jnp.where(used, idx, 0)
    difference = gather(sources, topology) - rows[:, None, :]
    codes, made = images
    if codes is None:
        shifts = nearest_shifts(difference, lattice)
    else:
        turns, query_turns = _turns_now(codes, made, ends)
        image = jnp.where(used, codes.codes.astype(jnp.int32), lattice.images.home)
        shifts = jnp.asarray(lattice.images.shifts).astype(sources.dtype)[image] + query_turns[:, None] - turns[neighbor]
    kind = lattice.images
    if half and kind.counts_short:  # of a particle's two opposite images, keep the forward one in the given vectors
        own = neighbor == lax.broadcasted_iota(jnp.int32, idx.shape, 0)
        shifts = jnp.where(own[..., None], forward_shifts(shifts, lattice), shifts)
    most = 2 * LARGEST_TURN + max(kind.reach)  # at larger distances no pair is decided exactly
    used = used & (jnp.abs(shifts) <= most).all(axis=-1)
    return _Slots(used, neighbor, difference, jnp.where(used[..., None], shifts, 0))


def edge_shifts(
    difference: Array, real: Array, sides: tuple[Topology, Topology], images: ImagesMade, ends: Ends, lattice: Lattice
) -> Array:
    """Return the lattice shifts [total, 1, d], whole floats, of edges between near points; `lattice` is that of all, or of each."""
    codes, made = images
    senders, receivers = (jnp.where(real, side.idx[:, 0], 0) for side in sides)
    if codes is None:
        return nearest_shifts(difference, lattice)
    turns, query_turns = _turns_now(codes, made, ends)
    kind = ends.of_rows.images
    image = jnp.where(real, codes.codes.astype(jnp.int32), kind.home)
    table = jnp.asarray(kind.shifts).astype(difference.dtype)
    return (table[image] + query_turns[receivers] - turns[senders])[:, None]


@functools.partial(compile_program, static_argnames=("kind", "half"))
def lattice_shifts(
    topology: Topology,
    count: Array,
    images: ImagesMade,
    sources: Array,
    rows: Array,
    box: Box,
    batch: Batch | None,
    kind: Images,
    half: bool,
) -> Array:
    """Return the lattice shift of each slot between points as they are given, [m, capacity, d] int32; 0 in unused slots."""
    ends = find_ends(sources, rows, box, kind, batch, topology.native)
    return _given_shifts(_find_slots(topology, count, images, ends, half), ends)


def _given_shifts(slots: _Slots, ends: Ends) -> Array:
    row = lax.broadcasted_iota(jnp.int32, slots.neighbor.shape, 0)
    shifts = ends.shifts_of_given(lax.stop_gradient(slots.shifts), slots.neighbor, row)
    return jnp.where(slots.used[..., None], shifts, 0)


@functools.partial(compile_program, static_argnames=("kind", "closed", "half", "as_given"))
def periodic_vectors(
    topology: Topology,
    count: Array,
    images: ImagesMade,
    sources: Array,
    rows: Array,
    box: Box,
    batch: Batch | None,
    kind: Images,
    given: Cutoff | Radii | None,
    closed: bool,
    half: bool,
    as_given: bool = False,
) -> tuple[Array, Array, Array]:
    """Return displacements, the mask, and the shifts of slots: whole floats between near points, or as `lattice_shifts` does."""
    cutoff = pair_cutoff(given, closed)
    ends = find_ends(sources, rows, box, kind, batch, topology.native)
    slots = _find_slots(topology, count, images, ends, half)
    fixed_rows, fixed_sources = lax.stop_gradient((ends.rows.points, ends.sources.points))
    pairs = shift_pairs(slots.difference, slots.shifts, ends.of_rows)
    if is_native(topology, kind, half):
        given_list = kept_list(topology, count, images, *lax.stop_gradient((sources, rows)), given, closed, box, kind, batch)
        mask = call_apart(kept_mask, given_list)
    else:
        fixed_pairs = pairs._replace(vectors=lax.stop_gradient(pairs.vectors))
        mask = call_apart(is_pair_of, fixed_rows, fixed_sources, slots.neighbor, slots.used, cutoff, fixed_pairs)
    shifts = _given_shifts(slots, ends) if as_given else slots.shifts
    return jnp.where(mask[..., None], pairs.vectors, 0), mask, shifts


def is_native(topology: Topology, kind: Images | None, half: bool) -> bool:
    """Say whether Warp's kernels decide which slots hold a pair.

    They do not in half lists of short vectors, whose images JAX chooses.
    """
    return topology.native and not (kind is not None and half and kind.counts_short)


def kept_list(
    topology: Topology,
    count: Array,
    images: ImagesMade,
    sources: Array,
    rows: Array,
    cutoff: Cutoff | Radii | None,
    closed: bool,
    box: Box | None,
    kind: Images | None,
    batch: Batch | None = None,
) -> KeptList:
    """Return a list at these positions as Warp's kernels take it: points near the box, and one lattice, or one per system."""
    (codes, made), of_pairs, systems, turns, lattice = images, pair_cutoff(cutoff, closed), None, None, None
    if box is not None and kind is not None:
        lattice = of_sources = of_rows = make_lattice(box, kind, np.dtype(sources.dtype))
        if batch is not None and kind.per_system:
            most = len(lattice.origin) - 1  # rows without a box get any
            systems = jnp.clip(batch.sources, 0, most), jnp.clip(batch.of_queries, 0, most)
            of_sources, of_rows = map(lattice.of_rows, systems)
        ends = Ends(bring_near(sources, of_sources), bring_near(rows, of_rows), of_sources, of_rows)
        sources, rows = ends.sources.points, ends.rows.points
        turns = None if codes is None else _turns_now(codes, made, ends)
    fixed = lax.stop_gradient((sources, rows, turns, of_pairs, lattice))
    return KeptList(topology.idx, count, topology.codes, *fixed, topology.order, None, systems)


def kept_shifts(given: KeptList) -> Array:
    """Return the lattice shifts of the slots of a list in a box, [m, capacity, d] whole floats, 0 in unused slots."""
    if given.lattice is None:
        raise TypeError("a list in open space has no shifts.")
    lattice = given.lattice if given.systems is None else given.lattice.of_rows(given.systems[1])
    used = given.idx < given.sources.shape[0]
    neighbor = jnp.where(used, given.idx, 0)
    if given.codes is None or given.turns is None:
        shifts = nearest_shifts(given.sources[neighbor] - given.rows[:, None, :], lattice)
    else:
        image = jnp.where(used, given.codes.astype(jnp.int32), lattice.images.home)
        table = jnp.asarray(lattice.images.shifts).astype(given.sources.dtype)
        shifts = table[image] + given.turns[1][:, None] - given.turns[0][neighbor]
    return jnp.where(used[..., None], shifts, 0)


def _turns_now(images: ImageCodes, made: tuple[Array, Array | None] | None, ends: Ends) -> tuple[Array, Array]:
    """Return the lattice vectors between the cell and near sources [n, d] and rows [m, d], in whole floats.

    They are those of the time when the list was made, plus the translations since then (`made` holds the positions of that time).
    So an image code denotes the same image after positions have been wrapped.
    """
    sources, rows, lattice = ends.sources.points, ends.rows.points, ends.of_rows
    both = [images.turns] if images.query_turns is None else [images.turns, images.query_turns]
    turns = [unpack_turns(x, lattice.dim).astype(sources.dtype) for x in both]
    if made is not None:
        since = zip(turns, made, (sources, rows), (ends.of_sources, lattice), strict=False)
        turns = [x if before is None else x + turns_between(before, now, each) for x, before, now, each in since]
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
