"""One run on a GPU: every hard case against the oracle first, then all timings.

A time counts only where its pairs were checked: lists are compared as sets with the array engine, whose decisions are its own.
"""

import functools
import itertools
import os
from collections.abc import Iterator
from pathlib import Path

from experiments import _machine
from experiments._library import load_warp
from experiments.bench.table import Line, Part, fill_parts
from experiments.gpu import exactness, timings, triangles
from experiments.gpu.config import Config


def run(config: Config, folder: Path) -> int:
    """Measure what the folder does not hold yet, and return the number of wrong hard cases."""
    # one pool from the start: a pool that grows hands out whole pieces, up to 128 MiB larger than what was asked for
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "true"
    import jax

    jax.config.update("jax_enable_x64", True)
    about = {"versions": _machine.versions() | {"warp-lang": load_warp().__version__}}
    return sum(int(row.get("wrong", 0) or 0) for row in fill_parts(folder, parts(config), config.model_dump(), about, describe))


def parts(config: Config) -> Iterator[Part]:
    """Yield what is measured, by name, in the order in which it has to be."""
    yield "memory", timings.memory_rows
    for part in config.exactness:
        for dtype, dim in itertools.product(part.dtypes, part.dims):
            name = f"exactness {part.backend} {part.cases} {dtype} {dim}D"
            yield name, functools.partial(exactness.rows, part, dtype, dim)
    yield "bandwidth", functools.partial(timings.bandwidth_rows, config)
    if config.corners_fill is not None:
        yield "corners", functools.partial(timings.scene_rows, config, "corners", config.corners_fill)
    for n in config.sizes:
        yield f"jitter {n}", functools.partial(timings.scene_rows, config, "jitter", n)
    for n in config.counts_only:
        yield f"counts {n}", functools.partial(timings.large_rows, config, n)
    timed = functools.partial(timings.time_calls, config)
    for part in config.triangles:
        for n, cutoff, dtype in itertools.product(part.points, part.cutoffs, part.dtypes):
            name = f"triangles {n} {part.faces} {cutoff:g} {dtype}"
            yield name, functools.partial(triangles.rows, n, part.faces, cutoff, dtype, config.steps, timed)


def describe(row: Line) -> str:
    """Return a row as a line for the reader."""
    names = ("kind", "method", "layout", "points", "dtype", "dim", "cases", "wrong", "median_s", "reason")
    return " ".join(f"{name} {row[name]}" for name in names if row.get(name) is not None)
