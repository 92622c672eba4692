"""Where the pairs of a list stand the other way round: the slot of (j, i) for each slot of (i, j), or the slots of each source."""

import functools

from jfrnn.kernels._native import program
from jfrnn.kernels._program import Entry, Kernel, declare

ROWS_AT_ONCE = 64  # that a thread of the CPU takes
LANES_PER_SLOT = 8  # on CUDA


@functools.cache
def reverse_kernel(code_bytes: int, cuda: bool) -> Kernel:
    """Return the kernel that finds reverse slots in a list whose image codes take so many bytes, 0 where there are none."""
    header, block = ("reverse.cuh", 256) if cuda else ("reverse_cpu.h", 1)
    text = program(False, 3, header, CODE_BYTES=code_bytes, QUERY_CHUNK=ROWS_AT_ONCE)
    return declare(f"reverse_{'cuda' if cuda else 'cpu'}_{code_bytes}", text, Entry("Reverse.run", block, 4), cuda=cuda)[0]


@functools.cache
def transpose_kernel() -> Kernel:
    """Return the kernel that sorts the slots of a list by source, on the CPU."""
    text = program(False, 3, "reverse_cpu.h", CODE_BYTES=0, QUERY_CHUNK=ROWS_AT_ONCE)
    return declare("transpose_cpu", text, "Transpose.run")[0]
