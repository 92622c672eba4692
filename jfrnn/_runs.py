"""The engine: from runs of candidates to rows of neighbors, in blocks of queries, with bounded scratch memory.

A run is a contiguous range of sorted sources. Runs are cut into words of 16 candidates; one bit per candidate says whether it is a
neighbor. A block holds `queries x words` words at a time, at most `_BLOCK_WORDS`, each of which takes a few tens of bytes: the
scratch of a block stays below 64 MB whatever n, and nothing per candidate is ever stored.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._exact import Cutoff, flat_take, refine, squared_distance

LANES = 16  # candidates per word: hits in its lower half, doubtful ones in its upper half
_BLOCK_WORDS = 1 << 16
_BLOCK_SLOTS = 1 << 22  # 16 MB of rows
_SLOT_GROUP = 128  # slots of a row that are filled at a time
_DOUBTFUL = 32  # doubtful candidates per row that one round of the exact test takes

Runs = Callable[[Array], tuple[Array, Array]]  # places of queries [b] -> first places and ends of their runs [b, r]


class Points(NamedTuple):
    """Particles in the order in which the engine walks them: d coordinate arrays [n], and the id of each [n] int32."""

    axes: list[Array]
    ids: Array


class Filter(NamedTuple):
    """Which candidates may be neighbors apart from their distance; static."""

    drop_self: bool
    later_only: bool


def count_neighbors(sources: Points, queries: Points, runs: Runs, cutoff: Cutoff, keep: Filter) -> Array:
    """Count the neighbors of every query: [m] int32, in the order of the queries' ids."""
    engine = _Engine(_padded(sources), queries, runs, cutoff, keep, capacity=1)

    def count_block(b: Array, out: Array) -> Array:
        place, ids = engine.block(b)

        def add_chunk(state: tuple[Array, Array]) -> tuple[Array, Array]:
            chunk, count = state
            return chunk + 1, count + _bit_counts(engine.hit_words(place, table, chunk)[0]).sum(1, dtype=jnp.int32)

        table = engine.word_table(place)
        start = (jnp.int32(0), jnp.zeros(place.shape, jnp.int32))
        _, count = lax.while_loop(lambda state: state[0] * engine.words < table.longest, add_chunk, start)
        return out.at[ids].set(count)

    return lax.fori_loop(0, engine.block_count, count_block, jnp.zeros(queries.ids.shape, jnp.int32))


