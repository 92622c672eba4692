"""Maxima and minima over pairs: the extreme pair of each row is found without derivatives, which are those of that pair."""

import functools
import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from jfrnn._engine import Block, Slots
from jfrnn._sums.fused import extremes, extremes_of_list
from jfrnn._sums.relations import Kept, Listed, Relation, evaluate, is_fused, summable
from jfrnn._sums.summation import bind_sum
from jfrnn._sums.terms import Derived, Groups, Term, choose, fresh_labels, join, make_term
from jfrnn._tracing import call_apart, compile_program, ruled, still

_Best = tuple[Array, Array, Array | None]  # per row and element [b, k]: largest value, its source (n: none), its shift [b, k, d]


def bind_extremes(relation: Relation, term: Term, operands: Groups, largest: bool) -> list[Array]:
    """Return the largest (or smallest) summand of each row, element by element; -inf (inf) in rows without pairs.

    NaN is more extreme than any number. Of equal values, that of the smallest j is chosen, and so is its derivative.
    """
    relation = summable(relation, term)
    find = functools.partial(_find, term=term, largest=largest)
    found = call_apart(lambda *given: find(given[0], operands=given[1]), lax.stop_gradient(relation), lax.stop_gradient(operands))
    return _extremes(found, operands, term=term, largest=largest, n=relation.sizes[1])


def _values(found: list[_Best], _: Groups, *, term: Term, largest: bool, n: int) -> list[Array]:
    """Return the extremes that were found, which are differentiable in the operands: only then are they evaluated once more."""
    del n
    values = [value if largest else -value for value, *_ in found]
    return [value.reshape(len(value), *like.shape) for value, like in zip(values, term.summands, strict=True)]


def _like(found: list[_Best], _: Groups, *, term: Term, largest: bool, n: int) -> list[jax.ShapeDtypeStruct]:
    del largest, n
    each = zip(found, term.summands, strict=True)
    return [jax.ShapeDtypeStruct((value.shape[0], *like.shape), value.dtype) for (value, *_), like in each]


def _move(
    primals: tuple, tangents: tuple, *, term: Term, largest: bool, n: int
) -> tuple[list[Array], Sequence[Array | SymbolicZero]]:
    (found, operands), moves = primals, tangents[1]
    flat, structure = jax.tree.flatten(operands)
    moved = structure.flatten_up_to(moves)
    moving = [not isinstance(move, SymbolicZero) for move in moved]
    results = _extremes(found, operands, term=term, largest=largest, n=n)
    if not any(moving):
        return results, [still(x) for x in results]

    def evaluate(some: list[Array]) -> list[Array]:
        left = iter(some)
        chosen = [next(left) if flag else x for x, flag in zip(flat, moving, strict=True)]
        return _evaluate(found, jax.tree.unflatten(structure, chosen), term, n)

    some, theirs = (list(itertools.compress(each, moving)) for each in (flat, moved))
    return results, jax.jvp(evaluate, (some,), (theirs,))[1]


_extremes = ruled("jfrnn_extremes", _values, _like, _move)


def _evaluate(found: list[_Best], operands: Groups, term: Term, n: int) -> list[Array]:
    """Return the summands of the extreme pairs, 0 for rows without pairs."""
    results = []
    for k, (like, (_, source, shift)) in enumerate(zip(term.summands, found, strict=True)):
        has, (m, elements) = source < n, source.shape
        shifts = None if shift is None else shift.reshape(-1, 1, shift.shape[-1])
        idx, mask = jnp.where(has, source, 0).reshape(-1, 1), has.reshape(-1, 1)
        one_each = Listed(idx=idx, mask=mask, shifts=shifts, source_count=n, symmetric=False)
        element, needed = _element(term, k)
        own = tuple(jnp.repeat(x, elements, axis=0) for x in operands.own)
        number = (jnp.tile(lax.iota(jnp.int32, elements), m),)
        (value,) = bind_sum(one_each, element, choose(join(operands._replace(own=own), Groups((), number, ())), needed), False)
        results.append(value.reshape(m, *like.shape))
    return results


