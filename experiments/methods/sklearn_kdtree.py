"""scikit-learn's kd-tree with a row of neighbors per particle, float64, distance <= cutoff."""

from collections.abc import Callable

import numpy as np
from sklearn.neighbors import KDTree  # pyright: ignore[reportMissingImports]

from experiments.methods import Found

PACKAGES = ("scikit-learn",)


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and lists the rows."""
    return lambda: KDTree(positions).query_radius(positions, cutoff)


def read(result: np.ndarray) -> Found:
    """Return the ordered pairs, less each particle with itself."""
    i = np.repeat(np.arange(len(result)), [len(row) for row in result])
    j = np.concatenate(result) if len(result) else np.zeros(0, np.int64)
    others = i != j
    return Found(int(j.nbytes + result.nbytes), (i[others], j[others].astype(np.int64)), directed=True)
