"""Sums over the same pairs become one sum while a program is lowered: pairs are found once for a density and its gradient.

Each sum looks for one that stands before it in the same block of operations, over the same pairs, at whose place all of its own
operands are known, too. One sum with the summands of both then stands there, and what used the results of the first uses those of
it. What the first left behind has no use, and XLA drops it. Operands that are one number in all rows, such as the ones that the
gradient of a total multiplies by, become shared, so that they are not written for every particle.

No other file reads operations of XLA, whose Python interface is private to JAX and differs between its releases. What is read is
tried out on a small program before the first sum is lowered. Where anything is not as expected, every sum is lowered alone, which
is as right and takes longer, and a warning says so once.
"""

import contextlib
import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import compress
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import ShapedArray
from jax.interpreters import mlir

from jfrnn._engine import level_of_caller
from jfrnn._sums.fused import can_sum
from jfrnn._sums.relations import Searched, is_fused
from jfrnn._sums.terms import Derived, Groups, Term, choose, join, make_term
from jfrnn._tracing import Aval, Internal

_MOST = 16  # numbers that are summed together for each particle: registers have to hold them
_DEPTH = 6  # operations behind a value that are looked at: an operand may be used twice by each
_PLACE = "jfrnn sums"  # where the sums of a module are, among what JAX keeps of it while it is lowered
# Operations that may stand wherever their operands are known: they do nothing but compute.
_PURE = (
    "constant iota convert negate not multiply divide add subtract and or select compare is_finite reshape broadcast_in_dim slice"
)
_ARITHMETIC = frozenset(f"stablehlo.{name}" for name in ("broadcast_in_dim", "multiply", "divide", "negate"))
_MOVABLE = frozenset(("func.call", *(f"stablehlo.{name}" for name in _PURE.split())))

ir: Internal = getattr(mlir, "ir", None)


class _Known(NamedTuple):
    """A value of the program that is lowered, and its type."""

    value: Internal
    aval: Aval


@dataclasses.dataclass
class _Lowered:
    """A sum that stands in a program; each operation of `results` passes one of its results on."""

    same: tuple  # for sums over the same pairs
    pairs: list[_Known]
    term: Term
    operands: Groups
    results: list[Internal]


def lower_sum(
    lower: Callable[..., Sequence], ctx: Internal, *args: Internal, term: Term, structure: Internal, compensated: bool
) -> list[Internal]:
    """Lower a sum, alone or together with one before it, whose terms are `term` and the structure of whose relation is given.

    `lower` makes the values of a sum that stands alone of the context, which has the types of all values, and the values: leaves of
    the relation, then operands.
    """
    fault = find_fault() or (None if hasattr(ctx.module_context, "lowering_cache") else "a module keeps no lowering_cache")
    if fault is not None:
        _warn(fault)
        return list(lower(ctx, *args, term=term, structure=structure, compensated=compensated))
    known = [_Known(*each) for each in zip(args, ctx.avals_in, strict=True)]
    pairs, rest = known[: structure.num_leaves], known[structure.num_leaves :]
    term, operands = _share_numbers(term, term.split(rest))

    def place(pairs: list[_Known], term: Term, operands: Groups) -> list[Internal]:
        given = [*pairs, *sum(operands, ())]
        inside = ctx.replace(avals_in=[x.aval for x in given])
        return list(lower(inside, *(x.value for x in given), term=term, structure=structure, compensated=compensated))

    relation = jax.tree.unflatten(structure, [x.aval for x in pairs])
    if not isinstance(relation, Searched) or 0 in relation.sizes:
        return place(pairs, term, operands)
    fused = is_fused(relation, term)
    same = tuple(_describe(x.value) for x in pairs), structure, compensated, fused
    before = ctx.module_context.lowering_cache.setdefault(_PLACE, [])
    for other in reversed(before):
        joined = _join(other, term, operands) if other.same == same else None
        if joined is not None and (not fused or can_sum(relation.inputs, joined[0])):
            with _before(other.results[0]):
                found = place(other.pairs, *joined)
            for operation, result in zip(other.results, found, strict=False):
                operation.operands[0] = result
            results = [_pass_on(x) for x in found[len(other.results) :]]
            other.term, other.operands, other.results = *joined, other.results + results
            break
    else:
        results = [_pass_on(x) for x in place(pairs, term, operands)]
        before.append(_Lowered(same, pairs, term, operands, results))
    return [operation.results[0] for operation in results]


# --- operations, as this JAX shows them -------------------------------------------------------------------------------


