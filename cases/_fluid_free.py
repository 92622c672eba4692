"""Fluids with a free surface: a tank at rest, an elliptical and a square drop, dam breaks, an oil jet onto a plate."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ._fluid import Floats, FluidScene, Physics, Tank, inflow, lattice

LAYERS = 3  # of wall dummies: as far as a Wendland kernel with h = 1.5 dx reaches


def free(density: float, sound_speed: float, spacing: float) -> Physics[float, Floats]:
    """Return physics for flows with a free surface: density carried by continuity and smoothed (δ-SPH), Tait's equation of state.

    Args:
        density: Rest density ρ0.
        sound_speed: c [m/s].
        spacing: Particle distance [m]; the smoothing length is 1.5 times as much: there the kernel's gradients on a lattice are
            right to 0.3 %, at 1.3 they are 3 % short.
    """
    return Physics(
        density=density,
        sound_speed=sound_speed,
        smoothing=1.5 * spacing,
        kernel="wendland2",
        density_diffusion=0.1,
        pressure="mean",
        slip=True,
    )


def hydrostatic(
    *,
    height: float = 0.9,
    ny: int = 45,
    duration: float = 4.0,
    viscosity: float = 0.005,
    damping: float = 10.0,
    settling: float = 2.0,
) -> FluidScene:
    """Return water in an open tank 2 m wide under g = 1 m/s², at first with the densities and masses that balance it.

    What is not balanced, by sums in place of integrals, is sound, which would run up and down for minutes: it is damped at first.

    Args:
        height: Of the water H [m].
        ny: Particles from the ground to the surface.
        duration: Time that is simulated [s].
        viscosity: ν [m²/s]: what brings it to rest.
        damping: Rate [1/s] at which velocities decay while it settles.
        settling: How long they do [s].

    Source: Adami, Hu & Adams (2012), doi:10.1016/j.jcp.2012.05.005, sec. 4.1.
    """
    spacing = height / ny
    sound_speed = 10 * math.sqrt(height)
    water = lattice((0.0, 0.0), (round(2 / spacing), ny), spacing)
    physics = replace(free(1000.0, sound_speed, spacing), gravity=(0.0, -1.0), viscosity=viscosity)
    physics = replace(physics, damping=damping or None, damped_until=settling if damping else None)
    scene = _in_tank("hydrostatic", water, spacing, (round(2 / spacing) * spacing, height + 0.1), physics, duration)
    depth = np.maximum(height - scene.positions[:, 1], 0.0)
    squeezed = 1000.0 * (1 + 7 * depth / sound_speed**2) ** (1 / 7)  # Tait's density at the pressure ρ0 g depth
    squeezed[len(water) :] = 1000.0
    return replace(scene, densities=squeezed, masses=squeezed * spacing**2)


def drop(*, radius: float = 1.0, nx: int = 40, duration: float = 0.0076, sound_speed: float = 1400.0) -> FluidScene:
    """Return a disc in free space that its own motion, (-100 x, 100 y) m/s, makes an ellipse.

    Args:
        radius: Of the disc [m].
        nx: Particles along a radius.
        duration: Time that is simulated [s].
        sound_speed: c [m/s].

    Source: Monaghan (1994), doi:10.1006/jcph.1994.1034, sec. 5.1.
    """
    spacing = radius / nx
    grid = lattice((-radius, -radius), (2 * nx, 2 * nx), spacing)
    disc = grid[(grid**2).sum(axis=1) <= radius**2]
    return FluidScene(
        name="drop",
        positions=disc,
        velocities=disc * (-100.0, 100.0),
        masses=np.full(len(disc), spacing**2),
        spacing=spacing,
        duration=duration,
        step=0.25 * 1.5 * spacing / (sound_speed + 100 * radius),
        physics=replace(free(1.0, sound_speed, spacing), artificial=0.05),
        bounds=Tank((-2 * radius, -2 * radius), (2 * radius, 2 * radius)),
    )


def square_drop(
    *, side: float = 1.0, nx: int = 20, surface_tension: float = 1.0, viscosity: float = 0.1, duration: float = 3.0
) -> FluidScene:
    """Return a square in free space, of density 1, that surface tension makes round: under σ/R inside, R = side/√π, in the end.

    Args:
        side: Of the square [m].
        nx: Particles along it.
        surface_tension: σ [N/m; in 2D N].
        viscosity: ν [m²/s]: what brings it to rest.
        duration: Time that is simulated [s].

    Source: Brackbill, Kothe & Zemach (1992), doi:10.1016/0021-9991(92)90240-Y, after their relaxing rod.
    """
    spacing = side / nx
    sound_speed = 15 * math.sqrt(surface_tension / side)
    square = lattice((-side / 2,) * 2, (nx, nx), spacing)
    physics = replace(free(1.0, sound_speed, spacing), surface_tension=surface_tension, viscosity=viscosity)
    return FluidScene(
        name="square-drop",
        positions=square,
        velocities=np.zeros_like(square),
        masses=np.full(len(square), spacing**2),
        spacing=spacing,
        duration=duration,
        step=0.25 * physics.smoothing / (1.1 * sound_speed),
        physics=physics,
        bounds=Tank((-0.75 * side,) * 2, (0.75 * side,) * 2),
    )


def dam_break(
    *,
    width: float = 1.0,
    nx: int = 40,
    dim: int = 2,
    tank: float = 4.0,
    depth: float = 0.5,
    duration: float = 0.8,
    artificial: float = 0.05,
) -> FluidScene:
    """Return a column of water, twice as high as wide, that collapses in a longer tank.

    Args:
        width: Of the column a [m].
        nx: Particles along it.
        dim: 2 or 3.
        tank: Length of the tank in column widths.
        depth: Of the tank in 3D, in column widths.
        duration: Time that is simulated [s].
        artificial: α of artificial viscosity. At 0.05 the water is nearly a perfect fluid, whose front is ahead of the experiment;
            at nx / 100, which was chosen among runs for that, it is with it.

    Source: Martin & Moyce (1952), doi:10.1098/rsta.1952.0006.
    """
    spacing = width / nx
    counts = (nx, 2 * nx) if dim == 2 else (nx, max(1, round(depth * nx)), 2 * nx)  # the last axis points up
    sides = (tank * width, 2.5 * width) if dim == 2 else (tank * width, counts[1] * spacing, 2.5 * width)
    sound_speed = 10 * math.sqrt(2 * 9.81 * 2 * width)
    physics = replace(free(1000.0, sound_speed, spacing), gravity=(*(0.0,) * (dim - 1), -9.81), artificial=artificial)
    return _in_tank(f"dam-break-{dim}d", lattice((0.0,) * dim, counts, spacing), spacing, sides, physics, duration)


def dam_break_3d(*, width: float = 1.0, nx: int = 20, tank: float = 4.0, depth: float = 0.5, duration: float = 0.8) -> FluidScene:
    """Return `dam_break` in three dimensions; nx = 46 makes 97 000 particles of water."""
    return dam_break(width=width, nx=nx, dim=3, tank=tank, depth=depth, duration=duration)


def jet(
    *,
    diameter: float = 2e-3,
    layers: int = 8,
    speed: float = 5.0,
    height: float = 8e-3,
    plate: float = 16e-3,
    duration: float = 5e-3,
    viscosity: float = 2e-5,
    tension: float = 0.0,
    surface_tension: float = 0.0,
) -> FluidScene:
    """Return a jet of oil (860 kg/m³) that leaves a nozzle downwards and hits a flat plate: a few percent of its box.

    Args:
        diameter: Of the jet [m].
        layers: Particles along it.
        speed: At the nozzle [m/s].
        height: Of the nozzle over the plate [m].
        plate: Side of the plate [m].
        duration: Time that is simulated, and for which oil comes [s].
        viscosity: ν [m²/s].
        tension: Cohesion [m/s²/kg]; 0: there is none.
        surface_tension: σ [N/m] as a continuum force, of oil about 0.03; 0: there is none.
    """
    spacing = diameter / layers
    disc = lattice((-diameter / 2,) * 2, (layers, layers), spacing)
    disc = disc[(disc**2).sum(axis=1) <= diameter**2 / 4]
    oil, _, enters = inflow(np.column_stack([disc, np.full(len(disc), height)]), (0.0, 0.0, -speed), spacing, duration)
    sites = round(plate / spacing)
    ground = lattice((-sites * spacing / 2, -sites * spacing / 2, -LAYERS * spacing), (sites, sites, LAYERS), spacing)
    positions, wall = np.concatenate([oil, ground]), np.arange(len(oil) + len(ground)) >= len(oil)
    physics = replace(free(860.0, 10 * speed, spacing), viscosity=viscosity, gravity=(0.0, 0.0, -9.81), artificial=0.05, slip=False)
    return FluidScene(
        name="jet",
        positions=positions,
        velocities=np.where(wall[:, None], 0.0, np.array([0.0, 0.0, -speed])),
        masses=np.full(len(positions), 860.0 * spacing**3),
        spacing=spacing,
        duration=duration,
        step=0.25 * 1.5 * spacing / (12 * speed),
        physics=replace(physics, tension=tension or None, surface_tension=surface_tension or None),
        wall=wall,
        bounds=Tank((-plate / 2, -plate / 2, 0.0), (plate / 2, plate / 2, height)),
        enters=np.concatenate([enters, np.zeros(len(ground))]),
        guided=3 * spacing / speed,
    )


def _in_tank(
    name: str, water: NDArray[np.float64], spacing: float, sides: Floats, physics: Physics[float, Floats], duration: float
) -> FluidScene:
    """Return water in a tank of dummy particles, open above; the last axis points up."""
    counts = [round(side / spacing) for side in sides]
    around = lattice((-LAYERS * spacing,) * len(counts), [*(n + 2 * LAYERS for n in counts[:-1]), counts[-1] + LAYERS], spacing)
    inner = ((around > 0) & (around < np.array([*(n * spacing for n in counts[:-1]), np.inf]))).all(axis=1)
    walls = around[~inner]
    positions = np.concatenate([water, walls])
    return FluidScene(
        name=name,
        positions=positions,
        velocities=np.zeros_like(positions),
        masses=np.full(len(positions), physics.density * spacing ** len(counts)),
        spacing=spacing,
        duration=duration,
        step=0.25 * physics.smoothing / (1.1 * physics.sound_speed),
        physics=physics,
        wall=np.arange(len(positions)) >= len(water),
        bounds=Tank((0.0,) * len(counts), tuple(n * spacing for n in counts)),
        sealed=Tank((0.0,) * len(counts), (*(n * spacing for n in counts[:-1]), np.inf)),
    )


SCENES = {
    "hydrostatic": hydrostatic,
    "drop": drop,
    "square-drop": square_drop,
    "dam-break-2d": dam_break,
    "dam-break-3d": dam_break_3d,
    "jet": jet,
}
