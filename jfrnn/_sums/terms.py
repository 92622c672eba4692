"""Terms: the summand of a pair sum as a jaxpr of one pair, and the terms of its derivatives.

A term gets, for a pair (i, j): whether the pair is real, the lattice shift of j, operands shared by all pairs, operands of i
("own") and operands of j ("others"). Positions are ordinary operands, and the displacement is computed inside the term. So the
tangent of a term is a term that takes tangents as further operands, and the transpose of a linear term is one term per side of the
pair that takes the cotangents of the sums, which belong to i, as further operands.
"""

import dataclasses
import functools
import math
import weakref
from collections.abc import Callable, Iterator, Sequence
from itertools import compress
from types import FunctionType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer, eval_jaxpr
from jax.interpreters import partial_eval

from jfrnn._tracing import ClosedJaxpr, Given, Jaxpr, Literal, jaxpr_as_fun, without_mesh


class Groups(NamedTuple):
    """One value per operand of a term, in three groups: arrays, shapes or flags."""

    shared: tuple
    own: tuple
    others: tuple


Labels = tuple[tuple[int, ...], tuple[int, ...]]
POSITIONS = OF_SOURCES, OF_QUERIES = 0, 1  # labels of positions; if the sources are the queries, both sides have OF_SOURCES
Summand = Callable[[Array, Array, Groups], Sequence[Array]]  # real [] bool, shift [d], operands -> summands


@dataclasses.dataclass(frozen=True, eq=False)
class Term:
    """A traced summand; static, and compared by identity.

    Attributes:
        jaxpr: (real, shift, *shared, *own, *others) -> summands.
        operands: Shapes and dtypes of the operands of one pair, without real and shift.
        shift: Shape and dtype of the shift, [d] whole floats.
        labels: One label per operand of i and of j; operands with equal labels are the same array. Those in `POSITIONS` are
            positions.
        totals: For each summand, whether it is summed over all pairs instead of over the neighbors j of each i.
        marks: For each summand, whether its sums are NaN (integers: the smallest one) where the position of i is not finite. Lists
            have no such sums.
        marking: Labels of operands whose cotangents are marked so.
    """

    jaxpr: ClosedJaxpr
    operands: Groups
    shift: jax.ShapeDtypeStruct
    labels: "Labels"
    totals: tuple[bool, ...]
    marks: tuple[bool, ...]
    marking: frozenset[int]

    @property
    def summands(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """Shapes and dtypes of the summands of one pair."""
        return tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in self.jaxpr.out_avals)

    @property
    def elements(self) -> int:
        """Number of scalars in the largest array that one pair needs."""
        of_equations = (v.aval for equation in self.jaxpr.jaxpr.eqns for v in equation.outvars)
        return max(math.prod(getattr(aval, "shape", ())) for aval in (*of_equations, *self.jaxpr.in_avals))

    def __call__(self, real: Array, shift: Array, operands: Groups) -> Sequence[Array]:
        """Evaluate one pair."""
        return jaxpr_as_fun(self.jaxpr)(real, shift, *operands.shared, *operands.own, *operands.others)

    def split(self, operands: Sequence) -> Groups:
        """Split a flat list of operands into the three groups."""
        return split_operands(operands, self.operands)


def split_operands(operands: Sequence, like: Groups) -> Groups:
    """Split a flat list of operands into the three groups."""
    shared, own, _ = (len(group) for group in like)
    return Groups(tuple(operands[:shared]), tuple(operands[shared : shared + own]), tuple(operands[shared + own :]))


def _jaxpr_of(summand: Summand, operands: Groups, shift: jax.ShapeDtypeStruct) -> ClosedJaxpr:
    """Trace the summand of one pair, with matrix products in full precision, where GPUs would use TF32 by default.

    Equations remember the mesh under which they were traced, and a term may be asked for again under another one.
    """

    def flat(real: Array, shift: Array, *flat: Array) -> list[Array]:
        return [jnp.asarray(x) for x in summand(real, shift, split_operands(flat, operands))]

    with jax.default_matmul_precision("highest"), without_mesh():
        return jax.make_jaxpr(flat)(jax.ShapeDtypeStruct((), np.bool_), shift, *sum(operands, ()))


