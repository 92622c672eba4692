"""Inputs that neighbor searches get wrong, or slow, or run out of memory on. All in an open box.

>>> import numpy as np
>>> given = HARD_CASES["two_blobs_1e12"].build(np.float32, 3)
>>> given.positions.shape, given.positions.dtype, given.cutoff, given.queries
((200, 3), dtype('float32'), 1.0, None)
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from . import _adversarial as adversarial

Points = NDArray[np.floating]
Parts = tuple[Points, float] | tuple[Points, float, Points]
Recipe = Callable[[np.dtype, int], Parts]


@dataclass(frozen=True)
class HardInput:
    """What a search is given.

    Attributes:
        positions: Sources, shape [n, dim], finite.
        cutoff: Positive, as a caller writes it: a search rounds it once to the dtype of positions.
        queries: Shape [m, dim], same dtype; None: the positions ask for each other.
    """

    positions: Points
    cutoff: float
    queries: Points | None = None


@dataclass(frozen=True)
class HardCase:
    """A named input and what is hard about it.

    Attributes:
        name: Its key in `HARD_CASES`.
        mechanism: Why it is hard, in one line.
        build: Makes the input for a dtype (float32 or float64) and a dimension (2 or 3). Same arguments, same input.
    """

    name: str
    mechanism: str
    build: Callable[[DTypeLike, int], HardInput]


def _case(name: str, mechanism: str, recipe: Recipe) -> HardCase:
    def build(dtype: DTypeLike, dim: int) -> HardInput:
        kind = np.dtype(dtype)
        if kind not in (np.float32, np.float64) or dim not in (2, 3):
            raise ValueError(f"a hard case is float32 or float64, in 2 or 3 dimensions: got {kind}, {dim}")
        positions, cutoff, *queries = recipe(kind, dim)
        # rounded here and once, where a recipe has computed in float64
        return HardInput(positions.astype(kind), cutoff, queries[0].astype(kind) if queries else None)

    return HardCase(name, mechanism, build)


def _sites(dim: int) -> NDArray[np.float64]:
    shape = (8, 9, 8) if dim == 3 else (24, 24)
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, dim).astype(float)


def _cube(n: int, dim: int, seed: int, low: float = 0.0, high: float = 1.0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(low, high, (n, dim))


def _lattice(spacing: float, offset: float) -> Recipe:
    return lambda dtype, dim: (_sites(dim) * spacing + offset, 3 * spacing)


def _one_off_the_lattice(dtype: np.dtype, dim: int) -> Parts:
    sites = _sites(dim)
    sites[-1] += 0.1
    return sites, 3.0


def _grid(steps: int) -> Recipe:
    """Put pairs on a grid of so many steps per unit length at exactly the cutoff of 3, and one step to either side of it."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        first = np.random.default_rng(12).integers(0, 4 * steps, (60, dim))
        way = np.eye(dim)[np.arange(60) % dim] * 3 * steps
        if dim == 3:
            way[::2] = np.roll([1, 2, 2], 1) * steps
        step = np.arange(60) % 3 - 1
        return np.concatenate([first, first + way + step[:, None] * (way != 0)]) / steps, 3.0

    return recipe


def _queries_between_sites(dtype: np.dtype, dim: int) -> Parts:
    sites = _sites(dim)
    return sites, 1.5, sites[::3] + np.eye(dim)[0] / 2


def _lattice_in_dtype(dtype: np.dtype, dim: int) -> Parts:
    spacing = dtype.type(1e-4)
    return _sites(dim).astype(dtype) * spacing, float(dtype.type(3) * spacing)


def _integers(squared_cutoff: int) -> Recipe:
    return lambda dtype, dim: (_sites(dim) - 4, float(np.sqrt(squared_cutoff)))


def _at_rounded_cutoff(cutoff: float) -> Recipe:
    def recipe(dtype: np.dtype, dim: int) -> Parts:
        points = np.zeros((50, 3, dim))
        points[..., 0] = float(dtype.type(cutoff)) * np.array([-1, 0, 1])
        points[..., 1] = np.arange(50)[:, None] - 20
        return points.reshape(-1, dim), cutoff

    return recipe


