"""`wp.HashGrid` as Warp's own examples use it: built anew, then one thread per particle; no JAX, float32, pairs as they round."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp

from experiments.methods import Found, _hashgrid_kernels
from experiments.methods._padded import found_in_rows

wp: Any = warp  # whose types are those of kernels, not of what the host gets
CELLS = (128, 128, 128)  # of Warp's examples


def allocate(positions: np.ndarray, cutoff: float) -> int:
    """Return the most neighbors that the kernel itself sees around a particle."""
    return int(prepare(positions, cutoff, 1)()[1].numpy().max(initial=0))


@dataclass
class Counts:
    """Neighbors of each particle [n], on their way: `jax.block_until_ready` waits for them as for an array of JAX."""

    array: Any

    def block_until_ready(self) -> "Counts":
        """Wait for the device."""
        wp.synchronize_device(self.array.device)
        return self


def start(positions: np.ndarray, cutoff: float, capacity: int) -> Callable[[], tuple[Any, Counts]]:
    """Compile the kernel, and return the search; a call does not wait."""
    device = wp.get_preferred_device()
    points = wp.array(positions.astype(np.float32, copy=False), dtype=wp.vec3, device=device)
    grid = wp.HashGrid(*CELLS, device=device)

    def search() -> tuple[Any, Counts]:
        idx = wp.empty((len(points), max(capacity, 1)), dtype=wp.int32, device=device)
        count = wp.empty(len(points), dtype=wp.int32, device=device)
        grid.build(points, cutoff)
        kernel = _hashgrid_kernels.list_neighbors_kernel
        wp.launch(kernel, dim=len(points), inputs=[grid.id, points, cutoff, capacity], outputs=[idx, count], device=device)
        return idx, Counts(count)

    return search


def prepare(positions: np.ndarray, cutoff: float, capacity: int) -> Callable[[], tuple[Any, Any]]:
    """Compile the kernel, and return the search."""
    begin = start(positions, cutoff, capacity)

    def search() -> tuple[Any, Any]:
        idx, count = begin()
        return idx, count.block_until_ready().array

    search()
    return search


def read(result: tuple[Any, Any]) -> Found:
    """Return the ordered pairs of the padded list."""
    idx, count = (part.numpy() for part in result)
    device = result[0].device
    return found_in_rows(idx, count, device.name if device.is_cuda else "cpu")


def prepare_counts(positions: np.ndarray, cutoffs: np.ndarray) -> Callable[[], Counts]:
    """Compile a count within a cutoff per particle, in cells as wide as the largest, and return it; a call does not wait."""
    device = wp.get_preferred_device()
    points, radii = (wp.array(np.float32(a), dtype=kind, device=device) for a, kind in ((positions, wp.vec3), (cutoffs, float)))
    grid, widest = wp.HashGrid(*CELLS, device=device), float(np.max(cutoffs))

    def search() -> Counts:
        count = wp.empty(len(points), dtype=wp.int32, device=device)
        grid.build(points, widest)
        kernel = _hashgrid_kernels.count_neighbors_kernel
        wp.launch(kernel, dim=len(points), inputs=[grid.id, points, radii], outputs=[count], device=device)
        return Counts(count)

    return search


def candidates(positions: np.ndarray, widest: float) -> float:
    """Return how many particles the queries of a count look at, for cutoffs as wide as the cells: what it costs, beforehand."""
    cells = np.floor(positions / widest).astype(np.int64) % CELLS
    held = np.bincount(np.ravel_multi_index(tuple(cells.T), CELLS), minlength=np.prod(CELLS)).reshape(CELLS).astype(float)
    near = held
    for axis in range(3):
        near = sum(np.roll(near, k, axis) for k in (-1, 0, 1))
    return float((held * near).sum())
