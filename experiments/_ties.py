"""What pairs at exactly the cutoff cost: lattices full of them beside the same scenes moved at random, side by side in one run.

The scenes are those of the thesis. On its lattice, as on a crystal, 30 of the 122 sites around a particle lie at exactly the
cutoff of 3 spacings. Whether floats can tell depends on the spacing: 1 and 1/64 are powers of two, 1e-4 is not.
"""

import csv
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax.typing import DTypeLike
from tqdm import tqdm

import jfrnn
from experiments import _config, _layouts, _machine, _measure, _oracle
from jfrnn._search.neighbor_list import rounded_capacity

JITTER = 0.3  # of a spacing, to either side
SAMPLE = 2000  # particles whose neighbors are compared with the oracle's
TIMED = ("count", "list", "density")
COLUMNS = (
    *("platform", "backend", "dtype", "scene", "sites", "n", "neighbors", "checked", "wrong", "rounds"),
    *(f"{what}_s" for what in TIMED),
    *(f"{what}_ratio" for what in TIMED),
    *("others_cores", "device", "jax", "warp", "commit", "dirty"),
)


class _Sites(NamedTuple):
    """Where the particles of a scene are: positions [n, 3] in the dtype of the run, and the cutoff."""

    name: str
    positions: np.ndarray
    cutoff: float


def measure(folder: Path, rounds: int, backend: str, scenes: Path, largest: int | None = None) -> Path:
    """Write a table of seconds, one row for each scene, dtype and kind of sites, as they are measured; return its path.

    Args:
        folder: Takes a file named after platform and backend, such as cpu_warp.csv; one that is there is replaced.
        rounds: Of timed runs; medians of them count.
        backend: As in `jfrnn.search`.
        scenes: Config of a sweep, whose layouts are taken.
        largest: Measure a cube of about so many sites instead, without other scenes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{jax.default_backend()}_{backend}.csv"
    integers = dict(_scenes(scenes)) if largest is None else {"cube": _cube(largest)}
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        for scene, sites in tqdm(integers.items(), desc="scenes"):
            for dtype in (np.float32, np.float64):
                writer.writerows(_rows(scene, sites, dtype, rounds, backend))
                stream.flush()
    return path


def table(path: Path) -> str:
    """Return the table of a run as text: ratios to the same scene moved at random."""
    columns = ["scene", "dtype", "sites", "n", "wrong", *(f"{what}_s" for what in TIMED), *(f"{what}_ratio" for what in TIMED)]
    return pd.read_csv(path)[columns].to_string(index=False)


def _scenes(config: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the scenes of a sweep by name, as whole numbers of spacings [n, 3]."""
    for part in _config.load(config).scenes:
        for layout in part.layouts:
            for fill in part.fills:
                scene = _layouts.make(layout, fill=fill)
                yield f"{layout} {fill:.0%}", np.rint(scene.positions / scene.spacing)


def _cube(size: int) -> np.ndarray:
    side = round(size ** (1 / 3))
    return np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)


def _placed(integers: np.ndarray, dtype: DTypeLike) -> Iterator[_Sites]:
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


def _rows(scene: str, integers: np.ndarray, dtype: DTypeLike, rounds: int, backend: str) -> Iterator[dict[str, Any]]:
    placed = list(_placed(integers, dtype))
    calls = [_compiled(sites, backend) for sites in placed]
    numbered = {f"{k} {what}": call for k, each in enumerate(calls) for what, call in each.items()}
    for call in numbered.values():
        jax.block_until_ready(call())
    burst = 20 if jax.default_backend() == "gpu" else 1
    seconds, others = _measure.time_in_turns(numbered, rounds, burst)
    medians = np.median(list(seconds.values()), axis=1).reshape(len(placed), len(TIMED))
    versions, commit, device = _machine.versions(), _machine.commit(), jax.devices()[0]
    for sites, each, median in zip(placed, calls, medians, strict=True):
        count = np.asarray(each["count"]())
        rows = np.sort(np.random.default_rng(1).choice(len(count), min(SAMPLE, len(count)), replace=False))
        keys = _oracle.find_sample(sites.positions, sites.cutoff, rows)
        exact = np.bincount(keys // len(count), minlength=len(count))[rows]
        yield (
            {"platform": device.platform, "backend": backend, "dtype": np.dtype(dtype).name, "scene": scene, "sites": sites.name}
            | {"n": len(count), "neighbors": round(float(count.mean()), 1), "checked": len(rows)}
            | {"wrong": int((count[rows] != exact).sum()), "rounds": rounds, "others_cores": others, "device": device.device_kind}
            | {f"{what}_s": f"{value:.3e}" for what, value in zip(TIMED, median, strict=True)}
            | {f"{what}_ratio": round(value, 2) for what, value in zip(TIMED, median / medians[0], strict=True)}
            | {"jax": versions["jax"], "warp": versions["warp-lang"], **commit}
        )


def _compiled(sites: _Sites, backend: str) -> dict[str, Callable[[], Any]]:
    x, r = jnp.asarray(sites.positions), sites.cutoff
    count = jax.jit(lambda x: jfrnn.count(x, r, backend=backend))
    capacity = rounded_capacity(int(np.asarray(count(x)).max()))
    search = jax.jit(lambda x: jfrnn.search(x, r, capacity=capacity, backend=backend).idx)

    def kernel(d: jax.Array, i: Any, j: Any) -> jax.Array:  # noqa: ANN401
        return jnp.maximum(1 - d @ d / (r * r), 0) ** 3

    density = jax.jit(lambda x: jfrnn.pair_sum(kernel, x, r, backend=backend))
    return {"count": lambda: count(x), "list": lambda: search(x), "density": lambda: density(x)}
