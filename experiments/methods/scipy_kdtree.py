"""SciPy's kd-tree with a list of unordered pairs: float64 arithmetic on the given positions, distance <= cutoff."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from experiments.methods import Found


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and lists the pairs."""
    return lambda: KDTree(positions).query_pairs(cutoff, output_type="ndarray")


def read(result: np.ndarray) -> Found:
    """Return the pairs, shape [m, 2]."""
    return Found(result.nbytes, (result[:, 0], result[:, 1]))
