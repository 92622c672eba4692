"""Whether exchanging i and j leaves the summands of a pair what they are, or changes their sign alone.

The derivative of a sum by the positions of a particle has two parts: what its own sum gives, and what the sums of its neighbors
give. Where the exchange leaves a summand as it is, the two differ by their cotangents alone, and both are computed at once.
"""

import functools

import jax
import jax.numpy as jnp

from jfrnn._sums.scalars import NoTranslationError, Scalars
from jfrnn._sums.terms import Term
from jfrnn._sums.translate import translate_scalars

_EVEN = {"abs", "cos", "cosh", "is_finite"}
_ODD = {
    *("neg", "reciprocal", "sign", "round", "round_even", "sin", "tan", "asin", "atan", "sinh", "tanh", "erf", "cbrt"),
    *("to_f32", "to_f64"),
}
Image = tuple[int, int]  # the number of a scalar, and 1 or -1, or 0 for the constant 0, whose sign does not matter


@functools.lru_cache(maxsize=256)
def signs_of(term: Term) -> tuple[int | None, ...]:
    """Return for each summand 1 if it stays the same when i and j are exchanged, -1 if it becomes its negative, else None.

    Both answers are proven, operation by operation; None may mean that the proof was not found.
    """
    nothing = (None,) * len(term.summands)
    if term.labels[0] != term.labels[1]:
        return nothing
    closed = jax.make_jaxpr(lambda shift, operands: term(jnp.asarray(True), shift, operands))(term.shift, term.operands)
    try:
        scalars, (shift, *inputs), results = translate_scalars(closed)
        shared, own, others = term.split(inputs)
        images: dict[int, Image | None] = {k: (k, -1) for k in shift.reshape(-1).tolist()}
        for sides in ((shared, shared), (own, others), (others, own)):
            for here, there in zip(*sides, strict=True):
                images |= zip(here.reshape(-1).tolist(), ((k, 1) for k in there.reshape(-1).tolist()), strict=True)
        _exchange(scalars, images)
    except NoTranslationError:
        return nothing
    return tuple(_sign_of([(k, images[k]) for k in result.reshape(-1).tolist()]) for result in results)


def _sign_of(elements: list[tuple[int, Image | None]]) -> int | None:
    """Return the sign that all elements of a summand get."""
    signs = {0 if image is None or image[0] != number else image[1] or 1 for number, image in elements}
    return signs.pop() if signs in ({1}, {-1}) else None


def _exchange(scalars: Scalars, images: dict[int, Image | None]) -> None:
    """Find the images of all scalars: what each becomes when those that are given become theirs."""
    for number in range(len(scalars.nodes)):
        if number in images:
            continue
        node = scalars.nodes[number]
        parts = [images[k] for k in node.operands]
        if not parts:
            images[number] = (number, 0 if node.value is not None and node.value == 0 else 1)
        elif None in parts:
            images[number] = None
        else:
            images[number] = _image(scalars, node.operation, [x for x in parts if x is not None], node.dtype)


def _image(scalars: Scalars, operation: str, parts: list[Image], dtype: str) -> Image | None:
    numbers, signs = [k for k, _ in parts], [sign for _, sign in parts]
    if operation in ("add", "sub"):
        return _sum(scalars, numbers, signs[0], signs[1] if operation == "add" else -signs[1], dtype)
    same = scalars.apply(operation, numbers, dtype)
    if operation in ("mul", "div"):
        return same, signs[0] * signs[1]
    if operation in _EVEN:
        return same, 1
    if operation in _ODD:
        return same, signs[0]
    if operation in ("eq", "ne") and len(set(signs) - {0}) < 2:
        return same, 1
    if operation == "select" and signs[0] >= 0:
        chosen = {sign for sign in signs[1:] if sign != 0}
        return None if len(chosen) > 1 else (same, chosen.pop() if chosen else 0)
    return (same, 1) if min(signs) >= 0 else None


def _sum(scalars: Scalars, numbers: list[int], first: int, second: int, dtype: str) -> Image:
    """Return the sum of two scalars with signs; what is there already, maybe the other way round, is taken."""
    first, second = first or second or 1, second or first or 1
    if first == second:
        return scalars.apply("add", numbers, dtype), first
    known, opposite = (scalars.find("sub", order, dtype) for order in (numbers, numbers[::-1]))
    if known is None and opposite is not None:
        return opposite, -first
    return scalars.apply("sub", numbers, dtype), first
