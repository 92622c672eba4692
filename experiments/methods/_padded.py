"""The library's padded full list, compiled once for the capacity that the scene needs."""

from collections.abc import Callable

import jax
import numpy as np

import jfrnn
from experiments.methods import Found


def prepare_backend(positions: np.ndarray, cutoff: float, backend: str) -> Callable[[], jfrnn.NeighborList]:
    """Count once to get the capacity, compile the search, and return it."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    x = jax.numpy.asarray(positions)
    capacity = int(jfrnn.count(x, cutoff, backend=backend).max())
    compiled = jax.jit(lambda x: jfrnn.search(x, cutoff, capacity=capacity, backend=backend)).lower(x).compile()
    return lambda: jax.block_until_ready(compiled(jax.numpy.asarray(positions)))


def read(result: jfrnn.NeighborList) -> Found:
    """Return the directed pairs of the padded list."""
    result.check()
    i, j = (np.asarray(index) for index in result.pairs())
    size = result.idx.nbytes + result.count.nbytes
    return Found(size, (i, j), directed=True, device=next(iter(result.idx.devices())).device_kind)
