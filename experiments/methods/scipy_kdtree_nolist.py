"""SciPy's kd-tree without a pair list: the number of neighbors of each particle, distance <= cutoff, one thread unless told."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from experiments.methods import Found


def prepare(positions: np.ndarray, cutoff: float | np.ndarray, *, workers: int = 1) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and counts the points in each ball, whose radii may differ, with so many threads."""

    def search() -> np.ndarray:
        return KDTree(positions).query_ball_point(positions, cutoff, return_length=True, workers=workers)

    return search


def read(result: np.ndarray) -> Found:
    """Return the counts, less the particle itself."""
    return Found(result.nbytes, counts=result - 1)
