"""vesin: a cell list in C++ with a list of unordered pairs, float64.

It is given lengths times a power of two, which changes their exponent alone, so that the cutoff is near 1: in metres it took ten
times as long on 7 200 particles, and did not end on 250 000.
"""

import math
from collections.abc import Callable

import numpy as np
from vesin import NeighborList  # pyright: ignore

from experiments.methods import Found

PACKAGES = ("vesin",)


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], tuple[np.ndarray, ...]]:
    """Return a search that lists the pairs."""
    scale = 2.0 ** -math.floor(math.log2(cutoff))
    search, box = NeighborList(cutoff=scale * cutoff, full_list=False), np.zeros((3, 3))  # pyright: ignore
    points = _in_space(positions)
    return lambda: tuple(search.compute(points=scale * points.astype(np.float64), box=box, periodic=False, quantities="ij"))


def read(result: tuple[np.ndarray, ...]) -> Found:
    """Return the pairs."""
    i, j = result
    return Found(i.nbytes + j.nbytes, (np.asarray(i, np.int64), np.asarray(j, np.int64)))


def _in_space(positions: np.ndarray) -> np.ndarray:
    return np.pad(positions, ((0, 0), (0, 3 - positions.shape[1])))
