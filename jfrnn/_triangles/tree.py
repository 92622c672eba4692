"""A tree of bounding boxes around triangles (in 2D: segments), the alternative to cells.

Triangles are sorted along a Hilbert curve through the centers of their boxes; each `WIDTH` of them share a node, each `WIDTH` nodes
a parent, up to the children of the root (Kamel & Faloutsos 1993, doi:10.1145/170088.170403). The tree is thus made by a sort and by
row-wise minima and maxima, in arrays whose shapes follow from the number of triangles, so it can be made inside `jax.jit`. The
curve resolves a millionth of the extent of all centers, so a few distant triangles leave the order of the others intact.

No pair is missed: a triangle's box is widened by r', slightly more than the cutoff, and holds all particles that are nearer,
because rounding is monotonic and coordinates are floats; the box of a node holds those of its children.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._geometry import Cutoff, hilbert_order
from jfrnn._tracing import portable

WIDTH = 16  # children of a node
_CELL = 2.0**-20  # cell of the curve, relative to the extent of all box centers


@portable
class TriangleTree(NamedTuple):
    """Triangles in a tree of boxes. A pytree.

    Attributes:
        triangles: Triangle indices along the curve, shape [leaves], int32, padded with the number of triangles.
        boxes: Corners of boxes widened by the cutoff, the low ones axis by axis, then the high ones, shape [2 d, entries]; first
            the leaves, then the nodes level by level. Unused boxes are empty: from infinity to -infinity.
    """

    triangles: Array
    boxes: Array


def level_starts(faces: int) -> np.ndarray:
    """Return the first entry of each level, leaves first, and the total number of entries, shape [levels + 1], int32."""
    ends = [0]
    while True:
        size = -(-faces // WIDTH) * WIDTH
        ends.append(ends[-1] + size)
        if size <= WIDTH:
            return np.array(ends, np.int32)
        faces = size // WIDTH


def boxes_around(corners: Array, cutoff: Cutoff) -> tuple[Array, Array]:
    """Return low and high corners, [f, d] each, of boxes that hold all particles near triangles [f, corner, axis]."""
    wide = jnp.asarray(cutoff.radius) * (1 + 8 * jnp.finfo(corners.dtype).eps)  # wide enough, as subtraction rounds monotonically
    return jnp.min(corners, axis=1) - wide, jnp.max(corners, axis=1) + wide


def grow_tree(corners: Array, good: Array, cutoff: Cutoff) -> TriangleTree:
    """Sort triangles [f, corner, axis] with f > 0 into a tree; those that are not `good` [f] bool are in no box."""
    faces, dim = corners.shape[:2]
    low, high = boxes_around(corners, cutoff)
    middle = jnp.where(good[:, None], 0.5 * low + 0.5 * high, jnp.nan)
    finite, finfo = jnp.isfinite(middle), jnp.finfo(corners.dtype)
    least = jnp.min(middle, axis=0, initial=finfo.max, where=finite)
    most = jnp.max(middle, axis=0, initial=finfo.min, where=finite)
    cell = jnp.max(most * _CELL - least * _CELL)  # scaled first, as the extent itself may overflow
    order = hilbert_order(middle, jnp.clip(cell, finfo.tiny, finfo.max))
    low, high = jnp.where(good[:, None], low, jnp.inf)[order].T, jnp.where(good[:, None], high, -jnp.inf)[order].T
    levels = []
    for size in np.diff(level_starts(faces)):
        more = ((0, 0), (0, size - low.shape[1]))
        low, high = jnp.pad(low, more, constant_values=jnp.inf), jnp.pad(high, more, constant_values=-jnp.inf)
        levels.append(jnp.concatenate([low, high]))
        low, high = jnp.min(low.reshape(dim, -1, WIDTH), axis=2), jnp.max(high.reshape(dim, -1, WIDTH), axis=2)
    leaves = levels[0].shape[1]
    return TriangleTree(jnp.pad(order, (0, leaves - faces), constant_values=faces), jnp.concatenate(levels, axis=1))
