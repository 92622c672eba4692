"""Scenes with known answers that no scene of `jfrnn.cases` is: a force that turns around in the middle of a box, and a rotor."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jax import Array

from experiments._library import free
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene, Solid, Turning
from jfrnn.sph.particles import State

WIDTH, SPEED, REYNOLDS = 0.5, 1.0, 10.0  # of a half of the box of reversed flow [m]; in its middle, in the end [m/s]
INNER, OUTER, RATE, FRICTION = 0.5, 1.0, 2.0, 0.1  # radii of rod and tube [m], the rod's rate [rad/s], ν [m²/s]


def reverse_poiseuille(nx: int, jitter: float = 0.2) -> FluidScene:
    """Return a periodic square of 1 m at rest, for `reverse`, which drives its lower half along x and its upper half back.

    Without walls, each half is a channel. Source: Backer, Lowe, Hoefsloot & Iedema (2005), doi:10.1063/1.1883163.
    """
    box = fluids.fluid("taylor-green", nx=nx, jitter=jitter, reynolds=REYNOLDS * SPEED / WIDTH)
    return replace(box, name="reverse-poiseuille", velocities=np.zeros_like(box.positions), pressures=None)


def reverse(s: State) -> Array:
    """Return the acceleration [m/s²] that brings the middle of each half to `SPEED`."""
    strength = 8 * SPEED**2 / REYNOLDS / WIDTH
    along = jnp.where(s.x[:, 1] % (2 * WIDTH) < WIDTH, strength, -strength)
    return jnp.stack([along, jnp.zeros_like(along)], axis=1)


def rotor(layers: int) -> FluidScene:
    """Return fluid at rest between a tube of dummy particles and a rod, a wall of segments that turns from the start on.

    The fluid, so many layers of 1 kg/m², is denser than at rest by a fiftieth: under a pressure that keeps it at the rod, and means
    nothing else.
    """
    spacing = (OUTER - INNER) / layers
    physics = replace(free(1 / 1.02, 10 * RATE * INNER, spacing), viscosity=FRICTION, slip=False)
    (water, around), (tube, beyond) = _rings(INNER, layers, spacing), _rings(OUTER, 3, spacing)
    positions = np.concatenate([water, tube])
    count = round(2 * np.pi * INNER / spacing)
    angles, corners = 2 * np.pi * np.arange(count) / count, np.arange(count, dtype=np.int32)
    radius = INNER / np.sqrt(np.sinc(2 / count))  # of the corners: the polygon is as large as the circle
    rod = Solid(
        radius * np.stack([np.cos(angles), np.sin(angles)], axis=1),
        np.stack([corners, (corners + 1) % count], axis=1),
        Turning((0.0, 0.0), None, RATE),
    )
    return FluidScene(
        name="rotor",
        positions=positions,
        velocities=np.zeros_like(positions),
        masses=np.concatenate([around, beyond]),
        spacing=spacing,
        duration=2.0,
        step=None,
        physics=physics,
        wall=np.arange(len(positions)) >= len(water),
        densities=np.ones(len(positions)),
        solid=rod,
    )


def _rings(radius: float, layers: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return particles in rings around the origin from a radius outwards, shape [n, 2], and the area of each [m²]."""
    positions, areas = [], []
    for r in radius + (np.arange(layers) + 0.5) * spacing:
        count = round(2 * np.pi * r / spacing)
        angles = 2 * np.pi * np.arange(count) / count
        positions.append(r * np.stack([np.cos(angles), np.sin(angles)], axis=1))
        areas.append(np.full(count, 2 * np.pi * r * spacing / count))
    return np.concatenate(positions), np.concatenate(areas)
