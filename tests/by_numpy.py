"""What NumPy makes of the oracle's pairs, in double precision: their displacements, sums over them, and derivatives of those."""

import itertools
from typing import NamedTuple

import jax
import numpy as np

STEP = 1e-30  # along the imaginary axis, on which a small step loses no digits


class Pairs(NamedTuple):
    """Rows i [e], sources j [e] and shifts [e, d] of pairs."""

    i: np.ndarray
    j: np.ndarray
    shifts: np.ndarray


def in_order(found, dim):
    """Return the pairs of a set of (i, j) or (i, j, shift), sorted."""
    named = sorted((*pair[:2], *(pair[2] if len(pair) > 2 else (0,) * dim)) for pair in found)
    table = np.array(named, int).reshape(-1, 2 + dim)
    return Pairs(table[:, 0], table[:, 1], table[:, 2:])


def forward(found):
    """Return those of a set of (i, j, shift) that half lists hold."""
    return {(i, j, shift) for i, j, shift in found if i < j or (i == j and shift >= (0,) * len(shift))}


def vectors_of(pairs, x, rows, matrix=None):
    """Return x_j - x_i, moved by shifts of the rows of a matrix."""
    apart = x[pairs.j] - rows[pairs.i]
    return apart if matrix is None else apart + pairs.shifts @ matrix


def add_up(terms, where, length):
    """Return the sums [length, ...] of terms [e, ...], each of which belongs to one place."""
    sums = np.zeros((length, *terms.shape[1:]), terms.dtype)
    np.add.at(sums, where, terms)
    return sums


def pull(pairs, slopes, x, rows=None):
    """Return derivatives by positions, and by rows of their own, from those by displacements [e, d]."""
    of_x, of_rows = add_up(slopes, pairs.j, len(x)), -add_up(slopes, pairs.i, len(x if rows is None else rows))
    return of_x + of_rows if rows is None else (of_x, of_rows)


def along(function, x, direction):
    """Return the derivatives of all that a function returns, analytic in x, along a direction."""
    return jax.tree.map(lambda leaf: np.imag(leaf) / STEP, function(x + STEP * 1j * direction))


def pairs_of_slots(idx, vectors, mask, x, rows=None, matrix=None):
    """Return the pairs of the slots that a mask names, in their order; their displacements tell the shifts.

    Fails where a displacement is not that of its pair, where a slot that is not named has one, and where a pair is named twice.
    """
    idx, vectors, mask = map(np.asarray, (idx, vectors, mask))
    eps, x = float(np.finfo(vectors.dtype).eps), np.asarray(x, float)
    rows = x if rows is None else np.asarray(rows, float)
    i, k = np.nonzero(mask)
    j, found = idx[i, k], vectors[i, k].astype(float)
    apart, shifts = x[j] - rows[i], np.zeros(found.shape, int)
    size = np.abs([*x[j].flat, *rows[i].flat]).max(initial=0)  # of what is rounded
    if matrix is not None:
        matrix = np.asarray(matrix, float)
        matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
        shifts = np.rint((found - apart) @ np.linalg.inv(matrix)).astype(int)
        apart, size = apart + shifts @ matrix, size + np.abs(matrix).max() * np.abs(shifts).max(initial=0)
    np.testing.assert_allclose(found, apart, rtol=0, atol=4 * eps * size)
    assert not vectors[~mask].any()
    pairs = Pairs(i, j, shifts)
    assert len(named(pairs)) == len(i)
    return pairs


def named(pairs):
    """Return the set of (i, j, shift)."""
    return set(zip(pairs.i.tolist(), pairs.j.tolist(), map(tuple, pairs.shifts.tolist()), strict=True))


def image_counts(x, cutoff, lengths=None):
    """Return how many images of j are closer to i than the cutoff, [n, n], without i itself; no length is shorter than that.

    The cutoff is one for all, or one per row i. Fails where rounding to double precision could decide.
    """
    radius = np.asarray(cutoff, x.dtype).astype(float).reshape(-1, 1)
    x, counts = x.astype(float), np.zeros((len(x), len(x)), int)
    apart, lengths = x - x[:, None], np.zeros(x.shape[1]) if lengths is None else np.asarray(lengths, float)
    apart = apart - np.rint(apart / np.where(lengths > 0, lengths, np.inf)) * lengths
    for step in itertools.product((-1, 0, 1) if lengths.any() else (0,), repeat=x.shape[1]):
        square = ((apart + step * lengths) ** 2).sum(-1)
        assert (np.abs(square - radius**2) > 1e-13 * radius**2).all()
        counts += (square < radius**2) & (any(step) | ~np.eye(len(x), dtype=bool))
    return counts
