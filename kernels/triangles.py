"""Triangles near particles on the CPU, pairs of a particle and a triangle one by one, and on which side of a wall points are.

On the CPU `build` sorts triangles into cells, one by one, and `query` lists those near each particle. It looks for them in the
cells, or in a tree of boxes (`jfrnn/_triangles/tree.py`); what it finds is decided by the same text. Threads that run `query`,
decide pairs or serve points hand themselves chunks of these from an atomic counter. On CUDA, rows have other kernels
(`triangles_cuda`).

Points cast rays through the tree of boxes: on CUDA a thread per point. What is decided, and why it is right, stands in
`jfrnn/_triangles/winding.py`. Here all is computed in float64: of float32 positions a ray then tells the side but for some 1e-14 of
the largest coordinate.
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import Kind, program
from jfrnn.kernels._program import Entry, Kernel, declare

CHUNK, PAIRS_CHUNK, POINTS_CHUNK = 1024, 4096, 256  # particles, pairs and points that a thread of the CPU takes at a time
POINTS_BLOCK = 128
# What the integers of a pair are: how many in 2D and in 3D, and products of how many coordinates.
_NUMBERS = {
    "x": (4, 9, 1),
    "along": (2, 3, 1),
    "square": (2, 3, 2),
    "limit": (1, 1, 2),
    "side": (0, 9, 2),
    "normal": (0, 3, 2),
    "place": (1, 1, 3),
    "length": (1, 1, 4),
    "rest": (1, 1, 6),
    "other": (1, 1, 6),
    "spare": (2, 2, 6),
}
_LIMBS = {False: 14, True: 90}  # of a coordinate of either width


def constants(dim: int, double: bool, stride: int) -> dict[str, int]:
    """Return the constants of `triangle_exact.h`: ROOM is the memory of a pair in ints; threads have every `stride`-th."""
    limbs = _LIMBS[double]
    room = sum((two, three)[dim == 3] * (2 + limbs * degree) for two, three, degree in _NUMBERS.values())
    return {"LIMBS": limbs, "ROOM": room, "STRIDE": stride}


def pending(node: int) -> int:
    """Return how many sets of siblings, `node` at a time, may wait while a tree of at most 2^31 leaves is searched depth first."""
    levels = 1
    while node**levels < 2**31:
        levels += 1
    return (levels - 1) * (node - 1) + 1


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


@functools.cache
def pairs_kernel(dim: int, double: bool) -> Kernel:
    """Return the kernel of the CPU that decides pairs exactly, whose work threads share."""
    options = {"CHUNK": PAIRS_CHUNK, **constants(dim, double, stride=1)}
    text = program(Kind(dim, double), "triangle_pairs.h", constants=options)
    return declare(f"triangle_pairs_{dim}d_{'f64' if double else 'f32'}", text, "TrianglePairs.run")[0]


@functools.cache
def side_kernel(dim: int, double: bool, node: int, cuda: bool) -> Kernel:
    """Return the kernel of points on either side of a wall, for a dimension, a dtype and a tree of `node` children each."""
    variant = f"{'cuda' if cuda else 'cpu'}_{dim}d_{'f64' if double else 'f32'}"
    text = program(Kind(dim, double), "winding.h", constants={"NODE": node, "PENDING": pending(node), "CHUNK": POINTS_CHUNK})
    return declare(f"winding_{variant}", text, Entry("Winding.run", POINTS_BLOCK), cuda=cuda)[0]
