"""Flows with known answers: Taylor-Green vortices, Poiseuille and Couette flow, the lid-driven cavity."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ._fluid import Floats, FluidScene, Periodic, Physics, Tank, lattice

LAYERS = 4  # of wall dummies: as far as a quintic kernel with h = dx reaches, and one more


def confined(spacing: float, speed: float, sound_speed: float, viscosity: float) -> Physics[float, Floats]:
    """Return physics for flows without free surface: the pressure is carried (EDAC), gradients are corrected, particles shifted.

    Args:
        spacing: Particle distance, and the smoothing length [m].
        speed: Largest velocity of the flow [m/s]; shifting goes by it.
        sound_speed: c [m/s].
        viscosity: ν [m²/s].

    Source: after Negi & Ramachandran (2022), doi:10.1063/5.0098352; EDAC: Ramachandran & Puri (2019),
    doi:10.1016/j.compfluid.2018.11.023, with their diffusion ch/16.
    """
    return Physics(
        density=1.0,
        sound_speed=sound_speed,
        smoothing=spacing,
        kernel="quintic",
        evolve="pressure",
        pressure="difference",
        viscosity=viscosity,
        pressure_diffusion=sound_speed * spacing / 16,
        shifting=2 * spacing * speed,
        corrected=True,
    )


def courant(spacing: float, speed: float, sound_speed: float, viscosity: float) -> float:
    """Return the step [s] that sound and viscosity allow for h = dx (Morris, Fox & Zhu 1997)."""
    return min(0.25 * spacing / (sound_speed + speed), 0.125 * spacing**2 / viscosity)


def taylor_green(
    *,
    nx: int = 50,
    dim: int = 2,
    reynolds: float = 100.0,
    duration: float = 2.0,
    sound_speed: float = 10.0,
    jitter: float = 0.1,
    seed: int = 0,
    transport: float | None = None,
) -> FluidScene:
    """Return decaying vortices on the periodic unit square or cube, speed 1 m/s at first.

    u = -cos 2πx sin 2πy, v = sin 2πx cos 2πy, decaying as exp(-8π²t/Re) in 2D; in 3D times cos 2πz: they break up.

    Args:
        nx: Particles along each axis.
        dim: 2 or 3.
        reynolds: Re.
        duration: Time that is simulated [s].
        sound_speed: c [m/s].
        jitter: Largest displacement of a particle from its site, in spacings: an exact lattice would keep its lines too long.
        seed: Of the displacements.
        transport: Background pressure [Pa], ρ0c² as published, of a transport velocity that keeps particles evenly spread, with
            volume forms of pressure and viscosity; None: particles are shifted, gradients corrected.

    Source: Taylor & Green (1937), doi:10.1098/rspa.1937.0036.
    """
    spacing = 1 / nx
    sites = lattice((0.0,) * dim, (nx,) * dim, spacing)
    positions = sites + jitter * spacing * np.random.default_rng(seed).uniform(-1, 1, sites.shape)
    physics = replace(confined(spacing, 1.0, sound_speed, 1 / reynolds), viscosity_form="fourth")
    if transport is not None:
        forms = {"pressure": "volume", "viscosity_form": "volume", "shifting": None, "corrected": False}
        physics = replace(physics, transport=transport, **forms)  # pyright: ignore[reportArgumentType]
    return FluidScene(
        name="taylor-green",
        positions=positions,
        velocities=taylor_green_velocity(positions, 0.0, reynolds),
        masses=np.full(len(positions), spacing**dim),
        spacing=spacing,
        duration=duration,
        step=courant(spacing, 1.0, sound_speed, (1 if transport else 2) / reynolds),  # "fourth" takes half the step
        physics=physics,
        periodic=Periodic((0.0,) * dim, (1.0,) * dim, (True,) * dim),
        bounds=Tank((0.0,) * dim, (1.0,) * dim),
        pressures=_taylor_green_pressure(positions),
    )


def _taylor_green_pressure(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pressures [Pa] that keep the flow of the beginning without divergence, shape [n]; density is 1 kg/m³."""
    x, y, *z = np.cos(4 * np.pi * positions.T)
    return -(x + y) / 4 if not z else -(x + y) * (z[0] + 2) / 16


