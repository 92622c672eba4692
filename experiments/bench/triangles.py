"""Particles around a gear: what `search_triangles` takes, beside libraries that find the nearest triangle of each point."""

import importlib.util
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import process_time
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import typer

import jfrnn
from experiments import _machine, _measure
from experiments._commands import Points, Rounds, check_choice, positive
from experiments._library import Name
from experiments.bench import table
from jfrnn.cases import meshes

COLUMNS = (
    *("method", "n", "faces", "cutoff", "dtype", "pairs", "longest_row", "rounds", "median_s", "p10_s", "p90_s", "us_per_particle"),
    *("processor_s", "missing", "extra", "others_cores", "device", "jax", "warp", "peer", "commit", "dirty"),
)
SHOWN = ("method", "n", "faces", "cutoff", "pairs", "median_s", "processor_s", "us_per_particle", "missing", "extra")
_FEW = 2_000  # points that a peer is asked for whose time would be minutes
Faces = Annotated[list[int], typer.Option(min=100, max=10_000_000, help="Of gears, about; may be said several times.")]
Cutoffs = Annotated[list[float], typer.Option(callback=positive, help="[modules]; may be said several times.")]


class _Asked(NamedTuple):
    """What a peer says of the points `which`: their distances; and seconds of its runs, and of processors per run."""

    which: np.ndarray
    distance: np.ndarray
    seconds: list[float]
    processor: float


class _Scene(NamedTuple):
    points: np.ndarray  # float32
    vertices: np.ndarray
    faces: np.ndarray


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "triangles",
    points: Points = 250_000,
    faces: Faces = [500, 12_000, 200_000],  # noqa: B006 - Typer copies it
    cutoff: Cutoffs = [0.01, 0.03, 0.1, 0.3, 0.8],  # noqa: B006
    rounds: Rounds = 9,
    backend: Annotated[str, typer.Option(help="warp (beside bvh), bvh or jax.")] = "warp",
    dtype: Annotated[str, typer.Option(help="Of positions: float32 or float64.")] = "float32",
) -> str:
    """Time the triangles of a gear that are near particles, beside trimesh and libigl where they are installed.

    jfrnn lists all triangles within the cutoff: "update" with the cells of a wall that stays, "rebuild" with one that is sorted
    anew, "count" only counts them. Beside "warp" also "bvh", the same in a tree of boxes. Peers find the one nearest triangle of
    each point, however far, but for "wp.Mesh nearest", which looks no farther than the cutoff, on one core of a CPU. On a GPU calls
    of jfrnn are not waited for one by one. `missing` and `extra` are particles of which jfrnn says otherwise than a peer, in
    float64, whether a triangle is near.
    The module of gears is 1, their teeth are 20; points are random in their bounding boxes.
    """
    check_choice("--backend", backend, ("warp", "bvh", "jax"))
    check_choice("--dtype", dtype, ("float32", "float64"))
    jax.config.update("jax_enable_x64", dtype == "float64" or jax.config.read("jax_enable_x64"))
    parts = [(f"{number} faces", partial(_gear_rows, points, number, cutoff, rounds, backend, dtype)) for number in faces]
    given = [points, cutoff, rounds, dtype]
    return table.text(table.measure(out, f"{jax.default_backend()}_{backend}", parts, given, COLUMNS), SHOWN)


def _gear_rows(n: int, faces: int, cutoffs: list[float], rounds: int, backend: Name, dtype: str) -> Iterator[table.Line]:
    scene = _gear(n, faces)
    peers = {name: peer(scene) for name, peer in _PEERS.items() if importlib.util.find_spec(_MODULES[name])}
    for cutoff in cutoffs:
        yield from ({"dtype": dtype} | row for row in _rows(scene, cutoff, rounds, backend, dtype, peers))


def _rows(scene: _Scene, cutoff: float, rounds: int, backend: Name, dtype: str, peers: dict[str, _Asked]) -> Iterator[table.Line]:
    engines = (backend, "bvh") if backend == "warp" else (backend,)
    lists = {engine: _calls(scene, cutoff, engine, dtype) for engine in engines}
    calls = {f"{engine} {way}": call for engine, (calls, _) in lists.items() for way, call in calls.items()}
    seconds, others = _measure.time_in_turns(calls, rounds, _measure.burst())
    tri, n = lists[backend][1], len(scene.points)
    if any(np.any(np.asarray(other.count) != np.asarray(tri.count)) for _, other in lists.values()):
        raise RuntimeError(f"two engines count other triangles within {cutoff}: {', '.join(engines)}.")
    near = np.asarray(tri.count) > 0
    common = {"faces": len(scene.faces), "cutoff": cutoff, "others_cores": others}
    row = {"n": n, "pairs": int(tri.count.sum()), "longest_row": int(tri.required)}
    for way, call in calls.items():
        _, _, processor = _repeat(lambda call=call: jax.block_until_ready(call()))
        yield common | row | {"method": f"jfrnn {way}"} | _times_of(seconds[way], n, processor)
    for name, (asked, distance, taken, processor) in (peers | _tree(scene, cutoff)).items():
        within = distance < cutoff
        wrong = {"missing": int(np.sum(within & ~near[asked])), "extra": int(np.sum(near[asked] & ~within))}
        package = "warp-lang" if name.startswith("wp.") else name
        row = {"n": len(asked), "method": name, "peer": str(_machine.versions([package])[package])} | wrong
        yield common | row | _times_of(taken, len(asked), processor)


