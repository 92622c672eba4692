"""Layouts beyond the thesis: random, jitter, two-blobs, clump, sheet, filament."""

import math
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from ._check import fraction, positive, whole
from ._domain import Domain
from ._thesis import clusters, lowest, nearest, tile_sites


def random(domain: Domain, *, fill: float | None = None, n: int | None = None, seed: int = 0) -> NDArray[np.float64]:
    """Return points drawn uniformly from the domain.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1]; left out, 0.11.
        n: Number of points, instead of `fill`.
        seed: Seed of the draw.

    Returns:
        Positions [m], shape [n, dim], in the order of the draw.

    Raises:
        TypeError: An argument is not a number, or `n` or `seed` not an integer.
        ValueError: An argument is out of range, or both `fill` and `n` are given.
    """
    points = _point_count(domain, fill, n)
    return _generator(seed).random((points, domain.dim)) * domain.lengths


def jitter(domain: Domain, *, fill: float = 0.11, amplitude: float = 0.5, seed: int = 0) -> NDArray[np.float64]:
    """Return a box of sites in the middle of the domain, each displaced at random.

    The box takes fill^(1/dim) of every axis, rounded to the nearest site. A displacement is uniform in
    [0, amplitude · spacing) along each axis, or less where the domain ends sooner, so that points keep to the domain and to the
    cell of their site.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1], up to that rounding.
        amplitude: Largest displacement in units of the spacing, in (0, 1].
        seed: Seed of the draw.

    Returns:
        Positions [m], shape [n, dim], in the lexicographic order of their sites, x slowest.

    Raises:
        TypeError: An argument is not a number, or `seed` not an integer.
        ValueError: An argument is out of range.
    """
    positions = clusters(domain, 1, fill=fill)
    reach, room = fraction("amplitude", amplitude), np.asarray(domain.lengths) - positions
    reach = reach * np.where(room < domain.spacing * (1 - 1e-9), room, domain.spacing)
    return positions + reach * _generator(seed).random(positions.shape)


def two_blobs(
    domain: Domain, *, fill: float | None = None, n: int | None = None, separation: float = 1000.0
) -> NDArray[np.float64]:
    """Return two cubes of sites, far apart along the diagonal of space: a large box around few particles.

    The cubes face each other like mirror images and hold half of the points each, the first one more when the number
    is odd; of a cube whose sites are more than its points, those far from the other cube stay empty. The closest two
    points are those of the facing corners, `separation` cutoffs apart. The scene outgrows the domain, which only
    counts its points. In float32 positions are good to 6e-8 of the distance: beyond a separation of 1e5 the lattice
    blurs.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1]; left out, 0.11.
        n: Number of points, at least 2, instead of `fill`.
        separation: Smallest distance of a point of one blob from a point of the other, in cutoffs.

    Returns:
        Positions [m], shape [n, dim], from 0 on; the first blob before the second.

    Raises:
        TypeError: An argument is not a number, or `n` not an integer.
        ValueError: An argument is out of range, or both `fill` and `n` are given.
    """
    points = _point_count(domain, fill, n, least=2)
    first = points - points // 2
    side = math.ceil(first ** (1 / domain.dim))  # 1/3 rounds down, so the root of a perfect cube is never above it
    cube = np.stack(np.unravel_index(np.arange(first), (side,) * domain.dim), axis=1)
    gap = positive("separation", separation) * domain.cutoff / math.sqrt(domain.dim)
    upper = (cube.max(axis=0) + cube[: points // 2]) * domain.spacing + gap
    return np.concatenate([(cube.max(axis=0) - cube) * domain.spacing, upper])


def clump(
    domain: Domain, *, fill: float | None = None, n: int | None = None, density: float = 8.0, seed: int = 0
) -> NDArray[np.float64]:
    """Return a dense ball of random points in the middle of an otherwise empty domain.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1]; left out, 0.11.
        n: Number of points, instead of `fill`.
        density: Points in the volume of one lattice site. A point has about density · (4/3)π · cutoff_ratio³
            neighbors: some 900 at 8 points per site.
        seed: Seed of the draw.

    Returns:
        Positions [m], shape [n, dim], uniform in the ball, in the order of the draw.

    Raises:
        TypeError: An argument is not a number, or `n` or `seed` not an integer.
        ValueError: An argument is out of range, both `fill` and `n` are given, or the ball does not fit.
    """
    points = _point_count(domain, fill, n)
    unit_ball = math.pi if domain.dim == 2 else 4 / 3 * math.pi
    radius = domain.spacing * (points / positive("density", density) / unit_ball) ** (1 / domain.dim)
    if radius > min(domain.lengths) / 2:
        raise ValueError(
            f"density={density} puts {points} points in a ball of radius {radius:.3g} m, more than half the shortest "
            f"side of the domain, {min(domain.lengths) / 2} m: raise density, or take fewer points."
        )
    generator = _generator(seed)
    rays = generator.standard_normal((points, domain.dim))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.array(domain.lengths) / 2 + radius * rays * generator.random((points, 1)) ** (1 / domain.dim)


def sheet(domain: Domain, *, fill: float = 0.11) -> NDArray[np.float64]:
    """Return whole layers of sites normal to x, in the middle of the domain.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1], rounded to the nearest layer (halves up, at least one): at
            1e-4 m, 0.02 is a single layer and 0.11 six, which are as thick as two cutoffs.

    Returns:
        Positions [m], shape [n, dim], in lexicographic order, x slowest.

    Raises:
        TypeError: `fill` is not a number.
        ValueError: `fill` is outside (0, 1].
    """
    layers = max(1, nearest(fraction("fill", fill) * domain.sites[0]))
    chosen = np.zeros(domain.sites, bool)
    chosen[tile_sites(domain.sites[0], 1, layers)] = True
    return domain.at(chosen)


def filament(domain: Domain, *, fill: float = 0.11) -> NDArray[np.float64]:
    """Return the sites of a straight thread from the first corner of the domain to the opposite one.

    A site belongs when its distance from the diagonal is at most a radius: the smallest radius that holds at least
    `fill`. A thin one (0.005 has a radius of less than two spacings) leaves most of its bounding box empty.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1], of which there will be at least that many.

    Returns:
        Positions [m], shape [n, dim], in lexicographic order, x slowest.

    Raises:
        TypeError: `fill` is not a number.
        ValueError: `fill` is outside (0, 1].
    """
    axis = np.array(domain.sites) - 1
    # twice the offset from the centre is an integer: squared distances times 4|axis|² are exact, and ties are ties
    offsets = [2 * np.arange(n) - (n - 1) for n in domain.sites]
    square = reduce(np.add.outer, [offset * offset for offset in offsets])
    along = reduce(np.add.outer, [a * offset for a, offset in zip(axis, offsets, strict=True)])
    return domain.at(lowest(square * (axis @ axis) - along * along, fraction("fill", fill)))


def _point_count(domain: Domain, fill: float | None, n: int | None, least: int = 1) -> int:
    if n is None:
        return max(least, nearest(fraction("fill", 0.11 if fill is None else fill) * domain.size))
    if fill is not None:
        raise ValueError(f"fill={fill} and n={n} both set the number of points: pass one of them.")
    return whole("n", n, least)


def _generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(whole("seed", seed, 0))
