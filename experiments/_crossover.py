"""From which size on an engine is the fastest: compiled searches of random points, the engines side by side."""

import csv
import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jfrnn
from experiments import _compare, _machine, _measure, _oracle
from experiments.methods import Found

BACKENDS = ("jax", "warp", "brute")
NEIGHBORS = (30, 108)
SIZES = (16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768, 100_000)
MOST_POINTS = {"brute": 8192}
REPEATS = 30
COLUMNS = (
    *("platform", "n", "neighbors", "mean_count", "capacity", "backend", "repeats", "median_s", "p10_s", "p90_s"),
    *("missing", "extra", "others_cores", "device", "jax", "warp", "commit", "dirty"),
)

Search = Callable[[jax.Array], jfrnn.NeighborList]


def measure(folder: Path, sizes: tuple[int, ...] | None = None, repeats: int = REPEATS) -> Path:
    """Write a table of seconds by size, neighbors and backend, a row at a time, and return its path.

    Args:
        folder: Takes a file named after the platform, such as cpu.csv; one that is there is replaced.
        sizes: Numbers of points; `SIZES` without it.
        repeats: Timed runs of each backend, in turns.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{jax.default_backend()}.csv"
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        for neighbors in NEIGHBORS:
            for n in sizes or SIZES:
                for row in _rows(n, neighbors, repeats):
                    writer.writerow(row)
                    stream.flush()
    return path


def _rows(n: int, neighbors: int, repeats: int) -> Iterator[dict[str, Any]]:
    """Yield a row per backend for one scene: n points in the unit cube, with about so many neighbors away from its faces."""
    points = np.random.default_rng(n).random((n, 3)).astype(np.float32)
    cutoff = _oracle.round_cutoff((3 * neighbors / (4 * math.pi * n)) ** (1 / 3), np.float32)
    x, exact = jax.numpy.asarray(points), _oracle.find_pairs(points, cutoff)
    capacity = jfrnn.search(x, cutoff).capacity
    backends = [backend for backend in BACKENDS if n <= MOST_POINTS.get(backend, n)]
    searches = {backend: _compile(x, cutoff, capacity, backend) for backend in backends}
    calls = {backend: functools.partial(search, x) for backend, search in searches.items()}
    seconds, others = _measure.time_in_turns(calls, repeats)
    versions, commit, device = _machine.versions(), _machine.commit(), next(iter(x.devices()))
    for backend, search in searches.items():
        nbrs = search(x)
        found = _compare.compare(Found(nbrs.idx.nbytes, nbrs.pairs(), directed=True), exact, n)
        times = {name: f"{value:.3e}" for name, value in _measure.summarize(seconds[backend]).items() if name.endswith("_s")}
        yield {
            **{"platform": device.platform, "n": n, "neighbors": neighbors, "mean_count": round(2 * len(exact) / n, 1)},
            **{"capacity": capacity, "backend": backend, "repeats": repeats, **times},
            **{"missing": found["missing"], "extra": found["extra"], "others_cores": others, "device": device.device_kind},
            **{"jax": versions["jax"], "warp": versions["warp-lang"], **commit},
        }


def _compile(x: jax.Array, cutoff: float, capacity: int, backend: str) -> Search:
    """Return a jitted search that has run twice: compiled, its kernels loaded, its memory touched."""
    search = jax.jit(lambda x: jfrnn.search(x, cutoff, capacity=capacity, backend=backend))
    for _ in range(2):
        jax.block_until_ready(search(x))
    return search
