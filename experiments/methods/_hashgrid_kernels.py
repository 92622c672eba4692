"""`wp.HashGrid` as Warp's own examples use it, without JAX and without exactness: the yardstick of the GPU rows."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def list_neighbors_kernel(
    grid: wp.uint64,
    positions: wp.array(dtype=wp.vec3),
    cutoff: float,
    capacity: int,
    idx_out: wp.array2d(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
) -> None:
    """List the neighbors of one particle per thread, in the order of the grid; unused slots hold n. Launch: dim = n."""
    n = positions.shape[0]
    i = wp.hash_grid_point_id(grid, wp.tid())
    position = positions[i]
    found = int(0)  # noqa: RUF046, UP018 (a plain literal would be a constant, which Warp does not let the loop change)
    for j in wp.hash_grid_query(grid, position, cutoff):
        if j != i and wp.length_sq(positions[j] - position) < cutoff * cutoff:
            if found < capacity:
                idx_out[i, found] = j
            found += 1
    count_out[i] = found
    for slot in range(found, capacity):
        idx_out[i, slot] = n


@wp.kernel
def count_neighbors_kernel(
    grid: wp.uint64, positions: wp.array(dtype=wp.vec3), cutoffs: wp.array(dtype=float), count_out: wp.array(dtype=wp.int32)
) -> None:
    """Count the neighbors of one particle per thread within its own cutoff. Launch: dim = n."""
    i = wp.hash_grid_point_id(grid, wp.tid())
    position, cutoff = positions[i], cutoffs[i]
    found = int(0)  # noqa: RUF046, UP018 (as above)
    for j in wp.hash_grid_query(grid, position, cutoff):
        if j != i and wp.length_sq(positions[j] - position) < cutoff * cutoff:
            found += 1
    count_out[i] = found
