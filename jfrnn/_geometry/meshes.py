"""Meshes as `search_triangles` takes them: corners that triangles have in common."""

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._tracing import Given, on_device, own_transfers


def merge_vertices(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Make one vertex of all that coincide, so that triangles written apart, as in STL files, share sides and corners.

    `TriangleList.signed_distance` knows by the numbers of vertices which triangles hang together.
    Vertices are the same where all coordinates are equal, exactly (0 and -0 are; NaN is equal to nothing). Those that
    are left stand in the order in which each came first. Triangles stay in order, also those that are left with a corner twice,
    which bound nothing.

    Args:
        vertices: Corners [length], shape [v, 3] or [v, 2], float32 or float64. Of triangles alone, `corners` [f, 3, 3]:
            `corners.reshape(-1, 3)`.
        faces: Indices of vertices, integers, shape [f, k]. Of triangles alone: `jnp.arange(3 * f).reshape(f, 3)`.

    Returns:
        The vertices that are left, shape [w, d], same dtype, and faces that name these, shape [f, k], int32.

    Raises:
        TypeError: an argument is traced (how many vertices are left is a shape), or of another dtype.
        ValueError: an argument has another shape, or a face names a vertex that does not exist.

    Jit: no; on the host. Cost: a sort of all vertices.

    >>> import jax.numpy as jnp, jfrnn
    >>> soup = jnp.array([[0.0, 0], [1, 0], [1, 0], [1, 1], [1, 1], [0, 0]])
    >>> corners, segments = jfrnn.merge_vertices(soup, jnp.arange(6).reshape(3, 2))
    >>> corners.shape, segments.tolist()
    ((3, 2), [[0, 1], [1, 2], [2, 0]])
    """
    if isinstance(vertices, Tracer) or isinstance(faces, Tracer):
        raise TypeError("merge_vertices() makes a shape of what it finds and cannot run inside jax.jit: call it before.")
    points, named = _check_mesh(vertices, faces)
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    fresh = np.concatenate([np.ones(min(len(points), 1), bool), np.any(ordered[1:] != ordered[:-1], axis=1)])
    group = np.cumsum(fresh) - 1
    first = np.minimum.reduceat(order, np.flatnonzero(fresh)) if len(points) else order
    rank = np.empty_like(first)
    rank[np.argsort(first)] = np.arange(len(first))
    of_vertex = np.empty(len(points), np.int32)
    of_vertex[order] = rank[group]
    with own_transfers():
        return on_device(points[np.sort(first)]), on_device(of_vertex[named])


def _check_mesh(vertices: Given, faces: Given) -> tuple[np.ndarray, np.ndarray]:
    points, named = np.asarray(jax.device_get(vertices)), np.asarray(jax.device_get(faces))
    if points.dtype not in (np.float32, np.float64):
        raise TypeError(f"vertices must be float32 or float64, got {points.dtype}.")
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"vertices must have shape [v, 3] or [v, 2], got {list(points.shape)}.")
    if not np.issubdtype(named.dtype, np.integer):
        raise TypeError(f"faces must be integers, the vertices of triangles or segments, got {named.dtype}.")
    if named.ndim != 2:
        raise ValueError(f"faces must have shape [f, {points.shape[1]}], got {list(named.shape)}.")
    wrong = np.argwhere((named < 0) | (named >= len(points)))
    if len(wrong):
        face = int(wrong[0, 0])
        raise ValueError(f"faces must name vertices from 0 to {len(points) - 1}: face {face} is {named[face].tolist()}.")
    return points, named
