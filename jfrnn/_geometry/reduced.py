"""Lattice reduction: short vectors of the same lattice, with which far fewer periodic images are within reach.

A basis B of short vectors is B = U·A with a whole-number matrix U of determinant ±1 (Semaev 2001, doi:10.1007/3-540-44670-2_13). A
shift S in short vectors is the shift S·U in the given ones, in which pairs are decided, so decisions stay exact.
"""

import functools
from collections.abc import Sequence
from fractions import Fraction
from itertools import product

import numpy as np

Basis = tuple[tuple[int, ...], ...]  # U: one row of whole numbers per short vector


def reduced_basis(vectors: np.ndarray, periodic: Sequence[bool]) -> tuple[Basis, np.ndarray]:
    """Return U [d, d] and U·A in float64 for lattice vectors A (rows of [d, d]); rows of open axes are unchanged."""
    rows = [[Fraction(x) for x in row] for row in vectors.tolist()]
    numbers = [[int(k == j) for j in range(len(rows))] for k in range(len(rows))]
    axes = [k for k, p in enumerate(periodic) if p]
    while any(_shorten(rows, numbers, k, [j for j in axes if j != k]) for k in axes):
        pass
    return tuple(map(tuple, numbers)), np.array([[float(x) for x in row] for row in rows])


def _shorten(rows: list[list[Fraction]], numbers: list[list[int]], k: int, others: list[int]) -> bool:
    """Subtract whole multiples of the other vectors from row k if that makes it shorter; return whether it did."""
    best: tuple[int, ...] = (0,) * len(others)
    tried = list(product((-1, 0, 1), repeat=len(others)))
    tried += [tuple(round(_dot(rows[k], rows[j]) / _dot(rows[j], rows[j])) if j == i else 0 for j in others) for i in others]
    best = min(tried, key=lambda times: _dot(*[_less(rows, k, others, times)] * 2))
    after = _less(rows, k, others, best)
    if not any(best) or _dot(after, after) >= _dot(rows[k], rows[k]):
        return False
    rows[k] = after
    for j, times in zip(others, best, strict=True):
        numbers[k] = [a - times * b for a, b in zip(numbers[k], numbers[j], strict=True)]
    return True


def _less(rows: list[list[Fraction]], k: int, others: list[int], times: tuple[int, ...]) -> list[Fraction]:
    taken = ([n * x for x in rows[j]] for j, n in zip(others, times, strict=True))
    return functools.reduce(lambda a, b: [x - y for x, y in zip(a, b, strict=True)], taken, rows[k])


def _dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))