@functools.cache
def find_fault() -> str | None:
    """Return what of a small program cannot be read as it is in this file; None: all of it can."""
    try:
        with mlir.make_ir_context(), ir.Location.unknown():
            module = ir.Module.create()
            with ir.InsertionPoint(module.body):
                return ", ".join(name for name, is_right in _try_out().items() if not is_right) or None
    except Exception as error:  # of whatever kind: this interface is not a promise
        return f"{type(error).__name__}: {error}"


def _try_out() -> dict[str, bool]:
    """Read and change a small program as sums are joined; return by name what came out as it has to."""
    zero = ir.DenseElementsAttr.get(np.zeros((), np.float32))
    rows = ir.RankedTensorType.get((3,), ir.F32Type.get())
    number = ir.Operation.create("stablehlo.constant", [zero.type], [], {"value": zero}).results[0]

    def fill() -> Internal:
        axes = ir.DenseI64ArrayAttr.get([])
        return ir.Operation.create("stablehlo.broadcast_in_dim", [rows], [number], {"broadcast_dimensions": axes}).results[0]

    first, second = fill(), fill()
    end = _pass_on(first)
    end.operands[0] = second
    negative = ir.Operation.create("stablehlo.negate", [rows], [fill()]).results[0]
    with _before(end):
        earlier = fill()
    return {
        "a value and its type": _rank(first) == 1 and first != second and first.type == second.type,
        "what an operation computes": _describe(first) == _describe(second) and _describe(first) != _describe(negative),
        "an operand that was exchanged": end.operands[0] == second,
        "a number that was broadcast": _rank(_find_number(negative)) == 0,
        "the block of an operation": end.block == ir.InsertionPoint.current.block,
        "operations before another": _is_before(_operation_of(first), end) and not _is_before(_operation_of(negative), end),
        "an operation that is made before another": _is_before(_operation_of(earlier), end),
        "an operation that is moved": _is_known(negative, end) and _is_before(_operation_of(negative), end),
        "an operation that stays": not _is_before(end, end) and not _is_known(end.results[0], end),
    }


@functools.cache
def _warn(fault: str) -> None:
    """Say once that sums are not joined."""
    warnings.warn(
        f"jfrnn/_sums/joint.py cannot read the operations of XLA as jax {jax.__version__} shows them ({fault}): sums are right, "
        "but those over the same pairs are not joined, and take longer. With another version of jax, or of jfrnn, they are joined.",
        RuntimeWarning,
        stacklevel=level_of_caller(),
    )


@contextlib.contextmanager
def _before(at: Internal) -> Iterator[None]:
    """Have operations made before another one: some releases put what they inline at the end of a block, wherever they are."""
    apart = ir.Module.create()
    with ir.InsertionPoint(apart.body):
        yield
    for operation in list(apart.body.operations):
        operation.move_before(at)


def _pass_on(value: Internal) -> Internal:
    """Return an operation that changes nothing, whose operand can be exchanged: its axes stay as they are."""
    axes = ir.DenseI64ArrayAttr.get(list(range(_rank(value))))
    return ir.Operation.create("stablehlo.transpose", [value.type], [value], {"permutation": axes})


def _operation_of(value: Internal) -> Internal:
    """Return the operation whose result a value is; None: it is an argument."""
    return getattr(value.owner, "operation", None)


def _describe(value: Internal, depth: int = _DEPTH) -> Internal:
    """Return what is equal for equal values: how they are computed, or the value itself. Each sum writes down its own constants."""
    operation = _operation_of(value)
    if depth == 0 or operation is None or operation.name not in _MOVABLE:
        return value
    attributes = [operation.attributes[k] for k in range(len(operation.attributes))]
    named = tuple((x.name, x.attr) for x in attributes)
    number = ir.OpResult(value).result_number
    return operation.name, named, value.type, number, tuple(_describe(x, depth - 1) for x in operation.operands)


# --- numbers that are the same in all rows ----------------------------------------------------------------------------


def _share_numbers(term: Term, operands: Groups) -> tuple[Term, Groups]:
    """Let all pairs share those operands of i and of j that are one number, which is broadcast."""
    found = [[_number_of(x) for x in group] for group in operands]
    numbers = list(dict.fromkeys(number for group in found[1:] for number in group if number is not None))
    if not numbers:
        return term, operands
    places = Groups((), *(tuple(None if x is None else numbers.index(x) for x in group) for group in found[1:]))
    derived = _with_numbers(term, tuple(x.aval.dtype for x in numbers), places)
    own, others = (tuple(x for x, place in zip(operands[k], places[k], strict=True) if place is None) for k in (1, 2))
    return derived.term, choose(Groups((*operands.shared, *numbers), own, others), derived.needed)


def _number_of(x: _Known) -> _Known | None:
    """Return the number that a value is in every place, if it was broadcast, or computed of such ones."""
    number = _find_number(x.value)
    return None if number is None else _Known(number, ShapedArray((), x.aval.dtype))


