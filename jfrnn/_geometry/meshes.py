"""Mesh preparation for `search_triangles`: join the corners that triangles share."""

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._geometry.inputs import refuse_rounding
from jfrnn._tracing import Given, IndexRows, Points, as_array, on_device, own_transfers


def merge_vertices(vertices: Points, faces: IndexRows) -> tuple[Array, Array]:
    """Join coincident vertices, so that triangles stored separately, as in STL files, share sides and corners.

    `TriangleList.signed_distance` and `contacts` recognize adjacent triangles by common vertex numbers. Vertices coincide if all
    coordinates are exactly equal (0 equals -0; NaN equals nothing). The remaining vertices keep the order of their first
    occurrence. Triangles keep their order; one that has a corner twice afterwards is kept as well, and bounds nothing.

    Args:
        vertices: Corners [length], shape [v, 3] or [v, 2], float32 or float64. For separate triangles `corners` [f, 3, 3] pass
            `corners.reshape(-1, 3)`.
        faces: Vertex indices, integers, shape [f, k]. For separate triangles pass `jnp.arange(3 * f).reshape(f, 3)`.

    Returns:
        The remaining vertices, shape [w, d], same dtype, and faces that index them, shape [f, k], int32.

    Raises:
        TypeError: an argument is traced (the number of vertices is a shape), or of another dtype.
        ValueError: an argument has another shape, or a face has an index that no vertex has.

    Jit: no; runs on the host. Cost: a sort of all vertices.

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
    points = np.asarray(jax.device_get(as_array("vertices", vertices, float)))
    named = np.asarray(jax.device_get(as_array("faces", faces)))
    if points.dtype not in (np.float32, np.float64):
        raise TypeError(f"vertices must be float32 or float64, got {points.dtype}.")
    if points.dtype == np.float64:
        refuse_rounding("vertices")
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
