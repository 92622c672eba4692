"""What it costs that water does not feel water through a thin wall: steps per second of two blocks beside a sheet."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import typer

from experiments import _measure
from experiments.bench import table
from jfrnn import sph
from jfrnn.cases import meshes
from jfrnn.cases.fluids import FluidScene

STEPS, ROUNDS = 20, 5


def command(
    sizes: Annotated[list[int] | None, typer.Argument(min=4, help="Particles along a block; 16 and 32 without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "sph-thin",
) -> str:
    """Time steps beside a thin wall, with lines of sight ("sight") and without ("through"), in turns; then print a table."""
    parts = [(f"{n}^3", partial(_rows, n)) for n in sizes or (16, 32)]
    return table.text(table.measure(out, "table", parts, None, ("device", "particles", "parted pairs", "through", "sight")))


def _rows(n: int) -> Iterator[table.Line]:
    ready = {}
    for name, thin in (("through", False), ("sight", True)):
        scene = blocks(n, thin)
        model = sph.make_model(scene, np.float32)
        ready[name] = model, jax.jit(sph.begin)(model, sph.make_state(scene, np.float32))
    calls = {name: lambda both=both: sph.advance(*both, None, STEPS) for name, both in ready.items()}
    seconds, _ = _measure.time_in_turns(calls, ROUNDS)
    row = {"particles": 2 * n**3, "parted pairs": int(ready["sight"][1].solid.sight.required[2])}
    yield row | {name: float(STEPS / np.median(each)) for name, each in seconds.items()}


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
