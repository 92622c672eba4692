"""`jfrnn.count` with the backend `warp`: the number of neighbors of each particle, no list."""

from collections.abc import Callable
from functools import partial

import jax
import numpy as np
import warp as wp  # without it this method is missing, which is no failure

import jfrnn
from experiments.methods import Found
from experiments.methods._padded import compile_for, plan_backend

plan = partial(plan_backend, backend="warp")


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], jax.Array]:
    """Compile the count, and return it."""
    return compile_for(lambda x: jfrnn.count(x, cutoff, backend="warp"), positions)


def read(result: jax.Array) -> Found:
    """Return the counts, shape [n]."""
    return Found(result.nbytes, counts=np.asarray(result), device=next(iter(result.devices())).device_kind)
