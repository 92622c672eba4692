"""The table of engines for triangles: how each sorts a wall, lists triangles, decides pairs and casts rays; the search by one."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine import WARP, Engine
from jfrnn._geometry import Cutoff, Status, make_cutoff
from jfrnn._search import round_capacity
from jfrnn._tracing import at_once, call_apart, compile_program, own_transfers
from jfrnn._triangles.cells import gather_corners, sort_triangles
from jfrnn._triangles.rows import Decide, decide_pairs, list_triangles
from jfrnn._triangles.tree import TriangleTree, grow_tree
from jfrnn._triangles.warp import cast_rays as cast_by_warp
from jfrnn._triangles.warp import decide_pairs as decide_by_warp
from jfrnn._triangles.warp import list_triangles as list_by_warp
from jfrnn._triangles.warp import sort_triangles as sort_by_warp
from jfrnn._triangles.winding import cast_rays

Wall = Any  # a sorted wall: the `TriangleCells` or `TriangleTree` that the engine's `sort` returns


class TriangleEngine(NamedTuple):
    """An engine that finds triangles. Engines differ in speed, never in their results.

    Attributes:
        name: The name that users pass as `backend`.
        uses_warp: Whether it needs Warp, and one of Warp's platforms.
        sort: (corners [f, corner, axis], good [f], cutoff) -> the sorted wall.
        list: (positions, corners, wall, cutoff, capacity or None) -> rows [n, capacity] and true counts [n].
        decide: Decides which particles are near which triangles, as `rows.decide_pairs` does.
        cast: Decides which points are inside, as `winding.cast_rays` does.
    """

    name: str
    uses_warp: bool
    sort: Callable[[Array, Array, Cutoff], Wall]
    list: Callable[[Array, Array, Wall, Cutoff, int | None], tuple[Array, Array]]
    decide: Decide
    cast: Callable[[TriangleTree, Array, Array, Array, Array, Array, Cutoff], tuple[Array, Array]]


_BY_WARP = (list_by_warp, decide_by_warp, cast_by_warp)
_JAX = TriangleEngine("jax", False, sort_triangles, list_triangles, decide_pairs, cast_rays)
_CELLS = TriangleEngine("warp", True, sort_by_warp, *_BY_WARP)
_TREE = TriangleEngine("bvh", True, grow_tree, *_BY_WARP)
TRIANGLE_ENGINES = {engine.name: engine for engine in (_JAX, _CELLS, _TREE)}

# Where Warp runs: which of its two engines "auto" takes, by platform. `python -m experiments bench triangles` and `gpu
# experiments/configs/h200_triangles.toml`, rows in experiments/results/triangles: on the CPU the tree takes 0.2 to 1.2 times as
# long as the cells around gears of 1 280 to 200 640 faces, at cutoffs from a hundredth of a module to 0.8, a wall anew 0.1 to 0.9
# times. On an H200 it takes 1.0 to 2.1 times as long, a wall anew 0.3 to 0.8 times.
_FASTER = {"cpu": _TREE, "gpu": _CELLS}


def fastest_of(platform: str, engine: Engine) -> TriangleEngine:
    """Return the engine that "auto" chooses for triangles on a platform where it chooses this one for neighbors."""
    return _FASTER.get(platform, _CELLS) if engine is WARP else _JAX


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
