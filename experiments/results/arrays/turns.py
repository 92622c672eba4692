"""What lists, counts and densities by the array engine take, where two checkouts are to be measured in turns on one card.

`python experiments/results/arrays/turns.py WHO SIZES WAYS`, run in a checkout with PYTHONPATH set to it, as in
`turns.py jfrnn 15625,64000 list,ties,counts,density,gradient,box`; WHO is jfrnn or jax-md, whose way is a list. A line each:
seconds to lower and to compile, without JAX's cache; microseconds of a waited call and of a step of a scan; the scratch memory.
"""

import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from experiments import _measure

CUTOFF, CAPACITY = 3.0, 128  # of a cubic lattice with a spacing of 1
Function = Callable[[Array], Any]


def make_scene(n: int, jitter: float) -> Array:
    """Return shuffled sites of a cube, moved a little."""
    side = round(n ** (1 / 3))
    sites = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    rng = np.random.default_rng(side)
    return jnp.asarray(rng.permutation((sites + rng.uniform(-jitter, jitter, sites.shape)).astype(np.float32)))


def make_way(who: str, way: str, x: Array) -> Function:
    """Return a function of positions."""
    if who == "jax-md":
        from experiments.methods import jax_md

        return jax_md.compile_update(x, CUTOFF, jax_md.allocate(np.asarray(x), CUTOFF))
    box = jfrnn.Box([float(np.ptp(np.asarray(x), axis=0).max()) + 2 * CUTOFF] * 3) if way == "box" else None

    def rows(x: Array) -> tuple[Array, Array]:
        nbrs = jfrnn.search(x, CUTOFF, capacity=CAPACITY, box=box, backend="jax")
        return nbrs.idx, nbrs.count

    def density(x: Array) -> Array:
        return jfrnn.pair_sum(lambda r, i, j: jnp.maximum(1 - (r @ r) / CUTOFF**2, 0) ** 3, x, CUTOFF, backend="jax")

    def gradient(x: Array) -> tuple[Array, Array]:
        found, back = jax.vjp(density, x)
        return found, back(jnp.ones_like(found))[0]

    known = {"counts": lambda x: jfrnn.count(x, CUTOFF, backend="jax"), "density": density, "gradient": gradient}
    return known.get(way, rows)


def main(who: str, sizes: str, ways: str) -> None:
    """Print a line for each size and way."""
    jax.config.update("jax_enable_compilation_cache", False)
    print(jax.devices()[0].device_kind, jax.__version__, flush=True)
    for n in map(int, sizes.split(",")):
        for way in ways.split(","):
            x = make_scene(n, 0.0 if way == "ties" else 0.3)
            function = make_way(who, way, x)
            jax.clear_caches()
            begin = time.perf_counter()
            lowered = jax.jit(function).lower(x)
            between = time.perf_counter()
            compiled = lowered.compile()
            end = time.perf_counter()
            repeats, steps = (40, 50) if n < 100_000 else (10, 5)
            calls = {"waited": lambda compiled=compiled, x=x: compiled(x), "scan": _measure.compile_scan(function, x, steps)}
            waited, scan = (
                median(_measure.time_in_turns({name: call}, k)[0][name])
                for (name, call), k in zip(calls.items(), (repeats, 5), strict=True)
            )
            step = scan / steps
            scratch = compiled.memory_analysis()
            times = (
                f"lower {between - begin:5.2f} compile {end - between:5.2f} waited {1e6 * waited:8.0f} us step {1e6 * step:8.0f} us"
            )
            print(
                f"{who:7s} {n:8d} {way:8s} {times} scratch {0 if scratch is None else scratch.temp_size_in_bytes / 1e6:7.1f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
