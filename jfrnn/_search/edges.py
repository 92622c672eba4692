"""The pairs of a list as the edges of a graph, sorted by receiver, with displacements that are differentiated by gathers."""

import dataclasses
import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn import _geometry as geometry
from jfrnn._engine import add_up, flatten_slots
from jfrnn._search.exports import flat_pairs
from jfrnn._search.geometry import edge_shifts, ends_of, lattice_of_rows, norms
from jfrnn._search.present import Present, Reverse, Topology, one_each
from jfrnn._search.triplets import Triplets, triplets_of
from jfrnn._tracing import call_apart, compile_program, on_platform, portable


@portable
class Edges(NamedTuple):
    """Edges from neighbors j to particles i, sorted by i; a pytree. Edges beyond the last pair lead from n to m.

    Attributes:
        senders: Neighbors j, shape [total], int32.
        receivers: Particles (or queries) i in ascending order, shape [total], int32.
        displacement: x_j - x_i [length], in a box plus the lattice translation of the image, shape [total, d]; 0 where `mask` is
            not set, and NaN everywhere if pairs may be missing: there are more of them than `total`, or the list lacks some.
        shift: Lattice shifts S, shape [total, d], int32; 0 where `mask` is not set, the smallest int32 where pairs may be missing.
        mask: Whether an edge is a pair, shape [total], bool: the first `pair_count` edges are, all others are padding. Those of a
            flat list with a skin stay where they stand in the list, with pairs of the skin among them.
        status: Bits of `Status` of the list, with `Status.TOTAL_OVERFLOW` if pairs are missing, shape [], int32.
        distance: Length of the displacement, shape [total]; 0 where `mask` is not set, and NaN where the displacement is.
        pair_count: The true number of pairs, shape [], int32; it may exceed `total`.
    """

    senders: Array
    receivers: Array
    displacement: Array
    shift: Array
    mask: Array
    status: Array
    distance: Array
    pair_count: Array

    def triplets(self, total: int | None = None, *, half: bool = False) -> Triplets:
        """Return the pairs of edges that end at the same particle: angles between bonds, differentiable by what edges hold.

        Args:
            total: The length of the arrays, a static int; default: as many as there are, outside of jit.
            half: Whether of (j, i, k) and (k, i, j) one is listed, the one whose first edge comes first.

        Returns:
            `Triplets`: indices of edges, as in `edges.displacement.at[triplets.first].get(mode="clip")`. Those of the padding
            are beyond the last edge. They are triplets of all neighbors of i if the list is not a half list.

        Raises:
            TypeError, ValueError: total is not a static int >= 0, or outside of jit too small; half is no bool.

        Cost: 9 B per triplet, one pass. Jit: yes, with `total`; if `triplet_count` exceeds it, triplets are missing.
        """
        known = geometry.are_whole(self.status) & (self.pair_count <= len(self.senders))
        return triplets_of(self.receivers, self.mask, known, total, half)


@portable
class Graph(NamedTuple):
    """A graph in the form of jraph's `GraphsTuple`: the same fields in the same order, which its models read and replace.

    It holds two graphs, as after `jraph.pad_with_graphs`: that of the particles, and one of a single node with all padding edges.

    Attributes:
        nodes: {"positions": [n + 1, d]}, 0 in the last row, the node of the padding.
        edges: {"displacement": [total, d], "distance": [total], "shift": [total, d] int32}; 0 in padding edges.
        receivers: Particles i in ascending order, shape [total], int32; n in padding edges.
        senders: Neighbors j, shape [total], int32; likewise.
        globals: None.
        n_node: [n, 1], int32.
        n_edge: The number of pairs and of padding edges, shape [2], int32.
    """

    nodes: dict[str, Array]
    edges: dict[str, Array]
    receivers: Array
    senders: Array
    globals: None
    n_node: Array
    n_edge: Array


@compile_program
def make_graph(edges: Edges, positions: Array) -> Graph:
    """Return the graph of the edges among n particles at these positions [n, d]."""
    total, held = len(edges.senders), jnp.minimum(edges.pair_count, len(edges.senders))
    nodes = {"positions": jnp.pad(positions, ((0, 1), (0, 0)))}
    of_edges = {"displacement": edges.displacement, "distance": edges.distance, "shift": edges.shift}
    sizes = jnp.array([len(positions), 1], jnp.int32), jnp.stack([held, total - held])
    return Graph(nodes, of_edges, edges.receivers, edges.senders, None, *sizes)


class Flat(NamedTuple):
    """The set slots of rows [m, capacity], one after another.

    Attributes:
        rows: The row of each, shape [total], int32; m in the padding.
        slots: Row * capacity + its place in the row, shape [total], int32; 0 in the padding.
        offsets: The start of each row and the end of the last, shape [m + 1], int32.
        edges: Which of these each slot is, shape [m * capacity], int32; `total` for slots that are not set, or beyond.
    """

    rows: Array
    slots: Array
    offsets: Array
    edges: Array


