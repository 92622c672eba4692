"""A mesh as Warp holds it, in a tree of boxes, on the CPU: its nearest point within a cutoff, and how many boxes are as near."""

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


def calls(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, cutoff: float) -> tuple[Callable[[], np.ndarray], ...]:
    """Return two functions of no argument, ready to be timed: distances of the nearest points, and counts of boxes.

    Args:
        points: Shape [n, 3], float32.
        vertices: Shape [v, 3], float32.
        faces: Shape [f, 3].
        cutoff: Beyond, distances are infinite.
    """
    corners = wp.array(vertices, dtype=wp.vec3, device="cpu")
    mesh = wp.Mesh(corners, wp.array(faces.reshape(-1).astype(np.int32), dtype=wp.int32, device="cpu"))
    asked = wp.array(points, dtype=wp.vec3, device="cpu")
    distance, count = wp.empty(len(points), dtype=float, device="cpu"), wp.empty(len(points), dtype=int, device="cpu")

    def run(kernel: wp.Kernel, out: wp.array) -> np.ndarray:
        wp.launch(kernel, len(points), [mesh.id, asked, cutoff], [out], device="cpu")
        return out.numpy()

    return lambda: run(_nearest_kernel, distance), lambda: run(_boxes_kernel, count)