def trace(
    summand: Summand, operands: Groups, shift: jax.ShapeDtypeStruct, labels: Labels, owner: object, marked: bool
) -> tuple[Term, Groups, tuple[Array, ...]]:
    """Trace a summand that may close over arrays; return its term, the operands that it needs, and the closed-over arrays.

    `operands` are the shapes and dtypes of the operands of one pair. Closed-over arrays become the first shared operands. `marked`
    says whether all sums are marked, and so are the cotangents of the first operand of i.
    While the user's function `owner` lives, equal traces return the same term, so that compiled programs are reused.
    """
    closed = _jaxpr_of(summand, operands, shift)
    _refuse_collectives(closed)
    consts = tuple(jnp.asarray(x) for x in closed.consts)
    of_consts = Groups(tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in consts), (), ())

    def evaluate(real: Array, shift: Array, operands: Groups) -> Sequence[Array]:
        shared, own, others = operands
        return eval_jaxpr(closed.jaxpr, shared[: len(consts)], real, shift, *shared[len(consts) :], *own, *others)

    derived = make_term(evaluate if consts else closed, join(of_consts, operands), shift, labels)
    if marked:
        marks = dict(marks=(True,) * len(derived.term.totals), marking=frozenset(labels[0][:1]))
        derived = derived._replace(term=dataclasses.replace(derived.term, **marks))
    derived = _keep(owner, derived)
    of_closed, needed = derived.needed.shared[: len(consts)], derived.needed.shared[len(consts) :]
    return derived.term, derived.needed._replace(shared=needed), tuple(compress(consts, of_closed))


_KNOWN: "weakref.WeakKeyDictionary[Any, dict[Any, Derived]]" = weakref.WeakKeyDictionary()


def _keep(owner: object, derived: "Derived") -> "Derived":
    """Return an equal term that was made for the owner before; otherwise remember this one.

    Where functions have rules for their derivatives (`jax.custom_jvp`), which a jaxpr names and does not show, terms are equal only
    if the rules are the same functions; those that are made in each trace anew are not.
    """
    closed = derived.term.jaxpr
    programs = list(_jaxprs(closed))
    if closed.consts or any(isinstance(x, Tracer) for each in programs for x in each.consts):
        return derived
    ruled = [equation for each in programs for equation in each.jaxpr.eqns if equation.primitive.name.startswith("custom_")]
    rules = [tuple(map(_ByIdentity, _rules(equation.params))) for equation in ruled]
    if not all(rules):
        return derived
    key = (
        str(closed.jaxpr),
        tuple(_constants(programs)),
        tuple(rules),
        jax.tree.structure(derived.needed),
        tuple(jax.tree.leaves(derived.needed)),
        derived.term.labels,
        derived.term.marks,
    )
    try:
        return _KNOWN.setdefault(owner, {}).setdefault(key, derived)
    except TypeError:  # an owner that cannot be a weak key is not cached
        return derived


def _refuse_collectives(closed: ClosedJaxpr) -> None:
    """Raise where a function asks other devices, or others of a batch, whose pairs are others; on a mesh it may ask where it is."""
    mesh = jax.sharding.get_abstract_mesh().axis_names
    for equation in (equation for each in _jaxprs(closed) for equation in each.jaxpr.eqns if not any(_inner(equation.params))):
        name = equation.primitive.name
        for axis in (effect.name for effect in equation.effects if type(effect).__name__ == "NamedAxisEffect"):
            if name != "axis_index" or axis not in mesh:
                raise TypeError(
                    f"fn must not use {name} over the axis {axis!r}, along which each sum has pairs of its own: use it on what "
                    "pair_sum returns, or before the call, and let fn close over the result."
                )


def _jaxprs(closed: ClosedJaxpr) -> Iterator[ClosedJaxpr]:
    """Yield a jaxpr and all that stand in it."""
    yield closed
    for equation in closed.jaxpr.eqns:
        for inner in _inner(equation.params):
            yield from _jaxprs(inner)


def _inner(params: dict[str, Any]) -> Iterator[ClosedJaxpr]:
    """Yield the jaxprs that stand in the parameters of an equation."""
    for inner in (x for value in params.values() for x in (value if isinstance(value, tuple) else (value,))):
        if isinstance(inner, Jaxpr | ClosedJaxpr):
            yield inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())


def _constants(programs: Sequence[ClosedJaxpr]) -> Iterator[bytes]:
    """Yield what jaxprs know of numbers: of literals their printed form may show a few digits only, of closed-over arrays none."""
    for closed in programs:
        read = [v for equation in closed.jaxpr.eqns for v in equation.invars] + closed.jaxpr.outvars
        yield from (np.asarray(v.val).tobytes() for v in read if isinstance(v, Literal))
        yield from (np.asarray(x).tobytes() for x in closed.consts)


