"""The scenes of the 2D source: a few particles, a block, a droplet and a dam break in a unit tank whose walls they bounce off.

Source: ImperialCollegeLondon/ReCoDE-SPH-solver-2D-NS (2024); equations after Müller, Charypar & Gross (2003),
doi:10.2312/SCA03/154-159. Radius of influence h = 0.01 m, gas constant 2000 m²/s², ρ0 = 1000, μ = 1, g = 9.81, restitution 0.5.
"""

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ._fluid import FluidScene, Physics, Tank

RADIUS = 0.01
FEW = {
    "one": ((0.5, 0.5),),
    "two": ((0.5, 0.5), (0.5, RADIUS)),
    "three": ((0.5, 0.5), (0.495, RADIUS), (0.505, RADIUS)),
    "four": ((0.505, 0.5), (0.515, 0.5), (0.51, 0.45), (0.5, 0.45)),
}


def few(name: str, *, duration: float = 2.0, step: float = 1e-4) -> FluidScene:
    """Return one to four particles that fall, by the names of `FEW`."""
    return _scene(name, np.array(FEW[name]), RADIUS, duration, step)


def block(*, spacing: float = 0.0252, duration: float = 2.0, step: float = 1e-4) -> FluidScene:
    """Return a block [0.1, 0.3] × [0.3, 0.6] that falls: about 95 particles."""
    return _scene("block", _grid((0.1, 0.3), (0.3, 0.6), spacing), spacing, duration, step)


def droplet(*, radius: float = 0.1, spacing: float = 0.0075, duration: float = 2.0, step: float = 1e-4) -> FluidScene:
    """Return a disc around (0.5, 0.7) that falls: about 560 particles."""
    grid = _grid((-radius, radius), (-radius, radius), spacing)
    return _scene("droplet", grid[(grid**2).sum(axis=1) <= radius**2] + (0.5, 0.7), spacing, duration, step)


def dam(*, spacing: float = RADIUS, duration: float = 2.0, step: float = 1e-4) -> FluidScene:
    """Return a block [0, 0.2]² in a corner that collapses, its first particles one radius from the walls."""
    return _scene("dam", _grid((RADIUS, 0.2), (RADIUS, 0.2), spacing), spacing, duration, step)


def _grid(xs: tuple[float, float], ys: tuple[float, float], spacing: float) -> NDArray[np.float64]:
    """Return lattice points between the ends, both included, so far apart as whole numbers of gaps allow."""
    axes = [np.linspace(low, high, round((high - low) / spacing) + 1) for low, high in (xs, ys)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def common_mass(positions: NDArray[np.float64], rest: float = 1000.0, radius: float = RADIUS) -> float:
    """Return the mass [kg] with which the mean density of these positions, shape [n, 2], is the rest density."""
    apart = positions[:, None] - positions
    q = np.sqrt((apart**2).sum(axis=-1)) / radius
    return len(positions) * rest / (4 / (math.pi * radius**2) * np.maximum(1 - q**2, 0.0) ** 3).sum()


def _scene(name: str, positions: NDArray[np.float64], spacing: float, duration: float, step: float) -> FluidScene:
    physics = Physics(
        density=1000.0,
        sound_speed=math.sqrt(2000.0),
        smoothing=RADIUS,
        kernel="poly6",
        evolve="summation",
        state="linear",
        pressure="source",
        viscosity=1.0,
        viscosity_form="source",
        gravity=(0.0, -9.81),
        restitution=0.5,
        integrator="leapfrog",
    )
    return FluidScene(
        name=name,
        positions=positions,
        velocities=np.zeros_like(positions),
        masses=np.full(len(positions), common_mass(positions)),
        spacing=spacing,
        duration=duration,
        step=step,
        physics=physics,
        tank=Tank((RADIUS, RADIUS), (1 - RADIUS, 1 - RADIUS)),
        bounds=Tank((0.0, 0.0), (1.0, 1.0)),
        sealed=Tank((0.0, 0.0), (1.0, 1.0)),
    )


SCENES = {**{name: partial(few, name) for name in FEW}, "block": block, "droplet": droplet, "dam": dam}
