"""matscipy-neighbours: a cell list in C++ with all ordered pairs, float64."""

from collections.abc import Callable

import numpy as np
from matscipy_neighbours import neighbour_list  # pyright: ignore[reportMissingImports]

from experiments.methods import Found

PACKAGES = ("matscipy-neighbours",)


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Return a search that lists the pairs."""
    points = np.pad(positions, ((0, 0), (0, 3 - positions.shape[1])))
    return lambda: neighbour_list("ij", positions=points.astype(np.float64), cutoff=cutoff)  # pyright: ignore


def read(result: tuple[np.ndarray, np.ndarray]) -> Found:
    """Return the ordered pairs."""
    i, j = result
    return Found(i.nbytes + j.nbytes, (np.asarray(i, np.int64), np.asarray(j, np.int64)), directed=True)
