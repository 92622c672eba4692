"""From runs of candidates to rows of neighbors, by array programming in blocks of queries (`jfrnn._engine.blocks`)."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.blocks import BlockSearch, HitWords, State, is_at_once, shifts_of
from jfrnn._engine.candidates import Candidates, Span
from jfrnn._engine.problem import Filter, Room
from jfrnn._engine.tuning import Tuning
from jfrnn._engine.words import BitRows, bit_counts
from jfrnn._geometry import Cutoff, Cutoffs, flat_take
from jfrnn._tracing import largest_of

FOLD_GROUP = 32  # neighbors per query that are folded at a time

Carry = Any  # the state of a loop over pairs


def count_neighbors(
    candidates: Candidates, cutoff: Cutoff | Cutoffs, keep: Filter, tuning: Tuning, state: list[Array]
) -> list[Array]:
    """Add the neighbors of every query to a count: [m] int32, in the order of the queries' ids."""
    engine = BlockSearch(candidates, cutoff, keep, tuning, slots=1, capacity=None)

    def count_block(span: Span, rows: list[Array]) -> list[Array]:
        def add(words: HitWords, count: Array) -> Array:
            return count + bit_counts(words.hits).sum(1, dtype=jnp.int32)

        return [engine.fold_words(span, add, rows[0])]

    return engine.map_blocks(count_block, state)


