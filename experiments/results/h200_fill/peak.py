"""The peak of a GPU's memory after each step of a small search: which of them takes it."""

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from experiments.methods._compiled import compile_for


def show(what: str) -> None:
    """Print what JAX holds now, and the most that it held so far."""
    stats = jax.devices()[0].memory_stats()
    print(f"{what:42s} in use {stats['bytes_in_use']:>12,d} peak {stats['peak_bytes_in_use']:>12,d}")


x = np.random.default_rng(0).random((1024, 3)).astype(np.float32)
show("start")
count = jax.block_until_ready(jfrnn.count(jnp.asarray(x), 0.1, backend="warp"))
show("count")
capacity = int(np.asarray(count).max())
show("largest count, on the host")
search = compile_for(lambda x: jfrnn.search(x, 0.1, capacity=capacity, backend="warp"), x)
show("search compiled")
nbrs = search()
show("search")
del nbrs
jax.block_until_ready(jnp.max(count))
show("largest count, by jnp.max")
