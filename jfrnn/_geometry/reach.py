"""How many cells of a lattice a cutoff reaches over."""

import math

import numpy as np

_ROUNDING = 0.01  # of a cell: the margin for rounding where vectors are about as long as their lattice is wide
_NEAREST = 0.5  # largest cutoff / width, with the margin for rounding, for which the minimum image suffices


def count_cells(
    vectors: np.ndarray, flags: np.ndarray, orthogonal: bool, radius: float, dtype: np.dtype
) -> tuple[tuple[int, ...], bool]:
    """Return how many cells away an image may lie and still be a neighbor, per axis, and whether the minimum image suffices.

    `vectors` are lengths [d] or rows [d, d], or those of each system; `flags` says which axes are periodic.
    `_ROUNDING` is far more than the rounding of coordinates, unless vectors are long beside the distances between their faces: then
    the residual of the transform, times the cells that an image lies away, is more (`jfrnn._geometry.wrapping.wrap`).
    """
    dim = vectors.shape[-1]
    rows = vectors[..., None] * np.eye(dim) if orthogonal else vectors
    rows = np.where(flags[..., None], rows, 0)
    regular = flags.all() and bool((np.linalg.det(rows) != 0).all())
    inverse = np.linalg.inv(rows) if regular else np.linalg.pinv(rows)  # which takes ten times as long
    share = np.where(flags, radius * np.linalg.norm(inverse, axis=-2), 0)  # of the distances between opposite faces
    residual = np.where(flags, (np.abs(rows) @ np.abs(inverse)).sum(axis=-2), 0)
    margin = 48 * float(np.finfo(dtype).eps) * (share.max(axis=-1, keepdims=True) + 3) * residual
    needed = (share + np.where(flags, np.maximum(_ROUNDING, margin), 0)).reshape(-1, dim).max(axis=0)  # of any system
    return tuple(math.ceil(x) for x in needed.tolist()), bool((needed <= _NEAREST).all())
