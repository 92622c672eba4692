"""What a start costs a flow: the kinetic energy that vortices keep from a lattice, and from relaxed particles."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jfrnn import sph
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene

JAX_SPH: dict[str, Any] = {"evolve": "summation", "state": "linear", "integrator": "leapfrog", "pressure_diffusion": None}
"""What of jax-sph's defaults with its transport velocity differs from `--set transport=100`: densities are summed, pressures are
those of the linear equation of state, and steps are those of its semi-implicit Euler scheme."""
SCHEMES: dict[str, dict[str, Any]] = {"EDAC, transport": {}, "jax-sph's": JAX_SPH}
STARTS = ("lattice", "off by 0.2 spacings", "relaxed")
_REYNOLDS, _END = 100.0, 2.0


def run(resolutions: tuple[int, ...], folder: Path) -> str:
    """Run the vortices from each start, with each scheme, and write table.csv, of which rows that are there stay."""
    path = folder / "table.csv"
    rows = pd.read_csv(path).to_dict("records") if path.exists() else []
    for nx in resolutions:
        for scheme, physics in SCHEMES.items():
            for start in STARTS:
                about = {"nx": nx, "scheme": scheme, "start": start}
                if any(about.items() <= row.items() for row in rows):
                    continue
                rows.append(about | {"kept": kept(begin(nx, physics, start))})
                pd.DataFrame(rows).to_csv(path, index=False)
    return pd.DataFrame(rows).to_string(index=False)


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
