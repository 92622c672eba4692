"""What a wrong neighbor does to a sum over neighbors: errors of a density, of its gradient, and of a sum that jumps at the cutoff.

All sums run in float64 over the given positions, so that they show the neighbors alone. With q = r / cutoff: density, the kernel
poly6 without its constant, (1 - q²)³ (Müller et al. 2003, doi:10.2312/SCA03/154-159); its gradient, -6 (1 - q²)² q; and unit
vectors, the gradient of 1 - q, which does not vanish at q = 1. Errors are the largest of all particles, over the exact mean.
"""

from typing import Any

import numpy as np

from experiments.methods import Found

CHUNK = 1 << 20


def errors(found: Found, row: dict[str, Any], exact: np.ndarray, positions: np.ndarray, cutoff: float) -> dict[str, float]:
    """Return density_error, gradient_error and jump_error of what a method found, those that can be known.

    Of a method that sums itself, the density alone is looked at, in its own arithmetic. `row` is what `_compare.compare` said,
    `exact` the sorted keys i·n + j of the oracle, and the cutoff is rounded to the dtype of the positions [n, d].
    """
    n = len(positions)
    if found.density is not None:
        density = sums(np.divmod(exact, n), None, positions, cutoff)[:, 0]
        return {"density_error": float(np.abs(found.density - density).max() / (density.mean() or 1.0))}
    if found.pairs is None:
        return {}
    if row["missing"] == row["extra"] == 0:
        return dict.fromkeys(("density_error", "gradient_error", "jump_error"), 0.0)
    i, j, weight = difference(found, exact, n)
    wrong = sums((i, j), weight, positions, cutoff, both=not found.directed)
    scale, count = _scale(exact, positions, cutoff), 2 * len(exact) / n
    lengths = [np.abs(wrong[:, 0]), *(np.linalg.norm(part, axis=1) for part in np.split(wrong[:, 1:], 2, axis=1))]
    worst = [float(length.max()) for length in lengths]
    return {"density_error": worst[0] / scale, "gradient_error": worst[1] / scale, "jump_error": worst[2] / max(count, 1.0)}


def difference(found: Found, exact: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the entries (i, j) that are too many, with weight 1, and those that are missing, with weight -1.

    Entries of a directed list are directed; of other lists, each unordered pair stands once.
    """
    assert found.pairs is not None
    i, j = (np.asarray(part, np.int64) for part in found.pairs)
    if found.directed:
        first, second = np.divmod(exact, n)
        mine, theirs = np.sort(i * n + j), np.sort(np.concatenate((exact, second * n + first)))
    else:
        mine, theirs = np.sort(np.minimum(i, j) * n + np.maximum(i, j)), exact
    twice = np.concatenate((mine[1:] == mine[:-1], [False])) if len(mine) else np.zeros(0, bool)
    extra, missing = mine[twice | ~_contains(theirs, mine)], theirs[~_contains(mine, theirs)]
    i, j = np.divmod(np.concatenate((extra, missing)), n)
    return i, j, np.repeat((1.0, -1.0), (len(extra), len(missing)))


def _contains(where: np.ndarray, what: np.ndarray) -> np.ndarray:
    """Return which values are in a sorted array; both are sorted, of which `np.isin` takes no advantage."""
    if len(where) == 0:
        return np.zeros(len(what), bool)
    return where[np.minimum(np.searchsorted(where, what), len(where) - 1)] == what


def sums(
    pairs: tuple[np.ndarray, np.ndarray], weight: np.ndarray | None, positions: np.ndarray, cutoff: float, both: bool = True
) -> np.ndarray:
    """Return of each particle density, its gradient times the cutoff, and the sum of unit vectors, shape [n, 1 + 2 d].

    Of pairs (i, j), weighed one by one or each by 1, j is summed at i, and with `both` i at j too.
    """
    n, dim = positions.shape
    total, x = np.zeros((n, 1 + 2 * dim)), positions.astype(np.float64)
    for start in range(0, len(pairs[0]), CHUNK):
        i, j = (part[start : start + CHUNK] for part in pairs)
        r = (x[j] - x[i]) / cutoff
        q = np.linalg.norm(r, axis=1)
        inside = np.maximum(1 - q * q, 0)[:, None]
        unit = np.divide(r, q[:, None], out=np.zeros_like(r), where=q[:, None] > 0)
        terms = np.hstack([inside**3, 6 * inside**2 * r, unit])
        terms *= 1.0 if weight is None else weight[start : start + CHUNK, None]
        for place, sign in ((i, 1), (j, -1)) if both else ((i, 1),):
            for column, values in enumerate(terms.T):
                total[:, column] += np.bincount(place, values if column == 0 else sign * values, n)
    return total


def _scale(exact: np.ndarray, positions: np.ndarray, cutoff: float) -> float:
    """Return the mean density of the exact scene, of evenly chosen pairs where there are many."""
    step = max(1, len(exact) // CHUNK)
    i, j = np.divmod(exact[::step], len(positions))
    r = (positions[j].astype(np.float64) - positions[i]) / cutoff
    kernel = np.maximum(1 - (r**2).sum(axis=1), 0) ** 3
    return 2 * float(kernel.mean() if len(kernel) else 1.0) * max(len(exact), 1) / len(positions)
