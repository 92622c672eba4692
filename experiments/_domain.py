"""What empty space costs: the same particles in two blobs, ever further apart."""

import math

import jax
import pandas as pd

import jfrnn
from experiments import _layouts, _measure

CAPACITY = 128  # more than the longest row up to 1e6 cutoffs, so that every row of the table runs the same program


def domain_table(separations: list[float], points: int) -> pd.DataFrame:
    """Time the compiled search of two blobs at each separation.

    Args:
        separations: Distances of the blobs [cutoffs].
        points: Particles in both blobs together.

    Returns:
        One row per separation: separation [cutoffs], cells of the bounding box, median, p10 and p90 [ms], pairs.
    """
    rows = []
    for separation in separations:
        scene = _layouts.make("two-blobs", n=points, separation=separation)
        x = jax.numpy.asarray(scene.positions)
        compiled = jax.jit(lambda x, r=scene.cutoff: jfrnn.search(x, r, capacity=CAPACITY)).lower(x).compile()
        jax.block_until_ready(compiled(x))
        nbrs, seconds = _measure.repeat(lambda run=compiled, x=x: jax.block_until_ready(run(x)), 50, 0.5, 500)
        nbrs.check()
        time = _measure.summarize(seconds)
        cells = math.prod(max(length / scene.cutoff, 1.0) for length in scene.lengths)
        milliseconds = {name: 1e3 * time[f"{name}_s"] for name in ("median", "p10", "p90")}
        rows.append({"separation": separation, "cells": cells, **milliseconds, "pairs": int(nbrs.count.sum()) // 2})
    return pd.DataFrame(rows)
