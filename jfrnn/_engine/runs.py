"""From runs of candidates to rows of neighbors, by array programming in blocks of queries, with bounded scratch memory.

A run is a contiguous range of sorted sources. Runs are divided into words of 16 candidates, with one bit per candidate that says
whether it is a neighbor. A block has at most `_BLOCK_WORDS` words at a time, of a few tens of bytes each. So the scratch memory of
a block stays below 64 MB for any n, and nothing is stored per candidate.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.candidates import Candidates, Points, Torus
from jfrnn._engine.problem import Filter
from jfrnn._engine.words import LANES, VERDICTS, bit_counts, deposit, nth_bits, take, windows
from jfrnn._geometry import Cutoff, Cutoffs, Pair, flat_take, refine, shift_in_given, squared_distance, step_one_bounds

_BLOCK_WORDS = 1 << 16
_BLOCK_SLOTS = 1 << 22  # 16 MB of rows
_SLOT_GROUP = 128  # slots per row that are filled at a time
_FEW_RUNS = 32
_MANY_RUNS = 4096
FOLD_GROUP = 32  # neighbors per query that are folded at a time

State = TypeVar("State")
Carry = Any  # the state of a loop over pairs


def count_neighbors(candidates: Candidates, cutoff: Cutoff | Cutoffs, keep: Filter) -> Array:
    """Count the neighbors of every query: [m] int32, in the order of the queries' ids."""
    engine = _Engine(candidates._replace(sources=_pad(candidates.sources)), cutoff, keep, capacity=1)
    queries = candidates.queries

    def count_block(b: Array, out: Array) -> Array:
        place, ids = engine.block(b)

        def add(words: _HitWords, count: Array) -> Array:
            return count + bit_counts(words.hits).sum(1, dtype=jnp.int32)

        return out.at[ids].set(engine.fold_words(place, add, jnp.zeros(place.shape, jnp.int32)))

    return lax.fori_loop(0, engine.block_count, count_block, jnp.zeros(queries.ids.shape, jnp.int32))


