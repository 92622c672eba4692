"""Triplets: two edges that end at the same particle, as angles between bonds need them."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._engine import add_up
from jfrnn._search.exports import check_held, check_total
from jfrnn._tracing import compile_program, portable


@portable
class Triplets(NamedTuple):
    """Two different edges j → i and k → i of each triplet (j, i, k), sorted by the first; a pytree.

    Attributes:
        first: Which edge leads from j to i, shape [total], int32; the number of edges in the padding.
        second: Which edge leads from k to i, shape [total], int32; likewise.
        mask: Whether there is a triplet, shape [total], bool: the first `triplet_count` are, all others are padding.
        triplet_count: The true number of triplets, shape [], int32, at most 2³¹ - 1; it may exceed `total`. The smallest int32
            where edges may be missing.
    """

    first: Array
    second: Array
    mask: Array
    triplet_count: Array


def triplets_of(receivers: Array, mask: Array, known: Array, total: int | None, half: bool) -> Triplets:
    """Return the triplets of edges that ascend by receiver, as many as there are if total is None; `known`: no edge is missing."""
    if not isinstance(half, bool):
        raise TypeError(f"half must be True or False, got {half!r}.")
    offsets, pairs = _count(receivers, mask, half)
    if total is None:
        if isinstance(offsets, Tracer):
            raise TypeError("total must be given inside jax.jit: the length of the arrays, which it cannot read from the edges.")
        total = int(jax.device_get(offsets[-1]))
    room = check_total(total)
    check_held(offsets[-1], room, "triplets")
    found = _find(receivers, offsets, pairs, room, half)
    return found._replace(triplet_count=jnp.where(known, found.triplet_count, np.iinfo(np.int32).min))


@functools.partial(compile_program, static_argnames=("half",))
def _count(receivers: Array, mask: Array, half: bool) -> tuple[Array, Array]:
    """Return where the triplets of each first edge begin, and those of the last one end, and how many pairs come before each edge.

    Both are [edges + 1] int32, the first one saturating. Edges that are no pairs may stand anywhere.
    """
    begin, end = _group(receivers)
    pairs = add_up(mask.astype(jnp.int32))
    others = pairs[end] - (pairs[:-1] if half else pairs[begin]) - 1
    return add_up(jnp.where(mask, others, 0)), pairs


def _group(receivers: Array) -> tuple[Array, Array]:
    """Return the first edge that has the receiver of an edge, and the one after the last, [edges] int32 each."""
    edge, new = lax.iota(jnp.int32, len(receivers)), receivers[1:] != receivers[:-1]
    begin = lax.cummax(jnp.where(jnp.pad(new, (1, 0), constant_values=True), edge, 0))
    end = lax.cummin(jnp.where(jnp.pad(new, (0, 1), constant_values=True), edge + 1, np.int32(len(receivers))), reverse=True)
    return begin, end


@functools.partial(compile_program, static_argnames=("total", "half"))
def _find(receivers: Array, offsets: Array, pairs: Array, total: int, half: bool) -> Triplets:
    edges, place = len(receivers), lax.iota(jnp.int32, total)
    if 0 in (edges, total):
        none = jnp.full(total, edges, jnp.int32)
        return Triplets(none, none, jnp.zeros(total, bool), offsets[-1])
    begun = jnp.zeros(total, jnp.int32).at[offsets[1:-1]].add(1, mode="drop", indices_are_sorted=True)
    first = jnp.cumsum(begun, dtype=jnp.int32)
    rank = place - offsets[first]
    other = pairs[first] + 1 + rank  # which pair it is
    if not half:
        other = pairs[_group(receivers)[0][first]] + rank
        other = jnp.where(other < pairs[first], other, other + 1)
    edge_of_pair = jnp.where(pairs[1:] > pairs[:-1], pairs[:-1], edges)
    second = jnp.zeros(edges, jnp.int32).at[edge_of_pair].set(lax.iota(jnp.int32, edges), mode="drop")[other]
    there = place < offsets[-1]
    return Triplets(jnp.where(there, first, edges), jnp.where(there, second, edges), there, offsets[-1])
