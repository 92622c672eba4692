"""freud: its tree of bounding boxes in C++, on all cores, with all ordered pairs, float32; open space as a box that is wide enough.

Its `LinkCell` took eight times as long on 450 particles.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from freud import box as boxes  # pyright: ignore
from freud import locality  # pyright: ignore

from experiments.methods import Found
from experiments.methods._pairs import in_space

PACKAGES = ("freud-analysis",)


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], Any]:
    """Return a search that sorts the particles and lists the pairs."""
    points = in_space(positions)
    # around the origin, as its boxes are: to move the points instead would round them
    lengths: Any = [2 * float(most) + 3 * cutoff for most in np.abs(points).max(axis=0)]
    box = boxes.Box(*lengths)

    def search() -> Any:  # noqa: ANN401
        query: Any = locality.AABBQuery(box, points)  # pyright: ignore
        return query.query(points, {"r_max": cutoff, "exclude_ii": True}).toNeighborList()

    return search


def read(result: Any) -> Found:  # noqa: ANN401
    """Return the ordered pairs."""
    pairs = np.asarray(result[:], np.int64)
    return Found(pairs.nbytes, (pairs[:, 0], pairs[:, 1]), directed=True)
