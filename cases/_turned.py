"""Cubes of sites, one in each of many cubic tiles: turned, cut at an angle, or drawn apart; particles and surface stay the same."""

import math
from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ._check import fraction, positive, real, whole
from ._domain import Domain


def turned(domain: Domain, tiles: int, *, fill: float = 0.11, angle: float = 45.0) -> NDArray[np.float64]:
    """Return cubes that are turned as a whole, lattice and all, about the last axis (in 2D in the plane).

    Every angle has the same particles, the same pairs up to rounding, and the same surface: what differs is how the clusters lie
    to the axes that cells or trees are cut along. No two cubes come within a cutoff of each other, whatever the angle. At 1e-4 m,
    2, 4 and 6 tiles at 0.11 hold 27 648 points each, as many as the clusters of the thesis.

    Args:
        domain: The domain.
        tiles: Cubic tiles along the shortest axis; others have as many as fit.
        fill: Points / sites of the domain, in (0, 1], rounded to whole cubes.
        angle: Of all cubes [degrees].

    Returns:
        Positions [m], shape [n, dim], cube by cube.

    Raises:
        TypeError: `tiles` is not an integer, or another argument not a number.
        ValueError: An argument is out of range, or cubes of that fill could come within a cutoff of each other.
    """
    rotation = _plane_rotation(domain.dim, angle)
    return _placed(domain, tiles, fill, lambda _: rotation)


def tumbled(domain: Domain, tiles: int, *, fill: float = 0.11, seed: int = 0) -> NDArray[np.float64]:
    """Return the cubes of `turned`, each turned at random, uniformly over all rotations.

    Args:
        domain: The domain.
        tiles: Cubic tiles along the shortest axis; others have as many as fit.
        fill: Points / sites of the domain, in (0, 1], rounded to whole cubes.
        seed: Seed of the draw.

    Returns:
        Positions [m], shape [n, dim], cube by cube.

    Raises:
        TypeError: `tiles` or `seed` is not an integer, or `fill` not a number.
        ValueError: As for `turned`.

    Source: Stewart (1980), doi:10.1137/0717034: Q of a Gaussian matrix, signs of R's diagonal taken along, is uniform.
    """
    generator = np.random.default_rng(whole("seed", seed, 0))

    def draw(_: int) -> NDArray[np.float64]:
        q, r = np.linalg.qr(generator.standard_normal((domain.dim, domain.dim)))
        q *= np.sign(np.diag(r))
        q[:, 0] *= np.sign(np.linalg.det(q))
        return q

    return _placed(domain, tiles, fill, draw)


def cut(domain: Domain, tiles: int, *, fill: float = 0.11, angle: float = 45.0) -> NDArray[np.float64]:
    """Return sites of the lattice, which stays as it is, inside the outlines of the cubes of `turned`.

    Of each cube, those sites are taken that lie deepest in its outline, as many as the cube has: every angle has the same number of
    particles, but outlines at an angle have steps. The thesis cut its lattice so (`diagonal`).

    Args:
        domain: The domain.
        tiles: Cubic tiles along the shortest axis; others have as many as fit.
        fill: Points / sites of the domain, in (0, 1], rounded to whole cubes.
        angle: Of all outlines [degrees].

    Returns:
        Positions [m], shape [n, dim], cluster by cluster.

    Raises:
        TypeError, ValueError: As for `turned`.
    """
    counts, side = _tiling(domain, tiles, fill)
    rotation = _plane_rotation(domain.dim, angle)
    reach = math.ceil(side * math.sqrt(domain.dim) / 2) + 1
    offsets = np.array(list(product(range(-reach, side + reach), repeat=domain.dim)))
    depth = np.abs((offsets - (side - 1) / 2) @ rotation).max(axis=1).round(9)  # of equally deep ones, the first
    chosen = offsets[np.sort(np.argsort(depth, kind="stable")[: side**domain.dim])]
    widths = np.array(domain.sites) / counts
    starts = [np.floor(np.array(tile) * widths + (widths - side) / 2) for tile in product(*map(range, counts))]
    return np.concatenate([(start + chosen) * domain.spacing for start in starts])


def grown(domain: Domain, tiles: int, *, fill: float = 0.11, growth: float = 1.0) -> NDArray[np.float64]:
    """Return the cubes of `turned` at 0 degrees, drawn apart until the domain is `growth` times as large.

    Args:
        domain: The domain.
        tiles: Cubic tiles along the shortest axis; others have as many as fit.
        fill: Points / sites of the domain before it grows, in (0, 1], rounded to whole cubes.
        growth: Volume (in 2D area) of the grown domain / that of the domain, at least 1.

    Returns:
        Positions [m], shape [n, dim], cube by cube.

    Raises:
        TypeError: `tiles` is not an integer, or another argument not a number.
        ValueError: As for `turned`.
    """
    if positive("growth", growth) < 1:
        raise ValueError(f"growth must be at least 1, got {growth}: the domain grows, its particles stay.")
    return _placed(domain, tiles, fill, lambda _: np.eye(domain.dim), growth ** (1 / domain.dim))


def _placed(
    domain: Domain, tiles: int, fill: float, rotation: Callable[[int], NDArray[np.float64]], stretch: float = 1.0
) -> NDArray[np.float64]:
    """Return the cubes of all tiles, the t-th turned by `rotation(t)`, their middles stretched apart."""
    counts, side = _tiling(domain, tiles, fill)
    cube = np.stack(np.unravel_index(np.arange(side**domain.dim), (side,) * domain.dim), axis=1) - (side - 1) / 2
    middles = [(np.array(tile) + 0.5) * domain.lengths / counts for tile in product(*map(range, counts))]
    return np.concatenate([stretch * middle + domain.spacing * cube @ rotation(t).T for t, middle in enumerate(middles)])


def _tiling(domain: Domain, tiles: int, fill: float) -> tuple[NDArray[np.int64], int]:
    """Return the number of tiles along each axis, shape [dim], and the sites along an edge of a cube."""
    whole("tiles", tiles, 1)
    shortest = min(domain.lengths)
    counts = np.array([max(1, math.floor(tiles * length / shortest + 1e-9)) for length in domain.lengths])
    ideal = (fraction("fill", fill) * domain.size / counts.prod()) ** (1 / domain.dim)
    side = max(1, math.floor(ideal + 0.5))
    width = shortest / tiles / domain.spacing
    if (side - 1) * math.sqrt(domain.dim) + domain.cutoff_ratio > width:
        edge = max(1, math.floor((width - domain.cutoff_ratio) / math.sqrt(domain.dim)) + 1)
        most = edge**domain.dim * counts.prod() / domain.size
        raise ValueError(
            f"fill={fill} makes cubes of {side} sites along an edge, which could come within a cutoff of each other when they "
            f"turn in tiles of {width:.3g} sites: take {most:.2g} at most, or fewer tiles."
        )
    return counts, side


def _plane_rotation(dim: int, angle: float) -> NDArray[np.float64]:
    """Return the rotation by an angle [degrees] in the plane of the first two axes, shape [dim, dim]."""
    radians = math.radians(real("angle", angle))
    rotation = np.eye(dim)
    rotation[:2, :2] = [[math.cos(radians), -math.sin(radians)], [math.sin(radians), math.cos(radians)]]
    return rotation
