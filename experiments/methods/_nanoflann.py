"""nanoflann in C++, float64, one thread, with a list of unordered pairs: rebuilt, or followed by its dynamic index."""

import ctypes
from collections.abc import Callable

import numpy as np

from experiments import _native
from experiments.methods import Found
from experiments.methods._moving import away, directions, turning_step

LIBRARY = _native.load("nanoflann", "nanoflann.hpp", "libnanoflann-dev")
for name in ("static_search", "dynamic_new", "dynamic_search"):
    getattr(LIBRARY, name).restype = ctypes.c_void_p
STEPS = 5  # after so many, the index is made anew: what it was told to forget stays in it
Result = tuple[np.ndarray, np.ndarray]


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], np.ndarray]:
    """Return a search that builds the tree and lists the pairs."""
    (n, dim), radius = positions.shape, ctypes.c_double(cutoff)

    def search() -> np.ndarray:
        points = np.ascontiguousarray(positions, np.float64)
        return _native.take_pairs(LIBRARY, LIBRARY.static_search(_native.pointer(points), n, dim, radius))

    return search


def follow(positions: np.ndarray, cutoff: float, motion: float, *, dynamic: bool) -> Callable[[], Result]:
    """Return `STEPS` steps of motion and search; the first of them builds the index."""
    rays, turn, (n, dim), at = directions(positions), turning_step(cutoff, motion), positions.shape, [0]
    radius = ctypes.c_double(cutoff)

    def place() -> tuple[np.ndarray, np.ndarray]:
        at[0] += 1
        x = positions + positions.dtype.type(away(at[0], turn) * motion) * rays
        return x, np.ascontiguousarray(x, np.float64)

    def search() -> Result:
        tree = None
        for _ in range(STEPS):
            x, points = place()
            if not dynamic:
                pairs = _native.take_pairs(LIBRARY, LIBRARY.static_search(_native.pointer(points), n, dim, radius))
                continue
            if tree is None:
                tree = ctypes.c_void_p(LIBRARY.dynamic_new(_native.pointer(points), n, dim))
            else:
                LIBRARY.dynamic_move(tree, _native.pointer(points))
            pairs = _native.take_pairs(LIBRARY, LIBRARY.dynamic_search(tree, radius))
        if dynamic:
            LIBRARY.dynamic_release(tree)
        return pairs, x  # pyright: ignore[reportPossiblyUnboundVariable]

    return search


def read(result: Result) -> Found:
    """Return the unordered pairs."""
    pairs, x = result
    return Found(pairs.nbytes, (pairs[:, 0], pairs[:, 1]), positions=x)
