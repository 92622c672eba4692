"""`jfrnn.pair_sum` with the backend `warp`: density by the kernel poly6 and the number of neighbors, in one sum, without a list."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp  # without it this method is missing, which is no failure

import jfrnn
from experiments.methods import Found
from experiments.methods._padded import compile_for


def prepare(positions: np.ndarray, cutoff: float) -> Callable[[], tuple[jax.Array, jax.Array]]:
    """Compile the sum, and return it; all masses are 1, and distances are in cutoffs."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    mass, one = jnp.ones(len(positions), positions.dtype), positions.dtype.type(1)

    def poly6(r: jax.Array, i: dict[str, jax.Array], j: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        rest = jnp.maximum(1 - (r @ r) / (cutoff * cutoff), 0)
        return j["m"] * rest * rest * rest, one

    return compile_for(lambda x, mass: jfrnn.pair_sum(poly6, x, cutoff, {"m": mass}, backend="warp"), positions, mass)


def plan(positions: np.ndarray, cutoff: float) -> jfrnn.MemoryPlan:
    """Return what the sum is said to take of the memory."""
    n, dim = positions.shape
    one = positions.dtype.type(1)
    values = {"m": jax.ShapeDtypeStruct((n,), positions.dtype)}
    return jfrnn.memory_plan(
        *(n, cutoff), dim=dim, dtype=positions.dtype, fn=lambda r, i, j: (j["m"] * (r @ r), one), values=values, backend="warp"
    )


def read(result: tuple[jax.Array, jax.Array]) -> Found:
    """Return the counts and the density, shape [n]."""
    density, count = result
    size = density.nbytes + count.nbytes
    counts, device = np.asarray(count).astype(np.int64), next(iter(count.devices())).device_kind
    return Found(size, counts=counts, device=device, density=np.asarray(density, np.float64))
