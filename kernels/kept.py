"""Lists that are kept: which slots hold a pair now, their distances and what these give to derivatives, and sums over the pairs.

On the CPU, LANES slots of a row are taken at a time. Numbers of their sources are read four at a time, where these stand, and rows
and columns of what was read are exchanged in registers. On CUDA, eight lanes serve a row, or two where many rows are summed. A lane
takes four slots at a time: it reads their ids at once, then the numbers of their sources. Nothing is sorted: these numbers may
stand anywhere, and rows that are taken together share them if they are close in space: rows follow each other, or come in an order
that the search has left.
"""

import functools
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

from jfrnn.kernels._native import Kind, program
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

ROWS_AT_ONCE = 64  # that a thread of the CPU takes
BLOCKS_OF_ROWS = 8  # whose derivatives are summed by themselves on the CPU
LANES = 8  # of CUDA that serve a row
_MANY = 1 << 15  # rows, from which fewer lanes sum over each
_BLOCK = 128
_BLOCKS, _BLOCKS_IN_BOX = 7, 6  # that share a multiprocessor: more of them, and numbers of a loop leave their registers


class ListKind(NamedTuple):
    """What is static about a list and what is asked of it, apart from shapes and the text of a term.

    Attributes:
        kind: What is static about its pairs, and about sums over them; of `batched` and what follows from rows it says nothing.
        images: How many images a code tells apart; kernels are told when they run.
        code_bytes: Bytes of the image code of a slot; 0 without.
        reversed: Whether rows are those of the sources of the list.
        aligned: Whether rows of ids begin at multiples of 16 bytes.
        ordered: Whether an order is given in which rows are taken (CUDA).
        lanes: How many lanes of CUDA serve a row; 0 on the CPU.
        boxes: Whether each system has a lattice of its own.
        itself: Whether a particle is its own neighbor, whatever its cutoff.
        measured: Whether distances are asked for, beside which slots hold a pair.
        apart: Whether sums leave out a particle's pair with itself, without a shift.
        mirrored: Whether a term reads of i what stands beside the points, of the same number.
        own: Whether rows are the sources, and are read among these.
    """

    kind: Kind
    images: int = 1
    code_bytes: int = 0
    reversed: bool = False
    aligned: bool = False
    ordered: bool = False
    lanes: int = 0
    boxes: bool = False
    itself: bool = False
    measured: bool = False
    apart: bool = False
    mirrored: bool = False
    own: bool = False

    @property
    def cuda(self) -> bool:
        """Whether it is on CUDA."""
        return self.lanes > 0

    @property
    def name(self) -> str:
        """Tells kernels of such lists from others."""
        return self._words(self.kind.compiled())

    @property
    def call(self) -> str:
        """Tells calls of these kernels from others: of the same kernels, too."""
        return f"{self._words(self.kind)}_{self.images}"

    def _words(self, kind: Kind) -> str:
        chosen = [field for field, value in zip(self._fields[3:], self[3:], strict=True) if value and field != "lanes"]
        return "_".join([kind.name, *chosen, str(self.code_bytes), f"cuda{self.lanes}" if self.cuda else "cpu"])

    @property
    def own_length(self) -> int:
        """How many numbers of a row are read to decide."""
        return self.kind.dim * (2 if self.code_bytes else 1) + bool(self.kind.rule)

    def length(self, columns: int) -> int:
        """Return how many numbers each source has, of which a term reads some: several are loaded at once."""
        least, at_once = self.own_length + columns, 2 if self.kind.double and self.cuda else 4
        return 2 if least == 2 and self.cuda else -(-least // at_once) * at_once

    def constants(self, columns: int) -> dict[str, int]:
        """Return the named integers of a program."""
        found = {"CODE_BYTES": self.code_bytes, "REVERSED": self.reversed, "ALIGNED": self.aligned, "ORDERED": self.ordered}
        found |= {"DECIDED": 1, "MEASURED": self.measured, "APART": self.apart, "MIRRORED": self.mirrored, "OWN": 0}
        found |= {"BOXES": self.boxes, "ITSELF": self.itself, "OWN_ROWS": self.own, "LENGTH": self.length(columns)}
        return found | {"LANES_PER_ROW": max(self.lanes, 1), "QUERY_CHUNK": ROWS_AT_ONCE}


def lanes_of_sums(rows: int) -> int:
    """Return how many lanes of CUDA sum over a row: fewer where there are rows enough for all multiprocessors."""
    return 2 if rows >= _MANY else LANES


def slots(rows: int, lanes: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-rows // (32 // lanes if lanes else ROWS_AT_ONCE))


def threads(rows: int, lanes: int) -> int:
    """Return the threads of a launch on CUDA."""
    return 32 * slots(rows, lanes)


@functools.lru_cache(256)
def mask_kernel(kind: ListKind) -> Kernel:
    """Return the kernel that tells which slots hold a pair now, and the distances if these are measured."""
    return _kernels(kind, "mask", ["run"], {"OTHERS": 0, "SUMS": 0, "LIST": 0, **kind.constants(0)})[0]


@functools.lru_cache(256)
def slope_kernels(kind: ListKind) -> list[Kernel]:
    """Return the kernels that make derivatives by positions of those by distances, in a list that is its own mirror image.

    On CUDA there is one, which reads reverse slots; on the CPU two, of which the second adds up what blocks of rows have summed.
    """
    constants = {"OTHERS": 0, "SUMS": 0, "LIST": 0, **kind.constants(0), "DECIDED": 0, "ROW_BLOCKS": BLOCKS_OF_ROWS}
    return _kernels(kind, "slopes", ["run"] if kind.cuda else ["run", "add"], constants)


@functools.lru_cache(512)
def sum_kernel(kind: ListKind, term: TermText, key: str) -> Kernel:
    """Return the kernel that sums a term; `key` tells it from all others in the names of programs.

    For extremes, `errors` [m, width, 2] gets the sources of the largest summands (n: there is none), and their places in the row.
    """
    constants = {"LIST": 0, **kind.constants(term.columns), **constants_of(term, kind.kind, turned=False)}
    return _kernels(kind, "sums", ["run"], constants, term_header(term, kind.kind.double, turned=False), f"_{key}")[0]


def _kernels(
    kind: ListKind,
    what: str,
    methods: Sequence[str],
    constants: Mapping[str, int],
    given: Mapping[str, str] = MappingProxyType({}),
    key: str = "",
) -> list[Kernel]:
    text = program(kind.kind, f"kept_{what}.cuh" if kind.cuda else f"kept_{what}_cpu.h", constants=constants, given=given)
    block, blocks = _BLOCK if kind.cuda else 1, _BLOCKS_IN_BOX if kind.kind.periodic else _BLOCKS
    entries = [Entry(f"Kept{what.title()}.{method}", block, blocks) for method in methods]
    return declare(f"kept_{what}_{kind.name}{key}", text, *entries, cuda=kind.cuda, fused=kind.cuda)