def list_neighbors(
    sources: Points, queries: Points, runs: Runs, cutoff: Cutoff, keep: Filter, capacity: int
) -> tuple[Array, Array]:
    """List the neighbors of every query: [m, capacity] int32 source indices, unused slots n, and [m] int32 true counts."""
    engine = _Engine(_padded(sources), queries, runs, cutoff, keep, capacity)
    group = min(_SLOT_GROUP, capacity)
    slots = lax.iota(jnp.int32, group)

    def list_block(b: Array, out: tuple[Array, Array]) -> tuple[Array, Array]:
        place, ids = engine.block(b)
        table = engine.word_table(place)

        def add_chunk(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            chunk, rows, count = state
            hits, first = engine.hit_words(place, table, chunk)
            total = _bit_counts(hits).sum(1, dtype=jnp.int32)

            def add_group(state: tuple[Array, Array]) -> tuple[Array, Array]:
                g, rows = state
                start = jnp.minimum(g * group, capacity - group)
                ordinal = start + slots - count[:, None]
                word, bit = _nth_bits(hits, ordinal)
                neighbor = engine.sources.ids.at[_take(first, word) + bit].get(mode="promise_in_bounds")
                old = lax.dynamic_slice_in_dim(rows, start, group, axis=1)
                new = jnp.where((ordinal >= 0) & (ordinal < total[:, None]), neighbor, old)
                return g + 1, lax.dynamic_update_slice_in_dim(rows, new, start, axis=1)

            until = jnp.minimum(jnp.max(count + total), capacity)
            _, rows = lax.while_loop(lambda state: state[0] * group < until, add_group, (jnp.min(count) // group, rows))
            return chunk + 1, rows, count + total

        rows = jnp.full((place.size, capacity), sources.ids.size, jnp.int32)
        start = (jnp.int32(0), rows, jnp.zeros(place.shape, jnp.int32))
        _, rows, count = lax.while_loop(lambda state: state[0] * engine.words < table.longest, add_chunk, start)
        return out[0].at[ids].set(rows), out[1].at[ids].set(count)

    m = queries.ids.size
    start = (jnp.zeros((m, capacity), jnp.int32), jnp.zeros(m, jnp.int32))
    return lax.fori_loop(0, engine.block_count, list_block, start)


class _WordTable(NamedTuple):
    """How the runs of a block's queries are cut into words."""

    start: Array  # [b, r] first place of each run
    stop: Array  # [b, r] its end
    before: Array  # [b, r] words of the query's earlier runs
    longest: Array  # [] words of the query that has most


class _Engine(NamedTuple):
    sources: Points
    queries: Points
    runs: Runs
    cutoff: Cutoff
    keep: Filter
    capacity: int

    @property
    def words(self) -> int:
        """Words per query that are in work at a time: about what the 9 runs of 3D or the 3 runs of 2D need."""
        return 64 if len(self.sources.axes) == 3 else 16

    @property
    def block_size(self) -> int:
        return min(_BLOCK_WORDS // self.words, max(_BLOCK_SLOTS // self.capacity, 1), self.queries.ids.size)

    @property
    def block_count(self) -> int:
        return -(-self.queries.ids.size // self.block_size)

    def block(self, b: Array) -> tuple[Array, Array]:
        """Return the places and ids of block b's queries; the last block reaches back, to be as long as the others."""
        first = jnp.minimum(b * self.block_size, self.queries.ids.size - self.block_size)
        place = first + lax.iota(jnp.int32, self.block_size)
        return place, lax.dynamic_slice_in_dim(self.queries.ids, first, self.block_size)

    def word_table(self, place: Array) -> _WordTable:
        start, stop = self.runs(place)
        count = (stop - start + (LANES - 1)) // LANES
        total = jnp.cumsum(count, axis=1, dtype=jnp.int32)
        return _WordTable(start, stop, total - count, jnp.max(total[:, -1]))

    def hit_words(self, place: Array, table: _WordTable, chunk: Array) -> tuple[Array, Array]:
        """Test one chunk of words per query: [b, words] uint32 neighbor bits, and the place of each word's first candidate."""
        first, stop = self._locate_words(table, chunk)
        query = [x.at[place].get(mode="promise_in_bounds") for x in self.queries.axes]
        first, packed = lax.optimization_barrier((first, self._test(first, stop, query, place)))
        hits, doubtful = packed & np.uint32(0xFFFF), packed >> np.uint32(LANES)
        return lax.optimization_barrier(hits | self._decide_doubtful(doubtful, first, query)), first

    def _locate_words(self, table: _WordTable, chunk: Array) -> tuple[Array, Array]:
        word = chunk * self.words + lax.iota(jnp.int32, self.words)
        first = jnp.zeros((table.start.shape[0], self.words), jnp.int32)
        stop = jnp.zeros_like(first)
        for r in range(table.start.shape[1]):
            before = table.before[:, r, None]
            reached = word >= before
            first = jnp.where(reached, table.start[:, r, None] + LANES * (word - before), first)
            stop = jnp.where(reached, table.stop[:, r, None], stop)
        return jnp.minimum(first, self.sources.ids.size - LANES), stop

    def _test(self, first: Array, stop: Array, query: list[Array], place: Array) -> Array:
        """Compare 16 candidates per word with the cutoff in working precision: hits low, doubtful ones high."""
        lane = lax.iota(jnp.int32, LANES)
        candidate = first[..., None] + lane
        allowed = candidate < stop[..., None]
        if self.keep.later_only:
            own = self.queries.ids.at[place].get(mode="promise_in_bounds") + int(self.keep.drop_self)
            allowed &= _windows(self.sources.ids, first) >= own[:, None, None]
        elif self.keep.drop_self:
            allowed &= candidate != place[:, None, None]
        difference = [_windows(x, first) - q[:, None, None] for x, q in zip(self.sources.axes, query, strict=True)]
        square = squared_distance(difference, self.cutoff)
        surely = square < self.cutoff.inside
        doubtful = (square <= self.cutoff.outside) & ~surely
        bit = np.uint32(1) << lane.astype(jnp.uint32)
        value = jnp.where(surely, bit, np.uint32(0)) | jnp.where(doubtful, bit << np.uint32(LANES), np.uint32(0))
        return lax.reduce(jnp.where(allowed, value, np.uint32(0)), np.uint32(0), lax.bitwise_or, (2,))

    def _decide_doubtful(self, doubtful: Array, first: Array, query: list[Array]) -> Array:
        """Decide the doubtful candidates of each row exactly, 32 a round: [b, words] uint32 bits of those that are pairs."""
        slots = lax.iota(jnp.int32, _DOUBTFUL)
        until = jnp.cumsum(_bit_counts(doubtful), axis=1, dtype=jnp.int32)
        before, total = until - _bit_counts(doubtful), until[:, -1]
        most = jnp.max(total)

        def decide_round(state: tuple[Array, Array]) -> tuple[Array, Array]:
            done, hits = state
            word, bit = _nth_bits(doubtful, jnp.broadcast_to(slots + done, (first.shape[0], _DOUBTFUL)))
            candidate = _take(first, word) + bit

            def points(at: Array | None, candidate: Array = candidate) -> tuple[list[Array], list[Array]]:
                rows = jnp.broadcast_to(lax.iota(jnp.int32, first.shape[0])[:, None], candidate.shape)
                if at is not None:
                    rows, candidate = flat_take(rows, at), flat_take(candidate, at)
                return [q[rows] for q in query], [x.at[candidate].get(mode="clip") for x in self.sources.axes]

            pair = refine(slots + done < total[:, None], points, self.cutoff)
            verdict = jnp.sum(jnp.where(pair, np.uint32(1) << slots.astype(jnp.uint32), np.uint32(0)), 1, dtype=jnp.uint32)
            return done + _DOUBTFUL, hits | _deposit(verdict[:, None], doubtful, before - done)

        start = (jnp.int32(0), jnp.zeros_like(doubtful))
        return lax.while_loop(lambda state: state[0] < most, decide_round, start)[1]


def _padded(sources: Points) -> Points:
    """Lengthen the sources so that a window of 16 never reaches past the end; masks keep the padding out."""
    return Points([jnp.pad(x, (0, LANES)) for x in sources.axes], jnp.pad(sources.ids, (0, LANES)))


def _windows(x: Array, first: Array) -> Array:
    """Gather x[first : first + 16] for every word: contiguous slices, several times faster than element by element."""
    dimensions = lax.GatherDimensionNumbers(offset_dims=(2,), collapsed_slice_dims=(), start_index_map=(0,))
    return lax.gather(x, first[..., None], dimensions, (LANES,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def _bit_counts(words: Array) -> Array:
    return lax.population_count(words).astype(jnp.int32)


def _take(rows: Array, column: Array) -> Array:
    """Return rows[i, column[i, k]] for [b, w] rows and [b, k] columns."""
    flat = lax.broadcasted_iota(jnp.int32, column.shape, 0) * rows.shape[1] + column
    return rows.reshape(-1).at[flat].get(mode="promise_in_bounds")


def _nth_bits(words: Array, ordinal: Array) -> tuple[Array, Array]:
    """Find the ordinal-th set bit of each row of words: its word and bit [b, k].

    Ordinals outside [0, total) give some valid word and bit: the caller masks them.
    """
    count = _bit_counts(words)
    count, until = lax.optimization_barrier((count, jnp.cumsum(count, axis=1, dtype=jnp.int32)))
    word = jnp.minimum(_count_not_above(until, ordinal), words.shape[1] - 1)
    within = ordinal - (_take(until, word) - _take(count, word))
    return word, _nth_bit(_take(words, word), within)


def _count_not_above(ascending: Array, value: Array) -> Array:
    """Count the entries of each row [b, w] that are <= value [b, k]; half the time of a binary search up to w = 128."""
    reached = ((ascending[:, i : i + 1] <= value).astype(jnp.int32) for i in range(ascending.shape[1]))
    return functools.reduce(jnp.add, reached)


def _nth_bit(word: Array, ordinal: Array) -> Array:
    """Return the position of the ordinal-th set bit of 16, by halving."""
    position = jnp.zeros_like(ordinal)
    for width in (8, 4, 2, 1):
        below = _bit_counts((word >> position.astype(jnp.uint32)) & np.uint32((1 << width) - 1))
        skip = ordinal >= below
        ordinal = jnp.where(skip, ordinal - below, ordinal)
        position = jnp.where(skip, position + width, position)
    return position


def _deposit(verdict: Array, mask: Array, before: Array) -> Array:
    """Spread verdict bits over the set bits of each mask: set bit k of a word takes verdict bit before + k, if below 32."""
    result = jnp.zeros_like(mask)
    for lane in range(LANES):
        ordinal = before + _bit_counts(mask & np.uint32((1 << lane) - 1))
        seen = (ordinal >= 0) & (ordinal < _DOUBTFUL)
        bit = (verdict >> jnp.clip(ordinal, 0, _DOUBTFUL - 1).astype(jnp.uint32)) & (mask >> np.uint32(lane)) & np.uint32(1)
        result = result | jnp.where(seen, bit << np.uint32(lane), np.uint32(0))
    return result
