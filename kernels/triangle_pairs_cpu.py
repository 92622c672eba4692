"""Pairs of a particle and a triangle, given one by one, on the CPU: which are closer than the cutoff, exactly.

Threads hand themselves chunks of pairs from an atomic counter.
"""

import functools

from jfrnn.kernels._kind import Kind
from jfrnn.kernels._native import program
from jfrnn.kernels._program import Kernel, declare
from jfrnn.kernels._triangles import constants

CHUNK = 4096  # pairs that a thread takes at a time


@functools.cache
def pairs_kernel(dim: int, double: bool) -> Kernel:
    """Return the kernel for a dimension and dtype, the work of which threads share."""
    options = {"CHUNK": CHUNK, **constants(dim, double, stride=1)}
    text = program(Kind(dim, double), "triangle_pairs.h", constants=options)
    return declare(f"triangle_pairs_{dim}d_{'f64' if double else 'f32'}", text, "TrianglePairs.run")[0]