# Modules of JAX whose functions hold those of the user.
_HOLDERS = tuple(
    f"jax._src.{name}" for name in ("custom_derivatives", "interpreters", "linear_util", "api_util", "core", "util", "tree_util")
)


class _ByIdentity:
    """A function as part of a key: nothing but itself is equal to it."""

    def __init__(self, function: object) -> None:
        self.function = function

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByIdentity) and self.function is other.function

    def __hash__(self) -> int:
        return id(self.function)


def _rules(params: dict[str, Any]) -> Iterator[object]:
    """Yield the functions that parameters of an equation hold, as rules for derivatives."""
    waiting, seen = list(params.values()), []
    while waiting:
        x = waiting.pop()
        if any(x is other for other in seen):
            continue
        seen.append(x)
        if isinstance(x, FunctionType) and x.__module__.startswith(_HOLDERS):
            waiting += [cell.cell_contents for cell in x.__closure__ or ()]
        elif isinstance(x, functools.partial):
            waiting += [x.func, *x.args, *x.keywords.values()]
        elif (transforms := getattr(x, "transforms", None)) is not None:  # a function that JAX has wrapped
            waiting += [getattr(x, "f", None), *(given for transform in transforms for given in transform[1])]
        elif isinstance(x, tuple | list):
            waiting += x
        elif callable(x):
            yield x


class Derived(NamedTuple):
    """A term, and flags that say which of the offered operands it needs."""

    term: Term
    needed: Groups


def make_term(
    summand: Summand | ClosedJaxpr,
    operands: Groups,
    shift: jax.ShapeDtypeStruct,
    labels: Labels,
    totals: Sequence[bool] | None = None,
    marks: Sequence[bool] | None = None,
    marking: frozenset[int] = frozenset(),
) -> Derived:
    """Trace a summand that closes over nothing, unless it has been traced, and drop the operands that it does not need."""
    closed = summand if isinstance(summand, ClosedJaxpr) else _jaxpr_of(summand, operands, shift)
    if any(isinstance(x, Tracer) for x in closed.consts):
        raise ValueError(_CLOSED)
    always = [True, True] + [False] * sum(map(len, operands))
    jaxpr, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), always)
    needed = split_operands(used[2:], operands)
    mine, theirs = labels
    labels = tuple(compress(mine, needed.own)), tuple(compress(theirs, needed.others))
    totals, marks = (tuple(flags or [False] * len(jaxpr.outvars)) for flags in (totals, marks))
    return Derived(Term(ClosedJaxpr(jaxpr, closed.consts), choose(operands, needed), shift, labels, totals, marks, marking), needed)


def fresh_labels(count: int, labels: Labels) -> tuple[int, ...]:
    """Return labels that are not in use."""
    first = max((*labels[0], *labels[1], *POSITIONS)) + 1
    return tuple(range(first, first + count))


def choose(operands: Groups, flags: Groups) -> Groups:
    """Return the operands whose flag is set."""
    return Groups(*(tuple(compress(group, which)) for group, which in zip(operands, flags, strict=True)))


def join(*groups: Groups) -> Groups:
    """Concatenate operands, group by group."""
    return Groups(*(sum(parts, ()) for parts in zip(*groups, strict=True)))


def is_moving(x: Given) -> bool:
    """Say whether a dtype has derivatives."""
    return jnp.issubdtype(x.dtype, jnp.inexact)


@functools.lru_cache(maxsize=256)
def tangent(term: Term, moving: Groups) -> Derived:
    """Make the term of the tangents of the float summands; operands are all operands, then the tangents of the moving ones."""
    tangents = choose(term.operands, moving)
    _refuse_constants(term.jaxpr.jaxpr, [False, False, *sum(moving, ())])

    def summand(real: Array, shift: Array, operands: Groups) -> list[Array]:
        primals, moves = _halves(operands, term.operands)

        def of_moving(moved: Groups) -> list[Array]:
            summands = term(real, shift, _merge(primals, moved, moving))
            return [x for x in summands if is_moving(x)]

        return jax.jvp(of_moving, (choose(primals, moving),), (moves,))[1]

    kept = [is_moving(x) for x in term.summands]
    totals, marks = list(compress(term.totals, kept)), list(compress(term.marks, kept))
    moved = sorted({label for labels, which in zip(term.labels, moving[1:], strict=True) for label in compress(labels, which)})
    of_tangent = dict(zip(moved, fresh_labels(len(moved), term.labels), strict=True))
    mine, theirs = (
        labels + tuple(of_tangent[label] for label in compress(labels, which))
        for labels, which in zip(term.labels, moving[1:], strict=True)
    )
    marking = term.marking | {of_tangent[label] for label in term.marking & of_tangent.keys()}
    return make_term(summand, join(term.operands, tangents), term.shift, (mine, theirs), totals, marks, marking)


