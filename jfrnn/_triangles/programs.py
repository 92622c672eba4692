"""The compiled program of a triangle search, and the count that determines its capacity."""

import functools
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry import Cutoff, Status, make_cutoff
from jfrnn._search import round_capacity
from jfrnn._tracing import at_once, call_apart, compile_program, own_transfers
from jfrnn._triangles.cells import gather_corners
from jfrnn._triangles.engines import TriangleEngine, Wall


def count_slots(points: Array, vertices: Array, faces: Array, cutoff: float, engine: TriangleEngine, slack: float) -> int:
    """Count the triangles near concrete positions; return a capacity of `slack` times the longest row."""
    with at_once(), own_transfers():
        found = find_fields(points, vertices, faces, None, cutoff, engine, None)
        longest = int(found["required"])
    return round_capacity(math.ceil(max(longest, 1) * slack))


def find_fields(
    points: Array, vertices: Array, faces: Array, cells: Wall | None, cutoff: float, engine: TriangleEngine, capacity: int | None
) -> dict[str, Any]:
    """Return the list's fields that come from data, or only counts if capacity=None. `cells`: an earlier list's sorted wall."""
    radius = make_cutoff(cutoff, np.dtype(points.dtype), closed=False)
    with own_transfers():
        find = functools.partial(find_triangles, engine=engine, capacity=capacity)
        return call_apart(find, *lax.stop_gradient((points, vertices, faces, cells)), radius)


@functools.partial(compile_program, static_argnames=("engine", "capacity"))
def find_triangles(
    points: Array, vertices: Array, faces: Array, cells: Wall | None, cutoff: Cutoff, engine: TriangleEngine, capacity: int | None
) -> dict[str, Any]:
    """List or count triangles: the compiled program of a search.

    The wall and its sorted form are returned too, so that as results they share no memory with the caller's arrays or another list.
    """
    corners, finite, there = gather_corners(vertices, faces)
    sound = {
        Status.NONFINITE: jnp.all(jnp.isfinite(points)),
        Status.NONFINITE_VERTEX: jnp.all(finite),
        Status.FACE_OUT_OF_RANGE: jnp.all(there),
    }
    n, f, slots = points.shape[0], faces.shape[0], capacity or 0
    if cells is None and f > 0:
        cells = engine.sort(corners, finite & there, cutoff)
    if cells is None or n == 0:
        idx, count = jnp.full((n, slots), f, jnp.int32), jnp.zeros(n, jnp.int32)
    else:
        idx, count = engine.list(points, corners, cells, cutoff, capacity)
    required = jnp.max(count, initial=0)
    if capacity is not None:
        sound[Status.ROW_OVERFLOW] = required <= slots
    bits = [jnp.where(good, 0, bit.value).astype(jnp.int32) for bit, good in sound.items()]
    status = functools.reduce(jnp.bitwise_or, bits)
    fields = {"idx": idx, "count": count, "status": status, "required": required}
    return fields if capacity is None else fields | {"cells": cells, "vertices": vertices, "faces": faces}
