"""Walls: a tank that particles bounce off, and dummy particles that carry the fluid's pressure and velocity on."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jfrnn.sph.pairs import Pair, Values


def bounce(x: Array, v: Array, lower: Array, upper: Array, restitution: Array) -> tuple[Array, Array]:
    """Put particles that left the tank onto its wall, and turn and damp the velocity across it, of which `restitution` is left.

    Positions [m] and velocities [m/s] are [n, d], the corners [d]. Source: ReCoDE-SPH-solver-2D-NS (2024).
    """
    outside = (x < lower) | (x > upper)
    return jnp.clip(x, lower, upper), jnp.where(outside, -restitution * v, v)


def wall_terms(pair: Pair, i: Values, j: Values) -> dict[str, Array]:
    """Return what a wall particle i takes from a fluid particle j, weighed by W: weight, pressure, velocity, ρ_j (x_i - x_j)."""
    weight = jnp.where(j["wall"], 0, pair.weight) if "wall" in j else pair.weight
    return {"weight": weight, "p": weight * j["p"], "v": weight * j["v"], "moment": -weight * j["rho"] * pair.r}


def extrapolate(sums: dict[str, Array], wall_velocity: Array, gravity: Array | None) -> tuple[Array, Array]:
    """Return the pressures [Pa], shape [n], and velocities [m/s], shape [n, d], that wall particles show to the fluid.

    p = (Σ p_j W + g·Σ ρ_j (x_i - x_j) W)/Σ W; u = 2 v_wall - Σ v_j W/Σ W, so that the fluid is held at the wall. Sums are those of
    `wall_terms`. Source: Adami, Hu & Adams (2012), doi:10.1016/j.jcp.2012.05.005, eqs. 23 and 27.
    """
    met = sums["weight"] > jnp.finfo(sums["weight"].dtype).smallest_normal ** 0.5  # whose square is a divisor of derivatives
    weight = jnp.where(met, sums["weight"], 1)
    pressure = sums["p"] if gravity is None else sums["p"] + jnp.sum(sums["moment"] * gravity, axis=1)
    held = 2 * wall_velocity - sums["v"] / weight[:, None]
    return jnp.where(met, pressure / weight, 0), jnp.where(met[:, None], held, wall_velocity)


def keep_fluid(wall: Array | None, rates: Any, rest: Any = 0) -> Any:  # noqa: ANN401
    """Return the rates of fluid particles, shape [n] or [n, d], and `rest` for those of a wall; all, where there is none."""
    if wall is None:
        return rates
    return jnp.where(wall if rates.ndim == 1 else wall[:, None], rest, rates)
