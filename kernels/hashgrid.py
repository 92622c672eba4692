"""Neighbor search with `wp.HashGrid` as Warp ships it, made exact: one thread per query, and one for all on the CPU.

The grid is built from the positions as they are, and that loses no pair. It finds the cell of a coordinate by a product with the
inverse cell width, a floor and a clamp to 32 bits; each of these never decreases where the coordinate grows, and neither does
rounding. A source within the cutoff r of a query q lies, on each axis, between q - r and q + r and, being a float itself, between
fl(q - r) and fl(q + r). So its cell lies between the cells of those two: the very range that `hash_grid_query` walks. No bound on
rounding errors is needed, however far from the origin; and any cell width would do, the cutoff is merely a good one.

Cells are numbered modulo the grid's dimensions, so distant cells share a bucket: their particles are candidates that the exact
test rejects. A range longer than a dimension is cut to one round of it, so no bucket is met twice and no pair listed twice. (Warp
1.18 clamped all cells below -2^20 to one bucket, which a query out there met again and again: it cannot be used.)

The grid files NaN under cell 0 and infinities under the cells at either end, where the test of distances refuses them. Queries that
are not finite ask nothing, and sources that are not finite are strewn over the cells: padding would else crowd the one cell 0.
"""

import functools
import struct
from typing import NamedTuple

from jfrnn.kernels._clang import warp_root
from jfrnn.kernels._native import Kind, declare_kind
from jfrnn.kernels._program import Entry, Kernel

BLOCK = 128
_RESIDENT = 6  # blocks of queries in float32 on a multiprocessor: 79 registers a thread, not 88
_CELLS_PER_PARTICLE = 2  # at least, and less than twice that; 8 B each
_SMALLEST_BITS = 4  # per axis: 16 cells
_LARGEST_BITS = 24  # in all: 256^3 or 4096^2 cells


class Kernels(NamedTuple):
    """The kernels of a variant: `pack` is launched over the sources, `query` over the queries."""

    pack: Kernel
    query: Kernel


def grid_shape(sources: int, dim: int) -> tuple[int, int, int]:
    """Return the dimensions of the grid, powers of two: memory follows the particles."""
    bits = (_CELLS_PER_PARTICLE * sources - 1).bit_length()
    bits = min(max(bits, dim * _SMALLEST_BITS), _LARGEST_BITS)
    x, y, z = (2 ** ((bits + dim - 1 - axis) // dim) if axis < dim else 1 for axis in range(3))
    return x, y, z


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of the positions that `pack` writes; `width` is 1 for float32 and 2 for float64."""
    del queries, dim, own
    return 3 * width * sources


def split_width(width: float) -> dict[str, int]:
    """Return the width of cells as `build_kernel` takes it."""
    low, high = struct.unpack("<2i", struct.pack("<d", width))
    return {"width_low": low, "width_high": high}


@functools.cache
def search_kernels(kind: Kind, cuda: bool) -> Kernels:
    """Return the kernels that list or count."""
    name, given = f"hashgrid_{'cuda' if cuda else 'cpu'}", {"warp_hashgrid.h": warp_header()}
    entries = Entry("HashGridSearch.pack", BLOCK), Entry("HashGridSearch.query", BLOCK, 1 if kind.double else _RESIDENT)
    return Kernels(
        *declare_kind(kind.compiled("later"), name, "hashgrid.h", *entries, cuda=cuda, given=given, constants={"LIST": kind.lists})
    )


@functools.cache
def build_kernel(double: bool) -> Kernel:
    """Return what builds a grid of a dtype, on the CPU or on CUDA: it runs on the host."""
    given = {"warp_hashgrid.h": warp_header()}
    return declare_kind(Kind(3, double), "hashgrid_build", "hashgrid_build.h", "HashGridBuild.build", given=given)[0]


@functools.cache
def warp_header() -> str:
    """Return Warp's own header of its grid."""
    return (warp_root() / "native" / "hashgrid.h").read_text("utf-8")
