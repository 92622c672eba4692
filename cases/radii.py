"""Inputs with a cutoff per particle: wide spreads, ties of every rule, coincident points, blobs far apart, queries, boxes.

>>> import numpy as np
>>> given = RADII_CASES["spread_100"].build(np.float32, 3)
>>> given.positions.shape, given.cutoffs.shape, bool(given.cutoffs.max() > 50 * given.cutoffs.min())
((120, 3), (120,), True)
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

Points = NDArray[np.floating]


@dataclass(frozen=True)
class RadiiInput:
    """What a search with a cutoff per particle is given.

    Attributes:
        positions: Sources, shape [n, dim].
        cutoffs: Of the sources, shape [n], same dtype, positive.
        lengths: Of an orthogonal periodic box, shape [dim]; None: space is open.
        queries: Shape [m, dim], same dtype; None: the positions ask for each other.
        query_cutoffs: Of the queries, shape [m]; None likewise.
    """

    positions: Points
    cutoffs: Points
    lengths: Points | None = None
    queries: Points | None = None
    query_cutoffs: Points | None = None


@dataclass(frozen=True)
class RadiiCase:
    """A named input and what is hard about it.

    Attributes:
        name: Its key in `RADII_CASES`.
        mechanism: Why it is hard, in one line.
        build: Makes the input for a dtype (float32 or float64) and a dimension (2 or 3). Same arguments, same input.
    """

    name: str
    mechanism: str
    build: Callable[[DTypeLike, int], RadiiInput]


def _spread(random: np.random.Generator, n: int, smallest: float, largest: float) -> Points:
    return np.exp(random.uniform(np.log(smallest), np.log(largest), n))


def _spread_100(dtype: np.dtype, dim: int) -> RadiiInput:
    random = np.random.default_rng(1)
    return RadiiInput(random.random((120, dim)).astype(dtype), _spread(random, 120, 0.005, 0.5).astype(dtype))


def _spread_1e6(dtype: np.dtype, dim: int) -> RadiiInput:
    random = np.random.default_rng(2)
    cutoffs = _spread(random, 120, 1e-6, 1.0).astype(dtype)
    distances = (_spread(random, 120, 1e-6, 1.0)[:, None] * random.normal(size=(120, dim))).astype(dtype)
    return RadiiInput(distances, cutoffs)


def _graded(dtype: np.dtype, dim: int) -> RadiiInput:
    """Return points that are the denser the nearer they are to the origin, with about as many neighbors each."""
    random = np.random.default_rng(3)
    away = random.normal(size=(120, dim))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    distance = 10.0 ** random.uniform(-2, 0, 120)
    return RadiiInput((distance[:, None] * away).astype(dtype), (0.6 * distance).astype(dtype))


def _ties(dtype: np.dtype, dim: int) -> RadiiInput:
    """Return lattice points whose cutoffs, their means included, are distances that occur: 1, 2, 3, 5, 7 and halves of sums."""
    random = np.random.default_rng(4)
    return RadiiInput(random.integers(-6, 7, (120, dim)).astype(dtype), random.choice([1, 2, 3, 5, 7], 120).astype(dtype))


def _ties_far(dtype: np.dtype, dim: int) -> RadiiInput:
    given = _ties(dtype, dim)
    return RadiiInput(given.positions + dtype.type(4096.0), given.cutoffs)


def _mean_residues(dtype: np.dtype, dim: int) -> RadiiInput:
    """Return pairs at distance 1 whose cutoffs add up to 2, or miss it by less than an ulp of the sum."""
    tiny = [0.0, 2.0**-40, 2.0**-60, -(2.0**-40), -(2.0**-60), 2.0**-20, -(2.0**-20)]
    small = 2.0**-8
    points, cutoffs = [], []
    for k, residue in enumerate(tiny):
        for side in (0.0, 1.0):
            points.append([4.0 * k + side] + [0.0] * (dim - 1))
        cutoffs += [2.0 - small, small * (1 + residue)]
    return RadiiInput(np.array(points, dtype), np.array(cutoffs, dtype))


def _one_large(dtype: np.dtype, dim: int) -> RadiiInput:
    random = np.random.default_rng(5)
    cutoffs = np.full(120, 0.08)
    cutoffs[60] = 3.0
    return RadiiInput(random.random((120, dim)).astype(dtype), cutoffs.astype(dtype))


def _powers_of_two(dtype: np.dtype, dim: int) -> RadiiInput:
    """Return cutoffs at and beside powers of two, where groups and levels meet, and points on the faces of cells."""
    random = np.random.default_rng(6)
    base = 2.0 ** random.integers(-7, 1, 120)
    cutoffs = np.nextafter(base.astype(dtype), (base * random.choice([0, 1, 2], 120)).astype(dtype))
    sites = random.integers(-32, 33, (120, dim)) * 2.0**-6
    return RadiiInput(sites.astype(dtype), cutoffs.astype(dtype))


def _coincident(dtype: np.dtype, dim: int) -> RadiiInput:
    random = np.random.default_rng(7)
    points = np.repeat(random.random((30, dim)), 4, axis=0).astype(dtype)
    return RadiiInput(points, _spread(random, 120, 0.01, 0.6).astype(dtype))


def _blobs(dtype: np.dtype, dim: int) -> RadiiInput:
    """Return two blobs 10^5 of the largest cutoffs apart, on either side of 0."""
    random = np.random.default_rng(8)
    points = random.random((120, dim)).astype(dtype)
    points[:60, 0] += dtype.type(1e4)
    points[60:, 0] -= dtype.type(4e4)
    return RadiiInput(points, _spread(random, 120, 0.01, 0.5).astype(dtype))


def _queries(dtype: np.dtype, dim: int) -> RadiiInput:
    given, random = _spread_100(dtype, dim), np.random.default_rng(9)
    queries = (1.6 * random.random((50, dim)) - 0.3).astype(dtype)
    queries[:10] = given.positions[:10]
    return RadiiInput(given.positions, given.cutoffs, None, queries, _spread(random, 50, 0.004, 0.8).astype(dtype))


def _periodic(dtype: np.dtype, dim: int) -> RadiiInput:
    given = _spread_100(dtype, dim)
    lengths = np.array([1.25, 1.5, 2.0][:dim], dtype)
    return RadiiInput(given.positions * dtype.type(2) - dtype.type(0.5), given.cutoffs, lengths)


def _periodic_ties(dtype: np.dtype, dim: int) -> RadiiInput:
    given = _ties(dtype, dim)
    return RadiiInput(given.positions, np.minimum(given.cutoffs, dtype.type(3)), np.array([13.0, 12.0, 16.0][:dim], dtype))


def _periodic_images(dtype: np.dtype, dim: int) -> RadiiInput:
    """Return a box narrower than the largest cutoffs: some particles meet several images of others, and of themselves."""
    given = _spread_100(dtype, dim)
    return RadiiInput(given.positions[:40], given.cutoffs[:40] * dtype.type(2), np.array([0.75, 1.0, 1.25][:dim], dtype))


def _case(name: str, mechanism: str, recipe: Callable[[np.dtype, int], RadiiInput]) -> tuple[str, RadiiCase]:
    return name, RadiiCase(name, mechanism, lambda dtype, dim: recipe(np.dtype(dtype), dim))


RADII_CASES: dict[str, RadiiCase] = dict(
    [
        _case("spread_100", "cutoffs over a factor of 100 at random: no two rules agree", _spread_100),
        _case("spread_1e6", "more powers of two than there are groups of cutoffs", _spread_1e6),
        _case("graded", "small cutoffs where points are dense, as adaptive smoothing lengths have it", _graded),
        _case("ties", "distances that equal one cutoff, or the mean of two", _ties),
        _case("ties_far", "the same ties with fewer digits left of the coordinates", _ties_far),
        _case("mean_residues", "means that miss a distance by less than their sum can say", _mean_residues),
        _case("one_large", "a single large cutoff among small ones, that sees everyone", _one_large),
        _case("powers_of_two", "cutoffs beside powers of two, points on the faces of cells", _powers_of_two),
        _case("coincident", "distance 0 between different cutoffs", _coincident),
        _case("blobs", "two blobs on either side of 0, 10^5 cutoffs apart", _blobs),
        _case("queries", "queries with cutoffs of their own, some far outside", _queries),
        _case("periodic", "images through faces, for large cutoffs alone", _periodic),
        _case("periodic_ties", "ties through faces", _periodic_ties),
        _case("periodic_images", "several images for large cutoffs, one for small ones", _periodic_images),
    ]
)
