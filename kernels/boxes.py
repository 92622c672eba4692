"""Systems with boxes of their own, on CUDA: six launches sort sources by system and cell, then one serves all queries.

On the CPU the kernels of cells and sums serve them (`jfrnn.kernels.cells_cpu`), which go to the cells of a system at a time.
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import Kind, declare_kind
from jfrnn.kernels._program import Entry, Kernel
from jfrnn.kernels.cells_cuda import GRID
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

PADDING = 16  # sources behind the last one that may be read
LANES = 16  # of CUDA that serve a query
_BLOCK = 128
BLOCKS = 8  # that share a multiprocessor: what decides exactly may spill registers, it is rare
_LAID_AT_ONCE = 1024  # systems whose cells are laid out at once
_HEADER = 16  # words


def scratch_words(sources: int, systems: int, cells: int) -> tuple[int, int]:
    """Return the int32 words of scratch in which sources are sorted on CUDA, and how many of them are 0 before."""
    zeros = _HEADER + 2 * (cells // GRID["TILE"] + 1) + systems
    return zeros + 3 * sources, zeros


class Sorting(NamedTuple):
    """The kernels that sort sources on CUDA, all with the same arguments."""

    count_members: Kernel
    lay_out: Kernel
    count_cells: Kernel
    scan: Kernel
    scatter: Kernel
    rank: Kernel

    def launches(self, sources: int, cells: int, multiprocessors: int) -> list[tuple[Kernel, int]]:
        """Return what is launched, in order, and the threads of each."""
        block = GRID["BLOCK"]
        tiles = min(cells // GRID["TILE"] + 1, multiprocessors)
        each = dict.fromkeys(self, -(-(sources + PADDING) // block) * block)
        each |= {self.lay_out: _LAID_AT_ONCE, self.scan: tiles * block}
        return list(each.items())


_STAGES = ("count_members", "lay_out", "count_cells", "scan_counts", "scatter", "rank")


@functools.lru_cache(16)
def sorting_kernels(kind: Kind) -> Sorting:
    """Return the kernels that sort sources on CUDA."""
    entries = [Entry(f"BoxSort.{name}", _LAID_AT_ONCE if name == "lay_out" else GRID["BLOCK"]) for name in _STAGES]
    return Sorting(*declare_kind(kind.only("periodic"), "box_sort", "box_sort.cuh", *entries, cuda=True, constants=GRID))


@functools.lru_cache(64)
def rows_kernel(kind: Kind) -> Kernel:
    """Return the kernel that lists or counts."""
    constants, entry = {"SUMS": 0, **_constants(kind)}, Entry("BoxRows.run", _BLOCK, BLOCKS)
    return declare_kind(kind.compiled("batched"), "box_rows_cuda", "box_rows.cuh", entry, cuda=True, constants=constants)[0]


def _constants(kind: Kind) -> dict[str, int]:
    return {"LIST": kind.lists, "LANES_PER_ROW": LANES}


@functools.lru_cache(512)
def sum_kernel(kind: Kind, term: TermText, key: str) -> Kernel:
    """Return the kernel that sums a term; `key` tells it from all others in the names of programs.

    For extremes, it finds the largest summands as `jfrnn.kernels.pair_sum_cpu.query_kernel` does.
    """
    constants, given = {**GRID, **_constants(kind), **constants_of(term, kind)}, term_header(term, kind.double)
    name, entry = f"box_sums_cuda_{key}", Entry("BoxSums.run", _BLOCK, BLOCKS)
    return declare_kind(kind.compiled("batched"), name, "box_sums.cuh", entry, cuda=True, given=given, constants=constants)[0]


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // (32 // LANES))


def threads(queries: int) -> int:
    """Return the threads of a launch."""
    return 32 * slots(queries)
