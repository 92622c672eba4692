"""The largest or smallest summand of each row: which pair it is, found without derivatives, then that pair alone, with them."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._relations import Listed, Relation, evaluate
from jfrnn._runs import Block, Slots
from jfrnn._summation import bind_sum
from jfrnn._terms import Derived, Groups, Term, chosen, joined, make_term

_Best = tuple[Array, Array, Array | None]  # of each row and element [b, k]: the largest, its source (n: none), its shift [b, k, d]


def bind_extremes(relation: Relation, term: Term, operands: Groups, largest: bool) -> list[Array]:
    """Return the largest (or smallest) of each element of the summands in each row; -inf (inf) where there is no pair.

    NaN counts as the most extreme. Of equal ones that of the smallest j counts, and with it its derivative.
    """
    m, n = relation.sizes
    found = _find(lax.stop_gradient(relation), term, lax.stop_gradient(operands), largest)
    results = []
    for k, (like, (_, source, shift)) in enumerate(zip(term.summands, found, strict=True)):
        has, elements = source < n, source.shape[1]
        shifts = None if shift is None else shift.reshape(-1, 1, shift.shape[-1])
        one_each = Listed(jnp.where(has, source, 0).reshape(-1, 1), has.reshape(-1, 1), shifts, n, symmetric=False)
        element, needed = _element(term, k)
        own = tuple(jnp.repeat(x, elements, axis=0) for x in operands.own)
        number = (jnp.tile(lax.iota(jnp.int32, elements), m),)
        (value,) = bind_sum(one_each, element, chosen(joined(operands._replace(own=own), Groups((), number, ())), needed), False)
        none = jnp.asarray(-np.inf if largest else np.inf, like.dtype)
        results.append(jnp.where(has, value.reshape(has.shape), none).reshape(m, *like.shape))
    return results


@functools.lru_cache(maxsize=256)
def _element(term: Term, k: int) -> Derived:
    """Make the term of one element of summand k; its number is the last of the own operands."""

    def summand(real: Array, shift: Array, operands: Groups) -> Sequence[Array]:
        *own, number = operands.own
        return [jnp.ravel(term(real, shift, operands._replace(own=tuple(own)))[k])[number]]

    number = jax.ShapeDtypeStruct((), np.int32)
    return make_term(summand, joined(term.operands, Groups((), (number,), ())), term.shift)


def _find(relation: Relation, term: Term, operands: Groups, largest: bool) -> list[_Best]:
    m, n = relation.sizes

    def start(rows: int, like: jax.ShapeDtypeStruct) -> _Best:
        elements = int(np.prod(like.shape))
        best, source = jnp.full((rows, elements), -jnp.inf, like.dtype), jnp.full((rows, elements), n, jnp.int32)
        return best, source, jnp.zeros((rows, elements, *term.shift.shape), term.shift.dtype) if relation.periodic else None

    def visit(block: Block, out: list[_Best]) -> list[_Best]:
        def add(slots: Slots, state: list[_Best]) -> list[_Best]:
            summands = evaluate(relation, term, operands, block, slots)
            return [_better(old, _best_of(x if largest else -x, slots, n), n) for old, x in zip(state, summands, strict=True)]

        done = block.fold(add, [start(block.query.size, like) for like in term.summands])
        place = jnp.where(block.fresh, block.query, m)
        return jax.tree.map(lambda all_rows, some: all_rows.at[place].set(some, mode="drop"), out, done)

    return relation.fold(term.elements, visit, [start(m, like) for like in term.summands])


def _best_of(values: Array, slots: Slots, n: int) -> _Best:
    """Return the largest of the values [b, g, ...] in each row."""
    values, real = values.reshape(*slots.real.shape, -1), slots.real[..., None]
    best = jnp.max(jnp.where(real, values, -jnp.inf), axis=1)
    equal = real & _same(values, best[:, None])
    source = jnp.min(jnp.where(equal, slots.source[..., None], n), axis=1)
    if slots.shift is None:
        return best, source, None
    slot = jnp.argmax(equal & (slots.source[..., None] == source[:, None]), axis=1)
    return best, source, jnp.take_along_axis(slots.shift, slot[..., None], axis=1)


def _better(old: _Best, new: _Best, n: int) -> _Best:
    larger = (new[0] > old[0]) | (jnp.isnan(new[0]) & ~jnp.isnan(old[0]))
    is_new = (new[1] < n) & ((old[1] == n) | larger | (_same(new[0], old[0]) & (new[1] < old[1])))
    shift = None if old[2] is None or new[2] is None else jnp.where(is_new[..., None], new[2], old[2])
    return jnp.where(is_new, new[0], old[0]), jnp.where(is_new, new[1], old[1]), shift


def _same(a: Array, b: Array) -> Array:
    return (a == b) | (jnp.isnan(a) & jnp.isnan(b))
