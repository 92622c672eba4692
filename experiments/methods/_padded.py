"""The library's padded full list, compiled once for the capacity that the scene needs."""

from collections.abc import Callable

import jax
import numpy as np

import jfrnn
from experiments.methods import Found
from experiments.methods._compiled import compile_for


def allocate_backend(positions: np.ndarray, cutoff: float, backend: str) -> int:
    """Count the neighbors once, and return the length of the longest row."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    return int(np.asarray(jfrnn.count(jax.numpy.asarray(positions), cutoff, backend=backend)).max(initial=0))


def prepare_backend(
    positions: np.ndarray, cutoff: float, capacity: int, backend: str, kernels: bool = False
) -> Callable[[], jfrnn.NeighborList]:
    """Compile the search, and return it."""
    return compile_for(lambda x: jfrnn.search(x, cutoff, capacity=capacity, backend=backend), positions, kernels=kernels)


def plan_backend(positions: np.ndarray, cutoff: float, capacity: int, backend: str) -> jfrnn.MemoryPlan:
    """Return what the search is said to take of the memory."""
    n, dim = positions.shape
    return jfrnn.memory_plan(n, cutoff, capacity, dim=dim, dtype=positions.dtype, backend=backend)


def found_in_rows(idx: np.ndarray, count: np.ndarray, device: str) -> Found:
    """Return the ordered pairs of another library's padded list; raise RuntimeError where a row was cut off."""
    if count.max(initial=0) > idx.shape[1]:
        raise RuntimeError(f"a row has {count.max()} neighbors and {idx.shape[1]} slots")
    i, k = np.nonzero(np.arange(idx.shape[1]) < count[:, None])
    return Found(idx.nbytes + count.nbytes, (i, idx[i, k].astype(np.int64)), directed=True, device=device)


def read(result: jfrnn.NeighborList) -> Found:
    """Return the directed pairs of the padded list."""
    result.check()
    size = result.idx.nbytes + result.count.nbytes
    return Found(size, result.pairs(), directed=True, device=next(iter(result.idx.devices())).device_kind)
