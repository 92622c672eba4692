"""Particles that move a little between two searches: each goes back and forth on a line of its own, a third of a cutoff at most."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from experiments.methods import Found
from experiments.methods._padded import plan_backend

STEPS = 20  # searches of a timed run
SKIN = 0.1  # of the cutoff


def directions(positions: np.ndarray) -> np.ndarray:
    """Return a random unit vector per particle, shape [n, d], in the dtype of the positions."""
    rays = np.random.default_rng(0).standard_normal(positions.shape)
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(positions.dtype)


def turning_step(cutoff: float, motion: float) -> int:
    """Return after how many steps particles turn back."""
    return max(1, int(cutoff / 3 / motion)) if motion > 0 else 1


def away(step: Any, turn: int) -> Any:  # noqa: ANN401
    """Return how many motions from their start particles are after a step: 0, 1 ... turn ... 1, 0, 1 ..."""
    return turn - abs(turn - step % (2 * turn))


def first_list(start: jax.Array, cutoff: float, skin: float) -> jfrnn.NeighborList:
    """Return the list that motion begins with, with room for more neighbors."""
    return jfrnn.search(start, cutoff, skin=skin * cutoff, slack=1.5, backend="warp")


def plan_list(positions: np.ndarray, cutoff: float, *, skin: float) -> jfrnn.MemoryPlan:
    """Return what one search is said to take of the memory; a list with a skin holds the positions of its making besides."""
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    capacity = first_list(jnp.asarray(positions), cutoff, skin).capacity
    return plan_backend(positions, cutoff, capacity, backend="warp")


def follow_list(positions: np.ndarray, cutoff: float, motion: float, *, skin: float) -> Callable[[], Any]:
    """Compile `STEPS` steps of motion and search in one scan, and return it: a list with a skin [cutoffs], or made anew for 0.

    Every call goes on where the last one ended; it returns the list, the positions, and the share of steps that made it anew.
    """
    jax.config.update("jax_enable_x64", positions.dtype == np.float64)
    start, rays = jnp.asarray(positions), jnp.asarray(motion * directions(positions), positions.dtype)
    turn = turning_step(cutoff, motion)
    first = first_list(start, cutoff, skin)

    @jax.jit
    def run(step: jax.Array, nbrs: jfrnn.NeighborList, start: jax.Array, rays: jax.Array) -> Any:  # noqa: ANN401
        def move(carry: tuple[jax.Array, jfrnn.NeighborList], _: None) -> Any:  # noqa: ANN401
            step, nbrs = carry[0] + 1, carry[1]
            x = start + away(step, turn).astype(start.dtype) * rays
            if skin == 0:
                return (step, jfrnn.search(x, cutoff, capacity=first.capacity, backend="warp")), None
            return (step, nbrs.update(x)), None

        return jax.lax.scan(move, (step, nbrs), None, length=STEPS)[0]

    state = [jnp.int32(0), first]

    def search() -> Any:  # noqa: ANN401
        before = None if skin == 0 else int(state[1].rebuild_count)
        state[:] = jax.block_until_ready(run(*state, start, rays))
        rebuilt = 1.0 if before is None else (int(state[1].rebuild_count) - before) / STEPS
        return state[1], start + away(state[0], turn).astype(start.dtype) * rays, rebuilt

    return search


def read_list(result: tuple[jfrnn.NeighborList, jax.Array, float]) -> Found:
    """Return the ordered pairs within the cutoff where the particles are."""
    nbrs, x, rebuilt = result
    nbrs.check()
    i, k = np.nonzero(np.asarray(nbrs.distances(x)[1]))
    j = np.asarray(nbrs.idx)[i, k].astype(np.int64)
    device = next(iter(nbrs.idx.devices())).device_kind
    size = nbrs.idx.nbytes + nbrs.count.nbytes
    return Found(size, (i, j), directed=True, device=device, rebuilt=rebuilt, positions=np.asarray(x))