def list_neighbors(
    candidates: Candidates, cutoff: Cutoff | Cutoffs, keep: Filter, capacity: int, tuning: Tuning, state: list[Array]
) -> list[Array]:
    """Add the neighbors of every query to rows and counts: [m, capacity] int32 source indices, and [m] int32 true counts.

    If images must be told apart, n times the image code is added to the source index.
    """
    engine = BlockSearch(candidates, cutoff, keep, tuning, slots=capacity, capacity=capacity)
    n, images = candidates.size, engine.images
    group = min(tuning.group, capacity)
    slots = lax.iota(jnp.int32, group)

    def list_block(span: Span, rows: list[Array]) -> list[Array]:
        def add(words: HitWords, found: tuple[Array, Array]) -> tuple[Array, Array]:
            (rows, count), (hits, _, image) = found, words
            bits = BitRows.of(hits, tuning.by_gathers)
            total = bits.total

            def find_group(start: Array | int) -> Array:
                """Return the neighbors for slots [start, start + group), and -1 for slots that this chunk does not fill."""
                ordinal = (start + slots)[None] - count[:, None]
                word, bit = bits.nth(ordinal)
                neighbor = engine.ids_of(words, word, bit)
                if image is not None and images > 1:
                    neighbor = neighbor + n * flat_take(image, word)
                return jnp.where((ordinal >= 0) & (ordinal < total[:, None]), neighbor, -1)

            def first_slot(g: Array) -> Array:
                return jnp.minimum(g * group, capacity - group)

            def keep_filled(rows: Array, found: Array) -> Array:
                return jnp.where(found < 0, rows, found)

            def put_group(rows: Array, start: Array, found: Array) -> Array:
                old = lax.dynamic_slice_in_dim(rows, start, group, axis=1)
                return lax.dynamic_update_slice_in_dim(rows, keep_filled(old, found), start, axis=1)

            def next_group(g: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
                # XLA divides no kernel among cores that writes into a part of an array: so one writes what the turn before found.
                return put_group(*state), first_slot(g), find_group(first_slot(g))

            if group == capacity and (tuning.by_gathers or words.first is None):
                return keep_filled(rows, find_group(0)), count + total
            start = np.int32(np.iinfo(np.int32).max), np.int32(0)
            begin, end = lax.reduce((count, count + total), start, lambda a, b: (lax.min(a[0], b[0]), lax.max(a[1], b[1])), (0,))
            begin = lax.div(begin, np.int32(group))
            until = lax.div(lax.min(end, np.int32(capacity)) + np.int32(group - 1), np.int32(group))
            if group == capacity:  # one turn of a loop, into which XLA does not fuse what has made the words
                rows = lax.fori_loop(begin, until, lambda g, rows: keep_filled(rows, find_group(first_slot(g))), rows)
            else:
                none = rows, jnp.int32(0), jnp.full((span.size, group), -1, jnp.int32)
                rows = put_group(*lax.fori_loop(begin, until, next_group, none))
            return rows, count + total

        return [*engine.fold_words(span, add, (rows[0], rows[1]))]

    return engine.map_blocks(list_block, state)


def fill_neighbors(
    candidates: Candidates, cutoff: Cutoff | Cutoffs, keep: Filter, room: Room, tuning: Tuning, state: list[Array]
) -> list[Array]:
    """Add the neighbors of every query to rows without gaps: [total] int32, as `list_neighbors` has them.

    The state holds these, and where the next neighbor of each query stands, [m] int32.
    """
    engine = BlockSearch(candidates, cutoff, keep, tuning, slots=FOLD_GROUP, capacity=None)
    n, images = candidates.size, engine.images
    slots = lax.iota(jnp.int32, FOLD_GROUP)

    def fill_block(b: Array, state: list[Array]) -> list[Array]:
        span, (out, places) = engine.block(b), state
        ids, fresh = span.of(engine.queries.ids), engine.fresh(b, span)
        begin, end = places[ids], room.starts[ids + 1]

        def add(words: HitWords, found: tuple[Array, Array]) -> tuple[Array, Array]:
            (out, at), (hits, _, image) = found, words
            bits = BitRows.of(hits, tuning.by_gathers)
            total = jnp.where(fresh, bits.total, 0)

            def add_group(state: tuple[Array, Array]) -> tuple[Array, Array]:
                done, out = state
                ordinal = jnp.broadcast_to(done + slots, (span.size, slots.size))
                word, bit = bits.nth(ordinal)
                neighbor = engine.ids_of(words, word, bit)
                if image is not None and images > 1:
                    neighbor = neighbor + n * flat_take(image, word)
                place = at[:, None] + ordinal
                there = (ordinal < total[:, None]) & (place < end[:, None])
                return done + FOLD_GROUP, out.at[jnp.where(there, place, room.total)].set(neighbor, mode="drop")

            most = largest_of(total)
            return lax.while_loop(lambda state: state[0] < most, add_group, (jnp.int32(0), out))[1], at + total

        out, at = engine.fold_words(span, add, (out, begin))
        return [out, places.at[jnp.where(fresh, ids, places.size)].set(at, mode="drop")]

    return lax.fori_loop(0, engine.used_blocks, fill_block, state)


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
        fresh: [b] bool, False for queries that the block before this one has processed; these have no pairs here.
        fold: (add, state) -> state; calls add(slots, state) -> state until all neighbors of all queries were visited.
    """

    query: Array
    fresh: Array
    fold: Callable[[Callable[[Slots, Any], Any], Any], Any]


Visit = Callable[[Block, State], State]


def fold_neighbors(
    candidates: Candidates, cutoff: Cutoff | Cutoffs, keep: Filter, elements: int, tuning: Tuning, visit: Visit[State], out: State
) -> State:
    """Visit the neighbors of all queries without listing them: out = visit(block, out) for one block after the other.

    Where cutoffs differ, some queries are visited more than once, each time with other neighbors.

    `elements` is the number of scalars per pair that a visitor needs; they count as slots of a block.
    """
    size = tuning.fold_group if is_at_once(candidates, tuning) else FOLD_GROUP
    engine = BlockSearch(candidates, cutoff, keep, tuning, slots=size * elements, capacity=None)
    slots, torus = lax.iota(jnp.int32, size), candidates.torus

    def fold_block(b: Array, out: State) -> State:
        span = engine.block(b)
        ids = span.of(engine.queries.ids)
        fresh = engine.fresh(b, span)

        def fold(add: Callable[[Slots, Carry], Carry], state: Carry) -> Carry:
            def add_words(words: HitWords, state: Carry, at_once: bool) -> Carry:
                hits, _, image = words
                bits = BitRows.of(hits, tuning.by_gathers)
                total = jnp.where(fresh, bits.total, 0)

                def add_group(state: tuple[Array, Any]) -> tuple[Array, Any]:
                    done, state = state
                    ordinal = jnp.broadcast_to(done + slots, (span.size, slots.size))
                    images = None if torus is None else image

                    def find() -> tuple[Array, Array | None]:
                        word, bit = bits.nth(ordinal)
                        return engine.ids_of(words, word, bit), None if images is None else flat_take(images, word)

                    if tuning.by_gathers:
                        source, code = find()
                    else:  # XLA fuses nothing into a branch, and does not know that it always takes it: so this is found once
                        none = jnp.zeros_like(ordinal)
                        source, code = lax.cond(done >= 0, find, lambda: (none, None if images is None else none))
                    shift = None if torus is None or code is None else shifts_of(torus, ids[:, None], source, code)
                    return done + size, add(Slots(source, shift, ordinal < total[:, None]), state)

                if at_once:
                    return add_group((jnp.int32(0), state))[1]
                most = largest_of(total)
                return lax.while_loop(lambda state: state[0] < most, add_group, (jnp.int32(0), state))[1]

            few = functools.partial(add_words, at_once=True)
            return engine.fold_words(span, functools.partial(add_words, at_once=False), state, (few, size))

        return visit(Block(ids, fresh, fold), out)

    return fold_block(jnp.int32(0), out) if engine.block_count == 1 else lax.fori_loop(0, engine.used_blocks, fold_block, out)
