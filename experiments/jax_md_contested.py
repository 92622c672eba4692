"""Where lists of jax-md and of jfrnn differ: who is right, by rational arithmetic on the given numbers.

`python -m experiments.jax_md_contested [ROWS.csv]` prints a row for each case: how many pairs there are, and how many each list
misses or has too many. jax-md has to be installed.
"""

import csv
import sys
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

COLUMNS = ("case", "particles", "pairs", "jax_md_missing", "jax_md_extra", "jfrnn_missing", "jfrnn_extra")
Pairs = set[tuple[int, int]]


class Case(NamedTuple):
    """Positions [n, d] float32, a box (a length, lengths or a matrix of columns), a cutoff, and whether positions are fractions."""

    positions: np.ndarray
    box: Any
    cutoff: float
    fractional: bool


def cases() -> dict[str, Case]:
    """Return scenes by what is special about them."""
    rng = np.random.default_rng(0)
    tenth, cutoff = np.float32(0.1), float(np.float32(0.3))
    lattice = np.stack(np.meshgrid(*[np.arange(8)] * 3), axis=-1).reshape(-1, 3).astype(np.float32) * tenth
    inside = rng.random((400, 3)).astype(np.float32)
    matrix = np.array([[6.0, 2.5, 1.5], [0.0, 6.0, 2.0], [0.0, 0.0, 6.0]], np.float32)
    return {
        "a lattice with distances at the cutoff": Case(lattice, float(np.float32(8) * tenth), cutoff, False),
        "particles outside the box": Case((inside * 4 - 2) * np.float32(6), 6.0, 1.0, False),
        "fractions in a box of lengths 3.5, 6, 12": Case(inside, np.array([3.5, 6.0, 12.0], np.float32), 1.0, True),
        "fractions in a skewed box": Case(inside, matrix, 1.0, True),
    }


def exact_pairs(case: Case) -> Pairs:
    """Return the pairs whose nearest images are closer than the cutoff: where float64 is in doubt, rational numbers decide."""
    n, dim = case.positions.shape
    matrix = (np.asarray(case.box) if np.ndim(case.box) == 2 else np.eye(dim) * case.box).astype(np.float64)
    unit, to_lengths = (np.ones(dim), matrix) if case.fractional else (np.diag(matrix), np.eye(dim))
    away = case.positions[:, None].astype(np.float64) - case.positions
    excess = np.square((away - unit * np.round(away / unit)) @ to_lengths.T).sum(axis=2) - case.cutoff**2
    near = excess < 0
    for i, j in np.argwhere(np.abs(excess) < 1e-9 * case.cutoff**2):
        parts = [Fraction(float(a)) - Fraction(float(b)) for a, b in zip(case.positions[i], case.positions[j], strict=True)]
        parts = [part - Fraction(u) * round(part / Fraction(u)) for part, u in zip(parts, unit.tolist(), strict=True)]
        lengths = [sum(Fraction(c) * part for c, part in zip(row, parts, strict=True)) for row in to_lengths.tolist()]
        near[i, j] = sum(length**2 for length in lengths) < Fraction(case.cutoff) ** 2
    return {(int(i), int(j)) for i, j in np.argwhere(near & ~np.eye(n, dtype=bool))}


def listed_pairs(make: Callable[..., Any], case: Case) -> Pairs:
    """Return the pairs of a list."""
    from jax_md import partition, space  # pyright: ignore[reportMissingImports]

    displacement, _ = space.periodic_general(case.box) if case.fractional else space.periodic(case.box)
    options = {"fractional_coordinates": case.fractional, "format": partition.Sparse}
    nbrs = make(displacement, case.box, case.cutoff, **options).allocate(case.positions, extra_capacity=9)
    return {(int(i), int(j)) for j, i in np.asarray(nbrs.idx).T if i < len(case.positions)}


def rows() -> list[tuple[Any, ...]]:
    """Return a row for each case."""
    import jax.numpy as jnp
    from jax_md import partition  # pyright: ignore[reportMissingImports]

    from jfrnn import jax_md

    found = []
    for name, case in cases().items():
        exact, given = exact_pairs(case), case._replace(positions=jnp.asarray(case.positions))
        theirs, ours = (listed_pairs(module.neighbor_list, given) for module in (partition, jax_md))
        wrong = [len(part) for listed in (theirs, ours) for part in (exact - listed, listed - exact)]
        found.append((name, len(case.positions), len(exact), *wrong))
    return found


def tell(columns: Sequence[str], made: Sequence[tuple[Any, ...]], words: list[str]) -> None:
    """Print rows below their columns, and write them to the file that is named, if one is."""
    for row in (columns, *made):
        print(*row, sep=", ")
    if words:
        with Path(words[0]).open("w", newline="") as file:
            csv.writer(file).writerows((columns, *made))


if __name__ == "__main__":
    tell(COLUMNS, rows(), sys.argv[1:])
