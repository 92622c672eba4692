"""Straight-line scalar code as a graph: equal expressions are computed once, and unused ones are not emitted.

Nodes are numbered, operands before their results, so ascending numbers are an order of execution. At the end: what rules know that
translate equations of JAX (see `jfrnn._sums.primitives`).
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

TYPES = {"float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "bool": "flag"}  # dtypes, and their names in `Math`
MOST_SCALARS = 20_000  # most nodes of a graph, to bound the native compiler's work

_INFIX = {"add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "neg": "-{0}"}  # for floats
_WRITTEN = {form: name for name, form in _INFIX.items()}
_SUFFIX = {"float32": "f", "float64": "", "int32": "", "int64": "ll"}
_BITS = {"float32": (np.uint32, "u"), "float64": (np.uint64, "ull")}
_FOLDED = {  # operations on constant integers and bools, such as indices, which are computed here
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative, "abs": np.abs, "sign": np.sign,
    "max": np.maximum, "min": np.minimum, "both": np.bitwise_and, "either": np.bitwise_or, "differ": np.bitwise_xor,
    "inverse": np.invert, "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater,
    "ge": np.greater_equal, "select": np.where, "div": lambda x, y: np.where(y == 0, -1, (x - np.fmod(x, y)) // y),
    "rem": lambda x, y: np.where(y == 0, x, np.fmod(x, y)), "clamp": lambda low, x, high: np.minimum(np.maximum(low, x), high),
}  # fmt: skip


Number = Any  # a number or bool of Python or NumPy; None if unknown


class NoTranslationError(NotImplementedError):
    """The function contains an operation that has no translation into a kernel."""


class Node(NamedTuple):
    """How a scalar is written, with {0}, {1}, ... in place of its operands; its dtype; and its value if that is constant."""

    form: str
    operands: tuple[int, ...]
    dtype: str
    value: Number = None

    @property
    def operation(self) -> str:
        """The operation of `Math` by which it follows from its operands."""
        return _WRITTEN.get(self.form) or self.form.removeprefix("Math::").partition("(")[0]


def literal(scalar: Number) -> str:
    """Return a NumPy scalar as a C++ literal with the same bits."""
    dtype = scalar.dtype.name
    if dtype == "bool":
        return f"Math::of({str(bool(scalar)).lower()})"
    if dtype in _BITS and not np.isfinite(scalar):
        width, suffix = _BITS[dtype]
        return f"Math::of_bits({int(scalar.view(width)):#x}{suffix})"
    if dtype in _BITS:
        return f"Math::of({float(scalar).hex()}{_SUFFIX[dtype]})"
    value, least = int(scalar), np.iinfo(dtype).min
    return f"Math::of({value if value != least else value + 1}{_SUFFIX[dtype]}{' - 1' if value == least else ''})"


def hash_of(*parts: object) -> str:
    """Return a hash that is the same in every process."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()