def _gear(n: int, faces: int) -> _Scene:
    """Return random points around a gear."""
    vertices, named = meshes.gear(20, faces)
    vertices = vertices.astype(np.float32)
    low, high = vertices.min(axis=0) - 0.5, vertices.max(axis=0) + 0.5
    return _Scene(np.random.default_rng(0).uniform(low, high, (n, 3)).astype(np.float32), vertices, named)


def _calls(scene: _Scene, cutoff: float, backend: Name, dtype: str) -> tuple[dict[str, Callable[[], Any]], jfrnn.TriangleList]:
    """Return compiled updates of a list by name: of a wall that stays or is sorted anew, and counts."""
    x, vertices = jnp.asarray(scene.points, dtype), jnp.asarray(scene.vertices, dtype)
    tri = jfrnn.search_triangles(x, vertices, jnp.asarray(scene.faces), cutoff, backend=backend)
    update = jax.jit(lambda x, tri: tri.update(x))
    rebuild = jax.jit(lambda x, vertices, tri: tri.update(x, vertices=vertices))
    count = jax.jit(lambda x, tri: tri.update(x).count)
    calls: dict[str, Callable[[], Any]] = {"update": lambda: update(x, tri), "rebuild": lambda: rebuild(x, vertices, tri)}
    calls["count"] = lambda: count(x, tri)
    jax.block_until_ready([call() for call in calls.values()])
    return calls, tri


def _libigl(scene: _Scene) -> _Asked:
    import igl  # pyright: ignore[reportMissingImports]

    points, vertices = scene.points.astype(np.float64), scene.vertices.astype(np.float64)
    (square, *_), seconds, processor = _repeat(lambda: igl.point_mesh_squared_distance(points, vertices, scene.faces))
    return _Asked(np.arange(len(points)), np.sqrt(square), seconds, processor)


def _trimesh(scene: _Scene) -> _Asked:
    mesh = trimesh.Trimesh(scene.vertices.astype(np.float64), scene.faces, process=False)
    asked = np.arange(min(_FEW, len(scene.points)))
    points = scene.points[asked].astype(np.float64)
    (_, distance, _), seconds, processor = _repeat(lambda: trimesh.proximity.closest_point(mesh, points))
    return _Asked(asked, distance, seconds, processor)


def _tree(scene: _Scene, cutoff: float) -> dict[str, _Asked]:
    """Ask the tree of boxes that Warp has of a mesh, by name of the way; empty where Warp is missing."""
    if importlib.util.find_spec("warp") is None:
        return {}
    from experiments.bench import bvh

    device = "cpu" if jax.default_backend() == "cpu" else "cuda:0"
    find = bvh.find_nearest(scene.points, scene.vertices, scene.faces, cutoff, device)
    found, seconds, processor = _repeat(find)
    return {"wp.Mesh nearest": _Asked(np.arange(len(scene.points)), found.numpy(), seconds, processor)}


def _repeat(call: Callable[[], Any]) -> tuple[Any, list[float], float]:
    """Return a result, the seconds of three runs, and those of all processors per run, which other work disturbs less."""
    call()
    begin = process_time()
    result, seconds = _measure.repeat(call, 3, 0.0, 3)
    return result, seconds, (process_time() - begin) / len(seconds)


_PEERS: dict[str, Callable[[_Scene], _Asked]] = {"libigl": _libigl, "trimesh": _trimesh}
_MODULES = {"libigl": "igl", "trimesh": "trimesh"}


def _times_of(seconds: list[float], n: int, processor: float) -> dict[str, Any]:
    said = _measure.summarize(seconds)
    times = {name: said[name] for name in ("median_s", "p10_s", "p90_s")}
    return times | {"rounds": said["repeats"], "us_per_particle": 1e6 * said["median_s"] / n, "processor_s": processor}
