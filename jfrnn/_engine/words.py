"""Words of 16 candidates, one bit per candidate: gather their sources and find their set bits."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import flat_take

LANES = 16  # candidates per word: in a uint32 hits take the lower half, doubtful candidates the upper half
_GROUP = 8  # words whose counts are added up together


def windows(x: Array, first: Array) -> Array:
    """Gather x[first : first + 16] for every word, as contiguous slices, which is several times faster than by element."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
    return lax.gather(x, first[..., None], dimensions, (LANES,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def bit_counts(words: Array) -> Array:
    return lax.population_count(words).astype(jnp.int32)


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
        """Find the ordinal-th set bit in each row: its word, as a position in the words of all rows, and its bit [b, k].

        Ordinals outside [0, total) give any valid word and bit, which callers mask.
        """
        width = self.until.shape[1]
        begin = lax.broadcasted_iota(jnp.int32, ordinal.shape, 0) * width
        if self.in_groups:
            heads = self.until[:, _GROUP - 1 :: _GROUP][:, : (width - 1) // _GROUP]
            word, last = begin + _count_not_above(heads, ordinal) * _GROUP, begin + (width - 1)
            until = (flat_take(self.until, lax.min(word + k, last)) for k in range(_GROUP - 1))
            inside = ((x <= ordinal).astype(jnp.int32) for x in until)
            word = lax.min(functools.reduce(jnp.add, inside, word), last)
            found = flat_take(self.before, word)
        else:
            word = lax.optimization_barrier(begin + _count_not_above(self.until[:, : width - 1], ordinal))
            found = lax.optimization_barrier(flat_take(self.before, word))
        return word, _nth_bit(found & np.int32((1 << LANES) - 1), ordinal - (found >> LANES))


def _count_not_above(ascending: Array, value: Array) -> Array:
    """Count the entries of each row [b, w] that are <= value [b, k]."""
    columns = (lax.slice_in_dim(ascending, i, i + 1, axis=1) for i in range(ascending.shape[1]))
    reached = ((column <= value).astype(jnp.int32) for column in columns)
    return functools.reduce(jnp.add, reached, jnp.zeros_like(value))


def _nth_bit(word: Array, ordinal: Array) -> Array:
    """Return the position of the ordinal-th set bit of 16, by bisection; both int32."""
    position = jnp.zeros_like(ordinal)
    for width in (8, 4, 2, 1):
        below = lax.population_count((word >> position) & np.int32((1 << width) - 1))
        skip = ordinal >= below
        ordinal = lax.select(skip, ordinal - below, ordinal)
        position = lax.select(skip, position + np.int32(width), position)
    return position
