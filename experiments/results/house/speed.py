"""Times of a list, counts, a density and its gradient, a line of JSON each: `python speed.py NAME SIZES [REPEATS]`.

Two checkouts are compared by running it in turns in an environment of each, with a name for each.
"""

import functools
import json
import statistics
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn

CUTOFF = 3.0  # spacings


def lattice(side: int, dtype: str, jitter: float) -> jax.Array:
    """Return a cubic lattice of spacing 1 in random order, every point moved by up to `jitter` along each axis."""
    random = np.random.default_rng(0)
    points = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float64)
    points += jitter * random.uniform(-1, 1, points.shape)
    random.shuffle(points)
    return jnp.asarray(points, dtype)


def weight(r: jax.Array, _i: None, _j: None) -> jax.Array:
    """Return a kernel with the cutoff as its support."""
    return jnp.maximum(0, 1 - jnp.sum(r * r) / CUTOFF**2) ** 2


def waited(program: Callable, x: jax.Array, repeats: int) -> float:
    """Return the median of calls that are waited for one by one [ms], after two that compile and warm up."""
    seconds = []
    for k in range(repeats + 2):
        begin = time.perf_counter()
        jax.block_until_ready(program(x))
        if k > 1:
            seconds.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(seconds)


def measure(name: str, size: int, repeats: int) -> None:
    """Print the lines of one size."""
    side = round(size ** (1 / 3))
    for dtype, jitter in ((dtype, jitter) for dtype in ("float32", "float64") for jitter in (0.3, 0.0)):
        jax.config.update("jax_enable_x64", dtype == "float64")
        x, box = lattice(side, dtype, jitter), jfrnn.Box([float(side)] * 3)
        capacity = -(-int(jfrnn.count(x, CUTOFF).max()) // 8) * 8

        def searched(x: jax.Array, capacity: int = capacity, box: jfrnn.Box | None = None) -> jax.Array:
            return jfrnn.search(x, CUTOFF, capacity=capacity, box=box).idx

        def density(x: jax.Array) -> jax.Array:
            return jfrnn.pair_sum(weight, x, CUTOFF)

        programs = {
            "list": searched,
            "count": lambda x: jfrnn.count(x, CUTOFF),
            "density": density,
            "gradient": jax.grad(lambda x: jnp.sum(density(x))),
            "box list": functools.partial(searched, box=box),
        }
        for what, program in programs.items():
            about = {"who": name, "n": len(x), "dtype": dtype, "jitter": jitter, "what": what}
            print(json.dumps(about | {"ms": waited(jax.jit(program), x, repeats)}), flush=True)


if __name__ == "__main__":
    for size in map(int, sys.argv[2].split(",")):
        measure(sys.argv[1], size, int(sys.argv[3]) if len(sys.argv) > 3 else 15)
