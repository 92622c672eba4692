"""What adapters of other libraries share: points in space, and pairs as they come."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import KDTree

from experiments.methods import Found


def in_space(positions: np.ndarray) -> np.ndarray:
    """Return points in space: what lies in a plane has z = 0."""
    return np.pad(positions, ((0, 0), (0, 3 - positions.shape[1])))


def most_in_ball(positions: np.ndarray, cutoff: float) -> int:
    """Return the most particles within the cutoff of one, itself included."""
    return int(KDTree(positions).query_ball_point(positions, cutoff, return_length=True, workers=-1).max())


def prepare_matscipy(
    neighbour_list: Callable[..., tuple[np.ndarray, np.ndarray]], positions: np.ndarray, cutoff: float
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Return a search that lists the pairs, by a function with the arguments of matscipy's."""
    points = in_space(positions)
    return lambda: neighbour_list("ij", positions=points.astype(np.float64), cutoff=cutoff)


def read_ordered(result: tuple[np.ndarray, ...], directed: bool = True) -> Found:
    """Return the ordered pairs (i, j), unless they are not `directed`."""
    i, j = result
    return Found(i.nbytes + j.nbytes, (np.asarray(i, np.int64), np.asarray(j, np.int64)), directed=directed)


def read_pairs(result: np.ndarray) -> Found:
    """Return the unordered pairs, shape [m, 2]."""
    return Found(result.nbytes, (result[:, 0], result[:, 1]))


def read_rows(result: Sequence[np.ndarray]) -> Found:
    """Return the ordered pairs of rows that hold each particle itself, too, less these."""
    i = np.repeat(np.arange(len(result)), [len(row) for row in result])
    j = np.concatenate([np.zeros(0, np.int64), *result]).astype(np.int64)
    return Found(sum(row.nbytes for row in result), (i[i != j], j[i != j]), directed=True)
