"""Equations of state: the pressure of a density, and back; the energy that compression takes."""

import jax.numpy as jnp
from jax import Array


def linear(density: Array, rest: Array, sound_speed: Array) -> Array:
    """Return p = c²(ρ - ρ0) [Pa] of densities, any shape. Source: Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776."""
    return sound_speed**2 * (density - rest)


def tait(density: Array, rest: Array, sound_speed: Array, exponent: float) -> Array:
    """Return p = ρ0c²/γ·((ρ/ρ0)^γ - 1) [Pa] of densities, any shape. Source: Monaghan (1994), doi:10.1006/jcph.1994.1034."""
    return rest * sound_speed**2 / exponent * ((density / rest) ** exponent - 1)


def linear_density(pressure: Array, rest: Array, sound_speed: Array) -> Array:
    """Return the density [kg/m³] at which `linear` gives this pressure."""
    return rest + pressure / sound_speed**2


def tait_density(pressure: Array, rest: Array, sound_speed: Array, exponent: float) -> Array:
    """Return the density [kg/m³] at which `tait` gives this pressure."""
    return rest * (pressure * exponent / (rest * sound_speed**2) + 1) ** (1 / exponent)


def linear_energy(density: Array, rest: Array, sound_speed: Array) -> Array:
    """Return the energy per mass [J/kg], 0 at rest, whose derivative in ρ is p/ρ² of `linear`."""
    return sound_speed**2 * (jnp.log(density / rest) + rest / density - 1)


def tait_energy(density: Array, rest: Array, sound_speed: Array, exponent: float) -> Array:
    """Return the energy per mass [J/kg], 0 at rest, whose derivative in ρ is p/ρ² of `tait`."""
    squeezed = ((density / rest) ** (exponent - 1) - 1) / (exponent - 1)
    return sound_speed**2 / exponent * (squeezed + rest / density - 1)