def list_neighbors(candidates: Candidates, cutoff: Cutoff | Cutoffs, keep: Filter, capacity: int) -> tuple[Array, Array]:
    """List the neighbors of every query: [m, capacity] int32 source indices, unused slots n, and [m] int32 true counts.

    If images must be told apart, n times the image code is added to the source index; unused slots are n·images.
    """
    sources, queries, torus = candidates.sources, candidates.queries, candidates.torus
    engine = _Engine(candidates._replace(sources=_pad(sources)), cutoff, keep, capacity)
    n, images = sources.ids.size, 1 if torus is None or torus.images.nearest else torus.images.total
    group = min(_SLOT_GROUP, capacity)
    slots = lax.iota(jnp.int32, group)

    def list_block(b: Array, out: tuple[Array, Array]) -> tuple[Array, Array]:
        place, ids = engine.block(b)

        def add(words: _HitWords, found: tuple[Array, Array]) -> tuple[Array, Array]:
            (rows, count), (hits, first, image) = found, words
            total = bit_counts(hits).sum(1, dtype=jnp.int32)

            def add_group(state: tuple[Array, Array]) -> tuple[Array, Array]:
                g, rows = state
                start = jnp.minimum(g * group, capacity - group)
                ordinal = (start + slots)[None] - count[:, None]
                word, bit = nth_bits(hits, ordinal)
                neighbor = engine.sources.ids.at[take(first, word) + bit].get(mode="promise_in_bounds")
                if image is not None and images > 1:
                    neighbor = neighbor + n * take(image, word)
                old = lax.dynamic_slice_in_dim(rows, start, group, axis=1)
                new = jnp.where((ordinal >= 0) & (ordinal < total[:, None]), neighbor, old)
                return g + 1, lax.dynamic_update_slice_in_dim(rows, new, start, axis=1)

            until = jnp.minimum(jnp.max(count + total), capacity)
            _, rows = lax.while_loop(lambda state: state[0] * group < until, add_group, (jnp.min(count) // group, rows))
            return rows, count + total

        rows = jnp.full((place.size, capacity), n * images, jnp.int32)
        rows, count = engine.fold_words(place, add, (rows, jnp.zeros(place.shape, jnp.int32)))
        return out[0].at[ids].set(rows), out[1].at[ids].set(count)

    m = queries.ids.size
    start = (jnp.zeros((m, capacity), jnp.int32), jnp.zeros(m, jnp.int32))
    return lax.fori_loop(0, engine.block_count, list_block, start)


class Slots(NamedTuple):
    """Some neighbors of each query of a block.

    Attributes:
        source: [b, g] int32 source indices, valid everywhere.
        shift: [b, g, d] whole floats, the lattice shifts; None in open space.
        real: [b, g] bool, whether the slot holds a pair.
    """

    source: Array
    shift: Array | None
    real: Array


class Block(NamedTuple):
    """Queries that are processed together.

    Attributes:
        query: [b] int32, their indices.
        fresh: [b] bool, False for queries that an earlier block has processed; these have no pairs here.
        fold: (add, state) -> state; calls add(slots, state) -> state until all neighbors of all queries were visited.
    """

    query: Array
    fresh: Array
    fold: Callable[[Callable[[Slots, Any], Any], Any], Any]


Visit = Callable[[Block, State], State]


def fold_neighbors(
    candidates: Candidates, cutoff: Cutoff | Cutoffs, keep: Filter, elements: int, visit: Visit[State], out: State
) -> State:
    """Visit the neighbors of all queries without listing them: out = visit(block, out) for one block after the other.

    `elements` is the number of scalars per pair that a visitor needs; blocks are chosen such that 16 MB of float32 hold them.
    """
    engine = _Engine(candidates._replace(sources=_pad(candidates.sources)), cutoff, keep, FOLD_GROUP * elements)
    slots, torus = lax.iota(jnp.int32, FOLD_GROUP), candidates.torus

    def fold_block(b: Array, out: State) -> State:
        place, ids = engine.block(b)
        fresh = place >= b * engine.block_size

        def fold(add: Callable[[Slots, Carry], Carry], state: Carry) -> Carry:
            def add_words(words: _HitWords, state: Carry) -> Carry:
                hits, first, image = words
                total = jnp.where(fresh, bit_counts(hits).sum(1, dtype=jnp.int32), 0)

                def add_group(state: tuple[Array, Any]) -> tuple[Array, Any]:
                    done, state = state
                    ordinal = jnp.broadcast_to(done + slots, (place.size, slots.size))
                    word, bit = nth_bits(hits, ordinal)
                    source = engine.sources.ids.at[take(first, word) + bit].get(mode="promise_in_bounds")
                    shift = None
                    if torus is not None and image is not None:
                        shift = _shifts_of(torus, ids[:, None], source, take(image, word))
                    return done + FOLD_GROUP, add(Slots(source, shift, ordinal < total[:, None]), state)

                most = jnp.max(total)
                return lax.while_loop(lambda state: state[0] < most, add_group, (jnp.int32(0), state))[1]

            return engine.fold_words(place, add_words, state)

        return visit(Block(ids, fresh, fold), out)

    return lax.fori_loop(0, engine.block_count, fold_block, out)


def _shifts_of(torus: Torus, query: Array, source: Array, image: Array) -> Array:
    """Return the lattice shifts [..., d], whole floats, of pairs of queries and images of sources."""
    turns, query_turns = torus.turns
    return jnp.asarray(torus.images.shifts).astype(turns.dtype)[image] + query_turns[query] - turns[source]


class _WordTable(NamedTuple):
    """How the runs of a block's queries are divided into words."""

    start: Array  # [b, r] start of each run
    stop: Array  # [b, r] its end
    image: Array | None  # [b, r] its image code
    before: Array  # [b, r] number of words in the query's earlier runs
    longest: Array  # [] largest number of words of a query


class _HitWords(NamedTuple):
    """The neighbors in a chunk of candidates: one bit per candidate, [b, words] each."""

    hits: Array
    first: Array  # position of each word's first candidate
    image: Array | None  # image code


class _Engine(NamedTuple):
    candidates: Candidates
    cutoff: Cutoff | Cutoffs
    keep: Filter
    capacity: int

    @property
    def sources(self) -> Points:
        return self.candidates.sources

    @property
    def queries(self) -> Points:
        return self.candidates.queries

    @property
    def words(self) -> int:
        """Words per query that are processed at a time: about as many as the 9 runs of 3D or the 3 runs of 2D need."""
        return 64 if len(self.sources.axes) == 3 else 16

    @property
    def block_size(self) -> int:
        torus = self.candidates.torus
        runs = 1 if torus is None or torus.images.nearest else torus.images.total  # every query has at least so many
        return min(_BLOCK_WORDS // self.words, max(_BLOCK_SLOTS // max(self.capacity, runs), 1), self.queries.ids.size)

    @property
    def block_count(self) -> int:
        return -(-self.queries.ids.size // self.block_size)

    def block(self, b: Array) -> tuple[Array, Array]:
        """Return positions and ids of block b's queries; the last block overlaps, so that all have one length."""
        first = jnp.minimum(b * self.block_size, self.queries.ids.size - self.block_size)
        place = first + lax.iota(jnp.int32, self.block_size)
        return place, lax.dynamic_slice_in_dim(self.queries.ids, first, self.block_size)

    def fold_words(self, place: Array, add: Callable[["_HitWords", State], State], state: State) -> State:
        """Return the state after state = add(words, state) for each chunk of candidates of the queries at these positions."""

        def add_pass(which: Array, state: State) -> State:
            table = self.word_table(place, which)

            def add_chunk(carried: tuple[Array, State]) -> tuple[Array, State]:
                chunk, state = carried
                state = add(self.hit_words(place, table, chunk), state)
                return chunk + 1, state

            return lax.while_loop(lambda carried: carried[0] * self.words < table.longest, add_chunk, (jnp.int32(0), state))[1]

        passes = self.candidates.passes
        return add_pass(jnp.int32(0), state) if passes is None else lax.fori_loop(0, passes, add_pass, state)

    def word_table(self, place: Array, which: Array) -> _WordTable:
        start, stop, image = self.candidates.runs(place, which)
        count = (stop - start + (LANES - 1)) // LANES
        total = jnp.cumsum(count, axis=1, dtype=jnp.int32)
        return _WordTable(start, stop, image, total - count, jnp.max(total[:, -1]))

    def hit_words(self, place: Array, table: _WordTable, chunk: Array) -> _HitWords:
        """Test one chunk of words per query."""
        first, stop, image = self._locate_words(table, chunk)
        query = [x.at[place].get(mode="promise_in_bounds")[:, None] for x in self.queries.axes]
        if image is not None and self.candidates.torus is not None:  # translate the query instead of the image
            query = [q - t[image] for q, t in zip(query, self.candidates.torus.translations.T, strict=True)]
        first, image, packed = lax.optimization_barrier((first, image, self._test(first, stop, image, query, place)))
        hits, doubtful = packed & np.uint32(0xFFFF), packed >> np.uint32(LANES)
        hits = lax.optimization_barrier(hits | self._decide_doubtful(doubtful, first, image, place))
        return _HitWords(hits, first, image)

    def _locate_words(self, table: _WordTable, chunk: Array) -> tuple[Array, Array, Array | None]:
        word = jnp.broadcast_to(chunk * self.words + lax.iota(jnp.int32, self.words), (table.start.shape[0], self.words))
        runs = table.start.shape[1]
        if runs > _FEW_RUNS:  # many images
            if runs > _MANY_RUNS:
                run = jax.vmap(functools.partial(jnp.searchsorted, side="right"))(table.before, word).astype(jnp.int32) - 1
            else:
                run = jnp.sum(word[..., None] >= table.before[:, None], axis=2, dtype=jnp.int32) - 1
            first = take(table.start, run) + LANES * (word - take(table.before, run))
            stop, image = take(table.stop, run), None if table.image is None else take(table.image, run)
        else:  # a chain of selections takes half the time of a lookup
            first, stop = jnp.zeros_like(word), jnp.zeros_like(word)
            image = None if table.image is None else jnp.zeros_like(word)
            for r in range(runs):
                before = table.before[:, r, None]
                reached = word >= before
                first = jnp.where(reached, table.start[:, r, None] + LANES * (word - before), first)
                stop = jnp.where(reached, table.stop[:, r, None], stop)
                if image is not None and table.image is not None:
                    image = jnp.where(reached, table.image[:, r, None], image)
        return jnp.minimum(first, self.sources.ids.size - LANES), stop, image

    def _test(self, first: Array, stop: Array, image: Array | None, query: list[Array], place: Array) -> Array:
        """Compare 16 candidates per word with the cutoff in working precision: low half hits, high half doubtful ones."""
        lane = lax.iota(jnp.int32, LANES)
        candidate = first[..., None] + lane[None, None]
        allowed = (candidate < stop[..., None]) & self._passes_filter(first, candidate, image, place)
        difference = [windows(x, first) - q[..., None] for x, q in zip(self.sources.axes, query, strict=True)]
        square = squared_distance(difference, self.cutoff)
        own, others = self.queries.radii, self.sources.radii
        own = None if own is None else own.at[place].get(mode="promise_in_bounds")[:, None, None]
        inside, outside = self._bounds(own, None if others is None else windows(others, first))
        surely = square < inside
        doubtful = (square <= outside) & ~surely
        bit = np.uint32(1) << lane.astype(jnp.uint32)
        value = jnp.where(surely, bit, np.uint32(0)) | jnp.where(doubtful, bit << np.uint32(LANES), np.uint32(0))
        return lax.reduce(jnp.where(allowed, value, np.uint32(0)), np.uint32(0), lax.bitwise_or, (2,))

    def _bounds(self, own: Array | None, others: Array | None) -> tuple[np.floating | Array, np.floating | Array]:
        torus = self.candidates.torus
        slack = None if torus is None else torus.slack
        radii = self.cutoff.of_pairs(own, others) if isinstance(self.cutoff, Cutoffs) else None
        return step_one_bounds(self.cutoff, radii, slack)

    def _passes_filter(self, first: Array, candidate: Array, image: Array | None, place: Array) -> Array:
        """Say which candidates [b, words, 16] pass the filter, whatever their distance."""
        if self.keep.later_only:
            own = self.queries.ids.at[place].get(mode="promise_in_bounds")[:, None]
            later = own + int(self.keep.drop_self)
            if image is not None and self.candidates.torus is not None:  # of its own images, keep the forward half
                home = self.candidates.torus.images.home
                later = jnp.where(image > home, own, jnp.where(image < home, own + 1, later))
            return windows(self.sources.ids, first) >= later[..., None]
        if not self.keep.drop_self:
            return jnp.ones((), bool)
        others = candidate != place[:, None, None]
        if image is None or self.candidates.torus is None:
            return others
        return others | (image != self.candidates.torus.images.home)[..., None]

    def _decide_doubtful(self, doubtful: Array, first: Array, image: Array | None, place: Array) -> Array:
        """Decide the doubtful candidates of each row exactly, 32 per round: bits of those that are pairs, [b, words] uint32."""
        slots = lax.iota(jnp.int32, VERDICTS)
        until = jnp.cumsum(bit_counts(doubtful), axis=1, dtype=jnp.int32)
        before, total = until - bit_counts(doubtful), until[:, -1]
        most = jnp.max(total)

        def decide_round(state: tuple[Array, Array]) -> tuple[Array, Array]:
            done, hits = state
            word, bit = nth_bits(doubtful, jnp.broadcast_to(slots + done, (first.shape[0], VERDICTS)))
            candidate = take(first, word) + bit

            def points(at: Array | None, word: Array = word, candidate: Array = candidate) -> Pair:
                rows = jnp.broadcast_to(lax.iota(jnp.int32, first.shape[0])[:, None], candidate.shape)
                if at is not None:
                    rows, word, candidate = flat_take(rows, at), flat_take(word, at), flat_take(candidate, at)
                return self._pair(place[rows], candidate, None if image is None else image[rows, word])

            pair = refine((slots + done)[None] < total[:, None], points, self.cutoff)
            verdict = jnp.sum(jnp.where(pair, np.uint32(1) << slots.astype(jnp.uint32), np.uint32(0)), 1, dtype=jnp.uint32)
            return done + VERDICTS, hits | deposit(verdict[:, None], doubtful, before - done)

        start = (jnp.int32(0), jnp.zeros_like(doubtful))
        return lax.while_loop(lambda state: state[0] < most, decide_round, start)[1]

    def _pair(self, place: Array, candidate: Array, image: Array | None) -> Pair:
        """Return the given (not wrapped) points of queries and candidates at these positions."""
        torus, radii = self.candidates.torus, None
        if isinstance(self.cutoff, Cutoffs):
            own, others = self.queries.radii, self.sources.radii
            own = None if own is None else own.at[place].get(mode="clip")
            radii = self.cutoff.of_pairs(own, None if others is None else others.at[candidate].get(mode="clip"))
        if torus is None or image is None:
            return Pair(
                [x.at[place].get(mode="clip") for x in self.queries.axes],
                [x.at[candidate].get(mode="clip") for x in self.sources.axes],
                radii,
            )
        i, j = self.queries.ids.at[place].get(mode="clip"), self.sources.ids.at[candidate].get(mode="clip")
        axes = range(len(self.sources.axes))
        (sources, queries), shifts = torus.raw, _shifts_of(torus, i, j, image)
        shift = [shifts[..., k] for k in axes]
        raw = [queries[i, k] for k in axes], [sources[j, k] for k in axes]
        return Pair(*raw, radii, *shift_in_given(shift, torus.images.basis, torus.matrix), torus.images.orthogonal)


def _pad(sources: Points) -> Points:
    """Pad the sources so that a window of 16 never reaches past the end; masks exclude the padding."""
    radii = None if sources.radii is None else jnp.pad(sources.radii, (0, LANES))
    return Points([jnp.pad(x, (0, LANES)) for x in sources.axes], jnp.pad(sources.ids, (0, LANES)), radii)
