"""The liquid of `bench lj`: its crystal, its potential, and what a run did to its energy."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn

DENSITY, TEMPERATURE, STEP = 0.8442, 1.44, 0.005  # in units of the potential, as in the benchmark of LAMMPS
ONSET, CUTOFF = 2.0, 2.5  # between which the potential goes to 0 smoothly, as that of jax-md does


class Liquid(NamedTuple):
    """Positions and velocities, and the periodic cube in which they move."""

    x: Array
    v: Array
    length: float

    @property
    def box(self) -> jfrnn.Box:
        """The cube."""
        return jfrnn.Box(np.full(3, self.length, self.x.dtype))


class Ran(NamedTuple):
    """What a simulation came to.

    Attributes:
        seconds: Median time of a run of all steps.
        potential: Potential energy of the liquid before and after the first run.
        kinetic: Kinetic energy then.
        told: More columns of the row.
    """

    seconds: float
    potential: tuple[float, float]
    kinetic: tuple[float, float]
    told: dict[str, Any]

    def columns(self, n: int, steps: int) -> dict[str, Any]:
        """Return the columns of a row of n particles: `drift` is that of the energy per particle."""
        drift = (self.potential[1] + self.kinetic[1] - self.potential[0] - self.kinetic[0]) / n
        found = {"steps_per_s": steps / self.seconds, "drift": drift, "temperature": 2 * self.kinetic[1] / (3 * n)}
        return {"status": "ok"} | found | self.told


def make_crystal(n: int) -> Liquid:
    """Return about n particles on a cubic lattice, a little off their sites, with velocities of the temperature."""
    rng, side = np.random.default_rng(n), max(round(n ** (1 / 3)), 4)
    length = side / DENSITY ** (1 / 3)
    sites = np.stack(np.meshgrid(*[np.arange(side) + 0.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = (sites + rng.uniform(-0.05, 0.05, sites.shape)) * (length / side)
    v = rng.normal(scale=math.sqrt(TEMPERATURE), size=x.shape)
    return Liquid(jnp.asarray(x, jnp.float32), jnp.asarray(v - v.mean(axis=0), jnp.float32), length)


def energy_of(square: Array) -> Array:
    """Return the potential of a pair from the square of its distance, half of which belongs to each particle."""
    sixth = 1 / (square * square * square)
    onset, cutoff = ONSET**2, CUTOFF**2
    fade = (cutoff - square) ** 2 * (cutoff + 2 * square - 3 * onset) / (cutoff - onset) ** 3
    return 4 * (sixth * sixth - sixth) * jnp.where(square < onset, 1, fade)


def kinetic_of(v: Array | np.ndarray) -> float:
    """Return the kinetic energy of particles of mass 1."""
    return float(np.sum(np.square(np.asarray(v, np.float64))) / 2)
