"""scikit-learn's kd-tree with a row of neighbors per particle, float64, distance <= cutoff."""

from collections.abc import Callable

import numpy as np
from sklearn.neighbors import KDTree  # pyright: ignore[reportMissingImports]

from experiments.methods._pairs import read_rows as read

PACKAGES = ("scikit-learn",)


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and lists the rows."""
    return lambda: KDTree(positions).query_radius(positions, cutoff)
