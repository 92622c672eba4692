"""The peak of a GPU's memory after each step of a small search: which of them takes it.

With the word `host` behind it, the largest count is looked for there.
"""

import sys

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
a = jax.block_until_ready(jnp.asarray(x))
show("positions")
count = jax.block_until_ready(jfrnn.count(a, 0.1, backend="warp"))
show("count warp")
more = jax.block_until_ready(count + 1)
show("count+1")
if "host" in sys.argv:
    capacity = int(np.asarray(count).max())
    show("max on the host")
else:
    longest = jax.block_until_ready(jnp.max(count))
    show("max")
    capacity = int(longest)
    show("int(max)")
search = compile_for(lambda x: jfrnn.search(x, 0.1, capacity=capacity, backend="warp"), x)
show("compiled")
nbrs = search()
show("search")
