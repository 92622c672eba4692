"""Gases: a blast."""

import numpy as np

from ._fluid import Gas, GasScene, Tank, lattice


def sedov(
    *,
    radius: float = 0.5,
    nx: int = 120,
    dim: int = 2,
    energy: float = 1.0,
    heat_ratio: float = 1.4,
    duration: float = 0.15,
    hot: float = 4.0,
    jitter: float = 0.1,
    seed: int = 0,
    step: float | None = None,
) -> GasScene:
    """Return a cold gas of density 1 at rest, in whose middle energy is set free: Sedov's blast, in 2D or 3D.

    Args:
        radius: Of the disc or ball of gas [m].
        nx: Particles along a radius.
        dim: Number of axes.
        energy: Set free at first [J; in 2D J/m].
        heat_ratio: Ratio of specific heats γ.
        duration: Time that is simulated [s].
        hot: Radius within which the energy is spread, in particle spacings.
        jitter: Largest displacement of a particle from its site, in spacings: along the rows of an exact lattice, jets run ahead.
        seed: Of the displacements.
        step: Time step [s]; None: it follows from the Courant condition.

    Source: Sedov (1959), Similarity and Dimensional Methods in Mechanics, ch. 4.
    """
    spacing = radius / nx
    grid = lattice((-radius,) * dim, (2 * nx,) * dim, spacing)
    sites = grid[(grid**2).sum(axis=1) <= radius**2]
    x = sites + jitter * spacing * np.random.default_rng(seed).uniform(-1, 1, sites.shape)
    masses = np.full(len(x), spacing**dim)
    share = np.maximum(1 - (x**2).sum(axis=1) / (hot * spacing) ** 2, 0)
    return GasScene(
        name="sedov",
        positions=x,
        velocities=np.zeros_like(x),
        masses=masses,
        spacing=spacing,
        duration=duration,
        step=step,
        physics=Gas(heat_ratio=heat_ratio, smoothing_ratio=1.3, artificial=1.0),
        energies=energy * share / (masses @ share),
        bounds=Tank((-radius,) * dim, (radius,) * dim),
    )


SCENES = {"sedov": sedov}
