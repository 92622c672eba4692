"""How many cells of a lattice a cutoff reaches over; and short vectors of the same lattice, with which these are far fewer.

A basis B of short vectors is B = U·A with a whole-number matrix U of determinant ±1 (Semaev 2001, doi:10.1007/3-540-44670-2_13). A
shift S in short vectors is the shift S·U in the given ones, in which pairs are decided, so decisions stay exact.
"""

import functools
import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import product

import numpy as np

Basis = tuple[tuple[int, ...], ...]  # U: one row of whole numbers per short vector
_ROUNDING = 0.01  # of a cell: the margin for rounding where vectors are about as long as their lattice is wide
_NEAREST = 0.5  # largest cutoff / width, with the margin for rounding, for which the minimum image suffices


def count_cells(
    vectors: np.ndarray, flags: np.ndarray, orthogonal: bool, radius: float, dtype: np.dtype
) -> tuple[tuple[int, ...], bool]:
    """Return how many cells away an image may lie and still be a neighbor, per axis, and whether the minimum image suffices.

    `vectors` are lengths [d] or rows [d, d], or those of each system; `flags` says which axes are periodic.
    `_ROUNDING` is far more than the rounding of coordinates, unless vectors are long beside the distances between their faces: then
    the residual of the transform, times the cells that an image lies away, is more (`jfrnn._geometry.wrapping.wrap`).
    """
    dim = vectors.shape[-1]
    rows = vectors[..., None] * np.eye(dim) if orthogonal else vectors
    rows = np.where(flags[..., None], rows, 0)
    regular = flags.all() and bool((np.linalg.det(rows) != 0).all())
    inverse = np.linalg.inv(rows) if regular else np.linalg.pinv(rows)  # which takes ten times as long
    share = np.where(flags, radius * np.linalg.norm(inverse, axis=-2), 0)  # of the distances between opposite faces
    residual = np.where(flags, (np.abs(rows) @ np.abs(inverse)).sum(axis=-2), 0)
    margin = 48 * float(np.finfo(dtype).eps) * (share.max(axis=-1, keepdims=True) + 3) * residual
    needed = (share + np.where(flags, np.maximum(_ROUNDING, margin), 0)).reshape(-1, dim).max(axis=0)  # of any system
    return tuple(math.ceil(x) for x in needed.tolist()), bool((needed <= _NEAREST).all())


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
    tried: list[tuple[int, ...]] = list(product((-1, 0, 1), repeat=len(others)))
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


# --- many lattices at a time ---------------------------------------------------------------------------------------------

_GAIN = 4.0  # so many times fewer images, at least, make short vectors worth while
_MOST_NUMBERS = 4096  # largest sum of the numbers of one given vector in all short ones: so shifts stay exact in float32
_ROUNDS = 64


def short_vectors(vectors: np.ndarray, periodic: np.ndarray) -> np.ndarray | None:
    """Return U [systems, d, d], whole floats, for lattices [systems, d, d] in float64; None if no system has far shorter vectors.

    Systems to which short vectors bring little keep theirs: their U is 1. `periodic` [systems, d] says which vectors count.
    """
    dim, unit = vectors.shape[-1], np.broadcast_to(np.eye(vectors.shape[-1]), vectors.shape)
    rows = np.where(periodic[..., None], vectors, 0)
    numbers, changing = unit.copy(), np.flatnonzero(_images_per_volume(rows, periodic) > _GAIN)
    for _ in range(_ROUNDS):
        before = numbers[changing]
        for k in range(dim):
            _shorten_many(rows, numbers, periodic, changing, k)
        changing = changing[(numbers[changing] != before).any(axis=(1, 2))]
        if not len(changing):
            break
    short = numbers @ rows
    gain = _images_per_volume(rows, periodic) / _images_per_volume(short, periodic)
    useful = (gain >= _GAIN) & (np.abs(numbers).sum(axis=1).max(axis=1) <= _MOST_NUMBERS)
    return np.where(useful[:, None, None], numbers, unit) if useful.any() else None


def _images_per_volume(rows: np.ndarray, periodic: np.ndarray) -> np.ndarray:
    """Return the product of the ratios of the lengths of vectors to the distances between faces, at least 1."""
    regular = periodic.all() and bool((np.linalg.det(rows) != 0).all())
    inverse = np.linalg.inv(rows) if regular else np.linalg.pinv(rows)  # which takes ten times as long
    lengths = np.linalg.norm(rows, axis=2) * np.linalg.norm(inverse, axis=1)
    return np.where(periodic, lengths, 1).prod(axis=1)


def _shorten_many(rows: np.ndarray, numbers: np.ndarray, periodic: np.ndarray, which: np.ndarray, k: int) -> None:
    """Subtract whole multiples of the other vectors from row k of the short vectors wherever that makes it shorter."""
    dim = rows.shape[-1]
    others = [j for j in range(dim) if j != k]
    given = rows[which]
    for times in [None, *product((-1.0, 0.0, 1.0), repeat=len(others))]:
        some = numbers[which]
        short = some @ given
        squares = (short**2).sum(axis=2)
        if times is None:  # one after the other, rounded
            for j in others:
                along = (short[:, k] * short[:, j]).sum(axis=1) / np.where(squares[:, j] > 0, squares[:, j], 1)
                some[:, k] -= np.round(along)[:, None] * some[:, j]
                short[:, k] = np.einsum("sd,sdk->sk", some[:, k], given)
        else:
            for j, many in zip(others, times, strict=True):
                some[:, k] += many * np.where(periodic[which, j], 1, 0)[:, None] * some[:, j]
            short[:, k] = np.einsum("sd,sdk->sk", some[:, k], given)
        shorter = periodic[which, k] & ((short[:, k] ** 2).sum(axis=1) < squares[:, k] * (1 - 1e-9))
        numbers[which[shorter], k] = some[shorter, k]
