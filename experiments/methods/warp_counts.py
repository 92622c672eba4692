"""`jfrnn.count` with the backend `warp`: the number of neighbors of each particle, no list."""

from collections.abc import Callable

import jax
import numpy as np
import warp as wp  # noqa: F401 - without it this method is missing, which is no failure

import jfrnn
from experiments.methods import Found, at_hand


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], jax.Array]:
    """Compile the count, and return it; kernels of Warp compile when they first run, here on one particle."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    count = jax.jit(lambda x: jfrnn.count(x, cutoff, backend="warp"))
    compiled = count.lower(jax.ShapeDtypeStruct(positions.shape, positions.dtype)).compile()
    x = at_hand(positions)
    jax.block_until_ready(count(jax.numpy.asarray(x)[:1]))  # to make an array of that shape compiles something, too
    return lambda: jax.block_until_ready(compiled(jax.numpy.asarray(x)))


def read(result: jax.Array) -> Found:
    """Return the counts, shape [n]."""
    return Found(result.nbytes, counts=np.asarray(result), device=next(iter(result.devices())).device_kind)
