"""One structure of atoms after another: `jfrnn.ase` beside ASE, matscipy and vesin, from the first call of a fresh process on.

`python -P structures.py WHO COUNT` is that process, and prints a line of JSON. Nothing but NumPy is imported before the clock runs.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np

LIBRARIES = ("jfrnn", "ase", "matscipy", "matscipy-neighbours", "vesin")
CUTOFF = 5.0  # [angstrom]
DENSITY = 0.06  # [atoms/angstrom³]
LETTERS = "ijSDd"
COLUMNS = ("who", "cache", "structures", "total_s", "first_s", "pairs", "atoms", "median_us", "p10_us", "p90_us", "status")
COLUMNS += ("commit", "dirty")
ROOT = Path(__file__).resolve().parents[2]
Find = Callable[[np.ndarray, np.ndarray], Any]  # positions and cell -> arrays


def make_structure(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [n, 3] and a cell [3, 3] that is skewed a little, periodic along all axes [angstrom]."""
    cell = np.eye(3) + rng.uniform(-0.3, 0.3, (3, 3))
    cell *= (n / DENSITY / abs(np.linalg.det(cell))) ** (1 / 3)
    return rng.random((n, 3)) @ cell, cell


def load(who: str) -> Find:
    """Import a library and return its search."""
    if who == "jfrnn":
        from jfrnn.ase import primitive_neighbor_list

        return lambda x, cell: primitive_neighbor_list(LETTERS, True, cell, x, CUTOFF)
    if who == "ase":
        from ase.neighborlist import primitive_neighbor_list

        return lambda x, cell: primitive_neighbor_list(LETTERS, [True] * 3, cell, x, CUTOFF)
    if who.startswith("matscipy"):
        if who == "matscipy":
            from matscipy.neighbours import neighbour_list  # pyright: ignore[reportMissingImports]
        else:
            from matscipy_neighbours import neighbour_list  # pyright: ignore[reportMissingImports]

        return lambda x, cell: neighbour_list(LETTERS, positions=x, cell=cell, pbc=[True] * 3, cutoff=CUTOFF)
    from vesin import NeighborList  # pyright: ignore[reportMissingImports]

    made = NeighborList(cutoff=CUTOFF, full_list=True, sorted=True)
    return lambda x, cell: made.compute(points=x, box=cell, periodic=True, quantities=LETTERS)


def convert(who: str, count: int) -> dict[str, Any]:
    """Search many structures; the clock runs from the import of the library on."""
    rng, pairs = np.random.default_rng(0), 0
    structures = [make_structure(rng, int(n)) for n in rng.integers(2, 201, count)]
    begin = perf_counter()
    find, first = load(who), None
    for x, cell in structures:
        pairs += len(find(x, cell)[0])
        first = perf_counter() - begin if first is None else first
    return {"total_s": perf_counter() - begin, "first_s": first, "pairs": pairs}


if __name__ == "__main__":
    print(json.dumps(convert(sys.argv[1], int(sys.argv[2]))))
    sys.exit()

import typer  # noqa: E402

from experiments import _measure  # noqa: E402
from experiments.bench import table  # noqa: E402


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "structures",
    count: Annotated[int, typer.Option(min=1, max=1_000_000, help="Structures of 2 to 200 atoms.")] = 10_000,
    repeats: Annotated[int, typer.Option(min=20, max=100_000, help="Timed calls for 32 atoms.")] = 300,
) -> str:
    """Time many structures of 2 to 200 atoms, first call included, and warm calls for one of 32 atoms.

    Cutoff 5 angstrom, 0.06 atoms/angstrom³. jfrnn finds an empty folder of compiled kernels ("cold"), or one that holds the kernel.
    """
    parts = [("warm calls", partial(_warm, repeats)), *((who, partial(_many, who, count)) for who in LIBRARIES)]
    return table.text(table.measure(out, "cpu", parts, [count, repeats], COLUMNS))


def _many(who: str, count: int) -> Iterator[table.Line]:
    with tempfile.TemporaryDirectory() as folder:
        for cache in ("cold", "warm") if who == "jfrnn" else ("",):
            given = [sys.executable, "-P", __file__, who, str(count)]
            environment = {**os.environ, "WARP_CACHE_PATH": folder, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
            done = subprocess.run(given, capture_output=True, text=True, check=False, env=environment)
            row = {"who": who, "cache": cache, "structures": count}
            words = (done.stderr.strip().splitlines() or ["no word"])[-1]
            yield row | (json.loads(done.stdout) | {"status": "ok"} if done.returncode == 0 else {"status": words})


def _warm(repeats: int) -> Iterator[table.Line]:
    x, cell = make_structure(np.random.default_rng(1), 32)
    calls, missing = {}, {}
    for who in LIBRARIES:
        try:
            calls[who] = partial(load(who), x, cell)
        except ImportError as error:
            missing[who] = str(error)
    seconds, _ = _measure.time_in_turns(calls, repeats)
    for who, call in calls.items():
        times = _measure.summarize(seconds[who])
        micro = {f"{name}_us": round(1e6 * times[f"{name}_s"], 1) for name in ("median", "p10", "p90")}
        yield {"who": who, "cache": "", "atoms": 32, "pairs": len(call()[0]), "status": "ok"} | micro
    yield from ({"who": who, "cache": "", "atoms": 32, "status": reason} for who, reason in missing.items())
