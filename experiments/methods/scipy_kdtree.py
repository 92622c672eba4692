"""SciPy's kd-tree with a list of unordered pairs: float64 arithmetic on the given positions, distance <= cutoff."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from experiments.methods._pairs import read_pairs as read


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and lists the pairs."""
    return lambda: KDTree(positions).query_pairs(cutoff, output_type="ndarray")
