"""Words of 16 candidates, one bit per candidate: gather their sources and find their set bits."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

LANES = 16  # candidates per word: in a uint32 hits take the lower half, doubtful candidates the upper half
_GROUP = 8  # words whose counts are added up together


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


def sums_along(counts: Array, in_groups: bool) -> Array:
    """Return the cumulative sums of rows [b, w], w being a multiple of 8. `in_groups` as in `BitRows`."""
    if in_groups:
        return jnp.cumsum(counts, axis=1, dtype=jnp.int32)
    rows, width = counts.shape  # within groups of 8, then over the groups: XLA's CPU compiler makes chains of cumulative sums
    groups = counts.reshape(rows, width // _GROUP, _GROUP)
    within = jnp.sum(groups[:, :, None, :] * np.tril(np.ones((_GROUP, _GROUP), np.int32)), axis=3, dtype=jnp.int32)
    earlier = np.tril(np.ones((width // _GROUP, width // _GROUP), np.int32), -1)
    before = jnp.sum(within[:, None, :, -1] * earlier, axis=2, dtype=jnp.int32)
    return (within + before[:, :, None]).reshape(rows, width)


class BitRows(NamedTuple):
    """Rows of words [b, w], prepared so that their set bits can be found one by one.

    Attributes:
        until: [b, w] int32, the number of set bits in the words of a row up to each word.
        before: [b, w] int32, the number of those before it, and in its lower half the word itself: one gather reads both.
        in_groups: Whether groups of words are looked at before words, in one kernel, which takes less time where gathers are cheap;
            otherwise every word of the row, in a kernel of its own. Static.
    """

    until: Array
    before: Array
    in_groups: bool

    @classmethod
    def of(cls, words: Array, in_groups: bool) -> "BitRows":
        """Prepare words, of which only the lower half is used."""
        hits = words & np.uint32((1 << LANES) - 1)
        count = bit_counts(hits)
        until = lax.optimization_barrier(sums_along(count, in_groups))
        before = lax.optimization_barrier(((until - count) << LANES) | hits.astype(jnp.int32))
        return cls(until, before, in_groups)

    @property
    def total(self) -> Array:
        """The number of set bits of each row, [b] int32."""
        return self.until[:, -1]

    def nth(self, ordinal: Array) -> tuple[Array, Array]:
        """Find the ordinal-th set bit in each row: its word and bit [b, k].

        Ordinals outside [0, total) give any valid word and bit, which callers mask.
        """
        last = self.until.shape[1] - 1
        if self.in_groups:
            heads = self.until[:, _GROUP - 1 :: _GROUP][:, : last // _GROUP]
            word = _count_not_above(heads, ordinal) * _GROUP
            inside = [(take(self.until, jnp.minimum(word + k, last)) <= ordinal).astype(jnp.int32) for k in range(_GROUP - 1)]
            word = jnp.minimum(functools.reduce(jnp.add, inside, word), last)
            found = take(self.before, word)
        else:
            word = lax.optimization_barrier(_count_not_above(self.until[:, :last], ordinal))
            found = lax.optimization_barrier(take(self.before, word))
        return word, _nth_bit(found.astype(jnp.uint32) & np.uint32((1 << LANES) - 1), ordinal - (found >> LANES))


def _count_not_above(ascending: Array, value: Array) -> Array:
    """Count the entries of each row [b, w] that are <= value [b, k]."""
    reached = ((ascending[:, i : i + 1] <= value).astype(jnp.int32) for i in range(ascending.shape[1]))
    return functools.reduce(jnp.add, reached, jnp.zeros_like(value))


def _nth_bit(word: Array, ordinal: Array) -> Array:
    """Return the position of the ordinal-th set bit of 16, by bisection."""
    position = jnp.zeros_like(ordinal)
    for width in (8, 4, 2, 1):
        below = bit_counts((word >> position.astype(jnp.uint32)) & np.uint32((1 << width) - 1))
        skip = ordinal >= below
        ordinal = jnp.where(skip, ordinal - below, ordinal)
        position = jnp.where(skip, position + width, position)
    return position
