"""Sums of products in which a factor occurs again: x·a + x·b takes one multiplication less as x·(a + b).

Derivatives are full of them: each part of one ends with a multiplication by the displacement, for every axis. What stands in
brackets is the same for all axes, so it is computed once. So are signs, and factors of 2: -(x·a + x·a) becomes x·(-2·a).
"""

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from jfrnn._sums.scalars import NoTranslationError, Scalars
from jfrnn._sums.scales import collect_scales

_MOST_TERMS = 64  # of a sum that is looked at as a whole
_MOST_DEPTH = 16  # of brackets in brackets


class _Part(NamedTuple):
    """A term of a sum: a scalar, how often it is added (negative: subtracted)."""

    number: int
    times: int


def factor_out(scalars: Scalars, outputs: Iterable[int]) -> dict[int, int]:
    """Return for each output the scalar that has its value up to rounding, and takes fewer operations where factors repeat."""
    outputs = list(outputs)
    needed, found = scalars.dependencies(outputs), {number: number for number in outputs}
    for scaled in (False, True):
        try:
            work = _Factors(scalars, needed, scaled)
            for number in sorted(needed):
                work.visit(number)
            other = {number: work.better[number] for number in outputs}
            collected = collect_scales(scalars, other.values())
        except NoTranslationError:  # it would take more scalars than there may be
            continue
        both = other, {number: collected[better] for number, better in other.items()}
        found = min(found, *both, key=lambda each: len(scalars.dependencies(each.values())))
    return found


class _Factors:
    """Scalars as sums of terms, and better ones in their place; operands are visited before their results.

    `scaled`: signs and factors of 2 go to the operand that stands in most products.
    """

    def __init__(self, scalars: Scalars, needed: set[int], scaled: bool) -> None:
        self.scalars, self._scaled = scalars, scaled
        self.better: dict[int, int] = {}
        self._parts: dict[int, list[_Part]] = {}
        products = (scalars.nodes[number] for number in needed)
        self._uses = Counter(x for node in products if node.operation == "mul" for x in set(node.operands))

    def visit(self, number: int) -> None:
        """Find what takes the place of a scalar."""
        node = self.scalars.nodes[number]
        real = node.dtype.startswith("float")
        parts = self._parts[number] = self._split(number) if real else [_Part(number, 1)]
        if real and node.operation in ("add", "sub", "neg") and self._common(parts) is not None:
            self.better[number] = self._sum(parts, node.dtype)
        elif real and self._scaled and self._single(number).number != number:
            self.better[number] = self._scale(*parts[0], node.dtype)
        elif node.operands:
            self.better[number] = self.scalars.apply(node.operation, [self.better[k] for k in node.operands], node.dtype)
        else:
            self.better[number] = number

    def _split(self, number: int) -> list[_Part]:
        """Return the terms of a sum; what is none is one term."""
        node = self.scalars.nodes[number]
        signs = {"add": (1, 1), "sub": (1, -1), "neg": (-1,)}.get(node.operation, ())
        parts = [_Part(x, sign * times) for k, sign in zip(node.operands, signs, strict=False) for x, times in self._parts[k]]
        merged = _merge(parts) if 0 < len(parts) <= _MOST_TERMS else None
        return [_Part(number, 1)] if merged is None else merged

    def _factors(self, number: int) -> tuple[int, ...]:
        node = self.scalars.nodes[number]
        return node.operands if node.operation == "mul" else (number,)

    def _common(self, parts: list[_Part]) -> int | None:
        """Return the factor of most terms, if it is one of several."""
        counts = Counter(x for number, _ in parts for x in set(self._factors(number)))
        most = max(counts, key=lambda x: (counts[x], -x), default=None)
        return most if most is not None and counts[most] > 1 else None

    def _sum(self, parts: list[_Part], dtype: str, depth: int = 0) -> int:
        """Return the sum of terms, with common factors before brackets."""
        common = self._common(parts) if depth < _MOST_DEPTH else None
        if common is None:
            return self._add(parts, dtype)
        inside, outside = list[_Part](), list[_Part]()
        for number, times in parts:
            factors = [*self._factors(number)]
            if common not in factors:
                outside.append(_Part(number, times))
                continue
            factors.remove(common)
            inside += [_Part(x, times * n) for x, n in (self._parts[factors[0]] if factors else [_Part(self._one(dtype), 1)])]
        merged = _merge(inside)
        if merged is None:
            return self._add(parts, dtype)
        bracket = self._sum(merged, dtype, depth + 1)
        product = self.scalars.apply("mul", [self.better[common], bracket], dtype)
        if not outside:
            return product
        return self.scalars.apply("add", [product, self._sum(outside, dtype, depth + 1)], dtype)

    def _one(self, dtype: str) -> int:
        one = self.scalars.constant(1, dtype)
        self.better[one], self._parts[one] = one, [_Part(one, 1)]
        return one

    def _add(self, parts: list[_Part], dtype: str) -> int:
        """Add up terms that have nothing in common, from the first one on; what all are multiplied by comes last."""
        least = min(abs(times) for _, times in parts)
        scale = least if all(times % least == 0 for _, times in parts) else 1
        scale = scale if any(times > 0 for _, times in parts) else -scale
        if len(parts) == 1:
            return self._scale(*parts[0], dtype)
        parts = sorted((_Part(number, times // scale) for number, times in parts), key=lambda part: part.times < 0)
        found = self._scale(*parts[0], dtype)
        for number, times in parts[1:]:
            found = self.scalars.apply("add" if times > 0 else "sub", [found, self._scale(number, abs(times), dtype)], dtype)
        return self._times(found, scale, dtype)

    def _scale(self, number: int, times: int, dtype: str, depth: int = 0) -> int:
        """Return a multiple of a scalar."""
        node = self.scalars.nodes[number]
        if times == 1 or not self._scaled or node.operation != "mul" or depth == _MOST_DEPTH:
            return self._times(self.better[number], times, dtype)
        one, other = sorted(node.operands, key=lambda x: (self.scalars.value(x) is not None, self._uses[x]))
        value = self.scalars.value(other)
        if value is None:
            inner, more = self._single(other)
            scaled = self._scale(inner, times * more, dtype, depth + 1)
            return self.scalars.apply("mul", [self.better[one], scaled], dtype)
        inner, more = self._single(one)
        constant = self.scalars.constant(value * value.dtype.type(times * more), dtype)
        return self.scalars.apply("mul", [self.better[inner], constant], dtype)

    def _single(self, number: int) -> _Part:
        """Return what a scalar is a multiple of."""
        parts = self._parts[number]
        return parts[0] if len(parts) == 1 else _Part(number, 1)

    def _times(self, found: int, times: int, dtype: str) -> int:
        if times == -1:
            return self.scalars.apply("neg", [found], dtype)
        return self.scalars.apply("mul", [found, self.scalars.constant(times, dtype)], dtype)


def _merge(parts: list[_Part]) -> list[_Part] | None:
    """Return terms, each once; None if some would cancel: who subtracts what was added wants to know what rounding took."""
    times = dict[int, int]()
    for number, count in parts:
        if times.get(number, 0) * count < 0:
            return None
        times[number] = times.get(number, 0) + count
    return [_Part(*part) for part in times.items()]
