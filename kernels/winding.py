"""On which side of a closed wall points are, by rays through the tree of its boxes.

One text serves a thread per point on CUDA, and on the CPU threads that hand themselves chunks of points from an atomic counter.

What is decided, and why it is right, stands in `jfrnn/_triangles_winding.py`. Here all is computed in float64: of float32 positions
a ray then tells the side but for some 1e-14 of the largest coordinate.
"""

import functools

import warp as wp
from jfrnn.kernels._native import bind, program
from jfrnn.kernels._triangles import pending

CHUNK = 256  # points that a thread takes at a time on the CPU
BLOCK = 128


@functools.cache
def side_kernel(dim: int, double: bool, node: int, cuda: bool) -> wp.Kernel:
    """Return the kernel for a dimension, a dtype and a tree of `node` children each: for a thread per point, or one per core."""
    scalar, where = wp.float64 if double else wp.float32, "cuda" if cuda else "cpu"
    reals, ints, points, shapes = (
        wp.array(dtype=scalar),
        wp.array(dtype=wp.int32),
        wp.array2d(dtype=scalar),
        wp.array3d(dtype=scalar),
    )
    variant = f"{dim}d_{'f64' if double else 'f32'}_{where}"

    def native(
        positions: points, corners: shapes, boxes: points, cutoff: reals, rays: points, start: ints, triangles: ints, asked: ints,
        least: ints, side: ints, info: ints, n: int, levels: int, entries: int, thread: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"winding_native_{variant}"
    options = {"NODE": node, "PENDING": pending(node), "CHUNK": CHUNK}
    module = wp.get_module(f"jfrnn.kernels.winding.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    function = bind(native, module, "Winding.run", program(double, dim, "winding.h", **options))

    def kernel(
        positions: points, corners: shapes, boxes: points, cutoff: reals, rays: points, start: ints, triangles: ints, asked: ints,
        least: ints, side: ints, info: ints, n: int, levels: int, entries: int,
    ):  # fmt: skip
        thread = wp.tid()
        function(
            positions, corners, boxes, cutoff, rays, start, triangles, asked, least, side, info, n, levels, entries, thread
        )  # fmt: skip

    if cuda:
        return wp.kernel(kernel, name=f"winding_{variant}", module=module, grid_stride=False, launch_bounds=(BLOCK, 1))
    return wp.kernel(kernel, module=module)