class Scalars:
    """The nodes of a graph, each stored once."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._numbers: dict[Any, int] = {}

    def declare(self, name: str, dtype: str) -> int:
        """Return a scalar that is defined elsewhere under this name."""
        return self._number((name, dtype), Node(name, (), dtype))

    def constant(self, value: Number, dtype: str) -> int:
        """Return a constant; constants with the same bits are one node."""
        scalar = np.asarray(value, dtype)[()]
        return self._number((dtype, scalar.tobytes()), Node(literal(scalar), (), dtype, scalar))

    def apply(self, operation: str, operands: Sequence[int], dtype: str) -> int:
        """Return the result of an operation of `Math`: simplified, folded if all operands are constant, or a new node."""
        known = self._simplify(operation, operands, dtype)
        if known is None:
            known = self._fold(operation, operands, dtype)
        if known is not None:
            return known
        if operation in ("add", "mul"):
            operands = sorted(operands)
        if operation == "div" and dtype.startswith("float") and self._is(operands[0], 1):
            operation, operands = "reciprocal", operands[1:]
        if operation == "mul" and operands[0] == operands[1]:
            operands = [self._known_up_to_sign(operands[0])] * 2
        form = _form(operation, len(operands), dtype)
        return self._number((form, *operands), Node(form, tuple(operands), dtype))

    def find(self, operation: str, operands: Sequence[int], dtype: str) -> int | None:
        """Return the result of an operation if it is a node already."""
        return self._numbers.get((_form(operation, len(operands), dtype), *operands))

    def value(self, number: int) -> Number:
        """Return the value of a constant, None for other nodes."""
        return self.nodes[number].value

    def dependencies(self, outputs: Iterable[int], instead: Mapping[int, Iterable[int]] | None = None) -> set[int]:
        """Return all nodes on which the outputs depend, themselves included; some have other operands `instead` of theirs."""
        found: set[int] = set()
        left, operands = list(outputs), instead or {}
        while left:
            number = left.pop()
            if number not in found:
                found.add(number)
                left.extend(operands.get(number, self.nodes[number].operands))
        return found

    def latest_input(self, number: int) -> int:
        """Return the last of the scalars defined elsewhere on which one depends; -1: it depends on none."""
        inputs = (k for k in self.dependencies([number]) if not self.nodes[k].operands and self.nodes[k].value is None)
        return max(inputs, default=-1)

    def text(self, outputs: dict[str, int], same: Mapping[int, int] | None = None) -> str:
        """Return the statements that define the outputs by name, without unused ones; `same`: nodes and equal ones before."""
        names, lines, same = {}, [], same or {}
        for number in sorted(self.dependencies(outputs.values(), {k: (other,) for k, other in same.items()})):
            if number in same:
                names[number] = names[same[number]]
                continue
            node = self.nodes[number]
            names[number] = node.form.format(*(names[k] for k in node.operands))
            if node.operands:  # inputs and constants are written inline
                name = f"v{len(lines)}"
                lines.append(f"const auto {name} = {names[number]};\n")
                names[number] = name
        lines += [f"const auto {name} = {names[number]};\n" for name, number in outputs.items()]
        return "".join(lines)

    def _number(self, key: tuple[Any, ...], node: Node) -> int:
        if key not in self._numbers:
            if len(self.nodes) == MOST_SCALARS:
                raise NoTranslationError(
                    f"the function takes more than {MOST_SCALARS} operations on scalars, the most that a kernel is made of: "
                    'write it with smaller arrays, or pass backend="jax".'
                )
            self._numbers[key] = len(self.nodes)
            self.nodes.append(node)
        return self._numbers[key]

    def _known_up_to_sign(self, number: int) -> int:
        """Return the node b - a for a - b if it exists, since its square has the same bits."""
        form, operands, *_ = self.nodes[number]
        return self._numbers.get((form, *reversed(operands)), number) if form == _INFIX["sub"] else number

    def _is(self, number: int, value: float) -> bool:
        known = self.value(number)
        return known is not None and known == value and bool(np.signbit(known) == np.signbit(value))

    def _simplify(self, operation: str, operands: Sequence[int], dtype: str) -> int | None:
        """Return the result of an operation without computing it, if this is right for NaN, infinities and signed zeros too."""
        first, last = operands[0], operands[-1]
        if operation == f"to_{TYPES[dtype]}" and self.nodes[first].dtype == dtype:
            return first
        if operation == "select":
            known = self.value(first)
            return last if operands[1] == last else None if known is None else operands[1] if known else last
        if dtype == "bool":
            known, other = (first, last) if self.value(first) is not None else (last, first)
            return other if operation == "both" and self.value(known) else None
        zero = -0.0 if dtype.startswith("float") else 0  # -0.0 + 0.0 is 0.0
        if operation == "mul" and (self._is(first, 1) or self._is(last, 1)):
            return last if self._is(first, 1) else first
        if operation == "add" and (self._is(first, zero) or self._is(last, zero)):
            return last if self._is(first, zero) else first
        if (operation == "div" and self._is(last, 1)) or (operation == "sub" and self._is(last, 0)):
            return first
        if operation == "neg" and self.nodes[first].form == "-{0}":
            return self.nodes[first].operands[0]
        if operation == "div" and self._is(first, 1) and (root := self._root(last)) is not None:
            known = self.find("reciprocal", (root,), dtype)  # 1 / a² for a known 1 / a, as derivatives of 1 / a have it
            if known is not None:
                return self.apply("mul", (known, known), dtype)
        reciprocal = self._reciprocal(last) if operation == "div" else None
        return None if reciprocal is None else self.apply("mul", (first, reciprocal), dtype)

    def _root(self, number: int) -> int | None:
        """Return the node a for a * a."""
        form, operands, *_ = self.nodes[number]
        return operands[0] if form == _INFIX["mul"] and operands[0] == operands[1] else None

    def _reciprocal(self, number: int) -> int | None:
        """Return 1 / a for a constant, or a choice of constants as in the derivative of max; XLA multiplies by it too."""
        form, operands, dtype, value = self.nodes[number]
        if value is not None and dtype.startswith("float"):
            moderate = 1e-30 < abs(value) < 1e30  # the reciprocal is a normal number
            return self.constant(value.dtype.type(1) / value, dtype) if moderate else None
        if not form.startswith("Math::select"):
            return None
        parts = [self._reciprocal(k) for k in operands[1:]]
        return None if None in parts else self.apply("select", [operands[0], *(k for k in parts if k is not None)], dtype)

    def _fold(self, operation: str, operands: Sequence[int], dtype: str) -> int | None:
        values = [self.value(k) for k in operands]
        if any(value is None for value in values):
            return None
        real = any(value.dtype.kind == "f" for value in values)
        if operation == f"to_{TYPES[dtype]}" and not (real and dtype.startswith("int")):
            return self.constant(_quietly(np.asarray(values[0]).astype, dtype), dtype)
        if real or operation not in _FOLDED:
            return None
        return self.constant(_quietly(_FOLDED[operation], *values), dtype)


def _form(operation: str, count: int, dtype: str) -> str:
    infix = dtype.startswith("float") and operation in _INFIX
    return _INFIX[operation] if infix else f"Math::{operation}({', '.join(f'{{{k}}}' for k in range(count))})"


def _quietly(function: Callable[..., Number], *arguments: Number) -> Number:
    with np.errstate(all="ignore"):
        return function(*arguments)


# --- equations of JAX -------------------------------------------------------------------------------------------------

Values = np.ndarray  # scalar numbers in the shape of the array that the scalars form


class Spec(NamedTuple):
    """The shape and dtype of an array."""

    shape: tuple[int, ...]
    dtype: str


class Equation(NamedTuple):
    """What a rule knows besides its inputs; `run` translates a nested jaxpr from the equation's parameters."""

    scalars: Scalars
    primitive: Any
    params: dict[str, Any]
    outputs: Sequence[Spec]
    run: Callable[[Any, Sequence[Values]], list[Values]]

    def each(self, operation: str, *arrays: Values, dtype: str | None = None) -> Values:
        """Apply an operation to every element, broadcasting scalars."""
        arrays = np.broadcast_arrays(*arrays)
        rows = zip(*(a.reshape(-1).tolist() for a in arrays), strict=True)
        dtype = dtype or self.outputs[0].dtype
        return np.array([self.scalars.apply(operation, row, dtype) for row in rows], int).reshape(arrays[0].shape)

    def full(self, value: Number, shape: tuple[int, ...] = (), dtype: str | None = None) -> Values:
        """Return an array filled with one constant."""
        return np.full(shape, self.scalars.constant(value, dtype or self.outputs[0].dtype))

    def cast(self, x: Values, dtype: str) -> Values:
        """Convert values to another dtype."""
        return self.each(f"to_{TYPES[dtype]}", x, dtype=dtype)


Rule = Callable[[Equation, list[Values]], list[Values]]