def _find_number(value: Internal, depth: int = _DEPTH) -> Internal:
    operation = _operation_of(value)
    if _rank(value) == 0:
        return value
    if depth == 0 or operation is None or operation.name not in _ARITHMETIC:
        return None
    numbers = [_find_number(x, depth - 1) for x in operation.operands]
    if any(x is None for x in numbers):
        return None
    if operation.name == "stablehlo.broadcast_in_dim":
        return numbers[0]
    return ir.Operation.create(operation.name, [numbers[0].type], numbers).results[0]


def _rank(value: Internal) -> int:
    return ir.RankedTensorType(value.type).rank


@functools.lru_cache(maxsize=256)
def _with_numbers(term: Term, dtypes: tuple, places: Groups) -> Derived:
    """Make the term that has numbers, behind what is shared, in place of those operands of i and of j that have a place there."""
    like, first = term.operands, len(term.operands.shared)

    def summand(real: Array, shift: Array, operands: Groups) -> Sequence[Array]:
        def fill(k: int) -> tuple:
            left = iter(operands[k])
            each = zip(like[k], places[k], strict=True)
            return tuple(next(left) if p is None else jnp.broadcast_to(operands.shared[first + p], x.shape) for x, p in each)

        return term(real, shift, Groups(operands.shared[:first], fill(1), fill(2)))

    rest = [[place is None for place in group] for group in places[1:]]
    own, others = (tuple(compress(group, flags)) for group, flags in zip(like[1:], rest, strict=True))
    mine, theirs = (tuple(compress(labels, flags)) for labels, flags in zip(term.labels, rest, strict=True))
    numbers = tuple(jax.ShapeDtypeStruct((), dtype) for dtype in dtypes)
    offered = Groups((*like.shared, *numbers), own, others)
    return make_term(summand, offered, term.shift, (mine, theirs), term.totals, term.marks, term.marking)


# --- sums that are joined ---------------------------------------------------------------------------------------------


def _join(first: _Lowered, term: Term, operands: Groups) -> tuple[Term, Groups] | None:
    """Return the term of both and its operands; None if those of the second are not known where the first stands."""
    at = first.results[0]
    more = Groups(*(tuple(x for x in group if x not in there) for group, there in zip(operands, first.operands, strict=True)))
    several = sum(math.prod(x.shape) for x in first.term.summands + term.summands)
    if at.block != ir.InsertionPoint.current.block or several > _MOST or not all(_is_known(x.value, at) for x in sum(more, ())):
        return None
    both = join(first.operands, more)
    places = Groups(*(tuple(map(there.index, group)) for group, there in zip(operands, both, strict=True)))
    derived = _of_both(first.term, term, places)
    return derived.term, choose(both, derived.needed)


def _is_known(value: Internal, at: Internal, depth: int = _DEPTH) -> bool:
    """Say whether a value is known where an operation stands; what can be computed there already is moved there."""
    operation = _operation_of(value)
    if operation is None or operation.block != at.block or _is_before(operation, at):
        return True
    movable = depth > 0 and operation.name in _MOVABLE
    if not movable or not all(_is_known(x, at, depth - 1) for x in operation.operands):
        return False
    operation.move_before(at)
    return True


def _is_before(operation: Internal, at: Internal) -> bool:
    """Say whether an operation stands before another one of its block; jax 0.7 has to look through the block."""
    if hasattr(operation, "is_before_in_block"):
        return operation.is_before_in_block(at)
    return next(x for x in at.block.operations if x in (operation, at)) != at


@functools.lru_cache(maxsize=256)
def _of_both(first: Term, second: Term, places: Groups) -> Derived:
    """Make the term with the summands of both.

    Operands are those of the first, and behind them what the second has alone; its operands are those at `places`.
    """
    count = [len(group) for group in first.operands]

    def extend(k: int, mine: tuple, theirs: tuple) -> tuple:
        more = dict(zip(places[k], theirs, strict=True))
        return (*mine, *(more[place] for place in sorted(more) if place >= count[k]))

    def summand(real: Array, shift: Array, operands: Groups) -> list[Array]:
        mine = Groups(*(group[:size] for group, size in zip(operands, count, strict=True)))
        theirs = Groups(*(tuple(group[k] for k in where) for group, where in zip(operands, places, strict=True)))
        return [*first(real, shift, mine), *second(real, shift, theirs)]

    offered = Groups(*(extend(k, first.operands[k], second.operands[k]) for k in range(3)))
    own, others = (extend(k, first.labels[k - 1], second.labels[k - 1]) for k in (1, 2))
    return make_term(summand, offered, first.shift, (own, others), first.totals + second.totals, first.marks + second.marks)
