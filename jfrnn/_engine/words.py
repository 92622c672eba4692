"""Words of 16 candidates, one bit per candidate: gather their sources, find their set bits, and set them."""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

LANES = 16  # candidates per word: in a uint32 hits take the lower half, doubtful candidates the upper half
VERDICTS = 32  # bits of a verdict


def windows(x: Array, first: Array) -> Array:
    """Gather x[first : first + 16] for every word, as contiguous slices, which is several times faster than by element."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
    return lax.gather(x, first[..., None], dimensions, (LANES,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def bit_counts(words: Array) -> Array:
    return lax.population_count(words).astype(jnp.int32)


def take(rows: Array, column: Array) -> Array:
    """Return rows[i, column[i, k]] for rows [b, w] and columns [b, k]."""
    flat = lax.broadcasted_iota(jnp.int32, column.shape, 0) * rows.shape[1] + column
    return rows.reshape(-1).at[flat].get(mode="promise_in_bounds")


def nth_bits(words: Array, ordinal: Array) -> tuple[Array, Array]:
    """Find the ordinal-th set bit in each row of words: its word and bit [b, k].

    Ordinals outside [0, total) give any valid word and bit, which callers mask.
    """
    count = bit_counts(words)
    count, until = lax.optimization_barrier((count, jnp.cumsum(count, axis=1, dtype=jnp.int32)))
    word = jnp.minimum(_count_not_above(until, ordinal), words.shape[1] - 1)
    within = ordinal - (take(until, word) - take(count, word))
    return word, _nth_bit(take(words, word), within)


def _count_not_above(ascending: Array, value: Array) -> Array:
    """Count the entries of each row [b, w] that are <= value [b, k], in half the time of a binary search up to w = 128."""
    reached = ((ascending[:, i : i + 1] <= value).astype(jnp.int32) for i in range(ascending.shape[1]))
    return functools.reduce(jnp.add, reached)


def _nth_bit(word: Array, ordinal: Array) -> Array:
    """Return the position of the ordinal-th set bit of 16, by bisection."""
    position = jnp.zeros_like(ordinal)
    for width in (8, 4, 2, 1):
        below = bit_counts((word >> position.astype(jnp.uint32)) & np.uint32((1 << width) - 1))
        skip = ordinal >= below
        ordinal = jnp.where(skip, ordinal - below, ordinal)
        position = jnp.where(skip, position + width, position)
    return position


def deposit(verdict: Array, mask: Array, before: Array) -> Array:
    """Distribute verdict bits to the set bits of each mask: set bit k of a word gets verdict bit before + k if that is below 32."""
    result = jnp.zeros_like(mask)
    for lane in range(LANES):
        ordinal = before + bit_counts(mask & np.uint32((1 << lane) - 1))
        seen = (ordinal >= 0) & (ordinal < VERDICTS)
        bit = (verdict >> jnp.clip(ordinal, 0, VERDICTS - 1).astype(jnp.uint32)) & (mask >> np.uint32(lane)) & np.uint32(1)
        result = result | jnp.where(seen, bit << np.uint32(lane), np.uint32(0))
    return result
