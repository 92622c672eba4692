"""Cell-linked lists as the thesis used them: half stencil, list of unordered pairs, one thread, distance < cutoff as rounded."""

from collections.abc import Callable

import numpy as np
import warp as wp

from experiments.methods import Found, _cll_kernels
from experiments.methods._pairs import in_space, read_pairs


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], wp.array]:
    """Return a search that links the cells, counts the pairs and lists them."""
    points = in_space(positions)
    vector = wp.vec3f if points.dtype == np.float32 else wp.vec3d

    def search(points: np.ndarray = points) -> wp.array:
        lower, upper = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        return _cll_kernels.search_pairs(wp.array(points, dtype=vector, device="cpu", copy=False), lower, upper, cutoff)

    search(points[:1])  # compiles the kernels
    return search


def read(result: wp.array) -> Found:
    """Return the pairs, shape [m, 2]."""
    return read_pairs(result.numpy())
