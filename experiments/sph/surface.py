"""Surface tension by cohesion: particles attract each other, and repel when close, so that free surfaces shrink."""

import jax.numpy as jnp
from jax import Array

from experiments.sph.pairs import Pair, Values


def cohesion(pair: Pair, i: Values, j: Values, strength: Array, reach: float) -> Array:
    """Return γ m_j C(r/reach) (x_j - x_i)/r [m/s²], antisymmetric in mass times acceleration.

    C(q) = 128 (1-q)³q³ - 1 for q ≤ 1/2, then 64 (1-q)³q³, 0 from q = 1 on: repulsion below q = 0.28, attraction beyond.

    Args:
        pair: The pair.
        i: Values of i.
        j: Values of j.
        strength: γ [m/s²/kg].
        reach: Distance [m] from which on particles do not attract each other: the cutoff.

    Source: Akinci, Akinci & Teschner (2013), doi:10.1145/2508363.2508395, eq. 2 (the spline without its norm).
    """
    q = jnp.minimum(pair.distance / reach, 1.0)
    bump = 64 * (1 - q) ** 3 * q**3
    spline = jnp.where(q > 0.5, bump, 2 * bump - 1)
    apart = pair.square > 0
    return strength * j["m"] * spline * pair.r / jnp.where(apart, pair.distance, 1)
