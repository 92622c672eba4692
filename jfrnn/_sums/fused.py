"""The fused engine of pair sums: the term becomes part of the kernel that finds the pairs, so that no list is made.

What a term reads travels packed, a column for each number, in the dtype of positions: of the pair sum as a whole, of each query, of
each source. Where this engine cannot do what is asked, it says so while tracing; none of its answers is another than "jax" gives,
but for rounding.
"""

import functools
import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine import (
    MOST_IN_BOX,
    PLATFORMS,
    Inputs,
    Options,
    Search,
    as_float,
    kernels_of,
    level_of_caller,
    pair_sums,
    prepare_search,
)
from jfrnn._geometry import Radii, unpack_turns
from jfrnn._sums.scalars import NoTranslationError, hash_of
from jfrnn._sums.terms import POSITIONS, Groups, Term, join
from jfrnn._sums.translate import input_name, output_name, translate

_Columns = tuple[tuple[int, int], ...]  # of each column: which operand of a group, which element of it


class Plan(NamedTuple):
    """A term in native text, where its columns come from, and a key that is the same in every process.

    Positions need no columns: the kernel has them.
    """

    text: Any  # jfrnn.kernels.pair_sum_cpu.TermText
    shared: _Columns
    own: _Columns
    others: _Columns
    key: str


def refusal(inputs: Inputs, platform: str) -> str | None:
    """Say what of a search this engine cannot do; None: nothing."""
    if platform not in PLATFORMS:
        return f"on the platform {platform!r}, only on the CPU and on CUDA"
    if platform != "cpu" and isinstance(inputs.cutoff, Radii):
        return f"with a cutoff per particle on the platform {platform!r}, only on the CPU"
    if platform != "cpu" and inputs.box is not None and inputs.sources.shape[0] >= MOST_IN_BOX:
        return f"of more than {MOST_IN_BOX - 1} positions in a periodic box on the platform {platform!r}"
    return None


def is_fused(inputs: Inputs, options: Options, term: Term) -> bool:
    """Say whether a sum is one for this engine: it was named, or it is "auto" and can do it."""
    if not options.engine.translates:
        return False
    return not options.may_change or _why_not(term, *_kind(inputs)) is None


