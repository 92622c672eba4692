"""Exports of a list: flat arrays of pairs with a static length, the number of pairs, and the view that jax-md reads."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._engine import add_up
from jfrnn._geometry import Status
from jfrnn._tracing import compile_program, portable

MOST_PAIRS = 2**31 - 1  # most pairs that int32 offsets can number


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DenseNeighbors:
    """The part of a neighbor list that jax-md's energies and simulations read.

    Attributes:
        idx: Neighbors, shape [n, capacity], int32; unused slots hold n.
        status: Bits of `Status` of the exported list, shape [], int32.
        format: None: not one of jax-md's two sparse formats, so jax-md treats it as dense. Static.
    """

    idx: Array
    status: Array
    format: None = dataclasses.field(default=None, metadata={"static": True})

    @property
    def did_buffer_overflow(self) -> Array:
        """Whether a row lost neighbors, shape [], bool: search again with more capacity."""
        return (self.status & Status.ROW_OVERFLOW.value) != 0


def check_total(total: object) -> int:
    """Return a static number of pairs, after checking that int32 offsets can number them."""
    if isinstance(total, bool) or not isinstance(total, int | np.integer):
        raise TypeError(f"total must be a static int, the length of the arrays, got {type(total).__name__} {total!r}.")
    if total < 0:
        raise ValueError(f"total must be at least 0, got {total}.")
    if total > MOST_PAIRS:
        raise ValueError(
            f"total must be at most {MOST_PAIRS}, as many pairs as int32 offsets can number, got {total}: export in parts, each a "
            "search with queries=, or outside jax.jit without total, where offsets are int64."
        )
    return int(total)


def check_held(held: Array, total: int, what: str = "pairs") -> None:
    """Raise outside jit if more is held than arrays of this length have room for."""
    if isinstance(held, Tracer):
        return
    known = int(np.max(jax.device_get(held)))
    if known > total:
        raise ValueError(f"total={total} is too small: the list holds {known} {what}. Pass total={known} or more.")


def saturating_add(a: Array, b: Array) -> Array:
    """Add nonnegative int32, saturating at the largest int32."""
    return jnp.where(a > MOST_PAIRS - b, MOST_PAIRS, a + b)


@functools.partial(compile_program, static_argnames="capacity")
def pair_total(count: Array, capacity: int) -> Array:
    """Return the number of used slots in all rows, [] int32, saturating at the largest int32."""
    used = jnp.minimum(count, capacity)
    if count.shape[0] * capacity <= MOST_PAIRS:
        return jnp.sum(used, dtype=jnp.int32)
    return lax.reduce(used, jnp.int32(0), saturating_add, (0,))


@functools.partial(compile_program, static_argnames=("sources", "total"))
def flat_pairs(idx: Array, count: Array, sources: int, total: int) -> tuple[Array, Array, Array]:
    """Return rows and sources of the pairs, [total] int32 each, padded with m and `sources`, and the row offsets."""
    m, capacity = idx.shape
    offsets = add_up(jnp.minimum(count, capacity))
    if 0 in (m, capacity, total):
        return jnp.full(total, m, jnp.int32), jnp.full(total, sources, jnp.int32), offsets
    place = lax.iota(jnp.int32, total)
    begun = jnp.zeros(total, jnp.int32).at[offsets[1:-1]].add(1, mode="drop", indices_are_sorted=True)
    row = jnp.cumsum(begun, dtype=jnp.int32)
    there = place < offsets[-1]
    found = idx[row, jnp.minimum(place - offsets[row], capacity - 1)]
    return jnp.where(there, row, m), jnp.where(there, found, sources), offsets
