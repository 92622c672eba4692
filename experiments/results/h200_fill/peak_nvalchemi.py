"""The peak of a GPU's memory after each step of a small search with nvalchemi-toolkit-ops, in a process of its own."""

import jax
import jax.numpy as jnp
import numpy as np
from nvalchemiops.jax.neighbors.cell_list import cell_list, estimate_cell_list_sizes  # pyright: ignore


def show(what: str) -> None:
    """Print what JAX holds now, and the most that it held so far."""
    stats = jax.devices()[0].memory_stats()
    print(f"{what:30s} in use {stats['bytes_in_use']:>12,d} peak {stats['peak_bytes_in_use']:>12,d}")


x = np.random.default_rng(0).random((1024, 3)).astype(np.float32)
cell, periodic = jnp.asarray(np.diag(x.max(axis=0) + np.float32(0.1))[None]), jnp.asarray(np.zeros((1, 3), bool))
show("start")
cells, _, radius = estimate_cell_list_sizes(jnp.asarray(x), cell, 0.1, periodic)
show("estimate_cell_list_sizes")
most = {"max_neighbors": 40, "max_total_cells": int(cells), "neighbor_search_radius": radius}
search = jax.jit(lambda x: cell_list(x, 0.1, cell, periodic, **most)[:2]).lower(jnp.asarray(x)).compile()
show("cell_list compiled")
nbrs = jax.block_until_ready(search(jnp.asarray(x)))
show("cell_list")
