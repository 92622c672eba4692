"""pykdtree: a kd-tree in C for the nearest k neighbors, k being the most that a particle has; all cores, dtype of the positions."""

from collections.abc import Callable

import numpy as np
from pykdtree.kdtree import KDTree  # pyright: ignore[reportMissingImports]

from experiments.methods import Found
from experiments.methods._pairs import most_in_ball as allocate  # it cannot ask for all within a distance

PACKAGES = ("pykdtree",)


def prepare(positions: np.ndarray, cutoff: float, capacity: int) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and finds the nearest of each particle."""
    return lambda: KDTree(positions).query(positions, k=capacity, distance_upper_bound=cutoff)[1].reshape(len(positions), -1)


def read(result: np.ndarray) -> Found:
    """Return the ordered pairs, less each particle with itself."""
    i, k = np.nonzero(result < len(result))
    j = result[i, k].astype(np.int64)
    return Found(result.nbytes, (i[i != j], j[i != j]), directed=True)
