"""The compiled programs of a search: prepare its operands, run an engine, complete the status."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.arrays import complete_rows, fold_candidates, is_few, refuse_many
from jfrnn._engine.auto import platform_of
from jfrnn._engine.candidates import Candidates
from jfrnn._engine.near_warp import prepare_for_kernels
from jfrnn._engine.problem import Engine, Inputs, Options, Room, Rows, Search, bits_of, prepare_search, rows_asked, take_present
from jfrnn._engine.reverse_warp import pack_rows
from jfrnn._engine.runs import State, Visit, fold_neighbors
from jfrnn._engine.tuning import Tuning, by_platform
from jfrnn._engine.warp import copies_rows
from jfrnn._geometry import NOT_FINITE, Cutoff, Status, are_whole, good_rows, mark_rows
from jfrnn._tracing import compile_program


class Found(NamedTuple):
    """The result of a search: rows of neighbors and the periodic images to which they belong.

    `images`, in the shape of `rows.idx`, holds codes, `turns` [n] and [m] int32 (or None) are packed; both are None unless images
    must be told apart.
    """

    rows: Rows
    images: Array | None
    turns: tuple[Array, Array | None] | None


class FoundFlat(NamedTuple):
    """A flat list: where its rows begin, and the last one ends, [m + 1] int32, saturating; and what is found of it.

    `found.rows.idx` and `receivers` are [total], padded by n and m. Counts are true ones, `required` is the number of all pairs.
    """

    offsets: Array
    found: Found


@functools.partial(compile_program, static_argnames=("options", "total"))
def list_flat(inputs: Inputs, options: Options, total: int) -> FoundFlat:
    """List the neighbors of every query in rows without gaps: count them, add up, and fill.

    Rows of a common length are about as fast to write as counts, so kernels write many at once, and copy them. Where one is too
    short for its neighbors, all are searched for once more.
    """
    n, m = len(inputs.sources), len(rows_asked(inputs)[0])
    one_image = options.images is None or options.images.nearest
    capacity = length_of_rows(options.engine, platform_of(inputs.sources), (n, m), total) if one_image else None
    counted = find_rows(inputs, options, capacity).rows
    offsets, status = add_up(counted.counts), counted.status & ~Status.ROW_OVERFLOW.value
    status = status | jnp.where(offsets[-1] > total, Status.TOTAL_OVERFLOW.value, 0).astype(jnp.int32)

    def find() -> Found:
        found = find_rows(inputs, options, Room(jnp.minimum(offsets, total), total))
        there = lax.iota(jnp.int32, total) < offsets[-1]
        idx, receivers = (jnp.where(there, jnp.asarray(x), most) for x, most in ((found.rows.idx, n), (found.rows.receivers, m)))
        images = None if found.images is None else jnp.where(there, found.images, 0)
        return Found(Rows(idx, counted.counts, offsets[-1], status, None, receivers), images, found.turns)

    def copy() -> Found:
        idx, receivers = pack_rows(jnp.asarray(counted.idx), counted.counts, offsets, n, total)
        return Found(Rows(idx, counted.counts, offsets[-1], status, None, receivers), None, None)

    return FoundFlat(offsets, find() if capacity is None else lax.cond(counted.required <= capacity, copy, find))


def length_of_rows(engine: Engine, platform: str, sizes: tuple[int, int], total: int) -> int | None:
    """Return the length of rows that become a flat list of `total` edges, or None if it is filled without them.

    `sizes`: n and m. Rows of random points are hardly ever longer: by six standard deviations. They begin at multiples of 64 bytes.
    """
    if total == 0 or 0 in sizes or not copies_rows(engine, platform, sizes[1]):
        return None
    mean = total / sizes[1]
    return 16 * math.ceil((mean + 6 * math.sqrt(mean)) / 16)


def add_up(counts: Array) -> Array:
    """Return 0 and the sums of the first counts, [m + 1] int32, saturating at the largest int32."""
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    m = counts.shape[0]
    whole = jnp.min(jnp.where(ends < 0, lax.iota(jnp.int32, m), m), initial=m)  # the first sum beyond int32 is negative
    ends = jnp.where(lax.iota(jnp.int32, m) < whole, ends, np.iinfo(np.int32).max)
    return jnp.concatenate([jnp.zeros(1, jnp.int32), ends])


@functools.partial(compile_program, static_argnames="options")
def count_rows(inputs: Inputs, options: Options) -> tuple[Array, Array, Array]:
    """Count the neighbors of every query, [m] int32; return their maximum and the bits of `Status`, too: the program of `count`."""
    rows = find_rows(inputs, options, None).rows
    return rows.counts, rows.required, rows.status


@compile_program
def mark_counts(inputs: Inputs, counts: Array, status: Array) -> Array:
    """Replace counts that may be wrong by the smallest integer: those of particles that are not finite, or all."""
    return mark_rows(counts, good_rows(*rows_asked(inputs), are_whole(status)))


def find_rows(inputs: Inputs, options: Options, capacity: int | Room | None) -> Found:
    """List the neighbors of every query, or only count them (capacity=None). Integers: no gradient flows through."""
    given, given_queries, active = lax.stop_gradient(take_present(inputs)[:3])
    search = prepare_for_kernels(inputs, options)
    sources, queries, cutoff, _, torus, checks = search[:6]
    rows = _empty_rows(search, options, capacity) if 0 in search.sizes else options.engine.rows(search, options, capacity)
    if torus is not None and active is None and isinstance(cutoff, Cutoff):  # else positions may be infinite for other reasons
        checks = checks | {Status.NONFINITE: (torus[1].met & NOT_FINITE) == 0}
    if active is not None or checks:  # engines see inactive and out-of-range particles as non-finite ones
        if Status.NONFINITE not in checks:
            finite = (jnp.isfinite(given).all(axis=1) | (False if active is None else ~active)).all()
            if given_queries is not None:
                there = rows_asked(inputs)[1]  # others are at infinity
                finite &= (jnp.isfinite(given_queries).all(axis=1) | (False if there is None else ~there)).all()
            checks = checks | {Status.NONFINITE: finite}
        rows = rows._replace(status=rows.status & ~Status.NONFINITE.value | bits_of(checks))
    images = options.images
    if rows.idx is None or torus is None or images is None or images.nearest:
        return Found(rows, None, None)
    n = max(sources.shape[0], 1)
    codes = (rows.idx // n).astype(images.dtype)
    idx = jnp.where(rows.idx == n * images.total, sources.shape[0], rows.idx % n)
    _, wrapped = torus
    return Found(rows._replace(idx=idx), codes, (wrapped.turns, None if queries is None else wrapped.query_turns))


def fold_pairs(inputs: Inputs, options: Options, elements: int, visit: Visit[State], out: State) -> State:
    """Visit all pairs of a search without storing them, as `fold_neighbors` does; by array programming, whatever the engine."""
    search = prepare_search(inputs, options)
    if 0 in search.sizes:
        return out
    refuse_many(search)

    def on(tuning: Tuning) -> Callable[[tuple[Search, State]], State]:
        def fold(operands: tuple[Search, State]) -> State:
            search, out = operands

            def step(candidates: Candidates, state: State) -> State:
                return fold_neighbors(candidates, search.cutoff, options.filter, elements, tuning, visit, state)

            return fold_candidates(search, options.engine.by_cells and not is_few(search, tuning), tuning, step, out)

        return fold

    return by_platform(on, (search._replace(checks={}), out))


def _empty_rows(search: Search, options: Options, capacity: int | Room | None) -> Rows:
    """Return rows without neighbors, for searches without queries or sources."""
    n, m = search.sizes
    fill = n if options.images is None or options.images.nearest else max(n, 1) * options.images.total
    if isinstance(capacity, Room):
        idx = jnp.full(capacity.total, fill, jnp.int32)
        return complete_rows(search, idx, jnp.zeros(m, jnp.int32), None)._replace(receivers=jnp.full(capacity.total, m, jnp.int32))
    idx = None if capacity is None else jnp.full((m, capacity), fill, jnp.int32)
    return complete_rows(search, idx, jnp.zeros(m, jnp.int32), capacity)


list_rows = functools.partial(compile_program, static_argnames=("options", "capacity"))(find_rows)
