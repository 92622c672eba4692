"""The fused engine of pair sums: the translated term becomes part of the kernel that finds the pairs, so no list is made.

Operands are packed into columns, one per scalar, in the dtype of the positions: one set for the whole sum, one per query and one
per source. While tracing, the engine reports what it cannot do. Its results agree with those of "jax" up to rounding.
"""

import functools
import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn import _engine as engine
from jfrnn._geometry import unpack_turns
from jfrnn._search import kept_shifts
from jfrnn._sums.scalars import NoTranslationError, hash_of
from jfrnn._sums.terms import POSITIONS, Groups, Term, join
from jfrnn._sums.translate import Ends, input_name, output_name, translate
from jfrnn.kernels.pair_sum_cpu import Step, Sum, TermText, Value

_FEW_COLUMNS = 4  # that are put behind those of an array one by one
_Columns = tuple[tuple[int, int], ...]  # per column: the operand of a group and the element of it


class Plan(NamedTuple):
    """A term in native code, the origin of its columns, and a cache key that is the same in every process.

    Positions need no columns, since the kernel has them anyway.
    """

    text: TermText
    shared: _Columns
    own: _Columns
    others: _Columns
    key: str


def refusal(inputs: engine.Inputs, platform: str) -> str | None:
    """Return why this engine cannot run on such a search, or None if it can."""
    if platform not in engine.PLATFORMS:
        return f"on the platform {platform!r}, only on the CPU and on CUDA"
    if platform != "cpu" and inputs.box is not None and inputs.sources.shape[0] >= engine.MOST_IN_BOX:
        return f"of more than {engine.MOST_IN_BOX - 1} positions in a periodic box on the platform {platform!r}"
    return None


def is_fused(inputs: engine.Inputs, options: engine.Options, term: Term) -> bool:
    """Say whether this engine computes a sum: it was chosen by name, or by "auto" and supports the term."""
    if not options.engine.translates:
        return False
    return not options.may_change or can_sum(inputs, term)


def can_sum(inputs: engine.Inputs, term: Term) -> bool:
    """Say whether this engine supports a term."""
    return _why_not(term, *_kind(inputs)) is None


def check(inputs: engine.Inputs, options: engine.Options, term: Term) -> None:
    """Raise if this engine was chosen by name and does not support the term; warn if "auto" falls back to a slower one.

    A NoTranslationError tells of a primitive of the term, or of its derivative, a TypeError of a dtype that the kernel does not
    have.
    """
    if not options.engine.translates:
        return
    reason = _why_not(term, *_kind(inputs))
    if reason is None:
        return
    if not options.may_change:
        raise reason
    if isinstance(reason, NoTranslationError):
        warnings.warn(
            f"backend='auto' takes the slower engine 'jax' for a pair sum: {reason}",
            RuntimeWarning,
            stacklevel=engine.level_of_caller(),
        )


def can_sum_list(given: engine.KeptList, term: Term) -> bool:
    """Say whether a term is summed over a list by this engine; warn if it has no translation."""
    reason = _why_not(term, *_kind_of_list(given))
    if isinstance(reason, NoTranslationError):
        warnings.warn(
            f"a pair sum over a list takes the slower engine 'jax': {reason}", RuntimeWarning, stacklevel=engine.level_of_caller()
        )
    return reason is None


def _kind_of_list(given: engine.KeptList) -> tuple[np.dtype, tuple[bool, ...]]:
    lattice = given.lattice
    periodic = (False,) * given.sources.shape[1] if lattice is None else lattice.images.periodic
    return np.dtype(given.sources.dtype), periodic


def _kind(inputs: engine.Inputs) -> tuple[np.dtype, tuple[bool, ...]]:
    """Return what a translation depends on besides its term: the dtype of the positions and the periodic axes."""
    return np.dtype(inputs.sources.dtype), (False,) * inputs.sources.shape[1] if inputs.box is None else inputs.box.periodic


# dtypes whose values the kernel holds exactly in columns of a dtype
_EXACT = {"float32": ("float32", "bool", "int32"), "float64": ("float32", "float64", "bool", "int32", "int64")}


@functools.lru_cache(maxsize=256)
def _why_not(term: Term, dtype: np.dtype, periodic: tuple[bool, ...]) -> Exception | None:
    for what, specs in (("fn returns", term.summands), ("fn gets or closes over", sum(term.operands, ()))):
        known = {dtype} if what == "fn returns" else set(map(np.dtype, _EXACT[dtype.name]))
        for spec in specs:
            if spec.dtype not in known:
                names = ", ".join(sorted(x.name for x in known))
                return TypeError(
                    f"backend='warp' sums {dtype} positions with values of {names}, {what} {spec.dtype}: "
                    "convert it, or pass backend='jax'."
                )
    try:
        make_plan(term, dtype, periodic)
    except NoTranslationError as error:
        return error
    return None


