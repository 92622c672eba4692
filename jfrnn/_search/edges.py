"""The pairs of a list as the edges of a graph, sorted by receiver, with displacements that are differentiated by gathers."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import Box, Images, Status, given_shifts, make_lattice, translation
from jfrnn._search.exports import flat_pairs, pair_total
from jfrnn._search.reverse import Reverse
from jfrnn._search.topology import Topology
from jfrnn._tracing import compile_program


class Edges(NamedTuple):
    """Edges from neighbors j to particles i, sorted by i; a pytree. Edges beyond the last pair lead from n to m.

    Attributes:
        senders: Neighbors j, shape [total], int32.
        receivers: Particles (or queries) i in ascending order, shape [total], int32.
        displacement: x_j - x_i [length], in a box plus the lattice translation of the image, shape [total, d]; 0 where `mask` is
            not set, and NaN everywhere if pairs are missing because there are more of them than `total`.
        shift: Lattice shifts S, shape [total, d], int32.
        mask: Whether an edge is a pair that is closer than the cutoff, exactly, shape [total], bool.
        status: Bits of `Status` of the list, with `Status.TOTAL_OVERFLOW` if pairs are missing, shape [], int32.
    """

    senders: Array
    receivers: Array
    displacement: Array
    shift: Array
    mask: Array
    status: Array


@functools.partial(compile_program, static_argnames=("kind", "total"))
def flat_edges(
    topology: Topology,
    count: Array,
    status: Array,
    mask: Array,
    shifts: Array | None,
    sources: Array,
    rows: Array,
    box: Box | None,
    kind: Images | None,
    total: int,
) -> Edges:
    """Return the edges of a list whose mask [m, capacity] and shifts [m, capacity, d], whole floats or None, are known."""
    from jfrnn._search.gathers import gather

    (m, capacity), dim = topology.idx.shape, sources.shape[1]
    receivers, senders, offsets = flat_pairs(topology.idx, count, topology.sources, total)
    slot = receivers * capacity + lax.iota(jnp.int32, total) - offsets.at[receivers].get(mode="clip")
    there = receivers < m
    of_edge = functools.partial(_take, slot=jnp.where(there, slot, 0))
    real = there & of_edge(mask)
    ends = _by_sender(topology, offsets, total), _by_row(offsets, capacity, total)
    sides = [
        gather(points, Topology(named[:, None], None, end, None, len(points), 1, end.starts is None, topology.native))[:, 0]
        for points, named, end in zip((sources, rows), (senders, receivers), ends, strict=True)
    ]
    displacement, shift = sides[0] - sides[1], jnp.zeros((total, dim), jnp.int32)
    if shifts is not None and box is not None and kind is not None:
        whole = jnp.where(there[:, None], of_edge(shifts), 0)
        displacement = displacement + translation(whole, make_lattice(box, kind, np.dtype(sources.dtype)))
        shift = given_shifts(whole, kind)
    missing = offsets[-1] > total
    displacement = jnp.where(missing, jnp.nan, jnp.where(real[:, None], displacement, 0))
    status = status | jnp.where(missing, jnp.int32(Status.TOTAL_OVERFLOW.value), 0)
    return Edges(senders, receivers, displacement.astype(sources.dtype), shift, real, status)


def no_edges(m: int, sources: int, points: Array, status: Array, count: Array, capacity: int, total: int) -> Edges:
    """Return the edges of a list that holds none, or of which none is asked for."""
    missing = pair_total(count, capacity) > total
    status = status | jnp.where(missing, jnp.int32(Status.TOTAL_OVERFLOW.value), 0)
    displacement = jnp.zeros((total, points.shape[1]), points.dtype)
    ends = jnp.full(total, sources, jnp.int32), jnp.full(total, m, jnp.int32)
    return Edges(*ends, displacement, displacement.astype(jnp.int32), jnp.zeros(total, bool), status)


def _take(x: Array, slot: Array) -> Array:
    return x.reshape(-1, *x.shape[2:]).at[slot].get(mode="clip")


def _by_sender(topology: Topology, offsets: Array, total: int) -> Reverse:
    """Return the edges of each source, from its slots."""
    reverse, (m, capacity) = topology.with_reverse(), topology.idx.shape
    row = jnp.minimum(reverse.slots // capacity, m - 1)
    edge = jnp.where(reverse.slots < m * capacity, offsets[row] + reverse.slots - row * capacity, total)
    return reverse._replace(slots=jnp.minimum(edge, total))


def _by_row(offsets: Array, capacity: int, total: int) -> Reverse:
    """Return the edges of each row, which follow each other."""
    edge = offsets[:-1, None] + lax.iota(jnp.int32, capacity)
    return Reverse(jnp.where(edge < offsets[1:, None], jnp.minimum(edge, total), total))
