"""Triangles in a run on a GPU: the hard cases against the oracle, then seconds of lists around a gear, by engine and kernel.

A time stands in a row that also says how many lists were wrong: those that differ, as sets, from the array engine's.
"""

import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jfrnn
from experiments import _compare, _measure
from experiments._library import Name, triangle_query
from experiments.bench import bvh
from experiments.bench.triangles import gear, updates


def decisions(oracle: Any, dtype: str, dim: int, capacity: int, backend: Name) -> Iterator[tuple[str, bool]]:  # noqa: ANN401
    """Say of every hard case whether its list is the oracle's, and its distances are as near as they are promised to be."""
    from jfrnn.cases.triangles import TRIANGLE_CASES, padded

    for name, case in TRIANGLE_CASES.items():
        plain = case.build(np.dtype(dtype), dim)
        given = padded(plain)
        x, vertices, faces = (jnp.asarray(array) for array in (given.positions, given.vertices, given.faces))
        tri = jfrnn.search_triangles(x, vertices, faces, given.cutoff, capacity=capacity, backend=backend)
        expected = oracle.triangle_pairs(plain.positions, plain.vertices, plain.faces, plain.cutoff)
        yield name, is_exact(oracle, tri, expected) and are_near(oracle, tri, x, plain)


def is_exact(oracle: Any, tri: Any, expected: Any) -> bool:  # noqa: ANN401
    """Say whether a list holds exactly these pairs, and says no less of itself."""
    idx, count, fill = np.asarray(tri.idx), np.asarray(tri.count), len(tri.faces)
    filled = np.all(idx[np.arange(tri.capacity) >= count[:, None]] == fill)
    told = bool(filled) and not tri.overflow and int(tri.required) == int(count.max())
    return told and _compare.is_exact(oracle, idx, count, fill, expected)


def are_near(oracle: Any, tri: Any, x: Any, given: Any) -> bool:  # noqa: ANN401
    """Say whether the distances of a list of particles x to their triangles are within what `TriangleList.closest` says."""
    _, distances, mask = (np.asarray(array) for array in tri.closest(x))
    if not np.array_equal(mask, np.arange(tri.capacity) < np.asarray(tri.count)[:, None]):
        return False
    idx, bound = np.asarray(tri.idx), 4 * float(np.finfo(distances.dtype).eps)
    for i, slot in np.argwhere(mask):
        exact, size = oracle.distance(given.positions[i], given.vertices[given.faces[idx[i, slot]]])
        if not abs(float(distances[i, slot]) - exact) <= bound * size:
            return False
    return True


def rows(
    n: int, faces: int, cutoff: float, dtype: str, steps: int, timed: Callable[..., dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Time lists of n random particles around a gear, by "warp", "bvh" and "jax".

    "update" keeps the cells or the tree of a wall that stays, also for particles along a Morton curve, "rebuild" sorts it anew,
    "count" makes no list; each is a call that is not waited for, or a step of a scan. On CUDA, each kernel of
    "warp" and "bvh" is timed, too.

    Args:
        n: Particles.
        faces: Of the gear, about.
        cutoff: [modules].
        dtype: Of all floats.
        steps: Of the scan.
        timed: Times a call: `experiments.gpu.timings.time_calls`, of a config.
    """
    scene = gear(n, faces)
    x, vertices = (jnp.asarray(part.astype(dtype)) for part in (scene.points, scene.vertices))
    named = jnp.asarray(scene.faces)
    exact = jfrnn.search_triangles(x, vertices, named, cutoff, backend="jax")
    base = {"kind": "triangles", "layout": "gear", "points": n, "faces": len(scene.faces), "cutoff": cutoff, "dtype": dtype}
    base |= {"capacity": exact.capacity, "pairs": int(np.asarray(exact.count).sum(dtype=np.int64))}
    for backend in ("warp", "bvh", "jax"):
        tri = jfrnn.search_triangles(x, vertices, named, cutoff, capacity=exact.capacity, backend=backend)
        again = tri.update(x)
        wrong = _compare.different_rows(tri.idx, exact.idx) + int(np.sum(np.asarray(tri.count) != np.asarray(exact.count)))
        about = base | {"wrong": wrong, "same_bits_twice": bool((tri.idx == again.idx).all() & (tri.count == again.count).all())}
        for name, call in _calls(tri, x, vertices, steps).items():
            said = timed(call)
            if name.startswith("scan"):
                said = _measure.summarize([s / steps for s in said["seconds"]]) | {"steps": steps}
            yield about | {"method": f"jfrnn {backend}, {name}"} | said
        if backend != "jax" and jax.default_backend() == "gpu":
            yield about | {"method": f"jfrnn {backend}, kernels alone"} | stages(tri, x)
    if dtype == "float32" and jax.default_backend() == "gpu":
        yield from tree_rows(base, scene, exact.count, "cuda:0")


def tree_rows(base: dict[str, Any], scene: Any, count: Any, device: str) -> Iterator[dict[str, Any]]:  # noqa: ANN401
    """Time what Warp's tree of boxes takes of the same scene, kernels alone: for nearest points, and for boxes that are near.

    `differing` says of how many particles the tree has a triangle within the cutoff and the list has none, or the other way round.
    """
    tree = bvh.Tree(scene.points, scene.vertices, scene.faces, base["cutoff"], device)
    differs = (tree.ask("nearest") < base["cutoff"]) != (np.asarray(count) > 0)
    for name in tree.launches:
        told = {"differing": int(differs.sum())} if name == "nearest" else {"boxes": int(tree.ask(name).sum(dtype=np.int64))}
        yield (
            base
            | {"method": f"wp.Mesh, {name}, kernel alone"}
            | told
            | {"median_s": _measure.time_kernels([functools.partial(tree.launch, name)], 5)[-1]}
        )


def _calls(tri: Any, x: Any, vertices: Any, steps: int) -> dict[str, Callable[[], Any]]:  # noqa: ANN401
    if tri.backend == "jax":  # takes long, to compile too: what `rows` has compiled says enough
        return {"update": lambda: tri.update(x).idx, "rebuild": lambda: tri.update(x, vertices=vertices).idx}

    def step(carry: Any, _: None) -> tuple[Any, None]:  # noqa: ANN401
        x, tri = carry
        tri = tri.update(x)
        return (x + 0 * (tri.idx[0, 0] + tri.count[0]).astype(x.dtype), tri), None

    scan = jax.jit(lambda x, tri: lax.scan(step, (x, tri), None, length=steps)[0][1].status)
    return updates(tri, x, vertices, ("morton",)) | {"scan of updates": lambda: scan(x, tri)}


def stages(tri: Any, x: Any, repeats: int = 5) -> dict[str, Any]:  # noqa: ANN401
    """Return the seconds of the kernels of a query on CUDA, each alone on the device's clock, and what waited for integers."""
    launches, scratch = triangle_query(tri, x, "cuda:0")
    for launch in launches.values():  # compiled and loaded before graphs are recorded
        launch()
    until = _measure.time_kernels(list(launches.values()), repeats)
    names = [f"{name}_s" for name in launches]
    near, queued = scratch.numpy()[:2]
    told = {"median_s": until[-1], **dict(zip(names, np.diff([0.0, *until]).tolist(), strict=True))}
    return told | {"with_candidates": int(near), "settled": int(queued)}