@functools.lru_cache(maxsize=256)
def make_plan(term: Term, dtype: np.dtype, periodic: tuple[bool, ...], negated: bool = False, listed: bool = False) -> Plan:
    """Translate a term, or its negative, for positions of this dtype and shifts along periodic axes.

    `listed`: for the kernel of lists, which has positions as they are and shifts, also in a box.
    """

    def of_pair(shift: Array, operands: Groups) -> Sequence[Array]:
        summands = term(jnp.asarray(True), jnp.where(np.array(periodic), shift, 0), operands)
        return [-x for x in summands] if negated else summands

    wrapped = any(periodic) and not listed  # kernels of cells hold wrapped positions, so that those that were given have columns
    translated = translate(jax.make_jaxpr(of_pair)(term.shift, term.operands), _ends(term) if any(periodic) else None)
    steps = tuple(Step(input_name(k, e), e) for k, e in translated.reads if k == 0)
    columns, values, before = [], [], 1
    for group, labels in zip(term.operands, ((), *term.labels), strict=True):
        reads = [(k - before, e) for k, e in translated.reads if before <= k < before + len(group)]
        axes = [e if labels and labels[k] in POSITIONS else None for k, e in reads]
        columns.append(tuple(read for read, axis in zip(reads, axes, strict=True) if wrapped or axis is None))
        values.append(
            tuple(
                Value(input_name(before + k, e), translated.inputs[before + k].dtype, *((None, axis) if wrapped else (axis, None)))
                for (k, e), axis in zip(reads, axes, strict=True)
            )
        )
        before += len(group)
    sums = tuple(
        Sum(output_name(k, e), total, mark)
        for k, (spec, total, mark) in enumerate(zip(translated.outputs, term.totals, term.marks, strict=True))
        for e in range(math.prod(spec.shape))
    )
    sizes = [math.prod(like.shape) for like, total in zip(term.summands, term.totals, strict=True) if not total]
    first = sizes[0] if not listed and 0 < sum(sizes[:1]) < sum(sizes) else 0  # sums that stand apart: nothing has to be cut out
    text = TermText(translated.text, steps, values[0], values[1], values[2], sums, first, translated.unshifted)
    # the columns of turns follow those of the operands
    turns = [((len(group), 0),) if steps and not listed else () for group in term.operands]
    return Plan(text, columns[0], columns[1] + turns[1], columns[2] + turns[2], hash_of(tuple(text), dtype.name)[:20])


def _ends(term: Term) -> Ends | None:
    """Return which inputs of a translated term are the shift and the positions of i and of j; None: it lacks some."""
    before, found = 1 + len(term.operands.shared), []
    for group, labels in zip(term.operands[1:], term.labels, strict=True):
        found += [before + k for k, label in enumerate(labels) if label in POSITIONS]
        before += len(group)
    if len(found) != 2:
        return None
    return Ends(0, found[0], found[1], range(1, 1 + len(term.operands.shared)))


def sums(inputs: engine.Inputs, options: engine.Options, term: Term, operands: Groups, compensated: bool) -> list[Array]:
    """Sum a term over all pairs of a search, as `jfrnn._sums.relations.sum_pairs` specifies."""
    plan = make_plan(term, *_kind(inputs))
    found, totals, _ = _launch(engine.prepare_for_kernels(inputs, options), options, plan, operands, compensated)
    return _unpack(term, found, totals)


def sums_of_list(given: engine.KeptList, term: Term, operands: Groups, compensated: bool, apart: bool) -> list[Array]:
    """Sum a term over the pairs of a list; with `given.reversal` over those of its sources."""
    plan = make_plan(term, *_kind_of_list(given), listed=True)
    found, totals, _ = engine.kept_sums(
        given, engine.Summed(plan.text, plan.key, compensated), _values_of_list(given, plan, term, operands), apart
    )
    return _unpack(term, found, totals)


def extremes_of_list(
    given: engine.KeptList, term: Term, operands: Groups, largest: bool
) -> list[tuple[Array, Array, Array | None]]:
    """Find the largest summands over the pairs of a list, as `extremes` does over those of a search."""
    plan = make_plan(term, *_kind_of_list(given), not largest, listed=True)
    values = _values_of_list(given, plan, term, operands)
    (found,), _, which = engine.kept_sums(given, engine.Summed(plan.text, plan.key, extremes=True), values)
    source, place, shifts = which[..., 0], which[..., 1], None
    if given.lattice is not None:
        codes = None if given.codes is None else jnp.take_along_axis(given.codes, place, axis=1)
        shifts = kept_shifts(given._replace(idx=source, codes=codes))
    return _split_extremes(term, found, source, shifts)


