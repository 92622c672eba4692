"""SciPy's kd-tree without a pair list: the number of neighbors of each particle, distance <= cutoff, one thread."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from experiments.methods import Found


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and counts the points in each ball."""

    def search() -> np.ndarray:
        return KDTree(positions).query_ball_point(positions, cutoff, return_length=True, workers=1)

    return search


def read(result: np.ndarray) -> Found:
    """Return the counts, less the particle itself."""
    return Found(result.nbytes, counts=result - 1)
