"""The library's padded full list, compiled once for the capacity that the scene needs."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from experiments import _compare
from experiments._library import Name
from experiments.methods import Found, at_hand


def compile_for(function: Callable[..., Any], positions: np.ndarray, *more: jax.Array, kernels: bool = True) -> Callable[[], Any]:
    """Compile `function(positions, *more)`, and return it; every call reads the positions anew and waits for the result.

    With `kernels` of Warp it runs on one particle here: they compile when they first run, as does what makes an array.
    """
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    jitted = jax.jit(function)
    given = (positions, *more)
    compiled = jitted.lower(*(jax.ShapeDtypeStruct(values.shape, values.dtype) for values in given)).compile()
    x = at_hand(positions)
    if kernels:
        jax.block_until_ready(jitted(*(jnp.asarray(values)[:1] for values in (x, *more))))
    return lambda: jax.block_until_ready(compiled(jnp.asarray(x), *more))


def compile_update(lists: tuple[Any, np.ndarray], positions: Any, cutoff: float) -> Callable[[Any], Any]:  # noqa: ANN401
    """Return a compiled update of a list of jax-md or jax-sph, with its lowest coordinates: from positions to pairs, made anew."""
    nbrs, low = lists
    moved = replace(nbrs, reference_position=nbrs.reference_position + 2 * cutoff)  # else it keeps what it has
    update = jax.jit(lambda x, nbrs: nbrs.update(x - low))
    if update(jnp.asarray(positions), moved).did_buffer_overflow:
        raise RuntimeError("the list overflowed right after it was allocated")
    return lambda x: update(x, moved).idx


def of_backend(backend: Name, kernels: bool = False) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """Return `allocate`, `prepare` and `plan` of an engine's list; `kernels`: whether Warp compiles some for it."""

    def allocate(positions: np.ndarray, cutoff: float) -> int:
        jax.config.update("jax_enable_x64", positions.dtype == np.float64)
        return int(np.asarray(jfrnn.count(jnp.asarray(positions), cutoff, backend=backend)).max(initial=0))

    def prepare(positions: np.ndarray, cutoff: float, capacity: int) -> Callable[[], jfrnn.NeighborList]:
        return compile_for(lambda x: jfrnn.search(x, cutoff, capacity=capacity, backend=backend), positions, kernels=kernels)

    return allocate, prepare, partial(plan_backend, backend=backend)


def plan_backend(positions: np.ndarray, cutoff: float, capacity: int | None = None, *, backend: Name) -> jfrnn.MemoryPlan:
    """Return what the search is said to take of the memory, without a capacity the count."""
    n, dim = positions.shape
    return jfrnn.memory_plan(n, cutoff, capacity, dim=dim, dtype=positions.dtype, backend=backend)


def found_in_rows(idx: np.ndarray, count: np.ndarray, device: str) -> Found:
    """Return the ordered pairs of a padded list, of which no row may be cut off; of a large one those that are compared."""
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
