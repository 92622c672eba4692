"""nvalchemi-toolkit-ops: cells and a padded list with Warp kernels inside `jax.jit`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from nvalchemiops.jax.neighbors.cell_list import cell_list, estimate_cell_list_sizes  # pyright: ignore
from nvalchemiops.jax.neighbors.naive import naive_neighbor_list  # pyright: ignore

from experiments.methods import Found, at_hand
from experiments.methods._padded import found_in_rows
from experiments.methods._pairs import most_in_ball as allocate  # without it, the list is cut off in silence

PACKAGES = ("nvalchemi-toolkit-ops",)


def compile_search(positions: Any, cutoff: float, capacity: int) -> Callable[[Any], tuple[jax.Array, jax.Array]]:  # noqa: ANN401
    """Return a compiled search of such positions, which is not waited for; open space as a box that nothing wraps around."""
    low = jnp.min(positions, axis=0)  # its cells begin at 0
    cell = jnp.diag(jnp.max(positions, axis=0) - low + cutoff)[None]
    periodic = jnp.zeros((1, positions.shape[1]), bool)
    cells, _, radius = estimate_cell_list_sizes(jnp.asarray(positions - low), cell, cutoff, periodic)
    most = {"max_neighbors": capacity, "max_total_cells": int(cells), "neighbor_search_radius": radius}
    return jax.jit(lambda x: cell_list(x - low, cutoff, cell, periodic, **most)[:2])


def compile_naive(cutoff: float, capacity: int, strategy: str) -> Callable[[Any], tuple[jax.Array, jax.Array]]:
    """Return a compiled search that looks at all pairs, by the strategy `scalar` or, on CUDA, `tile`; it is not waited for."""
    return jax.jit(lambda x: naive_neighbor_list(x, cutoff, max_neighbors=capacity, strategy=strategy)[:2])


def prepare(positions: np.ndarray, cutoff: float, capacity: int) -> Callable[[], tuple[jax.Array, jax.Array]]:
    """Compile the search, and return it."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    search = compile_search(positions, cutoff, capacity)
    jax.block_until_ready(search(jnp.asarray(positions)))
    x = at_hand(positions)
    return lambda: jax.block_until_ready(search(jnp.asarray(x)))


def read(result: tuple[jax.Array, jax.Array]) -> Found:
    """Return the ordered pairs of the padded list."""
    idx, count = (np.asarray(part) for part in result)
    return found_in_rows(idx, count, next(iter(result[0].devices())).device_kind)
