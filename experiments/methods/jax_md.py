"""jax-md: cells of fixed capacity and a padded list, jitted; its `update` is timed, made to rebuild."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax_md import partition, space  # pyright: ignore[reportMissingImports]

from experiments.methods import Found, at_hand

PACKAGES = ("jax-md",)
MAX_POINTS = 130_000  # 19 GB at 250 000


class Lists(NamedTuple):
    """Its functions, an allocated list, and the lowest coordinates of the particles, shape [dim]."""

    functions: Any
    nbrs: Any
    low: np.ndarray


def allocate(positions: np.ndarray, cutoff: float) -> Lists:
    """Return a list with its capacity; it is found with the list itself."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    low = positions.min(axis=0)
    size = jnp.asarray(positions.max(axis=0) - low + positions.dtype.type(cutoff))  # its cells begin at 0
    made: Any = partition.neighbor_list(space.free()[0], size, cutoff, format=partition.NeighborListFormat.Dense)  # pyright: ignore
    return Lists(made, made.allocate(jnp.asarray(positions - low)), low)


def prepare(positions: np.ndarray, cutoff: float, lists: Any) -> Callable[[], jax.Array]:  # noqa: ANN401
    """Compile the update, and return it."""
    nbrs = lists.nbrs
    moved = replace(nbrs, reference_position=nbrs.reference_position + 2 * cutoff)  # else it keeps what it has
    update = jax.jit(lambda x, nbrs: nbrs.update(x - lists.low))
    if update(jnp.asarray(positions), moved).did_buffer_overflow:
        raise RuntimeError("the list overflowed right after it was allocated")
    x = at_hand(positions)
    return lambda: jax.block_until_ready(update(jnp.asarray(x), moved).idx)


def read(result: jax.Array) -> Found:
    """Return the ordered pairs of the padded list, n where a slot is not used."""
    idx = np.asarray(result)
    i, k = np.nonzero(idx < len(idx))
    return Found(idx.nbytes, (i, idx[i, k].astype(np.int64)), directed=True, device=next(iter(result.devices())).device_kind)