def flatten(mask: Array, total: int, native: bool = False) -> Flat:
    """Put the set slots of a mask [m, capacity] one after another, in arrays of a static length, by Warp's kernels if `native`."""
    m, capacity = mask.shape
    if native:
        offsets = add_up(jnp.sum(mask, axis=1, dtype=jnp.int32))
        on_cpu, on_cuda = (functools.partial(flatten_slots, total=total, cuda=cuda) for cuda in (False, True))
        rows, slots = on_platform(mask, offsets[:-1], cpu=on_cpu, cuda=on_cuda)
        real, edge = lax.iota(jnp.int32, total) < offsets[-1], lax.iota(jnp.int32, total)
        at = jnp.where(real, slots, mask.size)
        edges = jnp.full(mask.size, total, jnp.int32).at[at].set(edge, mode="drop", unique_indices=True)
        return Flat(jnp.where(real, rows, m), jnp.where(real, slots, 0), offsets, edges)
    ranks = jnp.cumsum(mask, axis=1, dtype=jnp.int32)
    offsets = add_up(ranks[:, -1])
    edges = jnp.where(mask, jnp.minimum(offsets[:-1, None] + ranks - 1, total), total).reshape(-1)
    slots = jnp.zeros(total, jnp.int32).at[edges].set(lax.iota(jnp.int32, mask.size), mode="drop")
    rows = jnp.where(lax.iota(jnp.int32, total) < offsets[-1], slots // capacity, m)
    return Flat(rows, slots, offsets, edges)


@functools.partial(compile_program, static_argnames=("sources", "total", "native"))
def flat_pairs_of(idx: Array, mask: Array, sources: int, total: int, native: bool) -> tuple[Array, Array, Array, Array]:
    """Return what `flat_pairs` does, of the slots that are set in a mask [m, capacity], and their number."""
    if 0 in (*idx.shape, total):
        rows, indices, offsets = flat_pairs(idx, mask.sum(1, dtype=jnp.int32), sources, total)
        return rows, indices, offsets, offsets[-1]
    flat = flatten(mask, total, native)
    return flat.rows, jnp.where(flat.rows < len(idx), idx.reshape(-1)[flat.slots], sources), flat.offsets, flat.offsets[-1]


@functools.partial(compile_program, static_argnames="total")
def flat_edges(present: Present, status: Array, mask: Array, total: int) -> Edges:
    """Return the edges of a padded list whose mask [m, capacity] is known: those of a flat one."""
    topology, (m, capacity), (codes, made) = present.topology, present.topology.idx.shape, present.images
    flat = flatten(mask, total, topology.native)
    senders = jnp.where(flat.rows < m, topology.idx.reshape(-1)[flat.slots], topology.sources)
    of_slots = topology.with_reverse()
    by_sender = of_slots._replace(slots=flat.edges.at[of_slots.slots].get(mode="fill", fill_value=total))
    by_row = edges_of_rows(flat.offsets, total)
    if not topology.native:  # array programming adds rows of one length sooner
        edge = flat.offsets[:-1, None] + lax.iota(jnp.int32, capacity)[None]
        by_row = Reverse(jnp.where(edge < flat.offsets[1:, None], jnp.minimum(edge, total), total))
    sides = one_each(senders, topology.sources, topology.native, by_sender), one_each(flat.rows, m, topology.native, by_row)
    images = None if codes is None else codes._replace(codes=codes.codes.reshape(-1)[flat.slots]), made
    fixed = dataclasses.replace(present, topology=sides[0], count=flat.offsets[-1], images=images, cutoff=None)
    return edges_of(fixed, sides[1], status, harmless=geometry.ROWS_ARE_WHOLE)


@functools.partial(compile_program, static_argnames="harmless")
def edges_of(present: Present, by_receiver: Topology, status: Array, harmless: geometry.Status) -> Edges:
    """Return the edges of a flat list; without a cutoff, all of its pairs are edges. `harmless` bits mean no missing pairs."""
    vectors, mask, _, shift = _edge_pairs(present, by_receiver)
    missing, shift = present.count > len(mask), jnp.where(mask[:, None], shift, 0)
    displacement = jnp.where(mask[:, None], vectors[:, 0], 0).astype(present.sources.dtype)
    known = geometry.are_whole(status, harmless) & ~missing
    displacement, shift, distance = (geometry.mark_rows(x, known) for x in (displacement, shift, norms(displacement)))
    status = status | jnp.where(missing, jnp.int32(geometry.Status.TOTAL_OVERFLOW.value), 0)
    held = present.count if present.cutoff is None else jnp.where(missing, present.count, jnp.sum(mask, dtype=jnp.int32))
    return Edges(present.topology.idx[:, 0], by_receiver.idx[:, 0], displacement, shift, mask, status, distance, held)


@compile_program
def close_edges(present: Present, by_receiver: Topology) -> tuple[Array, Array | None]:
    """Say which edges are pairs [total]; and return their shifts between near points, [total, d] whole floats, in a box."""
    _, mask, whole, _ = _edge_pairs(present, by_receiver)
    return mask, None if whole is None else whole[:, 0]


def _edge_pairs(present: Present, by_receiver: Topology) -> tuple[Array, Array, Array | None, Array]:
    """Return x_j - x_i with the translation of its image, [total, 1, d], and which edges are pairs closer than the cutoff, [total].

    Behind them come lattice shifts between near points, [total, 1, d] whole floats, None in open space; and those between points
    as they are given, [total, d] int32.
    """
    from jfrnn._search.gathers import gather

    by_sender, sources, rows, near = present.topology, present.sources, present.rows, ends_of(present)
    total, senders, receivers = len(by_sender.idx), by_sender.idx[:, 0], by_receiver.idx[:, 0]
    mask = lax.iota(jnp.int32, total) < present.count
    if near is not None:
        sources, rows = near.sources.points, near.rows.points
    at_senders, at_receivers = gather(sources, by_sender), gather(rows, by_receiver)
    vectors, pairs, whole = at_senders - at_receivers, None, None
    shift = jnp.zeros((total, sources.shape[1]), jnp.int32)
    if near is not None and present.box is not None and present.kind is not None:
        systems = None if present.batch is None else present.batch.of_queries.at[receivers].get(mode="clip")
        lattice = lattice_of_rows(present.box, present.kind, np.dtype(sources.dtype), systems, by_sender.native)
        whole = edge_shifts(vectors, mask, present, receivers, near, lattice)
        if present.forward:  # as in padded lists
            whole = jnp.where((senders == receivers)[:, None, None], geometry.forward_shifts(whole, lattice), whole)
        whole = jnp.where(mask[:, None, None], whole, 0)
        pairs = geometry.shift_pairs(vectors, whole, lattice)
        vectors, shift = pairs.vectors, near._replace(of_rows=lattice).shifts_of_given(whole[:, 0], senders, receivers)
    if present.cutoff is not None:
        mask = mask & _are_close(present, by_receiver, mask, sources, at_receivers, pairs)
    return vectors, mask, whole, shift


def _are_close(
    present: Present, by_receiver: Topology, real: Array, sources: Array, at_receivers: Array, pairs: geometry.Shifted | None
) -> Array:
    """Say which edges are those of pairs that are closer than the cutoff, exactly, [total] bool."""
    given, by_sender = present.cutoff, present.topology
    if isinstance(given, geometry.Radii) and given.queries is not None:
        given = dataclasses.replace(given, queries=given.queries.at[by_receiver.idx[:, 0]].get(mode="clip"))
    senders, itself = jnp.where(real[:, None], by_sender.idx, 0), None
    fixed = lax.stop_gradient((at_receivers[:, 0], sources))
    pairs = None if pairs is None else pairs._replace(vectors=lax.stop_gradient(pairs.vectors))
    if isinstance(given, geometry.Radii) and given.itself:  # rows are edges here
        there = real & (by_sender.idx == by_receiver.idx)[:, 0] & geometry.are_finite(fixed[0])
        itself = there if pairs is None else there & (pairs.shifts == 0).all(axis=(1, 2))
        given = dataclasses.replace(given, itself=False)
    cutoffs = dataclasses.replace(present, cutoff=given).cutoffs
    close = call_apart(geometry.is_pair_of, *fixed, senders, real[:, None], cutoffs, pairs)[:, 0]
    return close if itself is None else close | itself


def no_edges(mask: Array, sources: int, points: Array, status: Array, total: int) -> Edges:
    """Return the edges of a list that holds none, or of which none is asked for."""
    count = jnp.sum(mask, dtype=jnp.int32)
    status = status | jnp.where(count > total, jnp.int32(geometry.Status.TOTAL_OVERFLOW.value), 0)
    displacement = jnp.zeros((total, points.shape[1]), points.dtype)
    ends = jnp.full(total, sources, jnp.int32), jnp.full(total, len(mask), jnp.int32)
    shift, none = displacement.astype(jnp.int32), jnp.zeros(total, bool)
    return Edges(*ends, displacement, shift, none, status, displacement[:, 0], count)


def edges_of_rows(offsets: Array, total: int) -> Reverse:
    """Return the edges of each receiver of a flat list."""
    held = jnp.minimum(offsets, total)
    return Reverse(lax.iota(jnp.int32, total), held[:-1], jnp.diff(held))
