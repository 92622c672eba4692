"""Signs and powers of two, which change no digit of a product: they are collected, and often cancel.

Derivatives are full of them, too: 2·x from squares, 1/2 from pairs that are counted twice, signs. What is left of them comes last.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from jfrnn._sums.scalars import Number, Scalars

_MOST_FACTORS = 16  # of a product that is looked at as a whole
_MOST = 64.0  # of a factor that is collected: others may keep numbers in the range of floats


class _Multiple(NamedTuple):
    """A scalar, and what it is multiplied by: 1 or -1 times a power of two."""

    number: int
    factor: float


def collect_scales(scalars: Scalars, outputs: Iterable[int]) -> dict[int, int]:
    """Return for each output a scalar of the same value, up to the sign of 0, and where numbers leave the range of floats.

    Constants never do: one that would is not scaled.
    """
    outputs = list(outputs)
    work = _Scales(scalars)
    for number in sorted(scalars.dependencies(outputs)):
        work.visit(number)
    return work.results(outputs)


def _is_scale(value: Number) -> bool:
    return value is not None and math.isfinite(value) and value != 0 and abs(math.frexp(value)[0]) == 0.5


class _Scales:
    """What scalars are multiples of; operands are visited before their results."""

    def __init__(self, scalars: Scalars) -> None:
        self.scalars = scalars
        self._found: dict[int, _Multiple] = {}
        self._products: dict[tuple[int, ...], int] = {}  # by all that is multiplied
        self._multiplied: dict[int, tuple[int, ...]] = {}

    def visit(self, number: int) -> None:
        """Find what a scalar is a multiple of."""
        node = self.scalars.nodes[number]
        found = self._find(number, [self._found[k] for k in node.operands])
        self._found[number] = found if 1 / _MOST <= abs(found.factor) <= _MOST else _Multiple(self._whole(found), 1)

    def _find(self, number: int, parts: list[_Multiple]) -> _Multiple:
        node, dtype, apply = self.scalars.nodes[number], self.scalars.nodes[number].dtype, self.scalars.apply
        operation = node.operation if dtype.startswith("float") else ""
        if not parts:
            return _Multiple(number, 1)
        first, last = parts[0], parts[-1]
        if operation == "mul":
            return self._product(first, last, dtype)
        if operation == "neg":
            return _Multiple(first.number, -first.factor)
        if operation in ("add", "sub"):
            sign = 1 if operation == "add" else -1
            return self._sum(first, _Multiple(last.number, sign * last.factor), dtype)
        if operation == "select":
            both, factor = self._alike(parts[1], last, dtype)
            return _Multiple(apply("select", [first.number, *both], dtype), factor)
        if operation == "reciprocal":
            return _Multiple(apply("div", [self.scalars.constant(1, dtype), first.number], dtype), 1 / first.factor)
        return _Multiple(apply(node.operation, [self._whole(part) for part in parts], dtype), 1)

    def results(self, outputs: Sequence[int]) -> dict[int, int]:
        """Return the outputs: what several of them are products of takes their factors."""
        found = {number: self._found[number] for number in outputs}
        uses = Counter(x for each in found.values() for x in self._factors(each))
        return {number: self._whole(each, uses) for number, each in found.items()}

    def _factors(self, each: _Multiple) -> tuple[int, ...]:
        node = self.scalars.nodes[each.number]
        return node.operands if node.operation == "mul" and each.factor != 1 else ()

    def _whole(self, each: _Multiple, uses: Counter[int] | None = None) -> int:
        if each.factor == 1:
            return each.number
        dtype, value = self.scalars.nodes[each.number].dtype, self.scalars.value(each.number)
        if value is not None and (scaled := self._scaled(each)) is not None:
            return scaled
        factors = self._factors(each) if uses else ()
        if factors and uses:
            one, other = sorted(factors, key=lambda x: uses[x])
            return self.scalars.apply("mul", [one, self._whole(_Multiple(other, each.factor))], dtype)
        if each.factor == -1:
            return self.scalars.apply("neg", [each.number], dtype)
        return self.scalars.apply("mul", [each.number, self.scalars.constant(each.factor, dtype)], dtype)

    def _scaled(self, each: _Multiple) -> int | None:
        """Return the constant that a multiple of one is; None for what is none, or would be no normal number any longer."""
        value = self.scalars.value(each.number)
        if value is None:
            return None
        exact, limits = float(value) * each.factor, np.finfo(value.dtype)
        stays = not np.isfinite(value) or value == 0 or float(limits.tiny) <= abs(exact) <= float(limits.max)
        return self.scalars.constant(exact, self.scalars.nodes[each.number].dtype) if stays else None

    def _product(self, a: _Multiple, b: _Multiple, dtype: str) -> _Multiple:
        factor = a.factor * b.factor
        for one, other in ((a, b), (b, a)):
            value = self.scalars.value(one.number)
            if _is_scale(value) and 1 / _MOST <= abs(factor * float(value)) <= _MOST:
                return _Multiple(other.number, factor * float(value))
            if value is not None and value < 0:
                positive = self.scalars.constant(-value, dtype)
                return _Multiple(self.scalars.apply("mul", [positive, other.number], dtype), -factor)
        multiplied = tuple(sorted(self._multiplied.get(a.number, (a.number,)) + self._multiplied.get(b.number, (b.number,))))
        if multiplied not in self._products:
            number = self._products[multiplied] = self.scalars.apply("mul", [a.number, b.number], dtype)
            if len(multiplied) <= _MOST_FACTORS:
                self._multiplied[number] = multiplied
        return _Multiple(self._products[multiplied], factor)

    def _alike(self, a: _Multiple, b: _Multiple, dtype: str) -> tuple[list[int], float]:
        """Return scalars of which both parts are the same multiple, and that."""
        if (constant := self._scaled(_Multiple(b.number, b.factor / a.factor))) is not None:
            return [a.number, constant], a.factor
        if (constant := self._scaled(_Multiple(a.number, a.factor / b.factor))) is not None:
            return [constant, b.number], b.factor
        return ([a.number, b.number], a.factor) if a.factor == b.factor else ([self._whole(a), self._whole(b)], 1)

    def _sum(self, a: _Multiple, b: _Multiple, dtype: str) -> _Multiple:
        for one, other in ((a, b), (b, a)):
            factor = abs(other.factor)
            constant = self._scaled(_Multiple(one.number, one.factor / factor))
            if constant is not None:
                return _Multiple(self.scalars.apply("add" if other.factor > 0 else "sub", [constant, other.number], dtype), factor)
            if self.scalars.value(one.number) is not None:
                return _Multiple(self.scalars.apply("add", [self._whole(one), self._whole(other)], dtype), 1)
        a, b = sorted((a, b), key=lambda each: (-abs(each.factor), -each.factor))  # so that nothing grows
        ratio = b.factor / a.factor
        if ratio == -1 and self.scalars.find("sub", (b.number, a.number), dtype) is not None:  # what is known already
            a, b = b, a
        scaled = self._whole(_Multiple(b.number, abs(ratio)))
        return _Multiple(self.scalars.apply("add" if ratio > 0 else "sub", [a.number, scaled], dtype), a.factor)
