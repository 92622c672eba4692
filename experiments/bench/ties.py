"""What pairs at exactly the cutoff cost: lattices full of them beside the same scenes moved at random, side by side in one run.

The scenes are those of the thesis. On its lattice, as on a crystal, 30 of the 122 sites around a particle lie at exactly the
cutoff of 3 spacings. Whether floats can tell depends on the spacing: 1 and 1/64 are powers of two, 1e-4 is not.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jax.typing import DTypeLike

import jfrnn
from experiments import _config, _layouts, _measure, _oracle
from experiments._commands import MOST_POINTS, Engine, Rounds
from experiments._library import Name
from experiments.bench import lists, table

JITTER = 0.3  # of a spacing, to either side
SAMPLE = 2000  # particles whose neighbors are compared with the oracle's
TIMED = ("count", "list", "density")
COLUMNS = (
    *("platform", "backend", "dtype", "scene", "sites", "n", "neighbors", "checked", "wrong", "rounds"),
    *(f"{what}_s" for what in TIMED),
    *(f"{what}_ratio" for what in TIMED),
    *("others_cores", "device", "jax", "warp", "commit", "dirty"),
)


SHOWN = ("scene", "dtype", "sites", "n", "wrong", *(f"{what}_s" for what in TIMED), *(f"{what}_ratio" for what in TIMED))
Scenes = Annotated[Path, typer.Argument(help="Config of a sweep whose layouts are measured, TOML.")]
Cube = Annotated[int | None, typer.Option(min=1000, max=MOST_POINTS, help="Sites of a cube to measure instead of these layouts.")]


class _Sites(NamedTuple):
    """Where the particles of a scene are: positions [n, 3] in the dtype of the run, and the cutoff."""

    name: str
    positions: np.ndarray
    cutoff: float


def command(
    scenes: Scenes = Path("experiments/configs/thesis.toml"),
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "ties",
    rounds: Rounds = 15,
    backend: Engine = "warp",
    cube: Cube = None,
) -> str:
    """Time lattices full of pairs at exactly the cutoff beside the same scenes moved at random."""
    jax.config.update("jax_enable_x64", True)
    given = _config.load(scenes)
    integers = dict(_scenes(given)) if cube is None else {f"cube {cube}": partial(_cube, cube)}
    parts = [
        (f"{scene} {np.dtype(dtype).name}", partial(_rows, scene, sites, dtype, rounds, backend))
        for scene, sites in integers.items()
        for dtype in (np.float32, np.float64)
    ]
    return table.text(table.measure(out, f"{jax.default_backend()}_{backend}", parts, rounds, COLUMNS), SHOWN)


def _scenes(config: _config.Config) -> Iterator[tuple[str, Callable[[], np.ndarray]]]:
    """Yield the scenes of a sweep by name, as whole numbers of spacings [n, 3]."""
    for part in config.scenes:
        for layout in part.layouts:
            for fill in part.fills:
                yield f"{layout} {fill:.0%}", partial(_sites, layout, fill)


def _sites(layout: str, fill: float) -> np.ndarray:
    scene = _layouts.make(layout, fill=fill)
    return np.rint(scene.positions / scene.spacing)


def _cube(size: int) -> np.ndarray:
    side = round(size ** (1 / 3))
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)


def _place(integers: np.ndarray, dtype: DTypeLike) -> Iterator[_Sites]:
    """Yield the same sites at several spacings, in random order; the first ones are moved at random."""
    random = np.random.default_rng(0)
    integers = random.permutation(integers)
    one_off = integers.copy()
    one_off[0] += 0.1
    kinds = {
        "moved at random": (integers + random.uniform(-JITTER, JITTER, integers.shape), 1.0),
        "spacing 1": (integers, 1.0),
        "spacing 1/64": (integers, 1 / 64),
        "spacing 1e-4": (integers, 1e-4),
        "spacing 1, one particle off": (one_off, 1.0),
    }
    for name, (sites, spacing) in kinds.items():
        yield _Sites(name, (sites * spacing).astype(dtype), float(np.asarray(3 * spacing, dtype)))


def _rows(scene: str, sites: Callable[[], np.ndarray], dtype: DTypeLike, rounds: int, backend: Name) -> Iterator[table.Line]:
    """Time one scene in one dtype: a row for each kind of sites; medians of rounds count."""
    placed = list(_place(sites(), dtype))
    calls = [_compile(each, backend) for each in placed]
    numbered = {f"{k} {what}": call for k, each in enumerate(calls) for what, call in each.items()}
    for call in numbered.values():
        jax.block_until_ready(call())
    seconds, others = _measure.time_in_turns(numbered, rounds, _measure.burst())
    medians = np.median(list(seconds.values()), axis=1).reshape(len(placed), len(TIMED))
    for place, each, median in zip(placed, calls, medians, strict=True):
        count = np.asarray(each["count"]())
        rows = np.sort(np.random.default_rng(1).choice(len(count), min(SAMPLE, len(count)), replace=False))
        keys = _oracle.find_sample(place.positions, place.cutoff, rows)
        exact = np.bincount(keys // len(count), minlength=len(count))[rows]
        row = {"backend": backend, "dtype": np.dtype(dtype).name, "scene": scene.split()[0] if "cube" in scene else scene}
        row |= {"sites": place.name, "n": len(count), "neighbors": round(float(count.mean()), 1), "checked": len(rows)}
        row |= {"wrong": int((count[rows] != exact).sum()), "rounds": rounds, "others_cores": others}
        row |= {f"{what}_s": float(value) for what, value in zip(TIMED, median, strict=True)}
        yield row | {f"{what}_ratio": round(float(value), 2) for what, value in zip(TIMED, median / medians[0], strict=True)}


def _compile(sites: _Sites, backend: Name) -> dict[str, Callable[[], Any]]:
    x, counts = jnp.asarray(sites.positions), jfrnn.count(sites.positions, sites.cutoff, backend=backend)
    scene = lists.Scene(x, sites.cutoff, np.asarray(counts))
    made = {"count": lists.count, "list": lists.search, "density": lists.density}
    return {what: partial(jax.jit(make(scene, backend=backend)), x) for what, make in made.items()}
