"""Crystals full of distances at exactly the cutoff: how many pairs each library misses or has too many, by rational arithmetic.

`python -m experiments.crystal_ties [ROWS.csv]` prints a row for each library that is installed: 60 crystals of five lattices and
twelve edges, 8 to 64 atoms each, and cutoffs at which shells of neighbors lie. All get the same numbers in float64.
"""

import importlib
import itertools
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import numpy as np

from experiments.jax_md_contested import tell

COLUMNS = ("library", "version", "crystals", "pairs", "at_the_cutoff", "missing", "extra")
EDGES = (3.57, 3.61, 4.05, 4.08, 3.92, 3.3, 2.87, 5.43, 5.64, 5.65, 4.21, 3.15)  # of cubic cells [angstrom]
HALF, QUARTER = np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]]) / 2, np.full(3, 0.25)
ALONG = np.array([0.5, 0, 0])
LATTICES = {  # atoms in a cubic cell, and the squares of two of its shells in squared edges
    "simple cubic": (np.zeros((1, 3)), 9, 3),
    "body-centered": (np.array([[0, 0, 0], [0.5, 0.5, 0.5]]), 3, 2),
    "face-centered": (HALF, 2, 1.5),
    "rock salt": (np.concatenate([HALF, HALF + ALONG]), 1.25, 2),
    "diamond": (np.concatenate([HALF, HALF + QUARTER]), 1.0, 1.1875),
}
Found = set[tuple[int, ...]]  # i, j and three shifts


class Crystal(NamedTuple):
    """Positions [n, 3], cell [3, 3], and a cutoff that is the distance of a shell, all rounded to float64."""

    x: np.ndarray
    cell: np.ndarray
    cutoff: float


def crystals() -> Iterator[Crystal]:
    """Yield 60 crystals of 2 x 2 x 2 cubic cells; every other one has the second of the two cutoffs."""
    corners = np.array(list(itertools.product(range(2), repeat=3)))
    for (atoms, *shells), (number, edge) in itertools.product(LATTICES.values(), enumerate(EDGES)):
        x = (corners[:, None] + atoms).reshape(-1, 3) * edge
        yield Crystal(x, 2 * edge * np.eye(3), edge * shells[number % 2] ** 0.5)


def exact_pairs(given: Crystal) -> tuple[Found, int]:
    """Return the pairs closer than the cutoff, as the oracle of the tests has them, and how many are within rounding of it."""
    images = importlib.import_module("tests.reference").reference_images
    found = [images(given.x, given.cutoff * (1 + off), matrix=given.cell, periodic=(True,) * 3) for off in (0, 5e-10, -5e-10)]
    return {(i, j, *shift) for i, j, shift in found[0]}, len(found[1] - found[2])


def libraries() -> dict[str, tuple[str, Callable[[Crystal], Any]]]:
    """Return of each library its package, and what asks it for i, j and S."""

    def by_ase(module: str) -> Callable[[Crystal], Any]:
        return lambda at: __import__(module, fromlist=["_"]).primitive_neighbor_list("ijS", [True] * 3, at.cell, at.x, at.cutoff)

    def by_matscipy(module: str) -> Callable[[Crystal], Any]:
        given = lambda at: {"positions": at.x, "cell": at.cell, "pbc": [True] * 3, "cutoff": at.cutoff}  # noqa: E731
        return lambda at: __import__(module, fromlist=["_"]).neighbour_list("ijS", **given(at))

    def by_vesin(at: Crystal) -> Any:  # noqa: ANN401
        from vesin import NeighborList  # pyright: ignore[reportMissingImports]

        return NeighborList(cutoff=at.cutoff, full_list=True).compute(at.x, at.cell, True, "ijS")

    named = {"ASE": ("ase", by_ase("ase.neighborlist")), "vesin": ("vesin", by_vesin)}
    named |= {"matscipy": ("matscipy", by_matscipy("matscipy.neighbours"))}
    named |= {"matscipy-neighbours": ("matscipy-neighbours", by_matscipy("matscipy_neighbours"))}
    return {"`jfrnn.ase`": ("jfrnn", by_ase("jfrnn.ase")), **named}


def rows() -> list[tuple[Any, ...]]:
    """Return a row for each library that is installed."""
    given, found = list(crystals()), []
    exact = [exact_pairs(each) for each in given]
    totals = [sum(len(pairs) for pairs, _ in exact), sum(ties for _, ties in exact)]
    for name, (package, ask) in libraries().items():
        wrong = [0, 0]
        try:
            for each, (pairs, _) in zip(given, exact, strict=True):
                i, j, shifts = ask(each)
                listed = {(int(a), int(b), *s) for a, b, s in zip(i, j, np.asarray(shifts).astype(int).tolist(), strict=True)}
                wrong = [wrong[0] + len(pairs - listed), wrong[1] + len(listed - pairs)]
            from_where = "" if package == "jfrnn" else version(package)
        except (ImportError, PackageNotFoundError) as error:
            print(f"{name} is left out: {error}")
            continue
        found.append((name, from_where, len(given), *totals, *wrong))
    return found


if __name__ == "__main__":
    tell(COLUMNS, rows(), sys.argv[1:])
