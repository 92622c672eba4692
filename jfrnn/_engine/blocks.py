"""The test of candidates in blocks of queries: words of 16 candidates, of which each has a bit that says whether it is a neighbor.

Runs, the contiguous ranges of sorted sources around a query, are divided into such words. A block has a bounded number of words and
slots (`jfrnn._engine.tuning`), so its scratch memory is bounded for any n, and nothing is stored per candidate.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.candidates import NOWHERE, Candidates, Excluded, Points, Span, Torus
from jfrnn._engine.problem import Filter
from jfrnn._engine.tuning import SLOT_BYTES, WORD_BYTES, Tuning
from jfrnn._engine.words import CHUNK, HITS, LANES, BitRows, Lanes, bit_counts, join_lanes, last_reached, nth_bit
from jfrnn._geometry import (
    Cutoff,
    Cutoffs,
    Pair,
    decide_in_integers,
    decide_in_units,
    decide_pairs,
    flat_take,
    shift_in_given,
    squared_distance,
    step_one_bounds,
    take_points,
)
from jfrnn._tracing import largest_of

_FEW_RUNS = 32
_AT_A_TIME = 1 << 10  # words of which one candidate each is decided by wide integers
_SLOTS = 32  # doubtful candidates of a row that are decided at a time
_MOST_WORDS = 256  # per query, that are tested at a time; (words << 16) has to be an int32

State = TypeVar("State")


def shifts_of(torus: Torus, query: Array, source: Array, image: Array) -> Array:
    """Return the lattice shifts [..., d], whole floats, of pairs of queries and images of sources."""
    turns, query_turns = torus.turns
    return jnp.asarray(torus.images.shifts).astype(turns.dtype)[image] + query_turns[query] - turns[source]


class _WordTable(NamedTuple):
    """How the runs of a block's queries are divided into words."""

    start: Array  # [b, r] start of each run
    stop: Array  # [b, r] its end
    image: Array | None  # [b, r] its image code
    before: Array | None  # [b, r] number of words in the query's earlier runs, if these are looked up
    total: Array  # [b] number of words of each query
    most: int | None  # that no query exceeds, if it is known

    @property
    def longest(self) -> Array | int:
        """The largest number of words of a query, []."""
        return self.most or largest_of(self.total)


def _words_of(start: Array, stop: Array) -> Array:
    return (stop - start + (LANES - 1)) >> (LANES.bit_length() - 1)


class HitWords(NamedTuple):
    """The neighbors in a chunk of candidates: one bit per candidate, [b, words] each."""

    hits: Array  # in the lower half
    first: Array | None  # position of each word's first candidate; None if the words of each row hold all sources in their order
    image: Array | None  # image code

    def places(self, word: Array, bit: Array) -> Array:
        """Return the positions of candidates [b, k], by the positions of their words among those of all rows and their bits."""
        if self.first is not None:
            return flat_take(self.first, word) + bit
        return LANES * lax.rem(word.astype(jnp.uint32), np.uint32(self.hits.shape[1])).astype(jnp.int32) + bit


Add = Callable[[HitWords, State], State]


def is_at_once(candidates: Candidates, tuning: Tuning) -> bool:
    """Say whether blocks are processed without loops where that is enough: doubts are rare in open space alone."""
    return candidates.queries.ids.size <= tuning.at_once and candidates.torus is None and candidates.passes is None


def _decided(bit: Array, pair: Array) -> Array:
    """Return what is added to a word so that this bit is doubtful no longer, and a hit if it is a pair."""
    one = np.uint32(1) << bit.astype(jnp.uint32)
    return jnp.where(pair, one, np.uint32(0)) - (one << np.uint32(LANES))


def _lanes_before(end: Array) -> Array:
    """Return the bits of the candidates of a word before a number, which may lie before or behind all of them; uint32."""
    one = np.uint32(1)
    return (one << jnp.clip(end, 0, LANES).astype(jnp.uint32)) - one


