"""A tree of boxes around triangles (in 2D: segments), the other structure in which a search looks for them.

Triangles stand along a Hilbert curve through the middles of their boxes; each `WIDTH` of them share a node, each `WIDTH` nodes one
above, up to the children of the root (Kamel & Faloutsos 1993, doi:10.1145/170088.170403). So a tree is made by sorting and by
minima and maxima of rows, in arrays whose shapes the number of triangles tells: inside `jax.jit`, too. The curve tells a millionth
of the extent of all middles apart, so that a few triangles far away leave the others in order.

Why no pair is missed: the box of a triangle is wider by r' on each side, slightly more than the cutoff, and holds all particles
that are nearer, since rounding is monotone and a particle is a float; the box of a node holds those of its children.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._geometry import Cutoff, hilbert_order

WIDTH = 16  # children of a node
_CELL = 2.0**-20  # of the curve, beside the extent of the middles of boxes


class TriangleTree(NamedTuple):
    """Triangles in a tree of boxes. A pytree.

    Attributes:
        triangles: Indices of triangles along the curve, shape [leaves], int32, their number behind the last.
        boxes: Corners of boxes, wider by the cutoff, axis by axis, the low ones first: shape [2 d, entries]; of the leaves, then
            of nodes, level by level. Where there is none, a box is empty: from infinity to -infinity.
    """

    triangles: Array
    boxes: Array


def level_starts(faces: int) -> np.ndarray:
    """Return the first entry of each level, the leaves first, and the number of all, shape [levels + 1], int32."""
    ends = [0]
    while True:
        size = -(-faces // WIDTH) * WIDTH
        ends.append(ends[-1] + size)
        if size <= WIDTH:
            return np.array(ends, np.int32)
        faces = size // WIDTH


def boxes_around(corners: Array, cutoff: Cutoff) -> tuple[Array, Array]:
    """Return the corners, low and high, [f, d] each, of boxes that hold all particles near triangles [f, corner, axis]."""
    wide = jnp.asarray(cutoff.radius) * (1 + 8 * jnp.finfo(corners.dtype).eps)  # subtraction rounds monotonously
    return jnp.min(corners, axis=1) - wide, jnp.max(corners, axis=1) + wide


def grow_tree(corners: Array, good: Array, cutoff: Cutoff) -> TriangleTree:
    """Put triangles [f, corner, axis] with f > 0 into a tree; those that are not `good` [f] bool are in no box."""
    faces, dim = corners.shape[:2]
    low, high = boxes_around(corners, cutoff)
    middle = jnp.where(good[:, None], 0.5 * low + 0.5 * high, jnp.nan)
    finite, finfo = jnp.isfinite(middle), jnp.finfo(corners.dtype)
    least = jnp.min(middle, axis=0, initial=finfo.max, where=finite)
    most = jnp.max(middle, axis=0, initial=finfo.min, where=finite)
    cell = jnp.max(most * _CELL - least * _CELL)  # the extent itself may be more than a float holds
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
