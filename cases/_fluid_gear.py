"""A jet of oil onto a gear that turns: the fluid is a few percent of its box, the wall a mesh of triangles."""

import math
from dataclasses import replace

import numpy as np

from ._fluid import FluidScene, Solid, Tank, Turning, inflow, lattice
from ._fluid_free import free
from .meshes import gear


def jet_gear(
    *,
    diameter: float = 3e-3,
    layers: int = 8,
    speed: float = 10.0,
    rate: float = 400.0,
    teeth: int = 12,
    module: float = 2e-3,
    width: float = 6e-3,
    faces: int = 2000,
    offset: float = 3e-3,
    height: float = 3e-3,
    duration: float = 4e-3,
    viscosity: float = 2e-5,
) -> FluidScene:
    """Return a jet of oil (860 kg/m³) that leaves a nozzle downwards, onto the teeth of a spur gear which turns around the y axis.

    Args:
        diameter: Of the jet [m].
        layers: Particles along it; 8 make 5 500 particles, 52 make 1.5 million.
        speed: At the nozzle [m/s].
        rate: At which the gear turns [rad/s]; 0: it stands.
        teeth: Of the gear.
        module: Diameter of the pitch circle per tooth [m].
        width: Of the gear [m].
        faces: Of its mesh, about.
        offset: Of the jet from the middle of the gear along x [m].
        height: Of the nozzle over the highest tip of a tooth [m].
        duration: Time that is simulated, and for which oil comes [s].
        viscosity: ν [m²/s].
    """
    spacing, tip = diameter / layers, (teeth / 2 + 1) * module
    vertices, named = gear(teeth, faces, module, width, teeth * module / 2)
    vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # its axis along -y
    disc = lattice((-diameter / 2,) * 2, (layers, layers), spacing)
    disc = disc[(disc**2).sum(axis=1) <= diameter**2 / 4] + (offset, 0.0)
    nozzle = np.column_stack([disc, np.full(len(disc), tip + height)])
    oil, velocities, enters = inflow(nozzle, (0.0, 0.0, -speed), spacing, duration)
    sound_speed = 10 * math.hypot(speed, rate * tip)
    physics = replace(
        free(860.0, sound_speed, spacing),
        viscosity=viscosity, gravity=(0.0, 0.0, -9.81), artificial=0.05, slip=False, tears=True,
    )  # fmt: skip
    around = 1.25 * tip
    return FluidScene(
        name="jet-gear",
        positions=oil,
        velocities=velocities,
        masses=np.full(len(oil), 860.0 * spacing**3),
        spacing=spacing,
        duration=duration,
        step=0.25 * physics.smoothing / (1.2 * sound_speed),
        physics=physics,
        bounds=Tank((-around, -1.2 * width, -around), (around, 1.2 * width, tip + height)),
        enters=enters,
        guided=3 * spacing / speed,
        solid=Solid(vertices, named, Turning((0.0,) * 3, (0.0, 1.0, 0.0), rate) if rate else None),
    )


SCENES = {"jet-gear": jet_gear}