_CLOSED = (
    "fn calls a function with a rule for its derivative (jax.custom_jvp or jax.custom_vjp) that closes over an array which is "
    "being traced or differentiated: hand that array over as an argument of the function."
)
# how many arguments of a loop's body stay as they are
_FIXED = {
    "scan": lambda params: params["num_consts"] if "num_consts" in params else len(params["ft_in"].unpack()[0]),  # before JAX 0.11
    "while": lambda params: params["body_nconsts"],
}


def _refuse_constants(jaxpr: Jaxpr, moving: Sequence[bool]) -> None:
    """Raise where a function with a rule of its own closes over what moves: no rule knows the tangent of that, which would be 0."""
    moved = set(compress(jaxpr.invars, moving))
    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        moves = [not isinstance(v, Literal) and v in moved for v in equation.invars]
        if name.startswith("custom_"):
            if any(moves[: params.get("num_consts", 0)]):
                raise ValueError(_CLOSED)
        else:
            for inner in _inner(params):
                given = moves[len(moves) - len(inner.jaxpr.invars) :]
                if name in _FIXED:  # what is carried may move after a turn
                    fixed = _FIXED[name](params)
                    given[fixed:] = [any(moves)] * (len(given) - fixed)
                _refuse_constants(inner.jaxpr, given)
        if any(moves) and name != "stop_gradient":
            moved.update(v for v in equation.outvars if is_moving(v.aval))


class Transposed(NamedTuple):
    """The terms of the cotangents of a term's linear operands; None for a side without any.

    Attributes:
        along: Summed over the same pairs: totals for shared linear operands, then sums for those of i. Its operands are the
            nonlinear ones, then the cotangents, which are shared for totals and belong to i for sums.
        across: Summed over the reversed pairs, or None: sums for the linear operands of j.
        sides: If one term serves both sides: the indices of the operands of i and then of j that either side holds.
        joint: For each linear operand of j, whether it is also one of i, whose sums then include both.
    """

    along: Derived | None
    across: Derived | None
    sides: tuple[int, ...] = ()
    joint: tuple[bool, ...] = ()


def _pull_back(
    term: Term, linear: Groups, cotangents: tuple[bool, ...], still: Groups, real: Array, shift: Array, operands: Groups
) -> Groups:
    """Return the cotangents of the linear operands of one pair; `operands` are the others and then the cotangents of sums."""
    known, cts = _halves(operands, still)
    by_kind = {True: list(cts.shared), False: list(cts.own)}
    ordered = [by_kind[total].pop(0) for total, there in zip(term.totals, cotangents, strict=True) if there]

    def of_linear(unknown: Groups) -> list[Array]:
        return list(compress(term(real, shift, _merge(known, unknown, linear)), cotangents))

    (result,) = jax.linear_transpose(of_linear, choose(term.operands, linear))(ordered)
    return result


