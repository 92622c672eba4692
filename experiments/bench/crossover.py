"""From which size on an engine is the fastest: compiled searches of random points, the engines side by side."""

import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer

import jfrnn
from experiments import _compare, _measure, _oracle
from experiments._library import Name
from experiments.bench import table
from experiments.methods import Found

BACKENDS = ("jax", "warp", "brute")
NEIGHBORS = (30, 108)
SIZES = (16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768, 100_000)
MOST_POINTS = {"brute": 8192}
COLUMNS = (
    *("platform", "n", "neighbors", "mean_count", "capacity", "backend", "repeats", "median_s", "p10_s", "p90_s"),
    *("missing", "extra", "others_cores", "device", "jax", "warp", "commit", "dirty"),
)

Search = Callable[[jax.Array], jfrnn.NeighborList]


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "crossovers",
    repeats: Annotated[int, typer.Option(min=20, max=100_000, help="Timed runs of each backend.")] = 30,
) -> str:
    """Time the backends side by side over sizes and neighbors: what `backend="auto"` goes by."""
    return table.text(measure(out, repeats), ("n", "neighbors", "backend", "median_s", "missing", "extra"))


def measure(out: Path, repeats: int, sizes: tuple[int, ...] = SIZES) -> table.pd.DataFrame:
    """Write the table of these numbers of points, and return it."""
    pairs = [(neighbors, n) for neighbors in NEIGHBORS for n in sizes]
    parts = [(f"{n} points, {neighbors} neighbors", functools.partial(_rows, n, neighbors, repeats)) for neighbors, n in pairs]
    return table.measure(out, jax.default_backend(), parts, repeats, COLUMNS)


def _rows(n: int, neighbors: int, repeats: int) -> Iterator[table.Line]:
    """Yield a row per backend for one scene: n points in the unit cube, with about so many neighbors away from its faces."""
    points = np.random.default_rng(n).random((n, 3)).astype(np.float32)
    cutoff = _oracle.round_cutoff((3 * neighbors / (4 * math.pi * n)) ** (1 / 3), np.float32)
    x, exact = jax.numpy.asarray(points), _oracle.find_pairs(points, cutoff)
    capacity = jfrnn.search(x, cutoff).capacity
    backends = [backend for backend in BACKENDS if n <= MOST_POINTS.get(backend, n)]
    searches = {backend: _compile(x, cutoff, capacity, backend) for backend in backends}
    calls = {backend: functools.partial(search, x) for backend, search in searches.items()}
    seconds, others = _measure.time_in_turns(calls, repeats)
    for backend, search in searches.items():
        nbrs = search(x)
        found = _compare.compare(Found(nbrs.idx.nbytes, nbrs.pairs(), directed=True), exact, n)
        times = {name: value for name, value in _measure.summarize(seconds[backend]).items() if name.endswith("_s")}
        row = {"n": n, "neighbors": neighbors, "mean_count": round(2 * len(exact) / n, 1), "capacity": capacity, "backend": backend}
        yield row | times | {"repeats": repeats, "missing": found["missing"], "extra": found["extra"], "others_cores": others}


def _compile(x: jax.Array, cutoff: float, capacity: int, backend: Name) -> Search:
    """Return a jitted search that has run twice: compiled, its kernels loaded, its memory touched."""
    search = jax.jit(lambda x: jfrnn.search(x, cutoff, capacity=capacity, backend=backend))
    for _ in range(2):
        jax.block_until_ready(search(x))
    return search
