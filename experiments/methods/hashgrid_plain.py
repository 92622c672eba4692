"""`wp.HashGrid` as Warp's own examples use it: built anew, then one thread per particle; no JAX, float32, pairs as they round."""

from collections.abc import Callable
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


def prepare(positions: np.ndarray, cutoff: float, capacity: int) -> Callable[[], tuple[Any, Any]]:
    """Compile the kernel, and return the search."""
    device = wp.get_preferred_device()
    kernel = _hashgrid_kernels.list_neighbors_kernel
    points = wp.array(positions.astype(np.float32, copy=False), dtype=wp.vec3, device=device)
    grid = wp.HashGrid(*CELLS, device=device)

    def search() -> tuple[Any, Any]:
        idx = wp.empty((len(points), max(capacity, 1)), dtype=wp.int32, device=device)
        count = wp.empty(len(points), dtype=wp.int32, device=device)
        grid.build(points, cutoff)
        wp.launch(kernel, dim=len(points), inputs=[grid.id, points, cutoff, capacity], outputs=[idx, count], device=device)
        wp.synchronize_device(device)
        return idx, count

    search()
    return search


def read(result: tuple[Any, Any]) -> Found:
    """Return the ordered pairs of the padded list."""
    idx, count = (part.numpy() for part in result)
    device = result[0].device
    return found_in_rows(idx, count, device.name if device.is_cuda else "cpu")
