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


def sums_along(counts: Array, cumulate: bool) -> Array:
    """Return the cumulative sums of rows [b, w], w being a multiple of 8: within groups of 8, then over the groups.

    With `cumulate`, by cumulative sums, which XLA's CPU compiler makes chains of kernels; otherwise by sums of products. A barrier
    keeps XLA's GPU compiler from adding up all words anew for each word.
    """

    def sums(x: Array) -> Array:
        if cumulate:
            return lax.cumsum(x, axis=x.ndim - 1)
        return jnp.sum(x[..., None, :] * np.tril(np.ones((x.shape[-1], x.shape[-1]), np.int32)), axis=-1, dtype=jnp.int32)

    rows, width = counts.shape
    within = lax.optimization_barrier(sums(counts.reshape(rows, width // _GROUP, _GROUP)))
    until = lax.optimization_barrier(sums(within[:, :, -1]))
    return (within + (until - within[:, :, -1])[:, :, None]).reshape(rows, width)


class BitRows(NamedTuple):
    """Rows of words [b, w], prepared so that their set bits can be found one by one.

    Attributes:
        until: [b, w] int32, the number of set bits in the words of a row up to each word.
        before: [b, w] int32, the number of those before it, and in its lower half the word itself: one gather reads both.
        by_bisection: Whether the word of a bit is found by bisection, which takes less time where gathers are cheap and is less to
            compile; otherwise by looking at every word of the row, in a kernel of its own. Static.
    """

    until: Array
    before: Array
    by_bisection: bool

    @classmethod
    def of(cls, words: Array, by_bisection: bool) -> "BitRows":
        """Prepare words, of which only the lower half is used."""
        hits = words & np.uint32((1 << LANES) - 1)
        count = bit_counts(hits)
        until = lax.optimization_barrier(sums_along(count, by_bisection))
        before = lax.optimization_barrier(((until - count) << LANES) | hits.astype(jnp.int32))
        return cls(until, before, by_bisection)

    @property
    def total(self) -> Array:
        """The number of set bits of each row, [b] int32."""
        return self.until[:, -1]

    def nth(self, ordinal: Array) -> tuple[Array, Array]:
        """Find the ordinal-th set bit in each row: its bit [b, k] and its word, as a position in the words of all rows.

        Ordinals outside [0, total) give any valid word and bit, which callers mask.
        """
        width = self.until.shape[1]
        begin = width * lax.broadcasted_iota(jnp.int32, ordinal.shape, 0)
        if self.by_bisection:
            word, last = begin, begin + (width - 1)
            for step in (1 << k for k in reversed(range((width - 1).bit_length()))):
                above = flat_take(self.until, lax.min(word + np.int32(step - 1), last)) > ordinal
                word = lax.select(above, word, word + np.int32(step))
            word = lax.min(word, last)
            found = flat_take(self.before, word)
        else:
            word = lax.optimization_barrier(begin + _count_not_above(self.until[:, :-1], ordinal))
            found = lax.optimization_barrier(flat_take(self.before, word))
        return word, _nth_bit(found & np.int32((1 << LANES) - 1), ordinal - (found >> LANES))


def _count_not_above(ascending: Array, value: Array) -> Array:
    """Count the entries of each row [b, w] that are <= value [b, k]."""
    columns = (lax.slice_in_dim(ascending, i, i + 1, axis=1) for i in range(ascending.shape[1]))
    reached = ((column <= value).astype(jnp.int32) for column in columns)
    return functools.reduce(jnp.add, reached, jnp.zeros_like(value))


def _nth_bit(word: Array, ordinal: Array) -> Array:
    """Return the position of the ordinal-th set bit of 16, by bisection; both int32."""
    position, one = jnp.zeros_like(ordinal), np.int32(1)
    for width in (8, 4, 2, 1):
        beyond = position + np.int32(width)
        below = lax.population_count(word & ((one << beyond) - one))
        position = lax.select(below > ordinal, position, beyond)
    return position