def check(inputs: Inputs, options: Options, term: Term) -> None:
    """Raise where this engine was named and cannot sum a term; warn where "auto" takes a slower one for lack of a translation.

    Raises:
        NoTranslationError: a primitive of the term, or of its derivative, has no translation.
        TypeError: a dtype cannot travel.
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
            f"backend='auto' takes the slower engine 'jax' for a pair sum: {reason}", RuntimeWarning, stacklevel=level_of_caller()
        )


def _kind(inputs: Inputs) -> tuple[np.dtype, tuple[bool, ...]]:
    """Return on what a translation depends besides its term: the dtype of positions, and which axes are periodic."""
    return np.dtype(inputs.sources.dtype), (False,) * inputs.sources.shape[1] if inputs.box is None else inputs.box.periodic


@functools.lru_cache(maxsize=256)
def _why_not(term: Term, dtype: np.dtype, periodic: tuple[bool, ...]) -> Exception | None:
    for what, specs in (("fn returns", term.summands), ("fn gets or closes over", sum(term.operands, ()))):
        known = {dtype} if what == "fn returns" else _travelling(dtype)
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


def _travelling(dtype: np.dtype) -> set[np.dtype]:
    """Return the dtypes that lose nothing among floats of a dtype."""
    names = ("float32", "bool", "int32") if dtype == np.float32 else ("float32", "float64", "bool", "int32", "int64")
    return {np.dtype(name) for name in names}


@functools.lru_cache(maxsize=256)
def make_plan(term: Term, dtype: np.dtype, periodic: tuple[bool, ...], negated: bool = False) -> Plan:
    """Translate a term, or its negative, for positions of a dtype and shifts along periodic axes."""
    kernels = kernels_of("pair_sum_cpu")

    def of_pair(shift: Array, operands: Groups) -> Sequence[Array]:
        summands = term(jnp.asarray(True), jnp.where(np.array(periodic), shift, 0), operands)
        return [-x for x in summands] if negated else summands

    translated = translate(jax.make_jaxpr(of_pair)(term.shift, term.operands))
    steps = tuple(kernels.Step(input_name(k, e), e) for k, e in translated.reads if k == 0)
    at_hand = () if any(periodic) else POSITIONS  # in a box the kernel has those of images
    columns, values, before = [], [], 1
    for group, labels in zip(term.operands, ((), *term.labels), strict=True):
        reads = [(k - before, e) for k, e in translated.reads if before <= k < before + len(group)]
        there = [bool(labels) and labels[k] in at_hand for k, _ in reads]
        columns.append(tuple(read for read, known in zip(reads, there, strict=True) if not known))
        values.append(
            tuple(
                kernels.Value(input_name(before + k, e), translated.inputs[before + k].dtype, e if known else None)
                for (k, e), known in zip(reads, there, strict=True)
            )
        )
        before += len(group)
    sums = tuple(
        kernels.Sum(output_name(k, e), total)
        for k, (spec, total) in enumerate(zip(translated.outputs, term.totals, strict=True))
        for e in range(math.prod(spec.shape))
    )
    text = kernels.TermText(translated.text, steps, values[0], values[1], values[2], sums)
    turns = [((len(group), 0),) if steps else () for group in term.operands]  # behind all operands
    return Plan(text, columns[0], columns[1] + turns[1], columns[2] + turns[2], hash_of(tuple(text), dtype.name)[:20])


def sums(inputs: Inputs, options: Options, term: Term, operands: Groups, compensated: bool) -> list[Array]:
    """Sum a term over all pairs of a search: see `jfrnn._sums.relations.sum_pairs`."""
    plan = make_plan(term, *_kind(inputs))
    found, totals, _ = _launch(prepare_search(inputs, options), options, plan, operands, compensated)
    return _unpack(term, found, totals)


def extremes(
    inputs: Inputs, options: Options, term: Term, operands: Groups, largest: bool
) -> list[tuple[Array, Array, Array | None]]:
    """Find the largest summands (or the negatives of the smallest) over all pairs of a search.

    Returns:
        For each summand, with its elements in one row: the largest [rows, elements]; of which source that is, int32, n where there
        is none; and in a box its lattice shift [rows, elements, d]. Of equal ones the smallest source, then any image.
    """
    search = prepare_search(inputs, options)
    values, _, which = _launch(search, options, make_plan(term, *_kind(inputs), not largest), operands, False, extremes=True)
    source, shifts = which[..., 0], None
    if search.torus is not None:
        lattice, wrapped = search.torus
        mine, theirs = (unpack_turns(x, lattice.dim) for x in (wrapped.query_turns, wrapped.turns))
        shifts = jnp.asarray(lattice.images.shifts)[which[..., 1]] + mine[:, None] - theirs.at[source].get(mode="clip")
        shifts = shifts.astype(values.dtype)
    ends = np.cumsum([math.prod(like.shape) for like in term.summands])[:-1]
    of_each = (values, source) if shifts is None else (values, source, shifts)
    parts = [jnp.split(x, ends, axis=1) for x in of_each] + [[None] * len(term.summands)]
    return list(zip(*parts[:3], strict=True))


def _launch(
    search: Search,
    options: Options,
    plan: Plan,
    operands: Groups,
    compensated: bool,
    extremes: bool = False,
) -> tuple[Array, Array, Array]:
    """Hand a prepared search and what a plan reads to the kernel."""
    sources, torus = search.sources, search.torus
    if torus is not None:
        operands = join(operands, Groups((), (torus[1].query_turns,), (torus[1].turns,)))
    n, m = search.sizes
    sizes = None, m, n
    columns = plan.shared, plan.own, plan.others
    shared, own, others = (_pack(*group, sources.dtype) for group in zip(operands, columns, sizes, strict=True))
    values = shared, own, others
    return pair_sums(search, options.filter, plan.text, plan.key, values, compensated, extremes)


def _pack(group: tuple, columns: _Columns, size: int | None, dtype: np.dtype) -> Array:
    """Return the columns of a group of operands: [size, width], or where all pairs share them, [width]; never empty."""
    if not columns:
        return jnp.zeros(1 if size is None else (1, 1), dtype)
    leading = () if size is None else (size,)
    flat = [as_float(jnp.reshape(x, (*leading, -1)), dtype) for x in group]
    return jnp.concatenate([flat[k][..., e : e + 1] for k, e in columns], axis=-1)


def _unpack(term: Term, sums: Array, totals: Array) -> list[Array]:
    """Return the sums of each summand from the columns of all."""
    found, row, total = [], 0, 0
    for like, is_total in zip(term.summands, term.totals, strict=True):
        size = math.prod(like.shape)
        if is_total:
            found.append(totals[total : total + size].reshape(like.shape))
            total += size
        else:
            found.append(sums[:, row : row + size].reshape(-1, *like.shape))
            row += size
    return found
