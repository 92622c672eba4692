"""Batches of systems: on top of each other, far apart, numbered at random, in one box, asked by queries.

>>> import numpy as np
>>> given = BATCH_CASES["superposed"].build(np.float32, 3)
>>> given.positions.shape, np.unique(given.batch).tolist()
((120, 3), [0, 1, 2, 3])
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

Points = NDArray[np.floating]
Systems = NDArray[np.int32]


@dataclass(frozen=True)
class BatchInput:
    """What a search among the particles of many systems is given.

    Attributes:
        positions: Sources, shape [n, dim].
        batch: The system of each, shape [n], int32.
        cutoff: Positive number, exact in the dtype.
        lengths: Of an orthogonal periodic box, shape [dim]; None: space is open.
        queries: Shape [m, dim], same dtype; None: the positions ask for each other.
        query_batch: Shape [m], int32; None likewise.
    """

    positions: Points
    batch: Systems
    cutoff: float
    lengths: Points | None = None
    queries: Points | None = None
    query_batch: Systems | None = None


@dataclass(frozen=True)
class BatchCase:
    """A named input and what is hard about it.

    Attributes:
        name: Its key in `BATCH_CASES`.
        mechanism: Why it is hard, in one line.
        build: Makes the input for a dtype (float32 or float64) and a dimension (2 or 3). Same arguments, same input.
    """

    name: str
    mechanism: str
    build: Callable[[DTypeLike, int], BatchInput]


_N = 120
_CUTOFF = 0.375


def _superposed(dtype: np.dtype, dim: int) -> BatchInput:
    """Return four copies of the same particles, in any order: every particle has a coincident one in each other system."""
    random = np.random.default_rng(0)
    order = random.permutation(_N)
    points, systems = np.tile(random.random((_N // 4, dim)), (4, 1)), np.repeat(np.arange(4), _N // 4)
    return BatchInput(points[order].astype(dtype), systems[order].astype(np.int32), _CUTOFF)


def _extreme_numbers(dtype: np.dtype, dim: int) -> BatchInput:
    random = np.random.default_rng(1)
    numbers = np.array([-(2**31), -1, 0, 2**24, 2**24 + 1, 2**31 - 1])
    return BatchInput(random.random((_N, dim)).astype(dtype), random.choice(numbers, _N).astype(np.int32), _CUTOFF)


def _one_each(dtype: np.dtype, dim: int) -> BatchInput:
    random = np.random.default_rng(2)
    return BatchInput(random.random((_N, dim)).astype(dtype), np.arange(_N, dtype=np.int32), _CUTOFF)


def _far_apart(dtype: np.dtype, dim: int) -> BatchInput:
    """Return systems on either side of 0, some 10^5 cutoffs apart, others on top of each other: no table holds such a box."""
    given, random = _superposed(dtype, dim), np.random.default_rng(3)
    moved = given.positions + dtype.type(32768) * (given.batch[:, None] % 2 * random.choice([-1, 1], dim)).astype(dtype)
    return BatchInput(moved, given.batch, _CUTOFF)


def _ties(dtype: np.dtype, dim: int) -> BatchInput:
    random = np.random.default_rng(4)
    return BatchInput(random.integers(-2, 3, (_N, dim)).astype(dtype), random.integers(0, 3, _N).astype(np.int32), 2.0)


def _single(dtype: np.dtype, dim: int) -> BatchInput:
    random = np.random.default_rng(5)
    return BatchInput(random.random((_N, dim)).astype(dtype), np.full(_N, -7, np.int32), _CUTOFF)


def _queries(dtype: np.dtype, dim: int) -> BatchInput:
    """Return queries of systems that have sources, and of some that have none."""
    given, random = _superposed(dtype, dim), np.random.default_rng(6)
    queries = np.concatenate([given.positions[:20], (1.5 * random.random((30, dim)) - 0.25).astype(dtype)])
    return BatchInput(given.positions, given.batch, _CUTOFF, None, queries, random.integers(-2, 6, 50).astype(np.int32))


def _periodic(dtype: np.dtype, dim: int) -> BatchInput:
    given = _superposed(dtype, dim)
    return BatchInput(given.positions, given.batch, _CUTOFF, np.array([1.0, 1.25, 1.5][:dim], dtype))


def _periodic_images(dtype: np.dtype, dim: int) -> BatchInput:
    given = _extreme_numbers(dtype, dim)
    return BatchInput(given.positions[:60], given.batch[:60], 0.75, np.array([1.0, 1.25, 1.0][:dim], dtype))


def _case(name: str, mechanism: str, recipe: Callable[[np.dtype, int], BatchInput]) -> tuple[str, BatchCase]:
    return name, BatchCase(name, mechanism, lambda dtype, dim: recipe(np.dtype(dtype), dim))


BATCH_CASES: dict[str, BatchCase] = dict(
    [
        _case("superposed", "systems on top of each other, in any order: every leak is a pair at distance 0", _superposed),
        _case("extreme_numbers", "systems numbered over all of int32, and beyond what float32 counts", _extreme_numbers),
        _case("one_each", "as many systems as particles: nobody has a neighbor", _one_each),
        _case("far_apart", "systems too far apart for a table of cells: what shares a hash may be of another system", _far_apart),
        _case("ties", "pairs at exactly the cutoff, in their own system and in others", _ties),
        _case("single", "one system, and its number is none that counts from 0", _single),
        _case("queries", "queries of systems without sources, and sources of systems without queries", _queries),
        _case("periodic", "systems that leak through faces", _periodic),
        _case("periodic_images", "several images of a pair, and of a particle with itself, in one system", _periodic_images),
    ]
)
