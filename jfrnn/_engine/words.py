"""Words of 16 candidates, one bit per candidate: gather their sources and find their set bits."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import flat_take

LANES = 16  # candidates per word: in a uint32 hits take the lower half, doubtful candidates the upper half
HITS = np.uint32((1 << LANES) - 1)  # the lower half
CHUNK = 64 * LANES  # most candidates per query that are tested at a time on a CPU
_GROUP = 8  # words whose counts are bytes of two integers
_FEW = 12  # entries that are compared one by one
_BYTES = np.uint32(0x01010101)
_TOPS = np.uint32(0x80808080)


class Lanes(NamedTuple):
    """The 16 candidates of each word, as an axis of arrays that are compared with the cutoff.

    On a CPU words are [b, w] and lanes their last axis: a word is read as one contiguous slice, faster than one by one.
    Elsewhere words are [w, b] and lanes the axis between: each thread tests all 16, and threads next to it test much the same
    candidates for other queries of a cell.

    Attributes:
        first: [b, w] or [w, b] int32, the position of each word's first candidate.
        image: The image code of its run, or None.
        queries_last: Whether words are [w, b]. Static.
    """

    first: Array
    image: Array | None
    queries_last: bool

    @property
    def numbers(self) -> np.ndarray:
        """The numbers of the lanes, int32, along their axis."""
        return np.arange(LANES, dtype=np.int32).reshape((1, -1, 1) if self.queries_last else (1, 1, -1))

    @property
    def places(self) -> Array:
        """The position of each candidate."""
        return self.of_words(self.first) + self.numbers

    def of_words(self, x: Array) -> Array:
        """Return values of words for all their lanes."""
        return x[:, None] if self.queries_last else x[..., None]

    def of_queries(self, x: Array) -> Array:
        """Return values [b] of queries for all their candidates."""
        return x[None, None] if self.queries_last else x[:, None, None]

    def read(self, x: Array) -> Array:
        """Gather the values of the candidates."""
        if self.queries_last:
            return flat_take(x, self.places)
        dimensions = lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
        return lax.gather(x, self.first[..., None], dimensions, (LANES,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def join_lanes(value: Array, queries_last: bool) -> Array:
    """Join uint32 values of all lanes ([b, w, 16] or [w, 16, b]) by `or`, each shifted by the number of its lane: [b, w]."""
    shift = np.arange(LANES, dtype=np.uint32).reshape((1, -1, 1) if queries_last else (1, 1, -1))
    words = lax.reduce(value << shift, np.uint32(0), lax.bitwise_or, (1 if queries_last else 2,))
    return lax.optimization_barrier(words).T if queries_last else words  # a kernel of its own compiles in less time


def bit_counts(words: Array) -> Array:
    return lax.population_count(words).astype(jnp.int32)


class BitRows(NamedTuple):
    """Rows of words [b, w], prepared so that their set bits can be found one by one.

    Words form groups of eight. The number of set bits in a group up to each of its words is a byte, at most 128.

    Attributes:
        hits: [b, w] uint32, the words; where numbers are gathered, the upper half is any.
        earlier: [b, g] int32, the number of set bits in earlier groups of the row.
        until: [b, g, 2] uint32, the bytes of a group's words 0 to 3, and of its words 4 to 7.
        by_gathers: Whether a group's numbers are gathered, or chosen by looking at every group of the row. Static.
    """

    hits: Array
    earlier: Array
    until: Array
    by_gathers: bool

    @classmethod
    def of(cls, words: Array, by_gathers: bool) -> "BitRows":
        """Prepare words, of which only the lower half is used; on a CPU, the upper half has to be empty."""
        rows, width = words.shape
        hits = words & HITS if by_gathers else words
        groups = -(-width // _GROUP)
        counts = jnp.pad(lax.population_count(hits), ((0, 0), (0, groups * _GROUP - width))).reshape(rows, groups, 1, _GROUP)
        until = lax.optimization_barrier(jnp.sum(counts * _until_bytes(), axis=3, dtype=jnp.uint32))
        in_group = (until[:, :, 1] >> np.uint32(24)).astype(jnp.int32)
        before = np.tril(np.ones((groups, groups), np.int32), -1)
        if by_gathers:  # over the middle axis: each thread adds up a number of its own
            earlier = jnp.sum(in_group[:, :, None] * before.T[None], axis=1, dtype=jnp.int32)
        else:
            earlier = jnp.sum(in_group[:, None] * before[None], axis=2, dtype=jnp.int32)
        return cls(words, lax.optimization_barrier(earlier), until, by_gathers)

    @property
    def total(self) -> Array:
        """The number of set bits of each row, [b] int32."""
        return self.earlier[:, -1] + (self.until[:, -1, 1] >> np.uint32(24)).astype(jnp.int32)

    def nth(self, ordinal: Array) -> tuple[Array, Array]:
        """Find the ordinal-th set bit in each row: its word, as a position in the words of all rows, and its bit [b, k].

        Ordinals outside [0, total) give any valid word and bit, which callers mask.
        """
        group, earlier, low, high = self._group_of(ordinal)
        within = (ordinal - earlier).astype(jnp.uint32) & np.uint32(0xFF)
        asked = within * _BYTES | _TOPS  # no byte borrows from the next, as counts are at most 128
        reached = ((asked - low) >> np.uint32(7) & _BYTES) + ((asked - high) >> np.uint32(7) & _BYTES)
        word = lax.min(reached * _BYTES >> np.uint32(24), np.uint32(_GROUP - 1))
        before = jnp.where(word < 4, low << np.uint32(8), high << np.uint32(8) | low >> np.uint32(24))
        within = within - (before >> (word % 4 * 8) & np.uint32(0xFF))
        width = self.hits.shape[1]
        word = lax.min(group * _GROUP + word.astype(jnp.int32), np.int32(width - 1))
        word = word + lax.broadcasted_iota(jnp.int32, ordinal.shape, 0) * width
        if self.by_gathers:
            return word, nth_bit(flat_take(self.hits, word) & HITS, within)
        word, within = lax.optimization_barrier((word, within))  # kernels without gathers are vectorized
        found = lax.optimization_barrier(flat_take(self.hits, word))
        return word, lax.optimization_barrier(nth_bit(found, within))

    def nth_apart(self, ordinal: Array, needed: Array) -> tuple[Array, Array]:
        """Return `nth` if it is needed, [] bool. XLA fuses nothing into a branch: several kernels read what one has found."""
        none = jnp.zeros_like(ordinal)
        return lax.cond(needed, lambda: self.nth(ordinal), lambda: (none, none))

    def _group_of(self, ordinal: Array) -> tuple[Array, Array, Array, Array]:
        """Return the group in which a bit is, the number of bits in earlier ones, and the bytes of the group."""
        if self.by_gathers:
            group = last_reached(self.earlier, ordinal)
            at = group + lax.broadcasted_iota(jnp.int32, ordinal.shape, 0) * self.earlier.shape[1]
            return group, flat_take(self.earlier, at), flat_take(self.until, 2 * at), flat_take(self.until, 2 * at + 1)
        columns = self.earlier, self.until[:, :, 0], self.until[:, :, 1]
        group, (earlier, low, high) = jnp.zeros_like(ordinal), (_column(x, 0, ordinal.shape) for x in columns)
        for k in range(1, self.earlier.shape[1]):
            new = [_column(x, k, ordinal.shape) for x in columns]
            reached = new[0] <= ordinal
            group = group + reached.astype(jnp.int32)
            earlier, low, high = (lax.select(reached, x, y) for x, y in zip(new, (earlier, low, high), strict=True))
        return group, earlier, low, high


def _column(x: Array, k: int, shape: tuple[int, ...]) -> Array:
    return jnp.broadcast_to(x[:, k : k + 1], shape)


def last_reached(ascending: Array, value: Array) -> Array:
    """Return the last place in each ascending row [b, w] whose entry is <= value [b, k], or 0, by few comparisons or a search.

    Entries are gathered: a reduction over a row would take XLA's autotuner for GPUs seconds, and slices kernels of their own.
    """
    last = ascending.shape[1] - 1
    row, place = lax.broadcasted_iota(jnp.int32, value.shape, 0) * (last + 1), jnp.zeros_like(value)
    if last < _FEW:
        return sum(((flat_take(ascending, row + k) <= value).astype(jnp.int32) for k in range(1, last + 1)), place)
    for bit in reversed(range(last.bit_length())):  # binary searches
        further = lax.min(place + np.int32(1 << bit), np.int32(last))
        place = lax.select(flat_take(ascending, row + further) <= value, further, place)
    return place


def _until_bytes() -> np.ndarray:
    """Return factors [1, 1, 2, 8] that turn the counts of eight words into bytes of cumulative counts."""
    place = np.arange(_GROUP)
    reached = (place[:, None] >= place).astype(np.uint32) << (place[:, None] % 4 * 8).astype(np.uint32)
    return reached.reshape(2, 4, _GROUP).sum(1, dtype=np.uint32)[None, None]


def nth_bit(word: Array, ordinal: Array) -> Array:
    """Return the position of the ordinal-th set bit of 16, by bisection of counts: int32; both are uint32."""
    pairs = word - (word >> np.uint32(1) & np.uint32(0x5555))
    fours = (pairs & np.uint32(0x3333)) + (pairs >> np.uint32(2) & np.uint32(0x3333))
    position = jnp.zeros_like(word)
    for counts, width in ((fours + (fours >> np.uint32(4)), 8), (fours, 4), (pairs, 2), (word, 1)):
        below = counts >> position & np.uint32(2 * width - 1)
        skip = ordinal >= below
        ordinal = jnp.where(skip, ordinal - below, ordinal)
        position = jnp.where(skip, position + np.uint32(width), position)
    return position.astype(jnp.int32)
