"""Sums that tell pairs apart: whole numbers, which no order of summation rounds, and displacements; and sums that nearly cancel."""

import math

import checked
import numpy as np
from by_numpy import in_order


def marks(r, i, j):
    """Return what kernels sum, in floats, of pairs whose particles have their numbers as values."""
    return {"count": 1.0, "ids": j, "rests": (j * j) % 61, "rows": i, "r": r, "square": r @ r}


def assert_marks(found, pairs, x, q=None, matrix=None):
    """Compare sums with those over the oracle's pairs; of displacements but for the rounding of their terms and of the sum.

    `matrix` is that of all pairs or, [m, d, d], of each row; without it, displacements are differences of positions.
    """
    q = x if q is None else q
    (m, d), eps, found = q.shape, np.finfo(x.dtype).eps, checked.with_sums(found, q)
    i, j, shifts = in_order(pairs, d)
    x, q, counts = x.astype(np.float64), q.astype(np.float64), np.bincount(i, minlength=m)
    wholes = {"count": counts, "rows": counts * np.arange(m), "ids": np.bincount(i, j, m)}
    wholes |= {"squares": np.bincount(i, j * j, m), "rests": np.bincount(i, j * j % 61, m)}
    for name in wholes.keys() & found.keys():
        np.testing.assert_array_equal(found[name], wholes[name], err_msg=name)
    with np.errstate(over="ignore", invalid="ignore"):
        r = x[j] - q[i]
        wrong = np.zeros_like(r)  # rounding of each component
        if matrix is not None:
            matrix = (np.diag(matrix) if matrix.ndim == 1 else matrix).astype(np.float64)
            matrix = matrix[i] if matrix.ndim == 3 else np.broadcast_to(matrix, (len(i), d, d))
            r = r + np.einsum("pk,pkd->pd", shifts, matrix)
            wrong = 2 * eps * (np.abs(x[j]) + np.abs(q[i]) + np.einsum("pk,pkd->pd", np.abs(shifts), np.abs(matrix)))
        terms = {k: (found["r"][:, k], r[:, k], wrong[:, k]) for k in range(d)}
        if "square" in found:
            terms["square"] = found["square"], (r**2).sum(axis=1), (2 * np.abs(r) * wrong + wrong**2).sum(axis=1)
        for name, (sums, term, each) in terms.items():
            total = np.bincount(i, np.abs(term), m)
            allowed = np.bincount(i, each, m) + 4 * eps * np.sqrt(counts) * total
            bounded = total < np.finfo(found["r"].dtype).max / 4
            assert (np.abs(sums - np.bincount(i, term, m)) <= allowed)[bounded].all(), name


def cancelling(n):
    """Return n numbers in float32, over eight powers of ten, whose sum is a small part of them."""
    random = np.random.default_rng(0)
    values = (random.standard_normal(n) * 10 ** random.uniform(-3, 5, n)).astype(np.float32)
    values[n // 2 :] = -values[: n // 2] * np.float32(1 + 1e-5)
    return values


def assert_compensated(plain, compensated, values, times=1, worse=10):
    """Compare sums of all values, each so many times, with exact ones: compensated sums have a far smaller bound."""
    eps, n = np.finfo(np.float32).eps, len(values)
    exact, total = times * math.fsum(values.tolist()), times * math.fsum(np.abs(values).tolist())
    off, left = (np.abs(np.asarray(found, np.float64) - exact).max() for found in (plain, compensated))
    bound = 2 * eps * abs(exact) + 4 * eps**2 * n * total
    assert off <= 4 * eps * math.sqrt(n * times) * total
    assert left <= bound
    assert off > worse * bound  # else this would prove nothing
