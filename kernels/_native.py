"""How C++ and CUDA of `kernels/native` become the programs of variants.

A kernel is a struct in a header, a method of which does the work. `program` is the whole text: what a variant fixes (the type of
positions, their dimension, named integers), the headers that this one includes, and the header.

`cutoff`, an array of one scalar, is an argument of all of them. Where space is periodic, the radius in it is followed by the
lattice: its vectors and the transform, row by row (3 x 3 each); origin, half the width of the stencil in units of the transform,
images within reach (3 each); slack. Where it is skewed, its vectors as they were given follow, and which whole numbers of those the
vectors are (3 x 3 each). Of a batch, the highest number of a system comes last. Such integers are the bits of a float, or the value
of a double.
"""

from collections.abc import Mapping
from types import MappingProxyType

from jfrnn.kernels._text import resolve

CELLS_PER_PARTICLE = 4  # size of the cell table; 16 B per particle
SMALLEST_TABLE = 4096
SKEWED = 2
OWN_BOXES = 2
EXCLUDED = (
    "excluded_starts",
    "excluded",
)  # arrays that are given where kernels are EXCLUDING (native/excluded.h), and else left out
RULES = ("gather", "scatter", "either", "both", "mean", "table")  # by which the cutoff of a pair follows from both, in native order
TABLE = ("table_of_kinds", "kinds_of_sources", "kinds_of_queries")  # arrays that the last of these rules asks for
ORDERS = ("source_order", "query_order")  # arrays that a tree on CUDA is fitted to
BATCHES = ("", "_batched", "_boxes")
SPACES = ("", "_nearest", "_images", "_nearest_skewed", "_images_skewed")  # in names of variants
_DEFAULTS = {"PERIODIC": 0, "BATCHED": 0, "SUM": 0, "SCALED": 0, "EXCLUDING": 0, "FLAT": 0, "RULE": -1, "BOXES": 0, "TREE": 0}


def table_cells(sources: int) -> int:
    """Return the number of cells in the table for a number of sources."""
    return min(max(SMALLEST_TABLE, CELLS_PER_PARTICLE * sources), 2**30)


def place_parts(parts: list[int]) -> int:
    """Return how many words parts of a scratch take, each of which begins at a multiple of 64 bytes."""
    return sum((words + 15) // 16 * 16 for words in parts)


def program(double: bool, dim: int, *headers: str, given: Mapping[str, str] = MappingProxyType({}), **constants: int) -> str:
    """Return the text of headers behind the constants of a variant.

    PERIODIC is 0 in an open space, 1 where the nearest image is the only one that can be a neighbor, 2 where images are told apart:
    `cutoff` then goes on with the numbers of the lattice, and a row of positions goes on with its packed turns (see
    `jfrnn._geometry.box`). Where vectors of it do not lie along the axes, it is given as two more, and the text finds SKEWED.
    BATCHED is 1 where a row ends with the number of its system (see `jfrnn._geometry.batch`), OWN_BOXES where each of these has a
    box of its own, too: then `cutoff` has numbers of each of them, and the text finds BOXES. SUM is 1 where the cutoff of a pair
    is the sum of two numbers. SHIFTED is 0 where all pairs that are decided are those of points as they are, though space is
    periodic. SCALED is 1 where cutoffs are so small, or so large, that their squares need a unit.
    EXCLUDING is 1 where queries exclude sources, 2 where they exclude images of sources. RULE is the number of one of `RULES`, -1
    where all pairs have one cutoff.

    Args:
        double: Whether positions are float64.
        dim: Their dimension.
        headers: Files of `kernels/native`.
        given: Texts in place of some files.
        constants: Named integers.
    """
    constants = {**_DEFAULTS, "SHIFTED": constants.get("PERIODIC", 0), **constants}
    constants |= {"BATCHED": 1, "BOXES": 1} if constants["BATCHED"] == OWN_BOXES else {}
    constants["SKEWED"] = constants["PERIODIC"] > SKEWED
    constants |= {name: constants[name] - SKEWED for name in ("PERIODIC", "SHIFTED") if constants[name] > SKEWED}
    lines = [f"using real = {'double' if double else 'float'};", f"using whole = {'long long' if double else 'int'};"]
    lines += [f"constexpr int DIM = {dim};", f"constexpr bool DOUBLE = {int(double)};"]
    lines += [f"constexpr int {name} = {int(value)};" for name, value in constants.items()]
    return resolve(*headers, given={"c_library.h": "", "constants.h": "\n".join([*lines, ""]), **given})