def _ulp_pairs(cutoff: float, base: adversarial.Draw, seed: int) -> Recipe:
    return lambda dtype, dim: adversarial.ulp_pairs(dtype, dim, cutoff=cutoff, base=base, seed=seed)


def _one_far_axis(rng: np.random.Generator, dim: int) -> NDArray[np.float64]:
    return rng.uniform(-1, 1, dim) + rng.permutation(np.eye(dim)[0]) * rng.choice([-1e4, 1e4])


def _cell_edges(cutoff: float, multiples: Iterable[int]) -> Recipe:
    return lambda dtype, dim: adversarial.cell_edges(dtype, dim, cutoff=cutoff, multiples=sorted(multiples))


_SMALL_MULTIPLES = {1, 2, -2, 1000, -1000, *np.random.default_rng(3).integers(-999, 1000, 80).tolist()} - {0, -1}
_LARGE_MULTIPLES = [sign * k + d for k in (10**5, 10**6) for sign in (-1, 1) for d in range(-6, 7)]


def _split_by_cells(origin: float, cutoff: float) -> Recipe:
    return lambda dtype, dim: adversarial.split_by_cells(dtype, dim, origin=origin, cutoff=cutoff)


def _residues(dtype: np.dtype, dim: int) -> Parts:
    sizes = [2.0**-30, 2.0**-60, 2.0**-100, float(np.finfo(dtype).tiny)]
    return adversarial.residues(dtype, dim, sizes=sizes)


def _denormal_residues(dtype: np.dtype, dim: int) -> Parts:
    info = np.finfo(dtype)
    return adversarial.residues(dtype, dim, sizes=[float(info.smallest_subnormal), float(info.tiny) / 8])


def _denormal_lattice(dtype: np.dtype, dim: int) -> Parts:
    step = float(np.finfo(dtype).smallest_subnormal)
    return (_sites(dim) - 4) * step, 3 * step


def _mixed_exponents(dtype: np.dtype, dim: int) -> Parts:
    rng = np.random.default_rng(31)
    points = rng.choice([-1.0, 1.0], (300, dim)) * 10.0 ** rng.uniform(-30, 5, (300, dim))
    points[:60, 0] = np.tile([-1.0, 0.0, 1.0], 20)
    return points, 1.0


def _far(offset: float) -> Recipe:
    signs = np.array([1, -1, 1])
    return lambda dtype, dim: (_cube(400, dim, 41, 0, 6) + offset * signs[:dim], 1.0)


def _negative_zeros(dtype: np.dtype, dim: int) -> Parts:
    values = [np.array([-1.0, -0.0, 0.0, 1.0])] * dim
    return np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, dim), 1.0


def _around_zero(dtype: np.dtype, dim: int) -> Parts:
    points = _cube(300, dim, 43, -2.5, 2.5)
    points[::3] = np.rint(points[::3])
    points[1::3] *= 1e-3
    return points, 1.0


def _some_coincident(dtype: np.dtype, dim: int) -> Parts:
    places = _cube(100, dim, 47, -3, 3)
    return places[np.random.default_rng(48).integers(0, 100, 300)], 1.0


def _blobs(*places: tuple[float, float, float], n: int = 100, size: float = 3.0) -> Recipe:
    def recipe(dtype: np.dtype, dim: int) -> Parts:
        blob = _cube(n, dim, 53, 0, size)
        return np.concatenate([blob + np.array(place[:dim]) for place in places]), 1.0

    return recipe


def _clump_and(far: Callable[[np.dtype, int], NDArray[np.float64]]) -> Recipe:
    return lambda dtype, dim: (np.concatenate([_cube(150, dim, 59, -1, 1), far(dtype, dim)]), 1.0)


def _largest(dtype: np.dtype, dim: int) -> NDArray[np.float64]:
    corners = np.concatenate([np.eye(dim), -np.eye(dim), np.ones((1, dim)), -np.ones((1, dim))])
    return corners * float(np.finfo(dtype).max)