def taylor_green_velocity(positions: NDArray[np.float64], time: float, reynolds: float) -> NDArray[np.float64]:
    """Return the exact velocities [m/s] in 2D (in 3D those of the beginning), shape [n, d]."""
    x, y, *z = (2 * np.pi * positions).T
    velocities = np.stack([-np.cos(x) * np.sin(y), np.sin(x) * np.cos(y), *(0 * axis for axis in z)], axis=-1)
    for axis in z:
        velocities *= np.cos(axis)[:, None]
    return velocities * np.exp(-8 * np.pi**2 * time / reynolds)


def poiseuille(*, ny: int = 60, viscosity: float = 100.0, top_speed: float = 1.25, duration: float = 1e-2) -> FluidScene:
    """Return flow between plates at rest, 1 m apart and 0.4 m long, that a body force brings to `top_speed` in the middle.

    Args:
        ny: Particles from plate to plate.
        viscosity: ν [m²/s].
        top_speed: umax [m/s], reached in the end; the force is 8 ν umax per m².
        duration: Time that is simulated [s].

    Source: Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776.
    """
    return _channel("poiseuille", ny, viscosity, top_speed, duration, (8 * viscosity * top_speed, 0.0), 0.0)


def couette(*, ny: int = 60, viscosity: float = 100.0, top_speed: float = 1.25, duration: float = 1e-2) -> FluidScene:
    """Return flow between plates, 1 m apart and 0.4 m long, of which the upper one moves at `top_speed` [m/s] from the start on.

    Arguments as those of `poiseuille`. Source: Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776.
    """
    return _channel("couette", ny, viscosity, top_speed, duration, None, top_speed)


def _channel(
    name: str, ny: int, viscosity: float, speed: float, duration: float, force: tuple[float, float] | None, lid: float
) -> FluidScene:
    spacing = 1 / ny
    length = round(0.4 * ny) * spacing
    positions = lattice((0.0, -LAYERS * spacing), (round(0.4 * ny), ny + 2 * LAYERS), spacing)
    wall = (positions[:, 1] < 0) | (positions[:, 1] > 1)
    velocities = np.where(positions[:, 1:] > 1, np.array([lid, 0.0]), 0.0)
    return FluidScene(
        name=name,
        positions=positions,
        velocities=velocities,
        masses=np.full(len(positions), spacing**2),
        spacing=spacing,
        duration=duration,
        step=courant(spacing, speed, 10 * speed, viscosity),
        physics=replace(confined(spacing, speed, 10 * speed, viscosity), gravity=force),
        wall=wall,
        periodic=Periodic((0.0, 0.0), (length, 1.0), (True, False)),
        bounds=Tank((0.0, 0.0), (length, 1.0)),
        sealed=Tank((-np.inf, 0.0), (np.inf, 1.0)),
    )


def cavity(*, nx: int = 50, reynolds: float = 100.0, duration: float = 25.0, sound_speed: float = 10.0) -> FluidScene:
    """Return a unit square of fluid whose lid moves at 1 m/s: a vortex that becomes steady.

    Args:
        nx: Particles along each side.
        reynolds: Re.
        duration: Time that is simulated [s].
        sound_speed: c [m/s].

    Source: Ghia, Ghia & Shin (1982), doi:10.1016/0021-9991(82)90058-4.
    """
    spacing = 1 / nx
    positions = lattice((-LAYERS * spacing,) * 2, (nx + 2 * LAYERS,) * 2, spacing)
    return FluidScene(
        name="cavity",
        positions=positions,
        velocities=np.where(positions[:, 1:] > 1, np.array([1.0, 0.0]), 0.0),
        masses=np.full(len(positions), spacing**2),
        spacing=spacing,
        duration=duration,
        step=courant(spacing, 1.0, sound_speed, 1 / reynolds),
        physics=confined(spacing, 1.0, sound_speed, 1 / reynolds),
        wall=np.any((positions < 0) | (positions > 1), axis=1),
        bounds=Tank((0.0, 0.0), (1.0, 1.0)),
        sealed=Tank((0.0, 0.0), (1.0, 1.0)),
    )


SCENES = {"taylor-green": taylor_green, "poiseuille": poiseuille, "couette": couette, "cavity": cavity}
