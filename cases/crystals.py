"""Batches of systems with boxes of their own: skewed, left-handed, tiny beside large ones, slabs, empty systems, absent particles.

>>> import numpy as np
>>> given = CRYSTAL_CASES["mixed"].build(np.float32, 3)
>>> given.boxes.shape, np.bincount(given.batch).tolist()
((6, 3, 3), [9, 0, 1, 24, 2, 14])
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

Points = NDArray[np.floating]
Systems = NDArray[np.int32]


@dataclass(frozen=True)
class CrystalInput:
    """What a search among the particles of systems with boxes of their own is given.

    Attributes:
        positions: Sources, shape [n, dim].
        batch: The system of each, shape [n], int32; -1: it is not there.
        cutoff: Positive number, exact in the dtype.
        boxes: Edge lengths, shape [systems, dim], or lattice vectors, one per row, shape [systems, dim, dim].
        periodic: One bool per axis, or of each system, shape [systems, dim].
        queries: Shape [m, dim], same dtype; None: the positions ask for each other.
        query_batch: Shape [m], int32; None likewise.
    """

    positions: Points
    batch: Systems
    cutoff: float
    boxes: Points
    periodic: tuple[bool, ...] | NDArray[np.bool_]
    queries: Points | None = None
    query_batch: Systems | None = None


@dataclass(frozen=True)
class CrystalCase:
    """A named input and what is hard about it.

    Attributes:
        name: Its key in `CRYSTAL_CASES`.
        mechanism: Why it is hard, in one line.
        build: Makes the input for a dtype (float32 or float64) and a dimension (2 or 3). Same arguments, same input.
    """

    name: str
    mechanism: str
    build: Callable[[DTypeLike, int], CrystalInput]


_CUTOFF = 0.75


def _crystals(
    dtype: np.dtype, dim: int, sizes: Sequence[int], widths: Sequence[float], skew: float = 0.3, seed: int = 0, spread: float = 1.0
) -> CrystalInput:
    """Return systems of so many particles, in any order, in cells about so wide, every other one left-handed."""
    random = np.random.default_rng(seed)
    boxes = np.stack([w * (np.diag(random.uniform(0.8, 1.2, dim)) + skew * random.uniform(-1, 1, (dim, dim))) for w in widths])
    boxes[1::2, 0] *= -1
    batch = np.repeat(np.arange(len(sizes)), sizes)
    fractions = random.uniform(-spread, spread, (len(batch), dim))
    points = np.einsum("nd,ndk->nk", fractions, boxes[batch])
    order = random.permutation(len(batch))
    return CrystalInput(points[order].astype(dtype), batch[order].astype(np.int32), _CUTOFF, boxes.astype(dtype), (True,) * dim)


def _mixed(dtype: np.dtype, dim: int) -> CrystalInput:
    return _crystals(dtype, dim, (9, 0, 1, 24, 2, 14), (1.0, 1.0, 0.4, 3.0, 0.6, 1.7))


def _nearest(dtype: np.dtype, dim: int) -> CrystalInput:
    return _crystals(dtype, dim, (20, 30, 12), (2.5, 4.0, 3.0), skew=0.1)


def _lengths(dtype: np.dtype, dim: int) -> CrystalInput:
    given = _crystals(dtype, dim, (8, 20, 1, 12), (0.9, 2.0, 0.5, 1.3), skew=0)
    return _with(given, boxes=np.abs(np.einsum("sdd->sd", given.boxes)))


def _divided(dtype: np.dtype, dim: int) -> CrystalInput:
    """Return one system that is divided into many cells, among others that are one each."""
    return _crystals(dtype, dim, (3, 200, 5, 60), (1.0, 6.0 if dim == 3 else 9.0, 0.8, 3.0))


def _tiny(dtype: np.dtype, dim: int) -> CrystalInput:
    return _crystals(dtype, dim, (1, 16, 2, 3), (0.15 if dim == 2 else 0.25, 2.5, 0.5, 5.0), skew=0.2)


def _unreduced(dtype: np.dtype, dim: int) -> CrystalInput:
    """Return lattice vectors that are far longer than need be."""
    given = _crystals(dtype, dim, (6, 10, 2), (1.2, 1.5, 1.0), skew=0.1)
    numbers = np.eye(dim)
    numbers[1, 0], numbers[-1, 0] = 3, -2
    return _with(given, boxes=(numbers @ given.boxes).astype(dtype))


def _far(dtype: np.dtype, dim: int) -> CrystalInput:
    return _crystals(dtype, dim, (8, 12, 3), (1.0, 1.7, 0.75), spread=150.0)


def _slabs(dtype: np.dtype, dim: int) -> CrystalInput:
    """Return a bulk, slabs along different axes, and a molecule in open space, all in one batch."""
    given = _crystals(dtype, dim, (8, 12, 10, 30), (1.2, 1.0, 1.0, 2.0))
    periodic = np.ones((4, dim), bool)
    periodic[1, -1] = periodic[2, 0] = False
    periodic[3] = False
    boxes = given.boxes.copy()
    boxes[3, 0] = 0  # rows of open axes only have to be finite
    return _with(given, boxes=boxes, periodic=periodic)


def _molecules(dtype: np.dtype, dim: int) -> CrystalInput:
    """Return a chain far from 0 and a cluster, both without a box, beside a tiny cell."""
    given, random = _crystals(dtype, dim, (5, 40, 40), (0.8, 1.0, 1.0)), np.random.default_rng(1)
    points = given.positions.copy()
    chain, cluster = given.batch == 1, given.batch == 2
    points[chain] = (1000 + random.uniform(0, 1, (40, dim)) * ([100.0] + [0.5] * (dim - 1))).astype(dtype)
    points[cluster] = random.uniform(-1, 1, (40, dim)).astype(dtype)
    periodic = np.array([[True] * dim, [False] * dim, [False] * dim])
    return _with(given, positions=points, periodic=periodic)


def _ties(dtype: np.dtype, dim: int) -> CrystalInput:
    """Return lattices whose neighbors lie at exactly the cutoff, in cells of one and of more sites."""
    boxes = np.stack([np.eye(dim), 2 * np.eye(dim), 3 * np.eye(dim) + np.eye(dim)[::-1] * (np.arange(dim) > 0)])
    random = np.random.default_rng(2)
    batch = np.array([0] + [1] * 6 + [2] * 12, np.int32)
    return CrystalInput(random.integers(-4, 5, (19, dim)).astype(dtype), batch, 2.0, boxes.astype(dtype), (True,) * dim)


def _absent(dtype: np.dtype, dim: int) -> CrystalInput:
    """Return particles that are in no system, of which some have coordinates that are no numbers, and systems without particles."""
    given = _mixed(dtype, dim)
    batch, points = given.batch.copy(), given.positions.copy()
    batch[::5] = -1
    points[::15] = np.nan
    return _with(given, batch=batch, positions=points)


def _queries(dtype: np.dtype, dim: int) -> CrystalInput:
    """Return queries of systems with and without sources, and of none."""
    given, random = _mixed(dtype, dim), np.random.default_rng(3)
    queries, batch = random.uniform(-2, 2, (30, dim)).astype(dtype), random.integers(-1, 6, 30).astype(np.int32)
    queries[batch == -1] *= np.nan
    return _with(given, queries=queries, query_batch=batch)


def _with(given: CrystalInput, **changed: Points | NDArray[np.bool_] | Systems) -> CrystalInput:
    return CrystalInput(**{**given.__dict__, **changed})


def _case(name: str, mechanism: str, recipe: Callable[[np.dtype, int], CrystalInput]) -> tuple[str, CrystalCase]:
    return name, CrystalCase(name, mechanism, lambda dtype, dim: recipe(np.dtype(dtype), dim))


CRYSTAL_CASES: dict[str, CrystalCase] = dict(
    [
        _case("mixed", "skewed and left-handed cells of 0 to 24 particles: what one system needs, another does not", _mixed),
        _case("nearest", "no pair has two images, so that lists store none", _nearest),
        _case("lengths", "cells given by lengths", _lengths),
        _case("divided", "a system that is divided into cells, among others that are one", _divided),
        _case("tiny", "a cell of one particle with hundreds of images, beside one whose queries leave it nowhere", _tiny),
        _case("unreduced", "lattice vectors that are far longer than need be", _unreduced),
        _case("far", "particles up to 150 lattice vectors away from their cells", _far),
        _case("slabs", "axes that are periodic in some systems alone, and rows of open ones that are 0", _slabs),
        _case("molecules", "systems without a box, one of them far away: open axes are folded", _molecules),
        _case("ties", "pairs at exactly the cutoff, in the cell and in images", _ties),
        _case("absent", "particles of no system, and coordinates of theirs that are no numbers", _absent),
        _case("queries", "queries of systems without sources, and of none", _queries),
    ]
)
