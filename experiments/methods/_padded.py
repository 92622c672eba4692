"""The library's padded full list, compiled once for the capacity that the scene needs."""

from collections.abc import Callable

import jax
import numpy as np

import jfrnn
from experiments import _compare
from experiments._library import Name
from experiments.methods import Found
from experiments.methods._compiled import compile_for


def allocate_backend(positions: np.ndarray, cutoff: float, backend: Name) -> int:
    """Count the neighbors once, and return the length of the longest row."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    return int(np.asarray(jfrnn.count(jax.numpy.asarray(positions), cutoff, backend=backend)).max(initial=0))


def prepare_backend(
    positions: np.ndarray, cutoff: float, capacity: int, backend: Name, kernels: bool = False
) -> Callable[[], jfrnn.NeighborList]:
    """Compile the search, and return it."""
    return compile_for(lambda x: jfrnn.search(x, cutoff, capacity=capacity, backend=backend), positions, kernels=kernels)


def plan_backend(positions: np.ndarray, cutoff: float, capacity: int | None = None, *, backend: Name) -> jfrnn.MemoryPlan:
    """Return what the search is said to take of the memory, without a capacity the count."""
    n, dim = positions.shape
    return jfrnn.memory_plan(n, cutoff, capacity, dim=dim, dtype=positions.dtype, backend=backend)


def found_in_rows(idx: np.ndarray, count: np.ndarray, device: str) -> Found:
    """Return the ordered pairs of a padded list; of a large one those that are compared.

    Raises:
        RuntimeError: A row was cut off.
    """
    n, slots = idx.shape
    if count.max(initial=0) > slots:
        raise RuntimeError(f"a row has {count.max()} neighbors and {slots} slots")
    rows = _compare.sample(n) if n > _compare.MOST_LISTED else np.arange(n)
    i, k = np.nonzero(np.arange(slots) < count[rows, None])
    pairs = rows[i], idx[rows[i], k].astype(np.int64)
    return Found(idx.nbytes + count.nbytes, pairs, directed=True, device=device, total=int(count.sum(dtype=np.int64)))


def read(result: jfrnn.NeighborList) -> Found:
    """Return the directed pairs of the padded list."""
    result.check()
    return found_in_rows(np.asarray(result.idx), np.asarray(result.count), next(iter(result.idx.devices())).device_kind)
