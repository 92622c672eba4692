"""Missing and extra pairs of a method against the oracle."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from experiments import _oracle
from experiments.methods import Found

MOST_LISTED = 2_000_000  # of more particles all pairs do not fit into memory: a sample of them is looked at
SAMPLED = 20_000  # particles


def compare(found: Found, exact: np.ndarray, size: int) -> dict[str, Any]:
    """Return what a row says about the pairs against the oracle's sorted keys i·n + j: how many, how many are missing or extra.

    All count unordered pairs. In a directed list a pair is found when both directions are there; one direction alone is missing
    where the oracle has the pair and extra where it has not. A pair given twice, or a particle paired with itself, is extra. Of
    counts, only the surplus and the deficit of each particle can be seen: half their sums, rounded up.
    """
    if found.pairs is None:
        if found.counts is None:
            raise ValueError("the adapter returned neither pairs nor counts: give one of them")
        row = _compare_counts(found.counts, exact, size)
    elif found.directed:
        row = _compare_directed(*found.pairs, exact, size)
    else:
        row = _compare_unordered(*found.pairs, exact, size)
    return row | {"exact_pairs": len(exact)}


def sample(size: int) -> np.ndarray:
    """Return the particles that are compared where all are too many, evenly chosen, shape [s]."""
    return np.unique(np.linspace(0, size - 1, SAMPLED).astype(np.int64))


def compare_sample(found: Found, exact: np.ndarray, rows: np.ndarray, size: int) -> dict[str, Any]:
    """Return the same of some particles alone, by the keys that the oracle has of them: their rows of a list, or their counts.

    A pair counts as half a pair for each of its particles that is among them; halves are rounded up.
    """
    if found.pairs is None:
        assert found.counts is not None
        surplus = found.counts[rows].astype(np.int64) - np.bincount(np.searchsorted(rows, exact // size), minlength=len(rows))
        missing, extra = (int(np.maximum(part, 0).sum()) for part in (-surplus, surplus))
        total = int(found.counts.sum(dtype=np.int64)) // 2
    else:
        keys = np.sort(np.concatenate([*_keys_of(rows, found, size)]))
        common = _common(_distinct(keys), exact)
        missing, extra = len(exact) - common, len(keys) - common
        total = (len(found.pairs[0]) if found.total is None else found.total) // (2 if found.directed else 1)
    row = {"pairs": total, "exact_pairs": len(exact) // 2, "compared": "sample"}
    return row | {"missing": -(-missing // 2), "extra": -(-extra // 2)}


def _keys(i: np.ndarray, j: np.ndarray, size: int) -> np.ndarray:
    """Return the sorted keys min(i, j)·n + max(i, j)."""
    return np.sort(np.minimum(i, j).astype(np.int64) * size + np.maximum(i, j))


def _keys_of(rows: np.ndarray, found: Found, size: int) -> Iterator[np.ndarray]:
    """Yield the keys i·n + j that a list has of some particles i."""
    assert found.pairs is not None
    wanted = np.zeros(size, bool)
    wanted[rows] = True
    for i, j in (found.pairs,) if found.directed else (found.pairs, found.pairs[::-1]):
        here = np.flatnonzero(wanted[i])
        yield i[here].astype(np.int64) * size + j[here]


def _distinct(keys: np.ndarray) -> np.ndarray:
    """Drop the repeats of sorted keys."""
    # np.unique makes a hash table of them: with it, 12 million pairs took 18 s to compare.
    return keys[np.concatenate(([True], keys[1:] != keys[:-1]))] if len(keys) else keys


def _merge(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge two sorted arrays, each without repeats; return their values, and of each but the last whether the next equals it."""
    merged = np.concatenate((first, second))
    merged.sort(kind="stable")
    return merged, merged[1:] == merged[:-1]


def _common(first: np.ndarray, second: np.ndarray) -> int:
    """Return how many values two sorted arrays without repeats share."""
    return int(_merge(first, second)[1].sum())


def _compare_unordered(i: np.ndarray, j: np.ndarray, exact: np.ndarray, size: int) -> dict[str, Any]:
    keys = _keys(i, j, size)
    common = len(exact) if np.array_equal(keys, exact) else _common(_distinct(keys), exact)
    return {"pairs": len(keys), "missing": len(exact) - common, "extra": len(keys) - common, "compared": "pairs"}


def _compare_directed(i: np.ndarray, j: np.ndarray, exact: np.ndarray, size: int) -> dict[str, Any]:
    ahead, back = (_keys(i[chosen], j[chosen], size) for chosen in (i < j, i > j))
    row = {"directed_pairs": len(i), "compared": "pairs"}
    own = len(i) - len(ahead) - len(back)
    if own == 0 and np.array_equal(ahead, exact) and np.array_equal(back, exact):
        return row | {"pairs": len(exact), "missing": 0, "extra": 0}
    there, here = _distinct(ahead), _distinct(back)
    merged, repeats = _merge(there, here)
    either, both = _distinct(merged), merged[1:][repeats]
    repeated = max(len(ahead) - len(there), len(back) - len(here))
    extra = len(either) - _common(either, exact) + repeated + own
    return row | {"pairs": len(either), "missing": len(exact) - _common(both, exact), "extra": extra}


def _compare_counts(counts: np.ndarray, exact: np.ndarray, size: int) -> dict[str, Any]:
    surplus = counts.astype(np.int64) - _oracle.count_neighbors(exact, size)
    missing, extra = (int(-(-np.maximum(part, 0).sum() // 2)) for part in (-surplus, surplus))
    return {"pairs": int(counts.sum() // 2), "missing": missing, "extra": extra, "compared": "counts"}
