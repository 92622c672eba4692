"""Which points are inside a solid whose faces are farther away than they see: winding numbers of a few of them tell.

Two points that have no face within reach, and are closer to each other than twice the reach, are on the same side: each place
between them is within reach of one of the two. So points are put into cells, cells that touch are one part, and one point of each
part is asked.
"""

import math

import numpy as np
from numpy.typing import NDArray

_CELL = 1.98  # reaches, the diagonal of two cells that touch


def find_inside(points: NDArray[np.float64], reach: float, corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Say which points [m], shape [n, d], are inside a closed solid, none of whose faces is within reach [m] of them; shape [n].

    Inside is where the winding number is 1 or more; of a solid around the fluid, which encloses a negative volume, 0 or more. Faces
    are given by their corners [m], shape [f, d, d], counterclockwise as seen from outside.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    volumes, low, high = np.linalg.det(corners - corners[0, 0]), corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    around = bool(volumes.sum() < -1e-9 * np.abs(volumes).sum())
    inside, between = np.full(len(points), around), ((points > low) & (points < high)).all(axis=1)
    if not between.any():
        return inside
    points = points[between]
    edge = reach * _CELL / (2 * math.sqrt(points.shape[1]))
    cells = np.floor((points - low) / edge).astype(np.int64)
    _, first, cell = np.unique(np.ravel_multi_index(cells.T, cells.max(axis=0) + 1), return_index=True, return_inverse=True)
    touching = KDTree(cells[first]).query_pairs(1.5, p=np.inf, output_type="ndarray").T
    graph = coo_array((np.ones(touching.shape[1]), tuple(touching)), (len(first), len(first)))
    part = connected_components(graph, directed=False)[1]
    asked = first[np.unique(part, return_index=True)[1]]
    found = np.array([_winding(corners - point) + around > 1 / 2 for point in points[asked]])
    inside[between] = found[part[cell]]
    return inside


def _winding(r: NDArray[np.float64]) -> float:
    """Return how often faces go around the origin: their angles as seen from there, over that of all directions.

    Source: Van Oosterom & Strackee (1983), doi:10.1109/TBME.1983.325207, for a triangle.
    """
    if r.shape[2] == len("xy"):
        return float(np.arctan2(np.linalg.det(r), np.einsum("fk,fk->f", r[:, 0], r[:, 1])).sum() / (2 * np.pi))
    length = np.linalg.norm(r, axis=2)
    dots = np.einsum("fak,fbk->fab", r, r)
    below = length.prod(axis=1) + dots[:, 0, 1] * length[:, 2] + dots[:, 0, 2] * length[:, 1] + dots[:, 1, 2] * length[:, 0]
    return float(np.arctan2(np.linalg.det(r), below).sum() / (2 * np.pi))
