"""jax-sph's own list `jaxmd_scan`, jitted: jax-md's cells, walked in parts to save memory. Toshev et al., arXiv:2403.04750."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax_sph.jax_md import space  # pyright: ignore[reportMissingImports]
from jax_sph.partition import neighbor_list  # pyright: ignore[reportMissingImports]

from experiments.methods import Found, at_hand
from experiments.methods._padded import compile_update

PACKAGES = ("jax-sph",)
MAX_POINTS = 130_000
MOST_PARTITIONS = 8  # the default of its scan; its last partition must be full: what pads it calls a function that JAX has dropped


def allocate(positions: np.ndarray, cutoff: float) -> Any:  # noqa: ANN401
    """Return a list with its capacity, and the lowest coordinates; open space as a box that nothing wraps around."""
    low = positions.min(axis=0)
    size = np.maximum(positions.max(axis=0) - low + 2 * cutoff, 3.5 * cutoff)
    parts = next(k for k in range(MOST_PARTITIONS, 0, -1) if len(positions) % k == 0)
    functions: Any = neighbor_list(space.free()[0], jnp.asarray(size), cutoff, backend="jaxmd_scan", num_partitions=parts)
    return functions.allocate(jnp.asarray(positions - low)), low


def prepare(positions: np.ndarray, cutoff: float, lists: Any) -> Callable[[], tuple[jax.Array, int]]:  # noqa: ANN401
    """Compile the update, and return it: its edges, and the number that unused ones lead from and to."""
    update, x = compile_update(lists, positions, cutoff), at_hand(positions)
    return lambda: (jax.block_until_ready(update(jnp.asarray(x))), len(positions))


def read(result: tuple[jax.Array, int]) -> Found:
    """Return the ordered pairs."""
    edges, unused = result
    j, i = np.asarray(edges).astype(np.int64)
    used = i < unused
    return Found(edges.nbytes, (i[used], j[used]), directed=True, device=next(iter(edges.devices())).device_kind)
