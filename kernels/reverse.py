"""Where the pairs of a list stand the other way round: the slot of (j, i) for each slot of (i, j), or the slots of each source."""

import functools

from jfrnn.kernels._native import Kind, program
from jfrnn.kernels._program import Entry, Kernel, declare

ROWS_AT_ONCE = 64  # that a thread of the CPU takes
_CHUNK = {"QUERY_CHUNK": ROWS_AT_ONCE}
LANES_PER_SHORT_ROW = 8  # on CUDA, where what belongs to slots is summed, or copied
LANES_PER_ROW = 32  # on CUDA, otherwise


@functools.cache
def reverse_kernels(code_bytes: int, ordered: bool, cuda: bool) -> tuple[Kernel, ...]:
    """Return what finds the reverse slots of a list whose image codes take so many bytes, 0 where there are none.

    On the CPU, a first kernel clears them. `ordered`: rows are taken in an order that is given (CUDA).
    """
    header, methods, block = ("reverse.cuh", ["run"], 128) if cuda else ("reverse_cpu.h", ["clear", "run"], 1)
    text = program(Kind(3, False), header, constants={"CODE_BYTES": code_bytes, "ORDERED": ordered, **_CHUNK})
    name = f"reverse_{'cuda' if cuda else 'cpu'}_{code_bytes}{'_ordered' * ordered}"
    return tuple(declare(name, text, *(Entry(f"Reverse.{method}", block, 4) for method in methods), cuda=cuda))


@functools.cache
def collect_kernel(width: int, double: bool, by_source: bool, cuda: bool) -> Kernel:
    """Return the kernel that sums `width` numbers of each slot for its source.

    `by_source`: slots are sorted by source; otherwise each source has a row of them.
    """
    name = f"collect_{'cuda' if cuda else 'cpu'}_{width}_{'f64' if double else 'f32'}{'_sorted' * by_source}"
    text = program(Kind(3, double), "collect.h", constants={"WIDTH": width, "REVERSED": by_source, **_CHUNK})
    return declare(name, text, Entry("Collect.run", 128 if cuda else 1, 8), cuda=cuda)[0]


@functools.cache
def flatten_kernel(cuda: bool) -> Kernel:
    """Return the kernel that finds the slots of a list that hold a pair, one after another."""
    text = program(Kind(3, False), "flatten.h", constants=_CHUNK)
    return declare(f"flatten_{'cuda' if cuda else 'cpu'}", text, Entry("Flatten.run", 128 if cuda else 1, 8), cuda=cuda)[0]


@functools.cache
def pack_kernel(cuda: bool) -> Kernel:
    """Return the kernel that makes rows of a common length those of a flat list."""
    text = program(Kind(3, False), "pack.h", constants=_CHUNK)
    return declare(f"pack_{'cuda' if cuda else 'cpu'}", text, Entry("Pack.run", 128 if cuda else 1, 8), cuda=cuda)[0]


@functools.cache
def transpose_kernel() -> Kernel:
    """Return the kernel that sorts the slots of a list by source, on the CPU."""
    text = program(Kind(3, False), "reverse_cpu.h", constants={"CODE_BYTES": 0, **_CHUNK})
    return declare("transpose_cpu", text, "Transpose.run")[0]
