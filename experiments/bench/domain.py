"""What empty space costs: the same particles in two blobs, ever further apart."""

import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import typer

import jfrnn
from experiments import _layouts, _measure
from experiments._commands import positive
from experiments.bench import table

CAPACITY = 128  # more than the longest row up to 1e6 cutoffs, so that every row of the table runs the same program
COLUMNS = ("separation", "cells", "median_ms", "p10_ms", "p90_ms", "pairs")
Separations = Annotated[list[float] | None, typer.Argument(callback=positive, help="Of the blobs [cutoffs]; 10 to 1e6 without.")]


def command(
    separations: Separations = None,
    points: Annotated[int, typer.Option(min=2, max=10_000, help="Particles in both blobs together.")] = 1000,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "domain",
) -> str:
    """Time a search of two blobs ever further apart: what empty space costs."""
    asked = separations or [10.0, 1e2, 1e3, 1e4, 1e5, 1e6]
    parts = [(f"separation {separation:g}", partial(_rows, separation, points)) for separation in asked]
    return table.text(table.measure(out, jax.default_backend(), parts, points, COLUMNS))


def _rows(separation: float, points: int) -> Iterator[table.Line]:
    scene = _layouts.make("two-blobs", n=points, separation=separation)
    x = jax.numpy.asarray(scene.positions)
    compiled = jax.jit(lambda x: jfrnn.search(x, scene.cutoff, capacity=CAPACITY)).lower(x).compile()
    jax.block_until_ready(compiled(x))
    nbrs, seconds = _measure.repeat(lambda: jax.block_until_ready(compiled(x)), 50, 0.5, 500)
    nbrs.check()
    time = _measure.summarize(seconds)
    milliseconds = {f"{name}_ms": 1e3 * time[f"{name}_s"] for name in ("median", "p10", "p90")}
    cells = math.prod(max(length / scene.cutoff, 1.0) for length in scene.lengths)
    yield {"separation": separation, "cells": cells, **milliseconds, "pairs": int(nbrs.count.sum()) // 2}
