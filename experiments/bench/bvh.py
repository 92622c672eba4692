"""A mesh as Warp holds it, in a tree of boxes: its nearest point within a cutoff."""

# pyright: reportInvalidTypeForm=false, reportAttributeAccessIssue=false, reportArgumentType=false
# (what Warp's language is made of)

from collections.abc import Callable

import numpy as np
import warp as wp


@wp.kernel
def _nearest_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), cutoff: float, distance_out: wp.array(dtype=float)):  # noqa: ANN202
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], cutoff)
    distance_out[i] = wp.inf
    if query.result:
        distance_out[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


def find_nearest(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, cutoff: float, device: str) -> Callable[[], wp.array]:
    """Build the tree of vertices [v, 3] and faces [f, 3], float32, on "cpu" or such as "cuda:0", and return what asks it.

    A call returns the distance of each of the points [n, 3] to the mesh, infinite beyond the cutoff, when the device has it.
    """
    corners = wp.array(vertices, dtype=wp.vec3, device=device)
    mesh = wp.Mesh(corners, wp.array(faces.reshape(-1).astype(np.int32), dtype=wp.int32, device=device))
    queries, distances = wp.array(points, dtype=wp.vec3, device=device), wp.empty(len(points), dtype=float, device=device)

    def find() -> wp.array:
        wp.launch(_nearest_kernel, len(points), [mesh.id, queries, cutoff, distances], device=device, block_dim=256)
        wp.synchronize_device(device)
        return distances

    return find
