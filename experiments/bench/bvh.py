"""A mesh as Warp holds it, in a tree of boxes: its nearest point within a cutoff, and how many boxes are as near."""

# pyright: reportInvalidTypeForm=false, reportAttributeAccessIssue=false, reportArgumentType=false
# (what Warp's language is made of)

from typing import Any

import numpy as np
import warp as wp


@wp.kernel
def _nearest_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), cutoff: float, distance_out: wp.array(dtype=float)):  # noqa: ANN202
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], cutoff)
    distance_out[i] = wp.inf
    if query.result:
        distance_out[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


@wp.kernel
def _boxes_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), cutoff: float, count_out: wp.array(dtype=int)):  # noqa: ANN202
    i = wp.tid()
    around = wp.vec3(cutoff, cutoff, cutoff)
    query = wp.mesh_query_aabb(mesh, points[i] - around, points[i] + around)
    face = int(0)  # noqa: UP018, RUF046 - changes in a loop
    count = int(0)  # noqa: UP018, RUF046
    while wp.mesh_query_aabb_next(query, face):
        count += 1
    count_out[i] = count


class Tree:
    """A mesh on a device, and points that ask for it."""

    def __init__(self, points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, cutoff: float, device: str) -> None:
        """Build the tree of vertices [v, 3] and faces [f, 3] for points [n, 3], float32, on "cpu" or such as "cuda:0"."""
        corners = wp.array(vertices, dtype=wp.vec3, device=device)
        self._mesh = wp.Mesh(corners, wp.array(faces.reshape(-1).astype(np.int32), dtype=wp.int32, device=device))
        given, n = [self._mesh.id, wp.array(points, dtype=wp.vec3, device=device), cutoff], len(points)
        self._nearest = _nearest_kernel, n, [*given, wp.empty(n, dtype=float, device=device)]
        self._boxes = _boxes_kernel, n, [*given, wp.empty(n, dtype=int, device=device)]

    def nearest(self) -> wp.array:
        """Return the distance of each point to the mesh, infinite beyond the cutoff, when the device has it, shape [n]."""
        return _launch(*self._nearest)

    def boxes(self) -> wp.array:
        """Return how many boxes of triangles are within the cutoff of each point, when the device has it, shape [n]."""
        return _launch(*self._boxes)


def _launch(kernel: wp.Kernel, threads: int, given: list[Any]) -> wp.array:
    wp.launch(kernel, threads, given, device=given[-1].device, block_dim=256)
    wp.synchronize_device(given[-1].device)
    return given[-1]