def _values_of_list(given: engine.KeptList, plan: Plan, term: Term, operands: Groups) -> tuple[Array, Array | None, Array]:
    """Return the columns of what all pairs share, of i, and of j; None for i where those are of the same arrays."""
    n, m = (len(x) for x in given.ends[:: 1 if given.reversal is None else -1])
    of_i, of_j = (
        [(labels[k], e) for k, e in columns] for labels, columns in zip(term.labels, (plan.own, plan.others), strict=True)
    )
    mirrored, dtype = of_i == of_j != [], given.sources.dtype  # equal labels: the same arrays
    own = None if mirrored else _pack(operands.own, plan.own, m, dtype)
    return _pack(operands.shared, plan.shared, None, dtype), own, _pack(operands.others, plan.others, n, dtype)


def extremes(
    inputs: engine.Inputs, options: engine.Options, term: Term, operands: Groups, largest: bool
) -> list[tuple[Array, Array, Array | None]]:
    """Find the largest summands (or the negatives of the smallest) over all pairs of a search.

    Return for each summand, with its elements in one row, the largest values [rows, elements]; their sources, int32, n for none;
    and in a box their lattice shifts [rows, elements, d]. Of equal values, that of the smallest source is chosen, of its images
    any.
    """
    search = engine.prepare_for_kernels(inputs, options)
    (values,), _, which = _launch(search, options, make_plan(term, *_kind(inputs), not largest), operands, False, extremes=True)
    source, shifts = which[..., 0], None
    if search.torus is not None:
        lattice, wrapped = search.torus
        mine, theirs = (unpack_turns(x, lattice.dim) for x in (wrapped.query_turns, wrapped.turns))
        shifts = jnp.asarray(lattice.images.shifts)[which[..., 1]] + mine[:, None] - theirs.at[source].get(mode="clip")
        shifts = shifts.astype(values.dtype)
    return _split_extremes(term, values, source, shifts)


def _split_extremes(term: Term, values: Array, source: Array, shifts: Array | None) -> list[tuple[Array, Array, Array | None]]:
    ends = np.cumsum([math.prod(like.shape) for like in term.summands])[:-1]
    of_each = (values, source) if shifts is None else (values, source, shifts)
    parts = [jnp.split(x, ends, axis=1) for x in of_each] + [[None] * len(term.summands)]
    return list(zip(*parts[:3], strict=True))


def _launch(
    search: engine.Search, options: engine.Options, plan: Plan, operands: Groups, compensated: bool, extremes: bool = False
) -> engine.FoundSums:
    """Run the kernel for a prepared search with the operands that a plan needs."""
    sources, torus = search.sources, search.torus
    if torus is not None:
        operands = join(operands, Groups((), (torus[1].query_turns,), (torus[1].turns,)))
    n, m = search.sizes
    own, others = (tuple(x[k] for k in y) for x, y in ((plan.own, plan.text.own_columns), (plan.others, plan.text.other_columns)))
    columns = (operands.shared, plan.shared, None), (operands.own, plan.own, m), (operands.others, plan.others, n)
    columns += (operands.own, own, m), (operands.others, others, n)
    values = engine.Values(*(_pack(*group, sources.dtype) for group in columns))
    return engine.pair_sums(search, options.filter, engine.Summed(plan.text, plan.key, compensated, extremes), values)


def _pack(group: tuple, columns: _Columns, size: int | None, dtype: np.dtype) -> Array:
    """Return the columns of a group of operands, [size, width] or, if all pairs share them, [width]; never empty."""
    if not columns:
        return jnp.zeros(1 if size is None else (1, 1), dtype)
    leading = () if size is None else (size,)
    flat = [engine.as_float(jnp.reshape(x, (*leading, -1)), dtype) for x in group]
    first, width = columns[0][0], flat[columns[0][0]].shape[-1]
    whole, rest = tuple((first, e) for e in range(width)), columns[width:]
    if size is not None and columns[:width] == whole and len(rest) <= _FEW_COLUMNS:
        return engine.side_by_side(flat[first], [flat[k][:, e] for k, e in rest])
    return jnp.concatenate([flat[k][..., e : e + 1] for k, e in columns], axis=-1)


def _unpack(term: Term, sums: tuple[Array, ...], totals: Array) -> list[Array]:
    """Return the sums of each summand from the columns of all summands, which may stand in several arrays."""
    found, row, total = [], 0, 0
    arrays = iter(sums)
    rows = next(arrays)
    for like, is_total in zip(term.summands, term.totals, strict=True):
        size = math.prod(like.shape)
        if is_total:
            found.append(totals[total : total + size].reshape(like.shape))
            total += size
        else:
            if row == rows.shape[1] and size > 0:
                rows, row = next(arrays), 0
            found.append(rows[:, row : row + size].reshape(len(rows), *like.shape))
            row += size
    return found