@functools.lru_cache(maxsize=256)
def _element(term: Term, k: int) -> Derived:
    """Make the term of a single element of summand k; the element number is the last operand of i."""

    def summand(real: Array, shift: Array, operands: Groups) -> Sequence[Array]:
        *own, number = operands.own
        return [jnp.ravel(term(real, shift, operands._replace(own=tuple(own)))[k])[number]]

    number = jax.ShapeDtypeStruct((), np.int32)
    mine, theirs = fresh_labels(len(term.operands.own) + 1, term.labels), term.labels[1]  # one row per element of i
    return make_term(summand, join(term.operands, Groups((), (number,), ())), term.shift, (mine, theirs))


@functools.partial(compile_program, static_argnames=("term", "largest"))
def _find(relation: Relation, term: Term, operands: Groups, largest: bool) -> list[_Best]:
    if isinstance(relation, Kept):
        return extremes_of_list(relation.given, term, operands, largest)
    if is_fused(relation, term):
        return extremes(relation.inputs, relation.options, term, operands, largest)
    m, n = relation.sizes

    def start(like: jax.ShapeDtypeStruct) -> _Best:
        elements = int(np.prod(like.shape))
        best, source = jnp.full((m, elements), -jnp.inf, like.dtype), jnp.full((m, elements), n, jnp.int32)
        return best, source, jnp.zeros((m, elements, *term.shift.shape), term.shift.dtype) if relation.periodic else None

    def visit(block: Block, out: list[_Best]) -> list[_Best]:
        def add(slots: Slots, state: list[_Best]) -> list[_Best]:
            summands = evaluate(relation, term, operands, block, slots)
            return [_better(old, _best_of(x if largest else -x, slots, n), n) for old, x in zip(state, summands, strict=True)]

        done = block.fold(add, jax.tree.map(lambda all_rows: all_rows[block.query], out))
        place = jnp.where(block.fresh, block.query, m)
        return jax.tree.map(lambda all_rows, some: all_rows.at[place].set(some, mode="drop"), out, done)

    return relation.fold(term.elements, visit, list(map(start, term.summands)))


def _best_of(values: Array, slots: Slots, n: int) -> _Best:
    """Return the largest of the values [b, g, ...] in each row, with its source and shift.

    Values and sources are reduced together: in separate reductions XLA may evaluate values twice, with different rounding.
    """
    values = values.reshape(*slots.real.shape, -1)
    source = jnp.broadcast_to(jnp.where(slots.real, slots.source, n)[..., None], values.shape)
    slot = lax.broadcasted_iota(jnp.int32, values.shape, 1)

    def larger(a: tuple[Array, Array, Array], b: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        take = _is_better(b[:2], a[:2], n) | (~_is_better(a[:2], b[:2], n) & (b[2] < a[2]))
        return jnp.where(take, b[0], a[0]), jnp.where(take, b[1], a[1]), jnp.where(take, b[2], a[2])

    start = jnp.asarray(-jnp.inf, values.dtype), jnp.int32(n), jnp.int32(values.shape[1])
    best, source, slot = lax.reduce((values, source, slot), start, larger, (1,))
    if slots.shift is None:
        return best, source, None
    slot = jnp.minimum(slot, values.shape[1] - 1)[..., None]
    return best, source, jnp.take_along_axis(slots.shift, slot, axis=1)


def _better(old: _Best, new: _Best, n: int) -> _Best:
    is_new = _is_better(new[:2], old[:2], n)
    shift = None if old[2] is None or new[2] is None else jnp.where(is_new[..., None], new[2], old[2])
    return jnp.where(is_new, new[0], old[0]), jnp.where(is_new, new[1], old[1]), shift


def _is_better(new: tuple[Array, Array], old: tuple[Array, Array], n: int) -> Array:
    """Say which (value, source) takes precedence over the other; source n means that there is none."""
    (value, source), (than, other) = new, old
    larger = (value > than) | (jnp.isnan(value) & ~jnp.isnan(than))
    same = (value == than) | (jnp.isnan(value) & jnp.isnan(than))
    return (source < n) & ((other == n) | larger | (same & (source < other)))
