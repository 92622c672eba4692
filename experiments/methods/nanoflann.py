"""nanoflann through pynanoflann: a kd-tree in C++ with a row of neighbors per particle, in the dtype of the positions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pynanoflann  # pyright: ignore[reportMissingImports]

from experiments.methods._pairs import read_rows as read

PACKAGES = ("pynanoflann",)


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], list[Any]]:
    """Return a search that builds the tree and lists the rows, on one thread."""

    def search() -> list[Any]:
        tree: Any = pynanoflann.KDTree(metric="L2", radius=cutoff)
        tree.fit(positions)
        return tree.radius_neighbors(positions, radius=cutoff, return_distance=False)

    return search
