"""Cell-linked lists as the thesis used them: half stencil, list of unordered pairs, one thread, distance < cutoff as rounded."""

from collections.abc import Callable

import numpy as np
import warp as wp

from experiments.methods import Found, _cll_kernels


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], wp.array]:
    """Return a search that links the cells, counts the pairs and lists them."""
    points = np.pad(positions, ((0, 0), (0, 3 - positions.shape[1])))
    vector = wp.vec3f if points.dtype == np.float32 else wp.vec3d

    def search(points: np.ndarray = points) -> wp.array:
        lower, upper = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        return _cll_kernels.search_pairs(wp.array(points, dtype=vector, device="cpu", copy=False), lower, upper, cutoff)

    search(points[:1])  # compiles the kernels
    return search


def read(result: wp.array) -> Found:
    """Return the pairs, shape [m, 2]."""
    pairs = result.numpy()
    return Found(pairs.nbytes, (pairs[:, 0], pairs[:, 1]))
