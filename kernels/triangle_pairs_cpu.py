"""Pairs of a particle and a triangle, given one by one, on the CPU: which are closer than the cutoff, exactly.

Threads hand themselves chunks of pairs from an atomic counter.
"""

import functools

import warp as wp
from jfrnn.kernels._native import bind, program
from jfrnn.kernels._triangles import constants

CHUNK = 4096  # pairs that a thread takes at a time


@functools.cache
def pairs_kernel(dim: int, double: bool) -> wp.Kernel:
    """Return the kernel for a dimension and dtype, launched once per thread with dim = 1."""
    scalar, variant = wp.float64 if double else wp.float32, f"{dim}d_{'f64' if double else 'f32'}"
    reals, ints = wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    points, shapes = wp.array2d(dtype=scalar), wp.array3d(dtype=scalar)

    def native(
        positions: points, corners: shapes, cutoff: reals, particle: ints, triangle: ints, asked: ints, near: ints, info: ints,
        n: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"triangle_pairs_native_{variant}"
    options = {"CHUNK": CHUNK, **constants(dim, double, stride=1)}
    module = wp.get_module(f"jfrnn.kernels.triangle_pairs_cpu.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    function = bind(native, module, "TrianglePairs.run", program(double, dim, "triangle_pairs.h", **options))

    def kernel(
        positions: points, corners: shapes, cutoff: reals, particle: ints, triangle: ints, asked: ints, near: ints, info: ints,
        n: int,
    ):  # fmt: skip
        function(positions, corners, cutoff, particle, triangle, asked, near, info, n)

    return wp.kernel(kernel, module=module)
