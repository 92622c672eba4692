"""jax-md: cells of fixed capacity and a padded list, jitted; its `update` is timed, made to rebuild."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax_md import partition, space  # pyright: ignore[reportMissingImports]

from experiments.methods import Found, _padded, at_hand

PACKAGES = ("jax-md",)
MAX_POINTS = 130_000  # 19 GB at 250 000


def allocate(positions: np.ndarray, cutoff: float, sparse: bool = False) -> tuple[Any, np.ndarray]:
    """Return a list with its capacity, which is found with the list itself, and the lowest coordinates, shape [dim].

    Rows of a dense list are padded, [n, capacity]; a sparse one holds pairs, [2, capacity]. Unused slots hold n.
    """
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    low = np.asarray(positions).min(axis=0)
    size = jnp.asarray(np.asarray(positions).max(axis=0) - low + positions.dtype.type(cutoff))  # its cells begin at 0
    formats: Any = partition.NeighborListFormat  # pyright: ignore
    made: Any = partition.neighbor_list(space.free()[0], size, cutoff, format=formats.Sparse if sparse else formats.Dense)  # pyright: ignore
    return made.allocate(jnp.asarray(positions - low)), low


def compile_update(positions: Any, cutoff: float, lists: Any = None) -> Callable[[Any], jax.Array]:  # noqa: ANN401
    """Return a compiled update of a list, from positions to the list, which is not waited for."""
    return _padded.compile_update(lists or allocate(positions, cutoff), positions, cutoff)


def prepare(positions: np.ndarray, cutoff: float, lists: Any) -> Callable[[], jax.Array]:  # noqa: ANN401
    """Compile the update, and return it."""
    update, x = compile_update(positions, cutoff, lists), at_hand(positions)
    return lambda: jax.block_until_ready(update(jnp.asarray(x)))


def read(result: jax.Array) -> Found:
    """Return the ordered pairs of the padded list, n where a slot is not used."""
    idx = np.asarray(result)
    i, k = np.nonzero(idx < len(idx))
    return Found(idx.nbytes, (i, idx[i, k].astype(np.int64)), directed=True, device=next(iter(result.devices())).device_kind)