@functools.lru_cache(maxsize=256)
def transpose(
    term: Term, linear: Groups, cotangents: tuple[bool, ...], symmetric: bool, signs: tuple[int | None, ...]
) -> Transposed:
    """Transpose a term in its linear operands; `cotangents` says for which sums there are any.

    `symmetric` means that j is a neighbor of i whenever i is one of j, and that both sides have the same kinds of operands. Then
    one term suffices: the sums for the linear operands of j are the last ones of `along`, whose operands on either side are all
    those of i and of j. If an operand of j is the same array as one of i, its sums are added to those of i. `signs` are those of
    `jfrnn._sums.exchange`: where all are known, cotangents of i and of j are added, and both sums are one.
    """
    still = choose(term.operands, Groups(*(tuple(not flag for flag in group) for group in linear)))
    of_totals, of_sums = (
        tuple(x for x, total, there in zip(term.summands, term.totals, cotangents, strict=True) if there and total == kind)
        for kind in (True, False)
    )
    given = join(still, Groups(of_totals, of_sums, ()))
    mine, theirs = (
        tuple(label for label, flag in zip(labels, which, strict=True) if not flag)
        for labels, which in zip(term.labels, linear[1:], strict=True)
    )
    of_cotangents = fresh_labels(len(of_sums), term.labels)
    mine += of_cotangents
    marked = [mark for mark, total, there in zip(term.marks, term.totals, cotangents, strict=True) if there and not total]
    marking = term.marking | set(compress(of_cotangents, marked))
    each = mine + theirs
    sides = tuple(k for k, label in enumerate(each) if label not in each[:k])  # each array occurs once
    place = [sides.index(each.index(label)) for label in each]
    moving_i, moving_j = (tuple(compress(labels, which)) for labels, which in zip(term.labels, linear[1:], strict=True))
    joint = tuple(label in moving_i for label in moving_j)
    of_given = [(sign, total) for sign, total, there in zip(signs, term.totals, cotangents, strict=True) if there]
    folds = moving_i == moving_j and not any(linear.shared) and all(sign is not None for sign, _ in of_given)
    pull = functools.partial(_pull_back, term, linear, cotangents, still)

    def along(real: Array, shift: Array, operands: Groups) -> list[Array]:
        result = pull(real, shift, operands)
        return [*result.shared, *result.own]

    def across(real: Array, shift: Array, operands: Groups) -> list[Array]:
        return list(pull(real, -shift, operands._replace(own=operands.others, others=operands.own)).others)

    def both(real: Array, shift: Array, operands: Groups) -> list[Array]:
        of_i, of_j = (tuple(side[k] for k in place) for side in (operands.own, operands.others))
        count = len(given.own)
        if folds:
            cut, rest = len(still.shared), count - len(of_sums)
            of_total, of_sum = ([sign or 0 for sign, total in of_given if total == kind] for kind in (True, False))
            totals = [x + sign * x for x, sign in zip(operands.shared[cut:], of_total, strict=True)]
            sums = [x + sign * y for x, y, sign in zip(of_i[rest:count], of_j[rest:count], of_sum, strict=True)]
            return list(pull(real, shift, Groups((*operands.shared[:cut], *totals), (*of_i[:rest], *sums), of_j[count:])).own)
        forward, backward = (Groups(operands.shared, a[:count], b[count:]) for a, b in ((of_i, of_j), (of_j, of_i)))
        result, others = pull(real, shift, forward), list(pull(real, -shift, backward).others)
        own = list(result.own)
        for label, x in zip(moving_j, others, strict=True):
            if label in moving_i:
                own[moving_i.index(label)] += x
        return [*result.shared, *own, *(x for x, there in zip(others, joint, strict=True) if not there)]

    totals, sums, across_sums = ([flag for flag in group if flag] for group in linear)
    rests = [label for label, there in zip(moving_j, joint, strict=True) if not there]
    marks_i, marks_j, marks_rest = ([label in term.marking for label in labels] for labels in (moving_i, moving_j, rests))
    if symmetric and across_sums and (totals or sums):
        operands = given.own + given.others
        side, labels = tuple(operands[k] for k in sides), tuple(each[k] for k in sides)
        flags = [True] * len(totals) + [False] * (len(sums) + joint.count(False))
        marks = [*[False] * len(totals), *marks_i, *marks_rest]
        of_both = make_term(both, Groups(given.shared, side, side), term.shift, (labels, labels), flags, marks, marking)
        return Transposed(of_both, None, sides, joint)
    exchanged = Groups(given.shared, given.others, given.own)
    flags = [True] * len(totals) + [False] * len(sums)
    marks = [*[False] * len(totals), *marks_i]
    return Transposed(
        make_term(along, given, term.shift, (mine, theirs), flags, marks, marking) if flags else None,
        make_term(across, exchanged, term.shift, (theirs, mine), None, marks_j, marking) if across_sums else None,
    )


def _halves(operands: Groups, first: Groups) -> tuple[Groups, Groups]:
    """Split each group at the end of `first`."""
    cuts = [len(group) for group in first]
    return (
        Groups(*(group[:cut] for group, cut in zip(operands, cuts, strict=True))),
        Groups(*(group[cut:] for group, cut in zip(operands, cuts, strict=True))),
    )


def _merge(unflagged: Groups, flagged: Groups, flags: Groups) -> Groups:
    """Return all operands in order; `unflagged` holds the others, or a value for every operand."""
    groups = []
    for rest, some, which in zip(unflagged, flagged, flags, strict=True):
        whole = len(rest) == len(which)
        rest_left, some_left = iter([x for k, x in enumerate(rest) if not (whole and which[k])]), iter(some)
        groups.append(tuple(next(some_left) if flag else next(rest_left) for flag in which))
    return Groups(*groups)
