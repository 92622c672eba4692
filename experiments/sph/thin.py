"""What it costs that water does not feel water through a thin wall: steps per second of two blocks beside a sheet."""

from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd

from jfrnn import sph
from jfrnn.cases import meshes
from jfrnn.cases.fluids import FluidScene

STEPS, ROUNDS = 20, 5


def run(sizes: tuple[int, ...], folder: Path) -> str:
    """Time steps with and without lines of sight, in turns, and write table.csv."""
    import jax

    rows: list[dict[str, Any]] = []
    for n in sizes:
        ready, times = {}, {}
        for thin in (False, True):
            scene = blocks(n, thin)
            model = sph.make_model(scene, np.float32)
            ready[thin] = model, jax.jit(sph.begin)(model, sph.make_state(scene, np.float32))
            jax.block_until_ready(sph.advance(*ready[thin], None, STEPS))
        for _ in range(ROUNDS):
            for thin, (model, s) in ready.items():
                start = perf_counter()
                jax.block_until_ready(sph.advance(model, s, None, STEPS))
                times.setdefault(thin, []).append((perf_counter() - start) / STEPS)
        sight = ready[True][1].solid.sight
        row = {"device": jax.devices()[0].device_kind, "particles": 2 * n**3, "parted pairs": int(sight.required[2])}
        rows.append(row | {"through": 1 / np.median(times[False]), "sight": 1 / np.median(times[True])})
        pd.DataFrame(rows).to_csv(folder / "table.csv", index=False)
    return pd.DataFrame(rows).to_string(index=False)


def blocks(n: int, thin: bool) -> FluidScene:
    """Return two blocks of n³ particles on two sides of a sheet of half a spacing."""
    dx = 0.02
    left = sph.lattice((-dx / 4 - n * dx, -n * dx / 2, -n * dx / 2), (n, n, n), dx)
    x = np.concatenate([left, left * [-1, 1, 1]])
    vertices, faces = meshes.cube(1.0, 1)
    return sph.FluidScene(
        name="blocks",
        positions=x,
        velocities=np.zeros_like(x),
        masses=np.full(len(x), 1000.0 * dx**3),
        spacing=dx,
        duration=1.0,
        step=None,
        physics=sph.Physics(density=1000.0, sound_speed=20.0, smoothing=1.5 * dx, pressure="mean", artificial=0.05),
        solid=sph.Solid(vertices / np.ptp(vertices, axis=0) * (dx / 2, 2 * n * dx, 2 * n * dx), faces, thin=thin),
    )
