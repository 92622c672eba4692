"""Renormalized kernel gradients: exact for linear fields, whatever the particles' order."""

import jax.numpy as jnp
from jax import Array

from jfrnn.sph.pairs import Pair, Values


def moment(pair: Pair, j: Values, gradient: Array) -> Array:
    """Return V_j ∇W ⊗ (x_j - x_i), shape [d, d], whose sum is the identity where particles lie evenly on all sides."""
    return j["volume"] * gradient[:, None] * pair.r[None, :]


def inverse(moments: Array, least: float = 0.1) -> Array:
    """Return the inverse of each moment, shape [n, d, d]; the identity where its determinant is below least^d: few neighbors.

    Source: Bonet & Lok (1999), doi:10.1016/S0045-7825(99)00051-1.
    """
    cofactors = _cofactors(moments)
    determinant = jnp.sum(moments[:, 0] * cofactors[:, 0], axis=-1)
    known = determinant > least ** moments.shape[-1]
    inverses = jnp.swapaxes(cofactors, 1, 2) / jnp.where(known, determinant, 1)[:, None, None]
    return jnp.where(known[:, None, None], inverses, jnp.eye(moments.shape[-1], dtype=moments.dtype))


def _cofactors(a: Array) -> Array:
    if a.shape[-1] == 2:
        rows = jnp.stack([a[:, 1, 1], -a[:, 1, 0], -a[:, 0, 1], a[:, 0, 0]], axis=-1)
        return rows.reshape(a.shape)
    return jnp.stack([jnp.cross(a[:, (k + 1) % 3], a[:, (k + 2) % 3]) for k in range(3)], axis=1)
