"""Times of hash grids, a line of CSV each: `python hashgrid.py NAME`, in an environment of each checkout that is compared."""

import functools
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from speed import CUTOFF, lattice

import jfrnn


def measure(call: Callable[[], Any]) -> list[float]:
    """Return until when a call returns, until when its result is there, and how long each of many calls takes [ms]: medians."""
    jax.block_until_ready([call(), call()])
    returns, waited, burst = [], [], []
    for _ in range(60):
        begin = time.perf_counter()
        result = call()
        returns.append(time.perf_counter() - begin)
        jax.block_until_ready(result)
        waited.append(time.perf_counter() - begin)
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready([call() for _ in range(100)][-1])
        burst.append((time.perf_counter() - begin) / 100)
    return [1e3 * statistics.median(seconds) for seconds in (returns, waited, burst)]


def listed(x: jax.Array, capacity: int) -> tuple[jax.Array, jax.Array]:
    """Return the rows of a list, and the counts."""
    nbrs = jfrnn.search(x, CUTOFF, capacity=capacity, backend="hashgrid")
    return nbrs.idx, nbrs.count


if __name__ == "__main__":
    for side in (10, 30):
        x = lattice(side, "float32", 0.3)
        capacity = -(-int(np.asarray(jfrnn.count(x, CUTOFF)).max()) // 8) * 8
        programs = {
            "list": jax.jit(functools.partial(listed, capacity=capacity)),
            "count": jax.jit(lambda x: jfrnn.count(x, CUTOFF, backend="hashgrid")),
        }
        for what, program in programs.items():
            times = measure(lambda program=program, x=x: program(x))
            print(sys.argv[1], len(x), what, *(f"{ms:.3f}" for ms in times), sep=",", flush=True)
