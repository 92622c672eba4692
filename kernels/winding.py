"""On which side of a closed wall points are, by rays through the tree of its boxes.

One text serves a thread per point on CUDA, and on the CPU threads that hand themselves chunks of points from an atomic counter.

What is decided, and why it is right, stands in `jfrnn/_triangles/winding.py`. Here all is computed in float64: of float32 positions
a ray then tells the side but for some 1e-14 of the largest coordinate.
"""

import functools

from jfrnn.kernels._kind import Kind
from jfrnn.kernels._native import program
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels._triangles import pending

CHUNK = 256  # points that a thread takes at a time on the CPU
BLOCK = 128


@functools.cache
def side_kernel(dim: int, double: bool, node: int, cuda: bool) -> Kernel:
    """Return the kernel for a dimension, a dtype and a tree of `node` children each: on CUDA for a thread per point."""
    variant = f"{'cuda' if cuda else 'cpu'}_{dim}d_{'f64' if double else 'f32'}"
    text = program(Kind(dim, double), "winding.h", constants={"NODE": node, "PENDING": pending(node), "CHUNK": CHUNK})
    return declare(f"winding_{variant}", text, Entry("Winding.run", BLOCK), cuda=cuda)[0]
