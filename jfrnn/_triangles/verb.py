"""The public function `search_triangles`: find the triangles of a wall that are closer to particles than a cutoff."""

from typing import Literal

import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._engine import ARRAYS, PLATFORMS, WARP, choose_engine, parse_backend, platform_of
from jfrnn._geometry import check_capacity, check_cutoff, check_positions, check_slack
from jfrnn._tracing import Given, IndexRows, Number, Points, Real, Size, as_array, gather, make_on_host
from jfrnn._triangles.engines import TRIANGLE_ENGINES, TriangleEngine, count_slots, fastest_of, find_fields
from jfrnn._triangles.triangle_list import TriangleList
from jfrnn._triangles.winding import is_closed


def search_triangles(
    positions: Points,
    vertices: Points,
    faces: IndexRows,
    cutoff: Number,
    *,
    capacity: Size | None = None,
    slack: Real = 1.0,
    backend: Literal["auto", "warp", "bvh", "jax"] = "auto",
) -> TriangleList:
    """Find all triangles of a wall that are closer to a particle than a cutoff, exactly, each once; in 2D all segments.

    (i, t) is listed iff the distance of particle i to the closed triangle t (face, sides and vertices) is below the cutoff in exact
    arithmetic on the given floats, the cutoff being rounded once to their dtype. Triangles may be slivers, segments or points, of
    any size. Cost: O(particles + faces + candidates). The candidates of a particle are the triangles in its cell, whose edge is
    about the cutoff, or about a quarter of a larger triangle; in a tree, the triangles of nodes whose boxes hold it.

    Args:
        positions: Particle positions [length], shape [n, 3] or [n, 2], float32 or float64. n = 0 is allowed.
        vertices: Corners [length], shape [v, 3] or [v, 2], same dtype.
        faces: Vertex indices, integers, shape [f, 3] for triangles, [f, 2] for segments in 2D. f = 0 is allowed. Their orientation
            matters to `TriangleList.signed_distance` only.
        cutoff: Distance [length], a static number > 0.
        capacity: Slots per row, a static int. Required if positions, vertices or faces are traced. Default: `slack` times the
            longest row, rounded up to a multiple of 8.
        slack: Factor >= 1 on the counted capacity, room for later motion.
        backend: "warp" (compiled kernels, on the CPU and on CUDA) and "jax" (any device) use cells; "bvh" (compiled kernels) uses a
            tree of boxes, which is rebuilt faster. "auto" is "bvh" on the CPU, "warp" on CUDA (if Warp is missing "jax", with a
            warning), and "jax" elsewhere.

    Returns:
        A `TriangleList`; `idx` has shape [n, capacity], unused slots hold f. The order within rows is unspecified, but the same
        input gives the same bits. `status` tells of overflow, of coordinates that are not finite and of invalid vertex indices.

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range, or `capacity` is missing under jit.
        ImportError, RuntimeError: "warp" or "bvh", and Warp is not installed or cannot run on the platform.

    Jit and vmap: yes, with capacity. `jax.shard_map`: yes, with distributed particles and the wall on every device. Differentiable:
    see `TriangleList.closest`. Memory and what compiles: the guide "Walls of triangles" (docs/guides/triangles.md).
    Source: strict cutoff (Peifle 2019, §2.2).

    >>> import jax.numpy as jnp, jfrnn
    >>> x = jnp.array([[0.2, 0.2, 0.05], [0.2, 0.2, -0.2], [1.05, 0.0, 0.0]])
    >>> corners = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    >>> tri = jfrnn.search_triangles(x, corners, jnp.array([[0, 1, 2]]), 0.1)
    >>> tri.count
    Array([1, 0, 1], dtype=int32)
    """
    points = check_positions("positions", positions)
    corners = check_positions("vertices", vertices, like=points)
    named = _check_faces(faces, points.shape[1], corners.shape[0])
    radius = check_cutoff(cutoff, np.dtype(points.dtype))
    engine, slack = _choose_engine(backend, points), check_slack(slack)
    if capacity is None:
        if any(isinstance(x, Tracer) for x in (points, corners, named)):
            raise ValueError(
                "capacity must be given where positions, vertices or faces are traced (jax.jit, vmap, grad, scan), because it is a "
                "shape: pass the capacity of an earlier search, with room to move, and check tri.overflow."
            )
        capacity = count_slots(points, corners, named, radius, engine, slack)
    found = find_fields(points, corners, named, None, radius, engine, check_capacity(capacity))
    closed = None if isinstance(named, Tracer) else is_closed(named)
    return TriangleList(**found, cutoff=radius, backend=engine.name, closed=closed)


def _check_faces(faces: Given, dim: int, vertices: int) -> Array:
    """Return faces as int32 [f, dim]; invalid indices stay out of range."""
    kind = "triangles" if dim == 3 else "segments"
    faces = as_array("faces", faces)
    if not hasattr(faces, "dtype") or not np.issubdtype(faces.dtype, np.integer):
        given = f"{np.dtype(faces.dtype)}" if hasattr(faces, "dtype") else type(faces).__name__
        raise TypeError(f"faces must be an array of integers of shape [f, {dim}], the vertices of {kind}, got {given}.")
    if len(faces.shape) != 2 or faces.shape[1] != dim:
        raise ValueError(f"faces must have shape [f, {dim}], the vertices of {kind} in {dim}D, got shape {list(faces.shape)}.")
    least = 0 if np.issubdtype(faces.dtype, np.unsignedinteger) else -1
    if isinstance(faces, Tracer):
        return _clip(gather(faces), least, vertices)
    return make_on_host(faces, lambda known: _clip(known, least, vertices))


def _clip(faces: Given, least: int, most: int) -> Given:
    return (faces.clip(least, most) if np.iinfo(faces.dtype).max > most else faces).astype(np.int32)


def _choose_engine(backend: object, points: Array) -> TriangleEngine:
    """Return the engine of a backend; raise if it cannot run on the platform of the points."""
    engine, platform = parse_backend(backend, TRIANGLE_ENGINES), platform_of(points)
    if engine is None:
        return fastest_of(platform, choose_engine(None, points, None))
    if engine.uses_warp and platform not in PLATFORMS:
        raise RuntimeError(f"backend={backend!r} finds triangles on the CPU and on CUDA, got {platform!r}: pass backend='jax'.")
    choose_engine(WARP if engine.uses_warp else ARRAYS, points, None)  # raises if Warp is needed and missing
    return engine
