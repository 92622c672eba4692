"""Translate each primitive of JAX to operations on scalars; the TABLE at the end has one entry per primitive.

A rule gets the equation and its inputs, arrays of scalar numbers (see `jfrnn._sums.scalars`), and returns its outputs. A primitive
that only moves elements needs no operations: its rule moves their numbers.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jfrnn._sums.indexing import add_window, choose, dynamic_slice, dynamic_update_slice, gather, scatter, set_window
from jfrnn._sums.scalars import Equation, NoTranslationError, Number, Rule, Values

MOST_REPEATED = 8  # largest constant exponent of `pow` that becomes repeated multiplication, within a few ulp


def _each(operation: str) -> Rule:
    """Return a rule that applies a function of `Math` to every element."""
    return lambda eqn, inputs: [eqn.each(operation, *inputs)]


def _move(move: Callable[..., Values]) -> Rule:
    """Return a rule that rearranges the elements of one array; `move` gets their numbers and the equation's parameters."""
    return lambda eqn, inputs: [np.asarray(move(inputs[0], eqn.params))]


# --- element-wise -----------------------------------------------------------------------------------------------------


def _power(eqn: Equation, inputs: list[Values]) -> list[Values]:
    (x, y), dtype = inputs, eqn.outputs[0].dtype
    if not dtype.startswith("float"):
        raise NoTranslationError(f"the primitive 'pow' has no translation into a kernel for {dtype}: convert it to a float.")
    exponents = {eqn.scalars.value(k) for k in y.reshape(-1).tolist()}
    exponent = exponents.pop() if len(exponents) == 1 else None
    if exponent is not None and abs(exponent) <= MOST_REPEATED and exponent == int(exponent):
        return [_repeat(eqn, np.broadcast_to(x, eqn.outputs[0].shape), int(exponent))]
    return [eqn.each("pow", x, eqn.cast(y, dtype))]


def _repeat(eqn: Equation, x: Values, exponent: int) -> Values:
    """Return a power by repeated multiplication."""
    result, square, left = eqn.full(1), x, abs(exponent)
    while left:
        if left & 1:
            result = eqn.each("mul", result, square)
        left >>= 1
        if left:
            square = eqn.each("mul", square, square)
    result = np.broadcast_to(result, x.shape)
    return eqn.each("div", eqn.full(1), result) if exponent < 0 else result


def _select(eqn: Equation, inputs: list[Values]) -> list[Values]:
    which, first, *others = inputs
    if not others:
        return [np.broadcast_to(first, eqn.outputs[0].shape)]
    return [choose(eqn, which, [first, *others], eqn.outputs[0].dtype)]


# --- reductions -------------------------------------------------------------------------------------------------------


def _reduce(operation: str, empty: Callable[[np.dtype], Number]) -> Rule:
    """Return the rule of a reduction from the first element to the last; `empty` is its result for no elements, per dtype."""

    def rule(eqn: Equation, inputs: list[Values]) -> list[Values]:
        axes, x = tuple(eqn.params["axes"]), inputs[0]
        kept = [k for k in range(x.ndim) if k not in axes]
        rows = x.transpose([*kept, *axes]).reshape(math.prod(x.shape[k] for k in kept), -1)
        shape, dtype = eqn.outputs[0]
        if rows.shape[1] == 0 or x.size == 0:
            return [eqn.full(empty(np.dtype(dtype)), shape)]
        result = rows[:, 0]
        for column in rows.T[1:]:
            result = eqn.each(operation, result, column)
        return [result.reshape(shape)]

    return rule


def _accumulate(operation: str) -> Rule:
    """Return the rule of a running reduction along an axis."""

    def rule(eqn: Equation, inputs: list[Values]) -> list[Values]:
        backward, axis = slice(None, None, -1 if eqn.params["reverse"] else 1), eqn.params["axis"]
        result = np.moveaxis(inputs[0].copy(), axis, 0)[backward]
        for k in range(1, len(result)):
            result[k] = eqn.each(operation, result[k - 1], result[k])
        return [np.moveaxis(result[backward], 0, axis)]

    return rule


def _dot_general(eqn: Equation, inputs: list[Values]) -> list[Values]:
    (left_sum, right_sum), (left_batch, right_batch) = eqn.params["dimension_numbers"]
    shape, dtype = eqn.outputs[0]

    def arrange(x: Values, summed: Sequence[int], batch: Sequence[int]) -> Values:  # [batch, kept, summed]
        kept = [k for k in range(x.ndim) if k not in (*summed, *batch)]
        sizes = [math.prod(x.shape[k] for k in axes) for axes in (batch, kept, summed)]
        return eqn.cast(x, dtype).transpose([*batch, *kept, *summed]).reshape(sizes)

    left, right = arrange(inputs[0], left_sum, left_batch), arrange(inputs[1], right_sum, right_batch)
    result = eqn.full(0, (left.shape[0], left.shape[1], right.shape[1]))
    for k in range(left.shape[2]):
        product = eqn.each("mul", left[:, :, None, k], right[:, None, :, k])
        result = product if k == 0 else eqn.each("add", result, product)
    return [result.reshape(shape)]


# --- moves ------------------------------------------------------------------------------------------------------------


def _broadcast(x: Values, params: dict[str, Any]) -> Values:
    shape = [1] * len(params["shape"])
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return np.broadcast_to(x.reshape(shape), params["shape"])


