"""The ANN library 1.1.2 (Mount and Arya) as the thesis used it: a tree in float64, a count and a fetch per particle, and a list."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from experiments import _native
from experiments.methods import Found

LIBRARY = _native.load("ann", "ANN/ANN.h", "libann-dev", ("ann",))
LIBRARY.ann_search.restype = ctypes.c_void_p
NO_LIST, SANE, NAIVE = range(3)
PARTS: tuple[str, ...] = ("t_tree", "t_ksearch", "t_frsearch", "t_processing")


@dataclass
class Result:
    """What a search found, and the seconds of `PARTS` of all searches so far; pairs have shape [m, 2]."""

    counts: np.ndarray
    pairs: np.ndarray
    seconds: list[np.ndarray] = field(default_factory=list)


def prepare(positions: np.ndarray, cutoff: float, *, tree: str, processing: int) -> Callable[[], Result]:
    """Return a search that builds the tree ("kd" or "bd"), counts, fetches, and lists pairs as `processing` says."""
    n, dim = positions.shape
    taken: list[np.ndarray] = []

    def search() -> Result:
        points = np.ascontiguousarray(positions, np.float64)
        counts, seconds = np.zeros(n, np.int32), np.zeros(4)
        handle = LIBRARY.ann_search(
            *(_native.pointer(points), n, dim, ctypes.c_double(cutoff), int(tree == "bd"), processing),
            *(_native.pointer(counts), _native.pointer(seconds)),
        )
        taken.append(seconds)
        return Result(counts, _native.take_pairs(LIBRARY, handle), taken)

    return search


def read(result: Result) -> Found:
    """Return the unordered pairs, and the median time of each part."""
    pairs, parts = result.pairs, dict(zip(PARTS, np.median(result.seconds, axis=0).tolist(), strict=True))
    return Found(pairs.nbytes, (pairs[:, 0], pairs[:, 1]), parts=parts)


def read_counts(result: Result) -> Found:
    """Return the neighbors of each particle, less itself, and the median time of each part."""
    return Found(result.counts.nbytes, counts=result.counts - 1, parts=read(result).parts)
