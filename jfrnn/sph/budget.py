"""Energies and momentum of a state."""

import jax.numpy as jnp
from jax import Array

from jfrnn.sph import states
from jfrnn.sph.particles import Flow, Model, State, mass_there


def kinetic_energy(model: Flow, s: State) -> Array:
    """Return ½ Σ m v² of the fluid [J; in 2D J/m], shape []."""
    return jnp.sum(mass_there(model, s) * jnp.sum(s.v * s.v, axis=1)) / 2


def potential_energy(model: Model, s: State) -> Array:
    """Return -Σ m g·(x - x0) of the fluid [J], shape []; 0 without gravity.

    x0 is the lower corner of the tank, and 0 along axes on which there is none, or where the tank is open downwards.
    """
    if model.physics.gravity is None:
        return jnp.zeros((), s.x.dtype)
    ground = jnp.zeros((), s.x.dtype) if model.tank is None else jnp.where(jnp.isfinite(model.tank[0]), model.tank[0], 0)
    return -jnp.sum(mass_there(model, s) * jnp.sum((s.x - ground) * model.physics.gravity, axis=1))


def internal_energy(model: Model, s: State) -> Array:
    """Return the energy [J], shape [], that compression of the fluid took, of a state that carries its densities.

    With the pressure force "mean", without dissipation, it and the kinetic and potential energy together are conserved.

    Raises:
        ValueError: The state carries no densities.
    """
    physics = model.physics
    if s.rho is None:
        raise ValueError(f"energy of compression needs carried densities, got evolve {physics.evolve!r}: take 'continuity'.")
    if physics.state == "linear":
        each = states.linear_energy(s.rho, physics.density, physics.sound_speed)
    else:
        each = states.tait_energy(s.rho, physics.density, physics.sound_speed, physics.exponent)
    return jnp.sum(mass_there(model, s) * each)


def momentum(model: Flow, s: State) -> Array:
    """Return Σ m v of the fluid [kg m/s], shape [d]."""
    return jnp.sum(mass_there(model, s)[:, None] * s.v, axis=0)
