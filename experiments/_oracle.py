"""The exact answer at scale: every unordered pair with |x_j - x_i| < cutoff, as exact arithmetic on the given floats decides it.

Independent of the library. A kd-tree gives candidates a little beyond the cutoff; float64 decides those that are clearly inside or
outside; integers of any length decide the rest.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial import KDTree

# The tree's own float64 rounding is below 1e-12 of the cutoff; a millionth more costs nothing and cannot lose a pair.
CANDIDATE_MARGIN = 1e-6
# With u = 2^-53: a float64 difference of two given floats is off by u, its square by 3 u, the sum of three squares by 5 u, the
# squared cutoff by u, each relative. Near the cutoff the comparison is off by less than 6 u (1 + 6 u) r²; 16 u r² is safe.
DECIDED_MARGIN = 16 * 2.0**-53
# Squares of lengths in this range neither overflow nor lose bits to denormals.
SQUARABLE = (1e-140, 1e140)
CHUNK = 1 << 20


def round_cutoff(cutoff: float, dtype: DTypeLike) -> float:
    """Round the cutoff once to the dtype of the positions."""
    return float(np.asarray(cutoff, dtype))


def find_pairs(positions: np.ndarray, cutoff: float) -> np.ndarray:
    """Return all pairs i < j with distance < cutoff as sorted keys i·n + j, int64; the cutoff is rounded to the dtype first.

    Positions are finite, shape [n, d], float32 or float64. A ValueError says where float64 cannot square the cutoff.
    """
    cutoff = round_cutoff(cutoff, positions.dtype)
    if not SQUARABLE[0] < cutoff < SQUARABLE[1]:
        raise ValueError(f"cutoff {cutoff!r} is outside {SQUARABLE}: its square is not safe in float64")
    points = positions.astype(np.float64)
    candidates = KDTree(points).query_pairs(cutoff * (1 + CANDIDATE_MARGIN), output_type="ndarray")
    keys = [_decide(points, part, cutoff) for part in np.split(candidates, range(CHUNK, len(candidates), CHUNK))]
    return np.sort(np.concatenate(keys))


def _decide(points: np.ndarray, candidates: np.ndarray, cutoff: float) -> np.ndarray:
    """Return the keys of the candidates that are pairs; candidates are [m, 2] with i < j."""
    i, j = candidates.T
    excess = np.square(points[j] - points[i]).sum(axis=1) - cutoff * cutoff
    margin = DECIDED_MARGIN * cutoff * cutoff
    inside = excess < -margin
    band = np.flatnonzero(np.abs(excess) <= margin)
    inside[band] = _is_closer(points, i[band], j[band], cutoff)
    return i[inside].astype(np.int64) * len(points) + j[inside]


def _is_closer(points: np.ndarray, i: np.ndarray, j: np.ndarray, cutoff: float) -> np.ndarray:
    """Compare squared distances with the squared cutoff in integers of any length, shape [m]."""
    used, inverse = np.unique(np.concatenate((i, j)), return_inverse=True)
    exact = _to_integers(np.append(points[used].ravel(), cutoff))
    coordinates, radius = exact[:-1].reshape(points[used].shape), exact[-1]
    first, second = np.split(inverse, 2)
    squared = sum((coordinates[second, axis] - coordinates[first, axis]) ** 2 for axis in range(points.shape[1]))
    return np.asarray(squared < radius**2, dtype=bool)


def _to_integers(values: np.ndarray) -> np.ndarray:
    """Return Python integers that are the given float64 values times one common power of two."""
    mantissa, exponent = np.frexp(values)
    exponent = np.where(values == 0, exponent.max(), exponent)
    shift = (exponent - exponent.min()).astype(object)
    return np.ldexp(mantissa, 53).astype(np.int64).astype(object) << shift


def count_neighbors(keys: np.ndarray, size: int) -> np.ndarray:
    """Return the number of neighbors of each of `size` particles, shape [size]."""
    i, j = np.divmod(keys, max(size, 1))
    return np.bincount(i, minlength=size) + np.bincount(j, minlength=size)


def find_sample(positions: np.ndarray, cutoff: float, rows: np.ndarray) -> np.ndarray:
    """Return all pairs of some particles i, whatever j is, as sorted keys i·n + j: where those of all would not fit into memory.

    As in `find_pairs`; the particles are given in ascending order, shape [s].
    """
    cutoff, points = round_cutoff(cutoff, positions.dtype), positions.astype(np.float64)
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)  # few are asked: what takes long is to build it
    near = tree.query_ball_point(points[rows], cutoff * (1 + CANDIDATE_MARGIN))
    i, j = np.repeat(rows, [len(row) for row in near]), np.concatenate([*near]).astype(np.int64)
    i, j = i[i != j], j[i != j]
    local, inverse = np.unique(np.concatenate((i, j)), return_inverse=True)  # keys of few points stay small
    pairs = np.stack(np.split(inverse, 2), axis=1)
    inside = np.isin(pairs @ [len(local), 1], _decide(points[local], pairs, cutoff))
    return np.sort(i[inside] * len(points) + j[inside])


def load_pairs(positions: np.ndarray, cutoff: float, folder: Path) -> np.ndarray:
    """Return `find_pairs`, computed at most once per folder."""
    return _load(find_pairs, positions, cutoff, folder)


def load_sample(positions: np.ndarray, cutoff: float, rows: np.ndarray, folder: Path) -> np.ndarray:
    """Return `find_sample`, computed at most once per folder."""
    return _load(find_sample, positions, cutoff, folder, rows)


def _load(find: Callable[..., np.ndarray], positions: np.ndarray, cutoff: float, folder: Path, *rows: np.ndarray) -> np.ndarray:
    """Return what `find` finds, from a file named by a digest of all that is given, where there is one."""
    cutoff = round_cutoff(cutoff, positions.dtype)
    digest = hashlib.sha256(f"{positions.shape} {positions.dtype} {cutoff.hex()}".encode())
    for values in (positions, *rows):
        digest.update(np.ascontiguousarray(values).data)
    file = folder / f"{digest.hexdigest()[:24]}.npy"
    if file.exists():
        return np.load(file)
    keys = find(positions, cutoff, *rows)
    folder.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{os.getpid()}.part")
    with partial.open("wb") as stream:
        np.save(stream, keys)
    partial.replace(file)
    return keys