def _filament(dtype: np.dtype, dim: int) -> Parts:
    stations = np.repeat(np.arange(300) * 5.0, 2)[:, None] * np.ones(dim)
    stations[1::2] += _cube(300, dim, 61, 0.35, 0.65)
    return stations, 1.0


def _sheet(dtype: np.dtype, dim: int) -> Parts:
    points = _cube(600, dim, 67, -12 if dim == 3 else -100, 12 if dim == 3 else 100)
    points[:, -1] *= 1e-4
    return points, 1.0


def _near_max(dtype: np.dtype, dim: int) -> Parts:
    largest = float(np.finfo(dtype).max)
    return _cube(200, dim, 71, -0.99, 0.99) * largest, 0.35 * largest


def _clumps_near_max(dtype: np.dtype, dim: int) -> Parts:
    """Return clumps at the ends of the float range, and the cutoff a millionth of it: half a stencil lies beyond."""
    largest = float(np.finfo(dtype).max)
    corners = np.array([[-1.0, -1.0, -1.0], [1.0, -1.0, 1.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])[:, :dim]
    points = np.repeat(corners, 25, axis=0) * (1 - 1e-6 * np.random.default_rng(79).random((100, dim)))
    return (points * largest).astype(dtype), 4e-7 * largest


def _tiny_scale(dtype: np.dtype, dim: int) -> Parts:
    scale = 1e-25 if dtype == np.float32 else 1e-200
    return _cube(300, dim, 73, -0.3, 0.3) * scale, 0.1 * scale


def _counted(n: int) -> Recipe:
    return lambda dtype, dim: (_cube(n, dim, 80) * 0.6 * n ** (1 / dim), 1.0)


def _uniform(dtype: np.dtype, dim: int) -> Parts:
    return _cube(2000, dim, 83), 0.13 if dim == 3 else 0.06


def _jittered(dtype: np.dtype, dim: int) -> Parts:
    sites = _sites(dim)
    return 1e-4 * (sites + np.random.default_rng(89).normal(0, 0.2, sites.shape)), 3e-4


def _uneven(dtype: np.dtype, dim: int) -> Parts:
    """Let distances from the center span five decades: from hundreds of neighbors down to none."""
    rng = np.random.default_rng(97)
    directions = rng.normal(size=(600, dim))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * 10.0 ** rng.uniform(-2, 3, (600, 1)), 1.0


def _empty_slab(dtype: np.dtype, dim: int) -> Parts:
    cutoff = 1e-5
    points = _cube(600, dim, 101)
    points[:, -1] *= 0.01
    points[1::2] = points[::2] + np.random.default_rng(102).uniform(-0.8, 0.8, (300, dim)) * cutoff
    return points, cutoff


def _queried(sources: int, queries: int, low: float = -0.2, high: float = 1.2) -> Recipe:
    return lambda dtype, dim: (_cube(sources, dim, 103), 0.2, _cube(queries, dim, 104, low, high))


def _queries_just_outside(dtype: np.dtype, dim: int) -> Parts:
    """Query from all around the bounding box, at half a cutoff, one cutoff and two cutoffs from it."""
    corners = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    rings = [0.5 + corners * (0.5 + 0.25 * away) for away in (0.5, 1.0, 2.0)]
    sources = np.concatenate([_cube(200, dim, 107), 0.5 + 0.5 * corners])
    return sources, 0.25, np.concatenate(rings)


def _queries_far_outside(dtype: np.dtype, dim: int) -> Parts:
    away = [1e3, 1e6, 1e12, 1e30, float(np.finfo(dtype).max)]
    queries = np.concatenate([sign * distance * np.eye(dim) for distance in away for sign in (-1, 1)])
    return _cube(200, dim, 109), 0.25, np.concatenate([queries, np.full((1, dim), 0.5)])


def _queries_coincident(dtype: np.dtype, dim: int) -> Parts:
    sources = np.repeat(_cube(100, dim, 113), 2, axis=0)
    return sources, 0.2, sources[::-3]


_SCALES = (("1e-4", 1e-4), ("1", 1.0), ("1e6", 1e6))
_OFFSETS = (("0", 0.0), ("-3", -3.0), ("1e4", 1e4))

_TABLE = (
    *[
        _case(f"lattice_{scale}_at_{offset}", "dozens of sites at the cutoff but for rounding", _lattice(dx, start))
        for scale, dx in _SCALES
        for offset, start in _OFFSETS
    ],
    _case("lattice_1e-4_at_1e4dx", "the lattice loses digits to its offset, spacings become uneven", _lattice(1e-4, 1.0)),
    _case("lattice_1e6_at_-3e4dx", "large negative coordinates, large cutoff", _lattice(1e6, -3e10)),
    _case("lattice_in_dtype", "k * dx multiplied in the working precision", _lattice_in_dtype),
    _case("integers_2", "sqrt(2) rounds, so that d² = 2 is on one side by half an ulp", _integers(2)),
    _case("integers_3", "sqrt(3) rounds", _integers(3)),
    _case("integers_5", "sqrt(5) rounds", _integers(5)),
    _case("integers_9", "exact ties at 3: (3, 0, 0), (1, 2, 2)", _integers(9)),
    _case("integers_14", "sqrt(14) rounds, beside (1, 2, 3)", _integers(14)),
    _case("integers_25", "exact ties at 5: (5, 0, 0), (3, 4, 0)", _integers(25)),
    _case("integers_49", "exact ties at 7: (7, 0, 0), (2, 3, 6)", _integers(49)),
    _case("integers_one_off", "exact ties at 3 among integers, beside one particle that is none", _one_off_the_lattice),
    _case("grid_256", "exact ties on a grid as fine as single precision can square", _grid(256)),
    _case("grid_1024", "exact ties on a grid finer than that", _grid(1024)),
    _case("dyadic_ties", "exact ties at (1, 2, 2) * 2^-10, and one float to either side", adversarial.dyadic_ties),
    _case("cutoff_rounds_down", "float32(0.7) < 0.7: a tie only once the cutoff is rounded", _at_rounded_cutoff(0.7)),
    _case("cutoff_rounds_up", "float32(0.1) > 0.1: a tie only once the cutoff is rounded", _at_rounded_cutoff(0.1)),
    _case(
        "ulp_near_zero",
        "distances within 3 ulp of the cutoff, points near the origin",
        _ulp_pairs(0.1, lambda rng, dim: rng.uniform(-1, 1, dim), 1),
    ),
    _case(
        "ulp_negative",
        "distances within 3 ulp of the cutoff, negative coordinates",
        _ulp_pairs(0.7, lambda rng, dim: rng.uniform(-4, -1, dim), 2),
    ),
    _case(
        "ulp_away",
        "distances within 3 ulp of the cutoff, coordinates coarser than that",
        _ulp_pairs(1.0, lambda rng, dim: rng.uniform(8, 16, dim), 3),
    ),
    _case(
        "ulp_far_axis",
        "distances within 3 ulp of the cutoff, one axis 1e4 cutoffs away",
        _ulp_pairs(3e-4, _one_far_axis, 4),
    ),
    _case(
        "cell_edges",
        "floats around k * cutoff, |k| <= 1000: on either side of a cell edge",
        _cell_edges(0.1, _SMALL_MULTIPLES),
    ),
    _case(
        "cell_edges_far",
        "floats around k * cutoff, k to 1e6: a float32 is a fraction of a cell",
        _cell_edges(0.1, _LARGE_MULTIPLES),
    ),
    _case("cell_edges_denormal", "the floats around the edge at zero are denormals", _cell_edges(0.1, [-1, 0, 1])),
    _case(
        "split_by_cells",
        "cells of edge r, counted from a far corner, put pairs within r two cells apart",
        _split_by_cells(-102.437, 0.1),
    ),
    _case("split_by_cells_near", "the same, with the corner 64 cutoffs away", _split_by_cells(-21.4333, 1 / 3)),
    _case("residues", "d² differs from r² by 2^-120 and less: beyond twice the precision", _residues),
    _case("residues_denormal", "the only difference from a tie is a denormal coordinate", _denormal_residues),
    _case("residues_balanced", "residues along and across cancel, their remainder decides", adversarial.balanced_residues),
    _case("denormal_lattice", "everything is denormal, the cutoff too: flushed to zero it is one place", _denormal_lattice),
    _case("mixed_exponents", "coordinates from 1e-30 to 1e5 with cutoff 1", _mixed_exponents),
    _case("far_1e4", "1e4 cutoffs from the origin: few digits left for the distance", _far(1e4)),
    _case("far_1e6", "1e6 cutoffs from the origin: float32 knows 1/16 of a cutoff", _far(1e6)),
    _case("far_1e8", "1e8 cutoffs from the origin: a float32 step is eight cutoffs", _far(1e8)),
    _case("around_zero", "both signs: truncation is not floor", _around_zero),
    _case("negative_zeros", "-0.0 and 0.0 are one place with two bit patterns", _negative_zeros),
    _case("all_coincident", "every distance is zero, every row full", lambda dtype, dim: (np.full((200, dim), 0.3), 1.0)),
    _case("some_coincident", "several particles in one place are each other's neighbors", _some_coincident),
    _case(
        "one_cell",
        "everything within a hundredth of the cutoff: one row of one cell",
        _blobs((5, 5, 5), n=300, size=0.01),
    ),
    _case(
        "clump_and_outlier",
        "one point 1e6 cutoffs away spans a huge box",
        _clump_and(lambda dtype, dim: np.full((1, dim), 1e6)),
    ),
    _case("clump_and_largest", "single points at the largest float, differences overflow", _clump_and(_largest)),
    _case("two_blobs_1e6", "1e18 cells between two blobs", _blobs((0, 0, 0), (1e6, 1e6, 1e6))),
    _case("two_blobs_1e12", "cell indices beyond int32", _blobs((0, 0, 0), (1e12, 0, 0))),
    _case(
        "three_blobs_1e12",
        "cell indices beyond int32 on two axes, of both signs",
        _blobs((0, 0, 0), (1e12, 0, 0), (0, -1e12, 0)),
    ),
    _case("filament", "a diagonal with gaps: no axis can be compressed", _filament),
    _case("sheet", "one layer of cells", _sheet),
    _case("near_max", "differences and squares overflow", _near_max),
    _case("clumps_near_max", "what a cutoff reaches from the largest floats is infinite", _clumps_near_max),
    _case("tiny_scale", "squares underflow to zero", _tiny_scale),
    *[_case(f"n_{n}", "edges of tiles and empty shapes", _counted(n)) for n in (0, 1, 2, 33, 65)],
    _case("no_pairs", "no two points in reach", lambda dtype, dim: (_sites(dim)[:100] * 2.0, 1.0)),
    _case("uniform", "the plain case, n = 2000", _uniform),
    _case("jittered_lattice", "what a simulation looks like", _jittered),
    _case("uneven_density", "hundreds of neighbors beside none", _uneven),
    _case("empty_slab", "1e13 cells, nearly all empty", _empty_slab),
    _case("queries_fewer", "37 queries, 200 sources", _queried(200, 37)),
    _case("queries_more", "330 queries, 41 sources", _queried(41, 330)),
    _case("queries_just_outside", "queries in cells beside the box of the sources", _queries_just_outside),
    _case(
        "queries_between_sites",
        "exact ties at (1.5, 0, 0) and (0.5, 1, 1) of queries halfway between integers",
        _queries_between_sites,
    ),
    _case("queries_far_outside", "queries whose cell indices overflow", _queries_far_outside),
    _case("queries_coincident", "distance zero is a pair, index equality means nothing", _queries_coincident),
    _case("queries_none_in_reach", "no query has a source", _queried(100, 50, 3.0, 4.0)),
    _case("no_queries", "zero rows", _queried(50, 0)),
    _case("no_sources", "rows without candidates", _queried(0, 20)),
)

HARD_CASES: dict[str, HardCase] = {case.name: case for case in _TABLE}
"""Every hard case by name."""
