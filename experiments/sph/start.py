"""What a start costs a flow: the kinetic energy that vortices keep from a lattice, and from relaxed particles."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

from experiments.bench import table
from jfrnn import sph
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene

JAX_SPH: dict[str, Any] = {"evolve": "summation", "state": "linear", "integrator": "leapfrog", "pressure_diffusion": None}
"""What of jax-sph's defaults with its transport velocity differs from `--set transport=100`: densities are summed, pressures are
those of the linear equation of state, and steps are those of its semi-implicit Euler scheme."""
SCHEMES: dict[str, dict[str, Any]] = {"EDAC, transport": {}, "jax-sph's": JAX_SPH}
STARTS = ("lattice", "off by 0.2 spacings", "relaxed")
_REYNOLDS, _END = 100.0, 2.0


def command(
    resolutions: Annotated[list[int] | None, typer.Argument(min=8, help="Particles along each axis; 25 and 50 without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "sph-start",
) -> str:
    """Run decaying vortices from a lattice, from displaced and from relaxed particles, or go on with it; then print a table."""
    jax.config.update("jax_enable_x64", True)
    parts = [(" ".join(map(str, kind)), partial(_rows, *kind)) for kind in product(resolutions or (25, 50), SCHEMES, STARTS)]
    return table.text(table.measure(out, "table", parts, None, ("nx", "scheme", "start", "kept")))


def _rows(nx: int, scheme: str, start: str) -> Iterator[table.Line]:
    yield {"nx": nx, "scheme": scheme, "start": start, "kept": kept(begin(nx, SCHEMES[scheme], start))}


def begin(nx: int, physics: dict[str, Any], start: str) -> FluidScene:
    """Return vortices by one scheme, from one start."""
    scene = fluids.fluid("taylor-green", nx=nx, transport=100.0, jitter=0.2 if start == STARTS[1] else 0.0)
    scene = replace(scene, physics=replace(scene.physics, **physics))
    return sph.relax(scene) if start == "relaxed" else scene


def kept(scene: FluidScene) -> float:
    """Return the kinetic energy in the end, over that of vortices that decay as they should from where these began."""
    model = sph.make_model(scene)
    first = sph.begin(model, sph.make_state(scene))
    end, _, _ = sph.advance_until(model, first, None, _END)
    decay = np.exp(-16 * np.pi**2 * _END / _REYNOLDS)
    return float(sph.energies(model, end)["kinetic"] / sph.energies(model, first)["kinetic"] / decay)
