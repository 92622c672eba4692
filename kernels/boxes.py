"""Systems with boxes of their own, on CUDA: six launches sort sources by system and cell, then one serves all queries.

On the CPU the kernels of cells and sums serve them (`jfrnn.kernels.cells_cpu`), which go to the cells of a system at a time.
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import RULES, SPACES, program
from jfrnn.kernels._program import Entry, Kernel, declare
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


@functools.lru_cache(16)
def sorting_kernels(dim: int, double: bool, periodic: int) -> Sorting:
    """Return the kernels that sort sources on CUDA; `periodic` is that of `jfrnn.kernels._native.program`."""
    entries = [Entry(f"BoxSort.{name}", _LAID_AT_ONCE if name == "lay_out" else GRID["BLOCK"]) for name in _STAGES]
    text = program(double, dim, "box_sort.cuh", given={}, PERIODIC=periodic, **GRID)
    name = f"box_sort_{dim}d_{'f64' if double else 'f32'}{SPACES[periodic]}"
    return Sorting(*declare(name, text, *entries, cuda=True, fused=True))


_STAGES = ("count_members", "lay_out", "count_cells", "scan_counts", "scatter", "rank")


@functools.lru_cache(64)
def rows_kernel(
    dim: int,
    double: bool,
    scaled: bool,
    lists: bool,
    later: bool,
    periodic: int,
    excluding: int = 0,
    flat: bool = False,
    rule: str = "",
) -> Kernel:
    """Return the kernel for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts, half lists or whole.

    `periodic`, `excluding` and `flat` are those of `jfrnn.kernels._native.program`; `rule` is one of its `RULES`, "" with one
    cutoff.
    """
    kind = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_list' * lists}{'_flat' * flat}{'_later' * later}"
    name = f"box_rows_cuda_{kind}{SPACES[periodic]}{'_excluding' * excluding}{f'_{rule}' * bool(rule)}"
    constants = _constants(periodic, scaled, lists, later, rule) | {"EXCLUDING": excluding, "FLAT": flat}
    text = program(double, dim, "box_rows.cuh", given={}, SUMS=0, **constants)
    return declare(name, text, Entry("BoxRows.run", _BLOCK, BLOCKS), cuda=True, fused=True)[0]


def _constants(periodic: int, scaled: bool, lists: bool, later: bool, rule: str) -> dict[str, int]:
    found = {"PERIODIC": periodic, "SCALED": scaled, "LIST": lists, "LATER": later, "SUM": rule == "mean"}
    found |= {"RULE": RULES.index(rule)} if rule else {}
    return found | {"LANES_PER_ROW": LANES}


@functools.lru_cache(512)
def sum_kernel(
    term: TermText,
    key: str,
    dim: int,
    double: bool,
    scaled: bool,
    compensated: bool,
    extremes: bool,
    periodic: int,
    excluding: int = 0,
    rule: str = "",
) -> Kernel:
    """Return the kernel that sums a term; `key` tells it from all others in the names of programs.

    `extremes`: it finds the largest summands instead, as `jfrnn.kernels.pair_sum_cpu.query_kernel` does.
    """
    name = f"box_sums_cuda_{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}"
    name += f"{'_compensated' * compensated}{SPACES[periodic]}{'_extremes' * extremes}{'_excluding' * excluding}"
    name += f"{f'_{rule}' * bool(rule)}_{key}"
    constants = {**GRID, **_constants(periodic, scaled, False, False, rule), **constants_of(term, compensated, extremes)}
    constants["EXCLUDING"] = excluding
    text = program(double, dim, "box_sums.cuh", given=term_header(term, double), **constants)
    return declare(name, text, Entry("BoxSums.run", _BLOCK, BLOCKS), cuda=True, fused=True)[0]


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // (32 // LANES))


def threads(queries: int) -> int:
    """Return the threads of a launch."""
    return 32 * slots(queries)