class BlockSearch(NamedTuple):
    """Tests the candidates of queries, block by block."""

    candidates: Candidates
    cutoff: Cutoff | Cutoffs
    keep: Filter
    tuning: Tuning
    slots: int  # scalars per query that a block holds
    capacity: int | None  # expected number of neighbors per query

    @property
    def sources(self) -> Points:
        return self.candidates.sources

    @property
    def queries(self) -> Points:
        return self.candidates.queries

    @property
    def images(self) -> int:
        """The number of images that rows tell apart."""
        torus = self.candidates.torus
        return 1 if torus is None or torus.images.nearest else torus.images.total

    @property
    def words(self) -> int:
        """Words per query that are processed at a time."""
        words = self.candidates.words(self.capacity)
        if self.tuning.by_gathers:
            return min(words, _MOST_WORDS)
        return min(-(-words // 8) * 8, CHUNK // LANES)

    @property
    def reads_all(self) -> bool:
        """Whether a chunk holds all sources in their order: no runs, words or places have to be looked up."""
        return self.candidates.whole and self.candidates.size <= LANES * self.words

    @property
    def block_count(self) -> int:
        """Number of blocks, whose words and slots fit into the scratch memory."""
        torus = self.candidates.torus
        several = torus is not None and not (torus.images.nearest or torus.images.per_system)
        runs = torus.images.total if torus is not None and several else 1  # every query has at least so many
        words = max(self.words, runs)
        most = min(self.tuning.words // words, self.tuning.scratch // (words * WORD_BYTES + self.slots * SLOT_BYTES))
        return -(-self.queries.ids.size // max(most, 1))

    @property
    def block_size(self) -> int:
        """Number of queries in a block."""
        return -(-self.queries.ids.size // self.block_count)

    def block(self, b: Array | int) -> Span:
        """Return the positions of block b's queries; the last block overlaps, so that all have one length."""
        if self.block_count == 1:
            return Span(0, self.block_size)
        return Span(jnp.minimum(b * self.block_size, self.queries.ids.size - self.block_size), self.block_size)

    @property
    def used_blocks(self) -> Array | int:
        """Number of blocks whose queries have candidates."""
        active = self.candidates.active
        return self.block_count if active is None else -(-active // self.block_size)

    def fresh(self, b: Array | int, span: Span) -> Array:
        """Say which queries of block b no earlier block has, [b] bool."""
        return span.places >= b * self.block_size

    def map_blocks(self, of_block: Callable[[Span, list[Array]], list[Array]], state: list[Array]) -> list[Array]:
        """Return of_block(span, rows), int32 arrays with a row per query, for all queries in the order of their indices.

        `rows` are what `state` has of these queries. Where all candidates are met at once, its rows are alike.
        """
        ids, several = self.queries.ids, self.candidates.active is not None
        alike = [jnp.broadcast_to(x[:1], (self.block_size, *x.shape[1:])) for x in state]

        def rows_of(state: list[Array], here: Array) -> list[Array]:
            return [x.at[here].get(mode="promise_in_bounds") for x in state] if several else alike

        if self.block_count == 1:
            rows = of_block(self.block(0), rows_of(state, ids))
            if self.candidates.in_order:
                return rows
            place = jnp.zeros_like(ids).at[ids].set(lax.iota(jnp.int32, ids.size), unique_indices=True)
            return [x.at[place].get(mode="promise_in_bounds") for x in rows]

        def put(b: Array, out: list[Array]) -> list[Array]:
            span = self.block(b)
            here = span.of(ids)
            found = of_block(span, rows_of(out, here))
            if several:  # what two blocks have is added once
                here = jnp.where(self.fresh(b, span), here, ids.size + lax.iota(jnp.int32, span.size))
            return [x.at[here].set(rows, mode="drop", unique_indices=True) for x, rows in zip(out, found, strict=True)]

        return lax.fori_loop(0, self.used_blocks, put, state)

    def fold_words(self, span: Span, add: "Add[State]", state: State, few: tuple["Add[State]", int] | None = None) -> State:
        """Return the state after state = add(words, state) for each chunk of candidates of the queries at these positions.

        `few` holds a function that does the same for so many neighbors of each query at most. Where all sources are candidates,
        lists and counts have one loop, that of doubtful candidates; without a second way, their programs compile in less time.
        """
        most = self.candidates.most_words
        if is_at_once(self.candidates, self.tuning) and (most is None or (few is not None and most <= self.words)):
            return self._fold_at_once(span, add, state, few)

        def add_pass(which: Array, state: State) -> State:
            return self._fold_table(span, add, self.word_table(span, which), state)

        passes = self.candidates.passes
        passes = passes(span) if callable(passes) else passes
        return add_pass(jnp.int32(0), state) if passes is None else lax.fori_loop(0, passes, add_pass, state)

    def _fold_at_once(self, span: Span, add: "Add[State]", state: State, few: tuple["Add[State]", int] | None) -> State:
        """Fold the first chunk of candidates without a loop; where that is not all, or leaves doubts, go on with loops."""
        table = self.word_table(span, jnp.int32(0))
        packed, first, image = self._test_words(span, [span.of(x) for x in self.queries.axes], table, jnp.int32(0))
        packed, rest, most = self._decide_first(packed, first, image, span)
        if table.most is None:
            rest = rest | (table.total > self.words)
        add_few = add
        if few is not None:
            add_few, room = few
            rest = rest | (most > room)
        words = HitWords(packed, first, image)
        return lax.cond(
            largest_of(rest.astype(jnp.int32)) > 0,
            lambda state: self._fold_rest(span, add, table, words, state),
            lambda state: add_few(words, state),
            state,
        )

    def _fold_rest(self, span: Span, add: "Add[State]", table: _WordTable, words: HitWords, state: State) -> State:
        """Fold the first chunk of candidates, which is tested, but has doubts, and all others."""
        query = [span.of(x) for x in self.queries.axes]

        def add_tested(words: HitWords, state: State) -> State:
            packed, first, image = words
            return add(HitWords(self._decide_rest(*words, span, largest_of(packed) > HITS), first, image), state)

        if table.most is not None and table.most <= self.words:
            return add_tested(words, state)
        longest = table.longest

        def add_next(now: tuple[Array, Array, HitWords, State]) -> tuple[Array, Array, HitWords, State]:
            _, chunk, words, state = now
            state, chunk = add_tested(words, state), chunk + 1
            more = chunk * self.words < longest
            return more, chunk, lax.cond(more, lambda: HitWords(*self._test_words(span, query, table, chunk)), lambda: words), state

        return lax.while_loop(lambda now: now[0], add_next, (jnp.asarray(longest > 0), jnp.int32(0), words, state))[3]

    def _fold_table(self, span: Span, add: "Add[State]", table: _WordTable, state: State) -> State:
        query = [span.of(x) for x in self.queries.axes]

        def add_chunk(chunk: Array, state: State) -> State:
            own, runs, chunk = lax.optimization_barrier((query, table, chunk))  # XLA would take small parts out of the loop
            return add(self.hit_words(span, own, runs, chunk), state)

        def add_next(now: tuple[Array, Array, State]) -> tuple[Array, Array, State]:
            _, chunk, state = now
            return (chunk + 1) * self.words < longest, chunk + 1, add_chunk(chunk, state)

        if table.most is not None and table.most <= self.words:
            return add(self.hit_words(span, query, table, jnp.int32(0)), state)
        longest = table.longest
        return lax.while_loop(lambda now: now[0], add_next, (jnp.asarray(longest > 0), jnp.int32(0), state))[2]

    def word_table(self, span: Span, which: Array) -> _WordTable:
        if self.reads_all:  # there is nothing to look up
            none = jnp.zeros((span.size, 0), jnp.int32)
            return _WordTable(none, none, None, None, jnp.zeros(span.size, jnp.int32), self.candidates.most_words)
        start, stop, image = self.candidates.runs(span, which)
        count, runs = _words_of(start, stop), start.shape[1]
        total, before = jnp.sum(count, axis=1, dtype=jnp.int32), None
        if runs > _FEW_RUNS:
            before = jnp.cumsum(count, axis=1, dtype=jnp.int32) - count
        elif self.tuning.by_gathers:  # of a short row, sums of gathered numbers take less time than a reduction
            row, run = (lax.broadcasted_iota(jnp.int32, count.shape, k) for k in (0, 1))
            gathered = [flat_take(count, row * runs + k) for k in range(runs)]
            before = sum((jnp.where(run > k, x, 0) for k, x in enumerate(gathered[:-1])), jnp.zeros_like(count))
            total = before[:, -1] + count[:, -1]
        return _WordTable(start, stop, image, before, total, self.candidates.most_words)

    def hit_words(self, span: Span, own: list[Array], table: _WordTable, chunk: Array) -> HitWords:
        """Test one chunk of words per query; `own` are the d coordinates [b] of the queries."""
        packed, first, image = self._test_words(span, own, table, chunk)
        if not self.tuning.by_gathers:
            return HitWords(self._decide_by_rounds(packed, first, image, span), first, image)
        if self.reads_all:  # of few sources, all ties are decided without a loop
            packed = self._decide_in_rows(packed, first, image, span)
            more = largest_of(packed) > HITS
        else:
            packed, left, _ = self._decide_first(packed, first, image, span)
            more = largest_of(left.astype(jnp.int32)) > 0
        return HitWords(self._decide_rest(packed, first, image, span, more, in_rows=not self.reads_all), first, image)

    def ids_of(self, words: HitWords, word: Array, bit: Array) -> Array:
        """Return the sources that bits stand for; those of unset bits are any."""
        place = words.places(word, bit)
        return lax.min(place, np.int32(self.candidates.size - 1)) if words.first is None else flat_take(self.sources.ids, place)

    def _test_words(
        self, span: Span, own: list[Array], table: _WordTable, chunk: Array
    ) -> tuple[Array, Array | None, Array | None]:
        """Return a chunk of words with hits and doubtful candidates, the positions of their first candidates, and their images."""
        allowed = HITS
        if self.reads_all:
            packed, first, image = self._test_all(own, span), None, None
        elif self.tuning.by_gathers:
            first, stop, image = self._locate_words(table, chunk)
            lanes = Lanes(first.T, None if image is None else image.T, queries_last=True)
            packed, allowed = self._test(lanes, own, span, stop.T), _lanes_before(stop - first)
        else:
            first, allowed, image = self._locate_apart(span, table, chunk)
            packed = self._test(Lanes(first, image, queries_last=False), own, span) & (allowed | allowed << np.uint32(LANES))
        if isinstance(self.cutoff, Cutoffs) and self.cutoff.itself:
            itself = self._own_lanes(self._first_of_all(span) if first is None else first, image, span) & allowed
            packed = packed & ~(itself << np.uint32(LANES)) | itself  # whatever its cutoff
        if self.candidates.excluded is not None:
            begin = self._first_of_all(span) if first is None else first
            allowed = ~self._excluded_lanes(self.candidates.excluded, begin, image, span) & HITS
            packed = packed & (allowed | allowed << np.uint32(LANES))
        if self.candidates.most_words is None:  # else the words are known before
            packed, first, image = lax.optimization_barrier((packed, first, image))
        return packed, first, image

    def _locate_apart(self, span: Span, table: _WordTable, chunk: Array) -> tuple[Array, Array, Array | None]:
        """Return the first candidates of words, which of their candidates are allowed, and their images, by a kernel of its own.

        XLA would else find them again for every word that it tests, one after the other. It fuses nothing into a branch.
        """

        def locate() -> tuple[Array, Array, Array | None]:
            first, stop, image = self._locate_words(table, chunk)
            return first, self._allowed_lanes(Lanes(first, image, queries_last=False), stop, span), image

        shape = table.start.shape[0], self.words
        none, image = jnp.zeros(shape, jnp.int32), table.image
        always = table.total[0] + chunk >= 0  # which XLA does not know
        return lax.cond(always, locate, lambda: (none, none.astype(jnp.uint32), None if image is None else none))

    def _locate_words(self, table: _WordTable, chunk: Array) -> tuple[Array, Array, Array | None]:
        """Return where words begin, where their runs end, and their images, [b, w] each."""
        rows, runs = table.start.shape
        word = jnp.broadcast_to(chunk * self.words + lax.iota(jnp.int32, self.words), (rows, self.words))
        if table.before is not None:
            run = last_reached(table.before, word) + runs * lax.broadcasted_iota(jnp.int32, word.shape, 0)
            first = flat_take(table.start, run) + LANES * (word - flat_take(table.before, run))
            stop, image = flat_take(table.stop, run), None if table.image is None else flat_take(table.image, run)
        else:  # a chain of selections takes half the time of a lookup on a CPU
            columns = [table.start, table.stop, *([] if table.image is None else [table.image])]
            found, before = [jnp.zeros_like(word) for _ in columns], jnp.zeros_like(table.start[:, :1])
            for start, stop, *others in zip(*(lax.split(x, [1] * runs, axis=1) for x in columns), strict=True):
                of_run, reached = [start + LANES * (word - before), stop, *others], word >= before
                found = [lax.select(reached, jnp.broadcast_to(x, word.shape), y) for x, y in zip(of_run, found, strict=True)]
                before = before + _words_of(start, stop)
            first, stop, image = found if table.image is not None else (*found, None)
        return jnp.minimum(first, self.sources.ids.size - LANES), stop, image

    def _translations(self, torus: Torus, lanes: Lanes, span: Span) -> list[Array]:
        """Return the lattice translation of the images of queries, per axis, for each word."""
        if lanes.image is None:
            raise TypeError("the runs of a search in a lattice have images.")
        if not torus.images.per_system:
            return [t[lanes.image] for t in torus.translations.T]
        own, shifts = (
            jnp.expand_dims(span.of(torus.matrix), 2 if lanes.queries_last else 3),
            [x[lanes.image] for x in torus.translations.T],
        )
        if torus.images.orthogonal:
            return [shift * own[k, k] for k, shift in enumerate(shifts)]
        return [functools.reduce(jnp.add, (x * own[row, k] for row, x in enumerate(shifts))) for k in range(len(shifts))]

    def _test(self, lanes: Lanes, own: list[Array], span: Span, stop: Array | None = None) -> Array:
        """Compare 16 candidates per word with the cutoff in working precision: low half hits, high half doubtful ones.

        If it is said where the runs of words stop, only candidates count that belong to them and are not the query itself.
        """
        query, torus = [lanes.of_queries(x) for x in own], self.candidates.torus
        if torus is not None:  # translate the query instead of the image
            query = [q - lanes.of_words(t) for q, t in zip(query, self._translations(torus, lanes, span), strict=True)]
        square = squared_distance([lanes.read(x) - q for x, q in zip(self.sources.axes, query, strict=True)], self.cutoff)
        own_radii, radii = self.queries.radii, self.sources.radii
        own_radii = None if own_radii is None else lanes.of_queries(span.of(own_radii))
        slack = None if torus is None else torus.slack
        if torus is not None and torus.images.per_system:
            slack = lanes.of_queries(span.of(torus.slack))
        inside, outside = self._bounds(own_radii, None if radii is None else lanes.read(radii), slack)
        doubtful = jnp.where(square <= outside, np.uint32(1 << LANES), np.uint32(0))
        value = jnp.where(square < inside, np.uint32(1), doubtful)
        if self.keep.later_only:
            value = jnp.where(self._is_later(lanes, span), value, np.uint32(0))
        if self.queries.systems is not None and self.sources.systems is not None:
            same = lanes.read(self.sources.systems) == lanes.of_queries(span.of(self.queries.systems))
            value = jnp.where(same, value, np.uint32(0))
        if stop is not None:  # in the same kernel
            value = jnp.where(self._is_allowed(lanes, stop, span), value, np.uint32(0))
        return join_lanes(value, lanes.queries_last)

    def _test_all(self, own: list[Array], span: Span) -> Array:
        """Do what `_test` does for words of all sources; what stands behind the last one is no neighbor."""
        none, queries_last = np.uint32(0), self.tuning.by_gathers
        shape = (self.words, LANES, 1) if queries_last else (1, self.words, LANES)
        of_queries = (None, None) if queries_last else (slice(None), None, None)

        def read(x: Array) -> Array:
            return x[: self.words * LANES].reshape(shape)

        square = squared_distance([read(x) - q[of_queries] for x, q in zip(self.sources.axes, own, strict=True)], self.cutoff)
        radii, others = self.queries.radii, self.sources.radii
        radii = None if radii is None else span.of(radii)[of_queries]
        inside, outside = self._bounds(radii, None if others is None else read(others), None)
        near, doubtful = (x.astype(jnp.uint32) for x in (square < inside, square <= outside))
        value = near | (near ^ doubtful) << np.uint32(LANES)
        bits = join_lanes(value, queries_last)
        lane = span.places[:, None] - self._first_of_all(span)
        if self.keep.later_only:
            refused = (np.uint32(1) << jnp.clip(lane + int(self.keep.drop_self), 0, LANES).astype(jnp.uint32)) - np.uint32(1)
        elif self.keep.drop_self:
            refused = jnp.where(lane.astype(jnp.uint32) < LANES, np.uint32(1) << lane.astype(jnp.uint32), none)
        else:
            refused = none
        return bits & ~(refused | refused << np.uint32(LANES))

    def _first_of_all(self, span: Span) -> Array:
        """Return the first candidates of words of all sources."""
        return jnp.broadcast_to(LANES * lax.iota(jnp.int32, self.words), (span.size, self.words))

    def _bounds(
        self, own: Array | None, others: Array | None, slack: Array | None
    ) -> tuple[np.floating | Array, np.floating | Array]:
        radii = self.cutoff.of_pairs(own, others) if isinstance(self.cutoff, Cutoffs) else None
        return step_one_bounds(self.cutoff, radii, slack)

    def _is_allowed(self, lanes: Lanes, stop: Array, span: Span) -> Array:
        """Say which candidates belong to their run and are not the query itself."""
        allowed = lanes.places < lanes.of_words(stop)
        if not self.keep.drop_self or self.keep.later_only:
            return allowed
        own, again, torus = lanes.of_queries(self._own_places(span)), self.candidates.again, self.candidates.torus
        other = lanes.places != own if again is None else (lanes.places != own) & (lanes.places != own + again)
        if lanes.image is not None and torus is not None:
            other = other | lanes.of_words(lanes.image != torus.images.home)
        return allowed & other

    def _allowed_lanes(self, lanes: Lanes, stop: Array, span: Span) -> Array:
        """Return which of a word's 16 candidates belong to its run and are not the query itself: bits, [b, words] uint32."""
        torus, allowed = self.candidates.torus, _lanes_before(stop - lanes.first)
        if not self.keep.drop_self or self.keep.later_only:
            return allowed
        own = self._lanes_at(self._own_places(span), lanes.first)
        if lanes.image is not None and torus is not None:
            own = jnp.where(lanes.image == torus.images.home, own, np.uint32(0))
        return allowed & ~own

    def _own_lanes(self, first: Array, image: Array | None, span: Span) -> Array:
        """Return which of a word's 16 candidates is the query itself, if that is finite: bits, [b, words] uint32."""
        finite = functools.reduce(jnp.logical_and, (jnp.isfinite(span.of(x)) for x in self.queries.axes))
        own, torus = self._lanes_at(self._own_places(span), first), self.candidates.torus
        itself = jnp.where(finite[:, None], own, np.uint32(0))
        if image is None or torus is None:
            return itself
        return jnp.where(image == torus.images.home, itself, np.uint32(0))

    def _own_places(self, span: Span) -> Array:
        """Return where queries stand among the sources [b], NOWHERE if they do not."""
        return span.places if self.queries.places is None else span.of(self.queries.places)

    def _lanes_at(self, place: Array, first: Array) -> Array:
        """Return the candidates at a position [b] of each query: bits, [b, words] uint32."""
        again, lanes = self.candidates.again, jnp.zeros(first.shape, jnp.uint32)
        for where in (place,) if again is None else (place, place + again):
            lane = where[:, None] - first
            here = (lane >= 0) & (lane < LANES)
            bit = np.uint32(1) << jnp.clip(lane, 0, LANES).astype(jnp.uint32)
            lanes = lanes | jnp.where(here, bit, np.uint32(0))
        return lanes

    def _excluded_lanes(self, excluded: Excluded, first: Array, image: Array | None, span: Span) -> Array:
        """Return which candidates queries exclude: bits, [b, words] uint32. One pass for each place in the longest row."""
        own = span.of(self.queries.ids)
        begin, end = flat_take(excluded.starts, own), flat_take(excluded.starts, own + 1)

        def add(k: Array, lanes: Array) -> Array:
            at = jnp.minimum(begin + k, excluded.places.size - 1)
            found = self._lanes_at(jnp.where(begin + k < end, flat_take(excluded.places, at), NOWHERE), first)
            if excluded.codes is not None and image is not None:
                found = jnp.where(image == flat_take(excluded.codes, at)[:, None], found, np.uint32(0))
            return lanes | found

        return lax.fori_loop(0, largest_of(end - begin), add, jnp.zeros(first.shape, jnp.uint32))

    def _is_later(self, lanes: Lanes, span: Span) -> Array:
        """Say which candidates are the later ones of their pairs: of a query's own images, the forward half."""
        own, torus = lanes.of_queries(span.of(self.queries.ids)), self.candidates.torus
        later = own + int(self.keep.drop_self)
        if lanes.image is not None and torus is not None:
            image = lanes.of_words(lanes.image)
            later = jnp.where(image > torus.images.home, own, jnp.where(image < torus.images.home, own + 1, later))
        return lanes.read(self.sources.ids) >= later

    def _decide_first(self, packed: Array, first: Array | None, image: Array | None, span: Span) -> tuple[Array, Array, Array]:
        """Decide the first doubtful candidate of each row, where that takes no wide integers, without any loop.

        Returns the words, which rows [b] have doubtful candidates left, and how many neighbors each has at most. All are found by
        one reduction: of a single minimum, XLA's autotuner for GPUs compiles several variants.
        """
        one, (rows, width) = np.uint32(1), packed.shape
        place = jnp.where(packed > HITS, lax.broadcasted_iota(jnp.int32, packed.shape, 1), width)
        columns = place, bit_counts(packed >> np.uint32(LANES)), bit_counts(packed)
        start = np.int32(width), np.int32(0), np.int32(0)
        word, doubts, most = lax.reduce(columns, start, lambda a, b: (lax.min(a[0], b[0]), a[1] + b[1], a[2] + b[2]), (1,))
        at = lax.min(word, np.int32(width - 1)) + width * lax.iota(jnp.int32, rows)
        asked = flat_take(packed, at) >> np.uint32(LANES)
        bit = bit_counts((asked & (~asked + one)) - one) % LANES
        known, near = decide_in_units(self._pair_at(span.places, HitWords(packed, first, image), at, bit), self.cutoff)
        known = known & (asked > 0)
        at, change, left = lax.optimization_barrier(
            (at, jnp.where(known, _decided(bit, near), np.uint32(0)), doubts > known.astype(jnp.int32))
        )
        flat = packed.reshape(-1).at[at].add(change, indices_are_sorted=True, unique_indices=True, mode="promise_in_bounds")
        return flat.reshape(packed.shape), left, most

    def _decide_in_rows(self, packed: Array, first: Array | None, image: Array | None, span: Span) -> Array:
        """Decide by step 2 the first 32 doubtful candidates of each row, a thread each.

        A thread without one ends where its index turns out to lie beyond the words, before it computes a decision.
        """
        shape, doubtful = (len(packed), _SLOTS), packed >> np.uint32(LANES)
        bits = BitRows.of(doubtful, self.tuning.by_gathers)
        row, slot = (lax.broadcasted_iota(jnp.int32, shape, k) for k in (0, 1))
        word, bit = bits.nth(slot)
        known, near = decide_in_units(self._pair_at(span.first + row, HitWords(packed, first, image), word, bit), self.cutoff)
        change = jnp.where(known, _decided(bit, near), np.uint32(0))
        place = jnp.where(slot < bits.total[:, None], word, packed.size)
        return packed.reshape(-1).at[place].add(change, mode="drop").reshape(packed.shape)

    def _decide_rest(
        self, packed: Array, first: Array | None, image: Array | None, span: Span, more: Array, in_rows: bool = True
    ) -> Array:
        """Decide what is still doubtful, if more is, in a loop that rarely turns: by step 2 in rows, then by step 3 in words."""
        (width,), many = packed.shape[1:], min(_AT_A_TIME, packed.size)

        def decide_next(state: tuple[Array, Array]) -> tuple[Array, Array]:
            _, packed = lax.optimization_barrier(state)
            flat = (self._decide_in_rows(packed, first, image, span) if in_rows else packed).reshape(-1)
            start = jnp.minimum(lax.argmax(flat > HITS, 0, jnp.int32), flat.size - many)  # the first that is left
            here, word = lax.dynamic_slice_in_dim(flat, start, many), start + lax.iota(jnp.int32, many)
            doubtful = here >> np.uint32(LANES)
            bit, row = nth_bit(doubtful, jnp.zeros_like(doubtful)), lax.div(word, np.int32(width))
            pair = self._pair_at(span.first + row, HitWords(packed, first, image), word, bit)
            here = here + jnp.where(doubtful > 0, _decided(bit, decide_in_integers(pair, self.cutoff)), np.uint32(0))
            flat = lax.dynamic_update_slice_in_dim(flat, here, start, axis=0)
            return largest_of(flat) > HITS, flat.reshape(packed.shape)

        return lax.while_loop(lambda state: state[0], decide_next, (more, packed))[1]

    def _decide_by_rounds(self, packed: Array, first: Array | None, image: Array | None, span: Span) -> Array:
        """Decide doubtful candidates on a CPU: the first 32 of each row at a time."""
        rows = len(packed)

        def decide_round(state: tuple[Array, Array]) -> tuple[Array, Array]:
            # The barrier keeps what follows in the loop: it is not worth computing where no round is needed.
            more, packed = lax.optimization_barrier(state)
            bits = BitRows.of(packed >> np.uint32(LANES), self.tuning.by_gathers)
            slot = lax.broadcasted_iota(jnp.int32, (rows, _SLOTS), 1)
            word, bit = bits.nth_apart(slot, more)
            candidate = HitWords(packed, first, image).places(word, bit)

            def points(at: Array | None) -> Pair:
                row, source, of_word = lax.iota(jnp.int32, rows)[:, None], candidate, word
                if at is not None:
                    row, source, of_word = at // _SLOTS, flat_take(source, at), flat_take(of_word, at)
                return self._pair(span.first + row, source, None if image is None else flat_take(image, of_word))

            there = slot < bits.total[:, None]
            pair = decide_pairs(there, points, self.cutoff)
            place = jnp.where(there, word, packed.size)
            packed = packed.reshape(-1).at[place].add(_decided(bit, pair), mode="drop").reshape(packed.shape)
            return largest_of(bits.total) > _SLOTS, packed

        return lax.while_loop(lambda state: state[0], decide_round, (largest_of(packed) > HITS, packed))[1]

    def _pair_at(self, place: Array, words: HitWords, word: Array, bit: Array) -> Pair:
        """Return the points of queries at these positions and of the candidates that bits stand for."""
        return self._pair(place, words.places(word, bit), None if words.image is None else flat_take(words.image, word))

    def _pair(self, place: Array, candidate: Array, image: Array | None) -> Pair:
        """Return the given (not wrapped) points of queries and candidates at these positions."""
        torus, radii = self.candidates.torus, None
        if isinstance(self.cutoff, Cutoffs):
            own, others = self.queries.radii, self.sources.radii
            radii = self.cutoff.of_pairs(
                None if own is None else flat_take(own, place), None if others is None else flat_take(others, candidate)
            )
        if torus is None:  # these are the given points
            a, b = (jnp.stack([flat_take(x, k) for x in of.axes]) for of, k in ((self.queries, place), (self.sources, candidate)))
            return Pair(a, b, radii)
        i, j = flat_take(self.queries.ids, place), flat_take(self.sources.ids, candidate)
        sources, queries = self.candidates.given
        pair = Pair(take_points(queries, i), take_points(sources, j), radii)
        if image is None:
            return pair
        matrix = torus.matrix.at[..., place].get(mode="promise_in_bounds") if torus.images.per_system else torus.matrix
        shift = jnp.moveaxis(shifts_of(torus, i, j, image), -1, 0)
        matrix = matrix[len(shift) :] if torus.images.short else matrix
        shift, matrix = shift_in_given(shift, torus.images.basis, matrix)
        return pair._replace(shift=shift, matrix=matrix, orthogonal=torus.images.orthogonal)
