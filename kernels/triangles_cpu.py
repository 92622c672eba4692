"""Triangles on the CPU: `build` sorts them into cells, one by one; `query` lists those near each particle, on every core.

`query` looks for them in the cells, or in a tree of boxes (`jfrnn/_triangles/tree.py`); what it finds is decided by the same text.

Threads that run `query` hand themselves chunks of particles from an atomic counter.
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._kind import Kind
from jfrnn.kernels._native import program
from jfrnn.kernels._program import Kernel, declare
from jfrnn.kernels._triangles import constants, pending

CHUNK = 1024  # particles that a thread takes at a time


class Kernels(NamedTuple):
    """The two kernels of a variant, of which threads share the work of `query`; a tree is built by XLA."""

    build: Kernel
    query: Kernel


@functools.cache
def triangle_kernels(dim: int, double: bool, lists: bool, tree: bool, most_cells: int, lanes: int, node: int) -> Kernels:
    """Return the kernels for a dimension and dtype, for lists or counts alone, in cells or in a tree.

    `most_cells` and `lanes` are those of the cells, `node` is the number of children in the tree.
    """
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_list' * lists}{'_tree' * tree}"
    options = {"LIST": lists, "MOST_CELLS": most_cells, "MOST_ALONG": lanes, "CHUNK": CHUNK}
    options |= {"MOST_ALONG_LOG2": lanes.bit_length() - 1, "NODE": node, "PENDING": pending(node), "TREE": tree}
    options |= constants(dim, double, stride=1)
    text = program(Kind(dim, double), "triangles_cpu.h", constants=options)
    return Kernels(*declare(f"triangles_cpu_{variant}", text, "TriangleSort.build", "TriangleRows.run"))
