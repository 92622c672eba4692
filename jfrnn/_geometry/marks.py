"""Marks: what stands in place of numbers that may be wrong, so that nobody takes them for right: NaN, or the smallest integer."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.status import Status

ROWS_ARE_WHOLE = Status.NONFINITE | Status.TOTAL_OVERFLOW  # bits that do not mean missing neighbors in rows


def are_whole(status: Array, spared: Status = ROWS_ARE_WHOLE) -> Array:
    """Say whether no pair is missing as far as status bits tell, of which the spared ones tell nothing of that; [] bool."""
    return (status & np.int32(~spared.value)) == 0


def are_finite(points: Array) -> Array:
    """Say which points have finite coordinates: [rows] bool. It takes no reduction, which XLA would not fuse."""
    return functools.reduce(jnp.logical_and, (jnp.isfinite(points[:, k]) for k in range(points.shape[1])))


def good_rows(points: Array, active: Array | None, whole: Array | None) -> Array:
    """Say which rows [m] are valid: those of finite points and of inactive particles, provided that no pairs are missing."""
    finite = are_finite(lax.stop_gradient(points))
    good = finite if active is None else finite | ~active
    return good if whole is None else good & whole


def mark_rows(x: Array, good: Array) -> Array:
    """Replace rows that are not good by NaN (integers: the smallest one); their derivatives become NaN too.

    `good` [rows] says it of each row, or [] of all.
    """
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x * one_or_nan(good, x)
    return jnp.where(_spread(good, x.ndim), x, jnp.iinfo(x.dtype).min)


def one_or_nan(good: Array, like: Array | jax.ShapeDtypeStruct) -> Array:
    """Return 1 for good rows and NaN for others, in a shape that multiplies `like` [rows, ...]."""
    return _spread(jnp.where(good, 1, jnp.nan).astype(like.dtype), like.ndim)


def _spread(good: Array, ndim: int) -> Array:
    return good.reshape(*good.shape, *[1] * (ndim - good.ndim)) if good.ndim else good
