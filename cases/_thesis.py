"""The layouts of the thesis: full, clustersN, corners, diagonal. Source: Peifle (2019), Table 6.1."""

import math
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from ._check import fraction, whole
from ._domain import Domain

DENSE_TILES = (5, 10, 20)  # the thesis fills these to 51 %, its other clusters to 11 %


def full(domain: Domain, *, fill: float = 1.0) -> NDArray[np.float64]:
    """Return every lattice site: 250 000 points at a spacing of 1e-4 m.

    Args:
        domain: The domain.
        fill: 1, the only fill of a full domain; here so that every layout of the thesis is called alike.

    Returns:
        Positions [m], shape [n, dim], in lexicographic order, x slowest.

    Raises:
        ValueError: `fill` is not 1.
    """
    if fraction("fill", fill) != 1:
        raise ValueError(f"fill must be 1 for the layout 'full', got {fill}: leave it out, or take another layout.")
    return domain.at(np.ones(domain.sites, bool))


def clusters(domain: Domain, tiles: int, *, fill: float | None = None) -> NDArray[np.float64]:
    """Return boxes of sites, one centred in each of tiles^dim equal tiles of the domain.

    All clusters together hold round(fill^(1/dim) · sites) sites along an axis (halves up), at least one each, spread
    over the tiles as evenly as integers allow. A fill of 0.11 gives the 27 648 points of the thesis for 2, 4 and 6
    tiles per axis, 0.51 its 128 000 for 5, 10 and 20; a fill of 1 is the full lattice. Below one site per cluster
    the fill cannot fall. Where tiles are not a whole number of sites, boxes sit at whole sites and may touch: of 20
    clusters over 50 sites at 0.51, every other pair does.

    Args:
        domain: The domain.
        tiles: Number of tiles along each axis.
        fill: Points / sites of the domain, in (0, 1]; left out, 0.51 for 5, 10 and 20 tiles and 0.11 for others.

    Returns:
        Positions [m], shape [n, dim], in lexicographic order, x slowest.

    Raises:
        TypeError: `tiles` is not an integer, or `fill` not a number.
        ValueError: `fill` is outside (0, 1], or the lattice has fewer sites than tiles along an axis.
    """
    whole("tiles", tiles, 1)
    if tiles > min(domain.sites):
        raise ValueError(
            f"tiles must not exceed the {min(domain.sites)} lattice sites along the shortest axis, got {tiles}: "
            "take fewer clusters or a smaller spacing."
        )
    share = fraction("fill", (0.51 if tiles in DENSE_TILES else 0.11) if fill is None else fill)
    share **= 1 / domain.dim
    chosen = np.zeros(domain.sites, bool)
    chosen[np.ix_(*(tile_sites(n, tiles, max(nearest(share * n), tiles)) for n in domain.sites))] = True
    return domain.at(chosen)


def corners(domain: Domain, *, fill: float = 0.11) -> NDArray[np.float64]:
    """Return two equal boxes in opposite corners: at the origin and at the far end of every axis.

    Both boxes take the same share p of every axis, rounded to the nearest site (halves up, at least one), where p
    solves 2·p^d - max(0, 2p - 1)^d = f: the share of the domain that they cover, their overlap counted once.
    The thesis names a scene by its percentage rounded down, and its corners hold 2.9, 11.3 and 14.8 %. To meet these
    counts, f lies above `fill` by (1 - fill)²·min(0.01, 25·fill²): at most one percent of the domain, and vanishing
    towards both ends. So 0.02, 0.11 and 0.14 give 7 200, 28 158 and 37 044 points at a spacing of 1e-4 m.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1], up to the rounding above.

    Returns:
        Positions [m], shape [n, dim], in lexicographic order, x slowest.

    Raises:
        TypeError: `fill` is not a number.
        ValueError: `fill` is outside (0, 1].
    """
    fraction("fill", fill)
    share = _corner_share(fill + (1 - fill) ** 2 * min(0.01, 25 * fill**2), domain.dim)
    sizes = [max(1, nearest(share * n)) for n in domain.sites]
    chosen = np.zeros(domain.sites, bool)
    chosen[tuple(slice(size) for size in sizes)] = True
    chosen[tuple(slice(n - size, n) for n, size in zip(domain.sites, sizes, strict=True))] = True
    return domain.at(chosen)


def diagonal(domain: Domain, *, fill: float = 0.11) -> NDArray[np.float64]:
    """Return the sites of every corner of the domain, up to planes at 45° to all axes.

    A site belongs when the sum over the axes of min(i, sites - 1 - i) is below a limit: the smallest limit that
    holds at least `fill`. For 0.11 at a spacing of 1e-4 m the limit is 27 and the points are 29 168. The thesis has
    29 424, and does not say how it cut.

    Args:
        domain: The domain.
        fill: Points / sites of the domain, in (0, 1], of which there will be at least that many.

    Returns:
        Positions [m], shape [n, dim], in lexicographic order, x slowest.

    Raises:
        TypeError: `fill` is not a number.
        ValueError: `fill` is outside (0, 1].
    """
    depths = (np.minimum(np.arange(n), n - 1 - np.arange(n)) for n in domain.sites)
    return domain.at(lowest(reduce(np.add.outer, depths), fraction("fill", fill)))


def nearest(value: float) -> int:
    """Return the nearest integer of a value that is not negative, halves up."""
    return math.floor(value + 0.5)


def lowest(measure: NDArray[np.int64], fill: float) -> NDArray[np.bool_]:
    """Choose the sites of the smallest measure, at least the share `fill` of all, together with all their ties."""
    need = math.ceil(fill * measure.size * (1 - 1e-12))  # 1e-12: a product that rounds upwards must not ask for more
    return measure <= np.partition(measure, need - 1, axis=None)[need - 1]


def tile_sites(n: int, tiles: int, total: int) -> NDArray[np.int64]:
    """Return the sites of one axis that lie in a cluster.

    Tile t owns the sites from floor(t·n / tiles) on. Every tile gets floor(total / tiles) sites around its middle,
    and the rest goes, one by one and evenly spread, to tiles that have a free site left: there are always enough.

    Args:
        n: Number of sites along the axis.
        tiles: Number of tiles, at most `n`.
        total: Number of sites to return, in [tiles, n].

    Returns:
        Site indices, ascending, shape [total].
    """
    edges = np.arange(tiles + 1) * n // tiles
    widths = np.diff(edges)
    sizes = np.full(tiles, total // tiles)
    free = np.flatnonzero(widths > sizes)
    rest = total % tiles
    sizes[free[np.arange(rest) * len(free) // max(rest, 1)]] += 1
    starts = edges[:-1] + (widths - sizes) // 2
    return np.concatenate([np.arange(start, start + size) for start, size in zip(starts, sizes, strict=True)])


def _corner_share(cover: float, dim: int) -> float:
    """Solve 2·p^dim - max(0, 2p - 1)^dim = cover for p in [0, 1]; the left side rises with p, so bisection finds it."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        if 2 * middle**dim - max(0.0, 2 * middle - 1) ** dim < cover:
            low = middle
        else:
            high = middle
    return high