def _slice(x: Values, params: dict[str, Any]) -> Values:
    strides = params["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _iota(eqn: Equation, _: list[Values]) -> list[Values]:
    (shape, dtype), axis = eqn.outputs[0], eqn.params["dimension"]
    line = np.array([eqn.scalars.constant(k, dtype) for k in range(shape[axis])], int)
    return [np.broadcast_to(line.reshape([-1 if k == axis else 1 for k in range(len(shape))]), shape)]


def _pad(eqn: Equation, inputs: list[Values]) -> list[Values]:
    x, value = inputs
    for axis, (low, high, interior) in enumerate(eqn.params["padding_config"]):
        size = x.shape[axis] + max(x.shape[axis] - 1, 0) * interior
        at = np.arange(-low, size + high)  # origin of each element, counting the gaps
        taken = (at >= 0) & (at < size) & (at % (interior + 1) == 0)
        source = np.insert(x, x.shape[axis], value, axis)
        x = np.take(source, np.where(taken, at // (interior + 1), x.shape[axis]), axis)
    return [x]


# --- nested functions -------------------------------------------------------------------------------------------------


def _inline(eqn: Equation, inputs: list[Values]) -> list[Values]:
    nested = next(eqn.params[name] for name in ("jaxpr", "call_jaxpr", "fun_jaxpr") if name in eqn.params)
    return eqn.run(nested, inputs)


def _cond(eqn: Equation, inputs: list[Values]) -> list[Values]:
    """Evaluate all branches, which have no side effects, and select one."""
    results = zip(*(eqn.run(branch, inputs[1:]) for branch in eqn.params["branches"]), strict=True)
    return [choose(eqn, inputs[0], cases, spec.dtype) for spec, cases in zip(eqn.outputs, results, strict=True)]


# --- all of it --------------------------------------------------------------------------------------------------------

_SAME_NAME = [
    *("add", "sub", "mul", "div", "rem", "neg", "abs", "sign", "max", "min", "clamp", "eq", "ne", "lt", "le", "gt", "ge"),
    *("floor", "ceil", "sqrt", "rsqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p", "logistic", "erf", "erfc", "is_finite"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh"),
]

_NESTED = ["jit", "pjit", "closed_call", "core_call", "checkpoint", "remat", "remat2"]
_NESTED += ["custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"]
# `reshard` is for arrays that fn closes over from outside `shard_map`: every device has all of them
_WITHOUT_EFFECT = ["copy", "copy_p", "reshard", "name", "optimization_barrier", "stop_gradient"]

TABLE: dict[str, Rule] = {name: _each(name) for name in _SAME_NAME}
TABLE |= dict.fromkeys(_NESTED, _inline) | dict.fromkeys(_WITHOUT_EFFECT, lambda _, inputs: inputs)
TABLE |= {
    # element-wise, under another name
    "add_any": _each("add"),
    "and": _each("both"),
    "or": _each("either"),
    "xor": _each("differ"),
    "not": _each("inverse"),
    "square": lambda eqn, inputs: [eqn.each("mul", inputs[0], inputs[0])],
    "pow": _power,
    "integer_pow": lambda eqn, inputs: [_repeat(eqn, inputs[0], eqn.params["y"])],
    "round": lambda eqn, inputs: [eqn.each("round_even" if int(eqn.params["rounding_method"]) else "round", *inputs)],
    "select_n": _select,
    "convert_element_type": lambda eqn, inputs: [eqn.cast(inputs[0], eqn.outputs[0].dtype)],
    # reductions
    "reduce_sum": _reduce("add", lambda _: 0),
    "reduce_prod": _reduce("mul", lambda _: 1),
    "reduce_max": _reduce("max", lambda dtype: dtype.kind != "b" and (-np.inf if dtype.kind == "f" else np.iinfo(dtype).min)),
    "reduce_min": _reduce("min", lambda dtype: dtype.kind == "b" or (np.inf if dtype.kind == "f" else np.iinfo(dtype).max)),
    "reduce_and": _reduce("both", lambda dtype: True if dtype.kind == "b" else -1),
    "reduce_or": _reduce("either", lambda _: 0),
    "reduce_xor": _reduce("differ", lambda _: 0),
    "cumsum": _accumulate("add"),
    "cumprod": _accumulate("mul"),
    "cummax": _accumulate("max"),
    "cummin": _accumulate("min"),
    "dot_general": _dot_general,
    # moves
    "broadcast_in_dim": _move(_broadcast),
    "expand_dims": _move(lambda x, params: np.expand_dims(x, params["dimensions"])),
    "reshape": _move(lambda x, params: x.transpose(params.get("dimensions") or range(x.ndim)).reshape(params["new_sizes"])),
    "rev": _move(lambda x, params: np.flip(x, params["dimensions"])),
    "slice": _move(_slice),
    "squeeze": _move(lambda x, params: np.squeeze(x, tuple(params["dimensions"]))),
    "transpose": _move(lambda x, params: x.transpose(params["permutation"])),
    "tile": _move(lambda x, params: np.tile(x, params["reps"])),
    "concatenate": lambda eqn, inputs: [np.concatenate(inputs, eqn.params["dimension"])],
    "stack": lambda eqn, inputs: [np.stack(inputs, eqn.params["axis"])],
    "split": lambda eqn, inputs: np.split(inputs[0], np.cumsum(eqn.params["sizes"])[:-1], eqn.params["axis"]),
    "unstack": lambda eqn, inputs: list(np.moveaxis(inputs[0], eqn.params["axis"], 0)),
    "iota": _iota,
    "pad": _pad,
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "gather": gather,
    "scatter": scatter(set_window),
    "scatter-add": scatter(add_window),
    "cond": _cond,
}
