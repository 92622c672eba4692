"""What neighbor searches are known to get wrong, row by row, and the cases of this package that stand for it.

>>> [row.title for row in CATALOG][:2]
['cell edge equal to the cutoff', 'distances that equal the cutoff']
>>> problem("splits/split_by_cells", "float32", 3).positions.shape
Traceback (most recent call last):
    ...
KeyError: "no table 'splits': hard, periodic, radii, batches"
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from .batches import BATCH_CASES
from .hard import HARD_CASES
from .periodic import PERIODIC_CASES
from .radii import RADII_CASES

TABLES: dict[str, dict[str, Any]] = {"hard": HARD_CASES, "periodic": PERIODIC_CASES, "radii": RADII_CASES, "batches": BATCH_CASES}


class Row(NamedTuple):
    """A way to be wrong: its title, why it happens, and the cases for it, as "table/name"; none: it is no single input."""

    title: str
    mechanism: str
    cases: tuple[str, ...]


@dataclass(frozen=True)
class Problem:
    """An input of any table.

    Attributes:
        positions: Sources, shape [n, dim].
        cutoff: One for all.
        matrix: Lattice vectors as rows, shape [dim, dim]; None: space is open.
        periodic: One bool per axis.
        queries: Shape [m, dim], or None.
        batch: System of each particle, shape [n], or None.
    """

    positions: NDArray[np.floating]
    cutoff: float
    matrix: NDArray[np.floating] | None
    periodic: tuple[bool, ...]
    queries: NDArray[np.floating] | None
    batch: NDArray[np.int32] | None


def problem(case: str, dtype: DTypeLike, dim: int) -> Problem:
    """Build the input of a case with one cutoff, named "table/name"."""
    table, name = case.split("/")
    if table not in TABLES:
        raise KeyError(f"no table {table!r}: {', '.join(TABLES)}")
    given = TABLES[table][name].build(dtype, dim)
    lengths = getattr(given, "lengths", None)
    matrix = getattr(given, "matrix", lengths)
    if matrix is not None and matrix.ndim == 1:
        matrix = np.diag(matrix)
    periodic = getattr(given, "periodic", (lengths is not None,) * dim)
    queries, batch = getattr(given, "queries", None), getattr(given, "batch", None)
    return Problem(given.positions, given.cutoff, matrix if any(periodic) else None, periodic, queries, batch)


CATALOG = (
    Row(
        "cell edge equal to the cutoff",
        "a rounded cell index puts a pair two cells apart",
        ("hard/split_by_cells", "hard/split_by_cells_near"),
    ),
    Row(
        "distances that equal the cutoff",
        "strict or not, float32 or float64, fused or not",
        ("hard/lattice_1e-4_at_0", "hard/integers_9", "periodic/crystal_0.1"),
    ),
    Row("far from the origin", "few digits are left for a distance", ("hard/far_1e6",)),
    Row("squares subtracted (Gram form)", "cancellation, negative squares", ("hard/far_1e4", "hard/ulp_far_axis")),
    Row("asymmetric minimum image", "(i, j) is a pair and (j, i) is none", ("periodic/half_box",)),
    Row("negative coordinates", "truncation is no floor", ("hard/around_zero", "hard/lattice_1e6_at_-3e4dx")),
    Row(
        "outside the box, slabs", "an open axis is wrapped, or a periodic one is not", ("periodic/outside", "periodic/periodic_xy")
    ),
    Row("fewer than 3 cells per axis", "the stencil meets a cell twice", ("periodic/box_2.5_cutoffs",)),
    Row("cutoff beyond half the box", "a pair has several images", ("periodic/cutoff_1.5_boxes", "periodic/half_box_both")),
    Row(
        "left-handed and skewed boxes", "a stencil goes by edges, not by heights", ("periodic/left_handed_skewed", "periodic/flat")
    ),
    Row("capacity", "neighbors that find no slot are dropped", ("hard/uneven_density",)),
    Row("one full cell, one far point", "cost and memory follow the cells", ("hard/one_cell", "hard/clump_and_outlier")),
    Row("more cells than int32 counts", "an index wraps around", ("hard/two_blobs_1e12",)),
    Row("tiny cutoff, huge domain", "a grid of (L/r)³ cells", ("hard/empty_slab",)),
    Row("NaN and infinite coordinates", "cast to some cell, or points vanish", ("periodic/nonfinite",)),
    Row("coincident points", "a particle is told from its neighbors by distance", ("hard/all_coincident", "hard/some_coincident")),
    Row("empty and small inputs", "edges of tiles, empty shapes", ("hard/n_0", "hard/n_1", "hard/n_33", "hard/no_pairs")),
    Row("batches", "systems leak into each other", ("batches/superposed", "batches/far_apart")),
    Row("a skin while the box changes", "only motion is looked at", ()),
    Row("float64 where it is switched off", "a silent cast", ()),
    Row(
        "denormals, values near the largest float",
        "squares overflow, or are flushed to zero",
        ("hard/residues_denormal", "hard/tiny_scale", "hard/near_max"),
    ),
)
