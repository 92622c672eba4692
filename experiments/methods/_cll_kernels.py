"""Cell-linked lists on the CPU: the classic serial search, kept as the yardstick of the sweep.

The box is cut into cells at least one cutoff wide. `first[cell]` names one particle of a cell, `next[particle]` the following one,
-1 ends the chain. A particle is compared with the rest of its own chain and with the chains of the 13 cells that lie forward of its
own (half stencil), so that every unordered pair is met once. Memory follows the box: one int32 per cell, empty or not.

Source: J. Peifle (2019), Implementation of a Nearest-Neighbor Search for Particle Simulation in Sparse Computational Domains.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MAX_CELLS = 2**28
OWN_CELL = wp.constant(13)
STENCIL_END = wp.constant(27)


@wp.func
def cell_of(position: Any, origin: Any, inverse_edge: Any, shape: wp.vec3i):
    """Return the cell of a position, clamped into the grid."""
    scaled = (position - origin) * inverse_edge
    return wp.vec3i(
        wp.clamp(int(scaled[0]), 0, shape[0] - 1),
        wp.clamp(int(scaled[1]), 0, shape[1] - 1),
        wp.clamp(int(scaled[2]), 0, shape[2] - 1),
    )


@wp.func
def flat_index(cell: wp.vec3i, shape: wp.vec3i):
    """Return the row-major number of a cell, x fastest."""
    return (cell[2] * shape[1] + cell[1]) * shape[0] + cell[0]


@wp.kernel
def link_particles_kernel(
    positions: wp.array(dtype=Any),
    origin: Any,
    inverse_edge: Any,
    shape: wp.vec3i,
    first_out: wp.array(dtype=wp.int32),
    next_out: wp.array(dtype=wp.int32),
):
    """Put each particle at the head of its cell's chain.

    Launch: dim = n particles. `first_out` must hold -1 before; it is exchanged atomically, so that chains run backwards through the
    launch order.
    """
    i = wp.tid()
    cell = cell_of(positions[i], origin, inverse_edge, shape)
    next_out[i] = wp.atomic_exch(first_out, flat_index(cell, shape), i)


@wp.kernel
def append_pairs_kernel(
    positions: wp.array(dtype=Any),
    first: wp.array(dtype=wp.int32),
    next: wp.array(dtype=wp.int32),
    origin: Any,
    inverse_edge: Any,
    shape: wp.vec3i,
    cutoff_squared: Any,
    capacity: wp.int64,
    count_out: wp.array(dtype=wp.int64),
    pairs_out: wp.array(dtype=wp.vec2i),
):
    """Append each unordered pair closer than the cutoff once; with capacity 0, only count them.

    Launch: dim = n particles. `count_out[0]` is the atomic append counter and goes on counting past the capacity. A CPU launch runs
    the particles one after the other, so the order of `pairs_out` is the same in every run.
    """
    i = wp.tid()
    position = positions[i]
    cell = cell_of(position, origin, inverse_edge, shape)
    for s in range(OWN_CELL, STENCIL_END):
        x = cell[0] + s % 3 - 1
        y = cell[1] + (s / 3) % 3 - 1
        z = cell[2] + s / 9 - 1
        j = int(-1)  # noqa: RUF046, UP018 (a plain literal would be a constant, which Warp does not let the loop change)
        if s == OWN_CELL:
            j = next[i]
        elif x >= 0 and x < shape[0] and y >= 0 and y < shape[1] and z < shape[2]:
            j = first[flat_index(wp.vec3i(x, y, z), shape)]
        while j >= 0:
            difference = positions[j] - position
            if wp.dot(difference, difference) < cutoff_squared:
                slot = wp.atomic_add(count_out, 0, wp.int64(1))
                if slot < capacity:
                    pairs_out[int(slot)] = wp.vec2i(i, j)
            j = next[j]


def size_grid(lower: list[float], upper: list[float], cutoff: float, epsilon: float) -> tuple[float, list[int]]:
    """Return the cell edge and the number of cells per axis, for coordinates between two corners and with such an epsilon.

    Raises:
        ValueError: The box needs more than `MAX_CELLS` cells.
    """
    extent = [high - low for low, high in zip(lower, upper, strict=True)]
    # Subtraction, the inverse edge and scaling each round once, so a cell coordinate c is off by less than 2 eps c. Two particles
    # one cutoff apart stay within neighboring cells if the edge exceeds the cutoff by the factor 1 + 4 eps c.
    edge = cutoff * (1.0 + 4.0 * epsilon * (max(extent) / cutoff + 1.0))
    shape = [int(length / edge) + 1 for length in extent]
    cells = shape[0] * shape[1] * shape[2]
    if cells > MAX_CELLS:
        raise ValueError(f"cell-linked lists need one entry per cell of the box: {cells} cells, at most {MAX_CELLS} allowed")
    return edge, shape


def search_pairs(positions: wp.array, lower: list[float], upper: list[float], cutoff: float) -> wp.array:
    """Return each unordered pair with distance < cutoff once, shape [m], vec2i, decided in the precision of the positions.

    The structure is built, the pairs are counted, then written: two passes, so the list has exactly the size it needs. Positions
    are on the CPU, shape [n], vec3f or vec3d, between a lower and an upper corner. Refused are a box of more than `MAX_CELLS`
    cells, and more pairs than an int32 can number.
    """
    vector = positions.dtype
    scalar = vector._wp_scalar_type_
    edge, shape = size_grid(lower, upper, cutoff, 2.0**-23 if scalar is wp.float32 else 2.0**-52)
    grid, size = [vector(*lower), scalar(1.0 / edge), wp.vec3i(*shape)], positions.shape[0]
    first = wp.full(shape[0] * shape[1] * shape[2], -1, dtype=wp.int32, device="cpu")
    following = wp.empty(size, dtype=wp.int32, device="cpu")
    wp.launch(link_particles_kernel, dim=size, inputs=[positions, *grid], outputs=[first, following], device="cpu")

    cutoff_squared = scalar(scalar(cutoff).value * scalar(cutoff).value)
    pairs = wp.empty(0, dtype=wp.vec2i, device="cpu")
    for _ in range(2):
        capacity = pairs.shape[0]
        count = wp.zeros(1, dtype=wp.int64, device="cpu")
        inputs = [positions, first, following, *grid, cutoff_squared, wp.int64(capacity)]
        wp.launch(append_pairs_kernel, dim=size, inputs=inputs, outputs=[count, pairs], device="cpu")
        total = int(count.numpy()[0])
        if total > 2**31 - 1:
            raise OverflowError(f"{total} pairs do not fit into a list indexed by int32")
        if total == capacity:
            break
        pairs = wp.empty(total, dtype=wp.vec2i, device="cpu")
    return pairs
