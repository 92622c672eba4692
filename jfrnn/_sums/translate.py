"""Translate a JAX function of small arrays to native code: its jaxpr becomes straight-line scalar C++.

    translated = translate(jax.make_jaxpr(function)(*examples))

Every array is split into scalars in C order. The text reads `in0_0`, `in0_1`, ... and defines `out0_0`, ...; it calls functions of
`Math`, defined in `kernels/native/math/math.h` for scalars on the CPU and on CUDA, and for vectors of lanes on the CPU.
`jfrnn._sums.primitives` translates the single primitives.

Results agree with JAX up to a few ulp, including NaN and infinities. Every operation is one statement, so the enclosing block
controls contraction: it is off under `#pragma clang fp contract(off)`, and on CUDA without `fuse_fp`. Sums run from the first
element to the last. Simplifications respect NaN, infinities and signed zeros. All branches of a `cond` are evaluated, and one is
selected.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer

from jfrnn._sums.factors import factor_out
from jfrnn._sums.primitives import TABLE
from jfrnn._sums.scalars import TYPES, Equation, NoTranslationError, Scalars, Spec, Values, hash_of
from jfrnn._tracing import Aval, ClosedJaxpr, Given, Internal, Literal

MOST_ELEMENTS = 256  # most elements of an array


class Translated(NamedTuple):
    """A function of small arrays as native text.

    `text` is a piece of a function body. For each (k, e) in `reads` it needs `input_name(k, e)`, element e of input k, in the type
    that `Math` has for its dtype; it defines `output_name(k, e)` for every element of every output. `key` is a hash of all of this,
    the same in every process. `unshifted` is the text for shifts of 0, if that was asked for (`Ends`), and there is one.
    """

    text: str
    inputs: tuple[Spec, ...]
    outputs: tuple[Spec, ...]
    reads: tuple[tuple[int, int], ...]
    key: str
    unshifted: str = ""


class Ends(NamedTuple):
    """Which inputs of a function are the shift of a pair, the positions of i and of j, and those that are of neither."""

    shift: int
    mine: int
    theirs: int
    shared: range


def input_name(k: int, e: int) -> str:
    """Return the name of element e, in C order, of input k."""
    return f"in{k}_{e}"


def output_name(k: int, e: int) -> str:
    """Return the name of element e, in C order, of output k."""
    return f"out{k}_{e}"


def translate(closed: ClosedJaxpr, ends: Ends | None = None) -> Translated:
    """Translate a closed jaxpr into native text; return the text, its inputs and its outputs.

    Arrays are of float32, float64, int32, int64 or bool. `ends` tells positions and shift, of which there may be a text without
    shifts (`_displacements`). A NoTranslationError says which primitive or dtype has no translation, which array has more than
    MOST_ELEMENTS elements, or that there are more than `jfrnn._sums.scalars.MOST_SCALARS` operations.
    """
    scalars, arguments, results = translate_scalars(closed)
    inputs = tuple(_spec(v.aval, "an input") for v in closed.jaxpr.invars)
    places = {number: (k, e) for k, numbers in enumerate(arguments) for e, number in enumerate(numbers.reshape(-1).tolist())}
    outputs = tuple(_spec(v.aval, "an output") for v in closed.jaxpr.outvars)
    defined = {output_name(k, e): x for k, result in enumerate(results) for e, x in enumerate(result.reshape(-1).tolist())}
    better = factor_out(scalars, defined.values())
    defined = {name: better[number] for name, number in defined.items()}
    text = scalars.text(defined)
    reads = tuple(places[number] for number in sorted(scalars.dependencies(defined.values()) & places.keys()))
    same = {} if ends is None else _displacements(scalars, arguments, defined, ends)
    unshifted = scalars.text(defined, same) if same else ""
    return Translated(text, inputs, outputs, reads, hash_of(text, inputs, outputs), unshifted)


def _displacements(scalars: Scalars, arguments: list[Values], defined: dict[str, int], ends: Ends) -> dict[int, int]:
    """Return the components of x_j - x_i + S·A, each with the node for x_j - x_i; none, if S or positions are read elsewhere."""
    mine, theirs, shift = (arguments[k].reshape(-1).tolist() for k in (ends.mine, ends.theirs, ends.shift))
    of_neither = {*shift, *(number for k in ends.shared for number in arguments[k].reshape(-1).tolist())}
    inputs = {number for values in arguments for number in values.reshape(-1).tolist()}
    used, same = scalars.dependencies(defined.values()), {}
    for x_i, x_j in zip(mine, theirs, strict=True):
        difference = scalars.find("sub", (x_j, x_i), scalars.nodes[x_j].dtype)
        for number in used:
            node = scalars.nodes[number]
            if node.operation == "add" and difference in node.operands:
                others = [k for k in node.operands if k != difference]
                if scalars.dependencies(others) & inputs <= of_neither:
                    same[number] = difference
    left = scalars.dependencies(defined.values(), dict.fromkeys(same, ()))
    return {} if left & {*mine, *theirs, *shift} else same


def translate_scalars(closed: ClosedJaxpr) -> tuple[Scalars, list[Values], list[Values]]:
    """Return the scalars of a closed jaxpr, and which of them are the elements of its inputs and of its results.

    Raises:
        NoTranslationError: as `translate`.
    """
    scalars, arguments = Scalars(), []
    for k, v in enumerate(closed.jaxpr.invars):
        shape, dtype = _spec(v.aval, "an input")
        numbers = [scalars.declare(input_name(k, e), dtype) for e in range(math.prod(shape))]
        arguments.append(np.array(numbers, int).reshape(shape))
    return scalars, arguments, _run(scalars, closed, arguments)


def _spec(aval: Aval, what: str) -> Spec:
    """Return the shape and dtype of a value, after checking that kernels support it."""
    shape, dtype = tuple(getattr(aval, "shape", ())), str(getattr(aval, "dtype", aval))
    if dtype not in TYPES:
        known = ", ".join(TYPES)
        raise NoTranslationError(f'{what} has the dtype {dtype}, kernels know {known}: convert it, or pass backend="jax".')
    if math.prod(shape) > MOST_ELEMENTS:
        raise NoTranslationError(
            f"{what} has the shape {shape}, more than the {MOST_ELEMENTS} elements that an array in a kernel may have: "
            'make it smaller, or pass backend="jax".'
        )
    return Spec(shape, dtype)


def _constants(scalars: Scalars, array: Given) -> Values:
    if isinstance(array, Tracer):
        raise NoTranslationError("the function closes over an array that is being traced: hand it over as an argument.")
    dtype = _spec(array, "a constant").dtype
    numbers = [scalars.constant(x, dtype) for x in np.asarray(array).reshape(-1)]
    return np.array(numbers, int).reshape(np.shape(array))


def _run(scalars: Scalars, nested: Internal, inputs: Sequence[Values]) -> list[Values]:
    """Translate the equations of a jaxpr, closed or without constants, and return its results."""
    jaxpr, consts = (nested.jaxpr, nested.consts) if hasattr(nested, "consts") else (nested, ())
    known: dict[Any, Values] = dict(zip(jaxpr.invars, inputs, strict=True))
    known |= {var: _constants(scalars, x) for var, x in zip(jaxpr.constvars, consts, strict=True)}

    def read(atom: Internal) -> Values:
        if not isinstance(atom, Literal):
            return known[atom]
        return _constants(scalars, np.asarray(atom.val, _spec(atom.aval, "a constant").dtype))

    for eqn in jaxpr.eqns:
        name = eqn.primitive.name
        if name not in TABLE:
            what = "a derivative of jax.custom_vjp" if name == "custom_lin" else f"the primitive {name!r}"
            raise NoTranslationError(
                f'{what} has no translation into a kernel: write the function without it, or pass backend="jax".'
            )
        specs = [_spec(v.aval, f"a result of {name!r}") for v in eqn.outvars]
        equation = Equation(scalars, eqn.primitive, eqn.params, specs, functools.partial(_run, scalars))
        results = TABLE[name](equation, [read(v) for v in eqn.invars])
        known |= zip(eqn.outvars, results, strict=True)
    return [read(v) for v in jaxpr.outvars]
