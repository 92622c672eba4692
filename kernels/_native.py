"""How C++ and CUDA of `kernels/native` become programs.

A kernel is a struct in a header, a method of which does the work. `program` is the whole text: what is static (the type of
positions, their dimension, named integers), the headers that this one includes, and the header.

`cutoff`, an array of one scalar, is an argument of all of them. Where space is periodic, the radius in it is followed by the
lattice: its vectors and the transform, row by row (3 x 3 each); origin, half the width of the stencil in units of the transform,
images within reach (3 each); slack. Where it is skewed, its vectors as they were given follow, and which whole numbers of those the
vectors are (3 x 3 each). In a batch, the highest number of a system comes last. Such integers are the bits of a float, or the value
of a double.
"""

from collections.abc import Mapping
from types import MappingProxyType

from jfrnn.kernels._kind import SKEWED, Kind
from jfrnn.kernels._program import Entry, Kernel, declare
from jfrnn.kernels._text import resolve

CELLS_PER_PARTICLE = 4  # size of the cell table; 16 B per particle
SMALLEST_TABLE = 4096
# Arrays that are given where kernels are EXCLUDING (native/decide/excluded.h), and else left out.
EXCLUDED = ("excluded_starts", "excluded")
TABLE = ("table_of_kinds", "kinds_of_sources", "kinds_of_queries")  # arrays that the last of these rules asks for
ORDERS = ("source_order", "query_order")  # arrays that a tree on CUDA is fitted to


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
