"""What is static about a search or a sum (`Kind`), and how C++ and CUDA of `kernels/native` become programs of it.

Names of programs and their constants follow from the fields of `Kind`. To add an option, add a field and, if native code reads it,
a constant. Whoever makes a kind of a search (`kind_of_search` in `jfrnn/_engine/operands.py`) sets the field.

A kernel is a struct in a header, a method of which does the work. `program` is the whole text: what is static (the type of
positions, their dimension, named integers), the headers that this one includes, and the header.

`cutoff`, an array of one scalar, is an argument of all of them. Where space is periodic, the radius in it is followed by the
lattice: its vectors and the transform, row by row (3 x 3 each); origin, half the width of the stencil in units of the transform,
images within reach (3 each); slack; a bound on the turns of particles. Where it is skewed, its vectors as they were given follow,
and which whole numbers of those the vectors are (3 x 3 each). In a batch, the highest number of a system comes last. Such integers
are the bits of a float, or the value of a double.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels._text import resolve

RULES = ("gather", "scatter", "either", "both", "mean", "table")  # by which the cutoff of a pair follows from both, in native order
SKEWED = 2
OWN_BOXES = 2
_TOLD = ("own", "closed", "drop_self")  # numbers that kernels are given when they run: programs do not depend on them
_WORDS = {  # of options that have more values than two
    "periodic": ("", "nearest", "images", "nearest_skewed", "images_skewed"),
    "batched": ("", "batched", "boxes"),
    "excluding": ("", "excluding", "excludingimages"),
    "drop_self": ("", "dropself"),
    "lists": ("", "list"),
}
CELLS_PER_PARTICLE = 4  # size of the cell table; 16 B per particle
SMALLEST_TABLE = 4096
# Arrays that are given where kernels are EXCLUDING (native/decide/excluded.h), and else left out.
EXCLUDED = ("excluded_starts", "excluded")
TABLE = ("table_of_kinds", "kinds_of_sources", "kinds_of_queries")  # arrays that the last of these rules asks for
ORDERS = ("source_order", "query_order")  # arrays that a tree on CUDA is fitted to


class Kind(NamedTuple):
    """All that is static about a search or a sum by kernels, apart from shapes and the text of a term.

    Attributes:
        dim: Dimension of the positions.
        double: Whether they are float64.
        scaled: Whether squares of cutoffs need a unit: these are very small or very large, or differ.
        own: Whether the queries are the sources.
        closed: Whether a pair may be as far apart as the cutoff.
        drop_self: Whether a particle is left out of its own row.
        later: Whether only pairs with a later source are listed, as in half lists.
        lists: Whether rows are written, not only their counts.
        flat: Whether rows follow each other without gaps.
        periodic: 0 in an open space, 1 where the nearest image is the only one that can be a neighbor, 2 where images are told
            apart, and SKEWED more where vectors of the lattice do not lie along the axes.
        batched: 1 where a particle knows its system, OWN_BOXES where each system has a box of its own.
        excluding: 1 where queries exclude sources, 2 where they exclude images of sources.
        rule: One of `RULES`, "" where all pairs have one cutoff.
        tree: Whether sources stand in the tree of `jfrnn.kernels.tree_cuda`; on the CPU `rule` alone says so.
        compensated: Whether rounding errors of sums are added up, too.
        extremes: Whether the largest summands are found in place of sums.
    """

    dim: int
    double: bool
    scaled: bool = False
    own: bool = False
    closed: bool = False
    drop_self: bool = False
    later: bool = False
    lists: bool = False
    flat: bool = False
    periodic: int = 0
    batched: int = 0
    excluding: int = 0
    rule: str = ""
    tree: bool = False
    compensated: bool = False
    extremes: bool = False

    @property
    def name(self) -> str:
        """The words of the options that are chosen: it tells this kind from all others."""
        values = zip(self._fields[2:], self[2:], strict=True)
        chosen = [value if isinstance(value, str) else _WORDS.get(field, ("", field))[value] for field, value in values if value]
        return "_".join([f"{self.dim}d", "f64" if self.double else "f32", *chosen])

    @property
    def long(self) -> bool:
        """Whether cells on CUDA take few queries with longer cutoffs than these are made for (`native/cells/long.cuh`)."""
        return self.rule == RULES[0] and not (self.periodic or self.batched or self.tree)

    def compiled(self, *without: str) -> "Kind":
        """Return what of this kind a program depends on: nothing that kernels are told when they run, nor options `without`."""
        return self._replace(**dict.fromkeys((*_TOLD, *without), 0))

    def only(self, *options: str) -> "Kind":
        """Return the kind of this dimension and dtype with some of its options."""
        return Kind(self.dim, self.double, **{option: getattr(self, option) for option in options})

    def constants(self) -> dict[str, int]:
        """Return what native code calls the options that every program can read."""
        return {
            "PERIODIC": self.periodic,
            "BATCHED": self.batched > 0,
            "SUM": self.rule == "mean",
            "SCALED": self.scaled,
            "EXCLUDING": self.excluding,
            "FLAT": self.flat,
            "LATER": self.later,
            "RULE": RULES.index(self.rule) if self.rule else -1,
            "BOXES": self.batched == OWN_BOXES,
            "TREE": self.tree,
            "LONG": self.long,
        }


def table_cells(sources: int) -> int:
    """Return the number of cells in the table for a number of sources."""
    return min(max(SMALLEST_TABLE, CELLS_PER_PARTICLE * sources), 2**30)


def place_parts(parts: list[int]) -> int:
    """Return how many words parts of a scratch take, each of which begins at a multiple of 64 bytes."""
    return sum((words + 15) // 16 * 16 for words in parts)


def program(
    kind: Kind, *headers: str, constants: Mapping[str, int] = MappingProxyType({}), given: Mapping[str, str] = MappingProxyType({})
) -> str:
    """Return the text of headers behind the constants of a kind, and others.

    Where space is periodic, `cutoff` goes on with the numbers of the lattice, and a row of positions with its packed turns (see
    `jfrnn._geometry.box`). BATCHED is 1 where such a row ends with the number of its system (see `jfrnn._geometry.batch`), BOXES
    where `cutoff` has numbers of each of these. SUM is 1 where the cutoff of a pair is the sum of two numbers. SHIFTED is 0 where
    all pairs that are decided are those of points as they are, though space is periodic.

    Args:
        kind: What is static; programs of no search or sum depend on its dimension and dtype alone.
        headers: Files of `kernels/native`.
        constants: Named integers.
        given: Texts in place of some files.
    """
    named = {**kind.constants(), "SHIFTED": kind.periodic, **constants, "SKEWED": kind.periodic > SKEWED}
    named |= {name: named[name] - SKEWED for name in ("PERIODIC", "SHIFTED") if named[name] > SKEWED}
    lines = [f"using real = {'double' if kind.double else 'float'};", f"using whole = {'long long' if kind.double else 'int'};"]
    lines += [f"constexpr int DIM = {kind.dim};", f"constexpr bool DOUBLE = {int(kind.double)};"]
    lines += [f"constexpr int {name} = {int(value)};" for name, value in named.items()]
    return resolve(*headers, given={"c_library.h": "", "constants.h": "\n".join([*lines, ""]), **given})


def declare_kind(
    kind: Kind,
    name: str,
    header: str,
    *entries: Entry | str,
    constants: Mapping[str, int] = MappingProxyType({}),
    given: Mapping[str, str] = MappingProxyType({}),
    cuda: bool = False,
) -> list[Kernel]:
    """Return the kernels of a header for a kind, with the arguments of `declare` and of `program`.

    On CUDA products may be contracted with sums: what they decide is right with either.
    """
    text = program(kind, header, constants=constants, given=given)
    return declare(f"{name}_{kind.name}", text, *entries, cuda=cuda, fused=cuda)
