"""Lists that are kept: which slots hold a pair now, their distances and what these give to derivatives, and sums over the pairs.

On the CPU, LANES slots of a row are taken at a time. Numbers of their sources are read four at a time, where these stand, and rows
and columns of what was read are exchanged in registers. On CUDA, eight lanes serve a row. A lane
takes four slots at a time: it reads their ids at once, then the numbers of their sources. Nothing is sorted: these numbers may
stand anywhere, and rows that are taken together share them if they are close in space: rows follow each other, or come in an order
that the search has left.
"""

import functools
from typing import NamedTuple

from jfrnn.kernels._native import RULES, SPACES, program
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels.cells_cuda import GRID
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

ROWS_AT_ONCE = 64  # that a thread of the CPU takes
LANES = 8  # of CUDA that serve a row
_BLOCK = 128
_BLOCKS, _BLOCKS_IN_BOX = 7, 6  # that share a multiprocessor: more of them, and numbers of a loop leave their registers


class ListKind(NamedTuple):
    """What is static about a list, apart from shapes.

    Attributes:
        dim: Dimension of the positions.
        double: Whether they are float64.
        scaled: Whether the cutoff is so small or large that squares need a unit.
        periodic: As in `jfrnn.kernels._native.program`.
        code_bytes: Of the image code of a slot; 0 without.
        rule: Whose cutoff is that of a pair, one of `RULES`; "" if all have one.
        reversed: Whether rows are those of the sources of the list.
        aligned: Whether rows of ids begin at multiples of 16 bytes.
        ordered: Whether an order is given in which rows are taken (CUDA).
        lanes: How many lanes of CUDA serve a row; 0 on the CPU.
        boxes: Whether each system has a lattice of its own.
        itself: Whether a particle is its own neighbor, whatever its cutoff.
    """

    dim: int
    double: bool
    scaled: bool
    periodic: int
    code_bytes: int
    rule: str
    reversed: bool
    aligned: bool
    ordered: bool
    lanes: int
    boxes: bool = False
    itself: bool = False

    @property
    def cuda(self) -> bool:
        """Whether it is on CUDA."""
        return self.lanes > 0

    @property
    def name(self) -> str:
        """Tells kernels of such lists from others."""
        flags = {"scaled": self.scaled, "reversed": self.reversed, "aligned": self.aligned, "ordered": self.ordered}
        flags |= {self.rule: bool(self.rule), "boxes": self.boxes, "itself": self.itself}
        parts = [f"{self.dim}d", "f64" if self.double else "f32", *(flag for flag, on in flags.items() if on)]
        return "_".join(parts) + f"{SPACES[self.periodic]}_{self.code_bytes}{f'_cuda{self.lanes}' if self.cuda else '_cpu'}"

    @property
    def own_length(self) -> int:
        """How many numbers of a row are read to decide."""
        return self.dim + (self.dim if self.code_bytes else 0) + bool(self.rule)

    def length(self, columns: int) -> int:
        """Return how many numbers each source has, of which a term reads some: several are loaded at once."""
        least = self.dim + columns + (self.dim if self.code_bytes else 0) + bool(self.rule)
        at_once = 2 if self.double and self.cuda else 4
        return 2 if least == 2 and self.cuda else -(-least // at_once) * at_once

    def constants(self, columns: int) -> dict[str, int]:
        """Return the named integers of a program."""
        found = {"PERIODIC": self.periodic, "SCALED": self.scaled, "CODE_BYTES": self.code_bytes, "REVERSED": self.reversed}
        found |= {"RULE": RULES.index(self.rule) if self.rule else -1, "SUM": self.rule == "mean"}
        found |= {"ALIGNED": self.aligned, "ORDERED": self.ordered}
        found |= {"DECIDED": 1, "MEASURED": 0, "APART": 0, "MIRRORED": 0, "OWN": 0, "BOXES": self.boxes, "ITSELF": self.itself}
        return found | {"LENGTH": self.length(columns), "LANES_PER_ROW": max(self.lanes, 1), "QUERY_CHUNK": ROWS_AT_ONCE, **GRID}


def slots(rows: int, lanes: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-rows // (32 // lanes if lanes else ROWS_AT_ONCE))


def threads(rows: int, lanes: int) -> int:
    """Return the threads of a launch on CUDA."""
    return 32 * slots(rows, lanes)


@functools.lru_cache(256)
def mask_kernel(kind: ListKind, measured: bool) -> Kernel:
    """Return the kernel that tells which slots hold a pair now, and (`measured`) the distances."""
    return _kernel(kind, "mask", "_measured" * measured, MEASURED=measured)


@functools.lru_cache(256)
def slope_kernel(kind: ListKind) -> Kernel:
    """Return the kernel that makes derivatives by positions of those by distances, in a list that is its own mirror image."""
    return _kernel(kind, "slopes", "", DECIDED=0)


def _entry(kind: ListKind, method: str) -> Entry:
    return Entry(method, _BLOCK if kind.cuda else 1, _BLOCKS_IN_BOX if kind.periodic else _BLOCKS)


def _kernel(kind: ListKind, what: str, suffix: str, **constants: int) -> Kernel:
    given = {"OTHERS": 0, "SUMS": 0, "LIST": 0, **kind.constants(0), **constants}
    text = program(kind.double, kind.dim, f"kept_{what}.cuh" if kind.cuda else f"kept_{what}_cpu.h", **given)
    entry = _entry(kind, f"Kept{what.title()}.run")
    return declare(f"kept_{what}_{kind.name}{suffix}", text, entry, cuda=kind.cuda, fused=kind.cuda)[0]


@functools.lru_cache(512)
def sum_kernel(kind: ListKind, term: TermText, key: str, compensated: bool, extremes: bool, apart: bool, mirrored: bool) -> Kernel:
    """Return the kernel that sums a term; `key` tells it from all others in the names of programs.

    `apart`: a particle's pair with itself, without a shift, is left out. `extremes`: it finds the largest summands instead;
    `errors` [m, width, 2] then gets their sources (n: there is none), and their places in the row. `mirrored`: the term
    reads of i what stands beside the points, of the same number.
    """
    constants = {
        "LIST": 0,
        **kind.constants(term.columns),
        **constants_of(term, compensated, extremes, turned=False),
        "APART": apart,
        "MIRRORED": mirrored,
    }
    header = "kept_sums.cuh" if kind.cuda else "kept_sums_cpu.h"
    text = program(kind.double, kind.dim, header, given=term_header(term, kind.double, turned=False), **constants)
    name = f"kept_sums_{kind.name}{'_compensated' * compensated}{'_apart' * apart}{'_extremes' * extremes}"
    name += f"{'_mirrored' * mirrored}_{key}"
    return declare(name, text, _entry(kind, "KeptSums.run"), cuda=kind.cuda, fused=kind.cuda)[0]
