"""Where the pairs of a list stand the other way round, so that what belongs to pairs is summed for their sources by gathers.

A slot is numbered row * capacity + its place in the row. In a list that is its own mirror image, the slot of (i, j, S) has one
reverse slot: that of (j, i, -S). In other lists (half lists, lists of queries, those with the cutoff of one side) the slots are
sorted by source.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine import reverse_slots, slots_by_source
from jfrnn._tracing import on_platform

MOST_SLOTS = 2**31 - 1  # that int32 can number
_BLOCK = 1 << 22  # ids that are compared at a time by array programming: 16 MB


class Reverse(NamedTuple):
    """The slots of each source.

    Attributes:
        slots: In a list that is its own mirror image: the reverse slot of each slot, shape [n, capacity], int32; n * capacity where
            there is none. In other lists: the used slots in the order of their sources, shape [m * capacity], int32, padded with
            m * capacity.
        starts: Where the slots of each source begin among these, shape [n], int32; None in a list that is its own mirror image.
        lengths: How many slots each source has, shape [n], int32; likewise.
    """

    slots: Array
    starts: Array | None = None
    lengths: Array | None = None


def find_reverse(idx: Array, codes: Array | None, images: int, sources: int, mutual: bool, native: bool) -> Reverse:
    """Find the slots of each source.

    Args:
        idx: The list, [m, capacity] int32; unused slots hold the number of sources.
        codes: The image code of each slot, or None if a pair has one image.
        images: The number of image codes.
        sources: The number of sources.
        mutual: Whether the list is its own mirror image.
        native: Whether Warp's kernels run where the list is.
    """
    if 0 in (*idx.shape, sources):
        none = jnp.zeros(sources, jnp.int32)
        return Reverse(jnp.zeros(idx.shape, jnp.int32)) if mutual else Reverse(jnp.zeros(idx.size, jnp.int32), none, none)
    if mutual:
        arrays = functools.partial(_reverse_by_comparing, images=images)
        if not native:
            return Reverse(arrays(idx, codes))
        on_cpu, on_cuda = (functools.partial(reverse_slots, images=images, cuda=cuda) for cuda in (False, True))
        return Reverse(on_platform(idx, codes, cpu=on_cpu, cuda=on_cuda))
    sort = functools.partial(_sort_slots, sources=sources)
    if not native:
        return Reverse(*sort(idx))
    return Reverse(*on_platform(idx, cpu=functools.partial(slots_by_source, sources=sources), cuda=sort))


def _reverse_by_comparing(idx: Array, codes: Array | None, images: int) -> Array:
    """Compare all ids of the rows of all neighbors, a block of rows at a time: capacity² comparisons per row."""
    n, capacity = idx.shape
    none = n * capacity
    rows = min(max(_BLOCK // capacity**2, 1), n)

    def find_block(b: Array, slots: Array) -> Array:
        first = jnp.minimum(b * rows, n - rows)
        here = lax.dynamic_slice_in_dim(idx, first, rows)
        neighbor = jnp.where(here < n, here, 0)
        same = idx[neighbor] == (first + lax.iota(jnp.int32, rows))[:, None, None]
        if codes is not None:
            opposite = images - 1 - lax.dynamic_slice_in_dim(codes, first, rows).astype(jnp.int32)
            same = same & (codes[neighbor].astype(jnp.int32) == opposite[..., None])
        place = jnp.min(jnp.where(same, lax.broadcasted_iota(jnp.int32, same.shape, 2), capacity), axis=2)
        found = jnp.where((here < n) & (place < capacity), neighbor * capacity + place, none)
        return lax.dynamic_update_slice_in_dim(slots, found, first, axis=0)

    return lax.fori_loop(0, -(-n // rows), find_block, jnp.full(idx.shape, none, jnp.int32))


def _sort_slots(idx: Array, sources: int) -> tuple[Array, Array, Array]:
    """Sort the slots by source; those of one source stay in order."""
    flat = idx.reshape(-1)
    by_source, slots = lax.sort((flat.astype(jnp.uint32), lax.iota(jnp.int32, flat.size)), num_keys=1, is_stable=True)
    lengths = jnp.zeros(sources, jnp.int32).at[flat].add(1, mode="drop")
    starts = jnp.cumsum(lengths, dtype=jnp.int32) - lengths
    return jnp.where(by_source < sources, slots, flat.size), starts, lengths
