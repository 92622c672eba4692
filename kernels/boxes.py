"""Systems with boxes of their own: which cells a query visits is known before (`jfrnn._geometry.box_cells`), one launch does it."""

import functools

from jfrnn.kernels._native import SPACES, program
from jfrnn.kernels._program import Entry, Kernel, declare

QUERIES_AT_ONCE = 64  # that a thread of the CPU takes
PADDING = 16  # sources behind the last one that may be read
LANES = 16  # of CUDA that serve a query
_BLOCK = 128
BLOCKS = 8  # that share a multiprocessor: what decides exactly may spill registers, it is rare


@functools.lru_cache(64)
def rows_kernel(
    dim: int, double: bool, scaled: bool, lists: bool, periodic: int, excluding: bool, cuda: bool, flat: bool = False
) -> Kernel:
    """Return the kernel for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts alone.

    `periodic`, `excluding` and `flat` are those of `jfrnn.kernels._native.program`.
    """
    where = "cuda" if cuda else "cpu"
    name = f"box_rows_{where}_{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_list' * lists}"
    name += f"{'_flat' * flat}{SPACES[periodic]}{'_excluding' * excluding}"
    constants = {"PERIODIC": periodic, "SCALED": scaled, "LIST": lists, "QUERY_CHUNK": QUERIES_AT_ONCE, "LANES_PER_ROW": LANES}
    constants |= {"EXCLUDING": excluding, "FLAT": flat}
    text = program(double, dim, "box_rows.cuh" if cuda else "box_rows_cpu.h", **constants)
    return declare(name, text, Entry("BoxRows.run", _BLOCK if cuda else 1, BLOCKS), cuda=cuda, fused=cuda)[0]


def threads(queries: int) -> int:
    """Return the threads of a launch on CUDA."""
    return 32 * -(-queries * LANES // 32)
