"""Points placed by exact arithmetic where rounding decides wrongly: at the cutoff, cell edges, behind tiny residues."""

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import product

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.floating]
Cloud = tuple[Points, float]
"""Positions [n, dim] and the cutoff."""
Draw = Callable[[np.random.Generator, int], NDArray[np.float64]]


def exact(value: float | np.floating) -> Fraction:
    """Return a float as the fraction that it is."""
    return Fraction(float(value))


def nearest(value: Fraction, dtype: np.dtype) -> np.floating:
    """Round a fraction to the dtype: exactly to float64, and from there once more for float32."""
    return dtype.type(float(value))


def root_below(value: Fraction, dtype: np.dtype) -> np.floating:
    """Return the largest float of the dtype whose square does not exceed a value >= 0."""
    root = dtype.type(math.sqrt(value))
    while exact(root) ** 2 > value:
        root = np.nextafter(root, dtype.type(0))
    while exact(above := np.nextafter(root, dtype.type(np.inf))) ** 2 <= value:
        root = above
    return root


def neighbors_of(value: np.floating, steps: int = 1) -> list[np.floating]:
    """Return the floats from `steps` below a value to `steps` above it."""
    below, above = [value], [value]
    for _ in range(steps):
        below.append(np.nextafter(below[-1], value.dtype.type(-np.inf)))
        above.append(np.nextafter(above[-1], value.dtype.type(np.inf)))
    return below[:0:-1] + above


def ulp_pairs(dtype: np.dtype, dim: int, *, cutoff: float, base: Draw, seed: int, repeats: int = 20) -> Cloud:
    """Pair random points with partners at less than 1, 2 and 3 ulp of the cutoff from it, on both sides.

    Args:
        dtype: float32 or float64.
        dim: 2 or 3.
        cutoff: Cutoff; the ulp is that of its value in the dtype.
        base: Draws a base point [dim] in units of the cutoff.
        seed: Of the random numbers.
        repeats: Pairs for each of the six shells.

    Returns:
        Positions [12 * repeats, dim], points 2k and 2k + 1 being a pair, and the cutoff.
    """
    rng = np.random.default_rng(seed)
    radius = exact(dtype.type(cutoff))
    ulp = exact(np.spacing(dtype.type(cutoff)))
    shells = [(radius + k * ulp, radius + (k + 1) * ulp) for k in (-3, -2, -1, 0, 1, 2)]
    points: list[Points] = []
    for inner, outer in shells * repeats:
        points += _pair_in_shell(rng, lambda: (base(rng, dim) * cutoff).astype(dtype), inner, outer)
    return np.array(points, dtype), cutoff


def _pair_in_shell(rng: np.random.Generator, draw: Callable[[], Points], inner: Fraction, outer: Fraction) -> list[Points]:
    """Draw points until one has a partner at a distance strictly between `inner` and `outer`.

    All but one of the partner's coordinates follow a random direction; the last one is solved for. That is the axis
    where the base point is nearest to zero, because floats are densest there.
    """
    middle = (inner + outer) / 2
    while True:
        start = draw()
        direction = rng.normal(size=len(start))
        end = (start + float(middle) * direction / np.linalg.norm(direction)).astype(start.dtype)
        axis = int(np.argmin(np.abs(start)))
        end[axis] = start[axis]
        rest = middle**2 - squared_distance(start, end)
        if rest > 0:
            step = Fraction(math.copysign(math.sqrt(rest), direction[axis]))
            for value in neighbors_of(nearest(exact(start[axis]) + step, start.dtype)):
                end[axis] = value
                if inner**2 < squared_distance(start, end) < outer**2:
                    return [start, end]


def squared_distance(a: Points, b: Points) -> Fraction:
    """Return |b - a|² without rounding."""
    return sum(((exact(y) - exact(x)) ** 2 for x, y in zip(a, b, strict=True)), Fraction(0))


def dyadic_ties(dtype: np.dtype, dim: int) -> Cloud:
    """Pair points at exactly the cutoff along (1, 2, 2) or (3, 4), each partner also one float to either side."""
    rng = np.random.default_rng(11)
    unit = 2.0**-10
    triple, length = ((1, 2, 2), 3) if dim == 3 else ((3, 4), 5)
    points = []
    for _ in range(120):
        start = (rng.integers(-4000, 4000, dim) * unit).astype(dtype)
        end = (start + unit * rng.permutation(triple) * rng.choice([-1, 1], dim)).astype(dtype)
        axis = np.argmax(np.abs(end))  # not at zero, whose neighbors are denormals
        points.append(start)
        for value in neighbors_of(end[axis]):
            points.append(end.copy())
            points[-1][axis] = value
    return np.array(points, dtype), length * unit


def cell_edges(dtype: np.dtype, dim: int, *, cutoff: float, multiples: Sequence[int]) -> Cloud:
    """Put the three floats around k·cutoff and those around k·cutoff + cutoff on an axis, the next axis for each k."""
    radius = exact(dtype.type(cutoff))
    points = []
    for turn, k in enumerate(multiples):
        edge = nearest(k * radius, dtype)
        for value in neighbors_of(edge) + neighbors_of(nearest(exact(edge) + radius, dtype)):
            points.append(np.zeros(dim, dtype))
            points[-1][turn % dim] = value
    return np.array(points, dtype), cutoff


def split_by_cells(dtype: np.dtype, dim: int, *, origin: float, cutoff: float, pairs: int = 150) -> Cloud:
    """Pair points within the cutoff that cells of edge exactly the cutoff put two cells apart.

    The first point is the smallest corner of all, x0. Then come pairs: |x_b - x_a| < r holds exactly, but on one axis
    floor((x - x0) / r) in the working precision differs by 2; of the second half, floor(x * (1 / r) - x0 * (1 / r)).
    """
    rng = np.random.default_rng(5)
    x0, radius = dtype.type(origin), dtype.type(cutoff)
    inverse = dtype.type(1) / radius
    found = _split_pairs(rng, lambda x: np.floor((x - x0) / radius), x0, radius)[: pairs // 2]
    found += _split_pairs(rng, lambda x: np.floor(x * inverse - x0 * inverse), x0, radius)[: pairs // 2]
    points = np.empty((1 + 2 * len(found), dim), dtype)
    points[0] = x0
    for start, pair in zip(range(1, len(points), 2), found, strict=True):
        points[start : start + 2] = x0 + radius * dtype.type(rng.integers(0, 4000))
        points[start : start + 2, rng.integers(dim)] = pair
    return points, cutoff


def _split_pairs(rng: np.random.Generator, cell: Callable[[Points], Points], x0: np.floating, radius: np.floating) -> list[Points]:
    """Search near cell edges for coordinates less than `radius` apart whose cells differ by two."""
    # near zero, where x has digits that x - x0 loses; best with -x0 / r near a power of two, where spacings change
    steps = rng.integers(-3, 4, 50_000) + round(float(-x0 / radius))
    edge = x0 + steps.astype(x0.dtype) * radius
    lost = np.spacing(edge - x0)
    low = edge + 2 * lost * rng.uniform(-1, 1, len(edge)).astype(x0.dtype)
    high = low + (radius - lost * rng.uniform(0, 1, len(edge)).astype(x0.dtype))
    split = (cell(high) - cell(low) == 2) & (low > x0)
    return [np.array(pair) for pair in zip(low[split], high[split], strict=True) if exact(pair[1]) - exact(pair[0]) < exact(radius)]


def residues(dtype: np.dtype, dim: int, *, sizes: Sequence[float]) -> Cloud:
    """Put unit vectors, and those an ulp shorter or longer, beside points at tiny residues from them or from the origin.

    The cutoff is 1. A residue across a unit vector makes d² = 1 + residue²: no pair, not even with `closed`. A residue
    along it makes d = 1 - residue: a pair. Where the residue is rounded away, both are ties.
    """
    axes = np.eye(dim, dtype=dtype)
    eps = np.finfo(dtype).eps
    points = [np.zeros(dim, dtype)]
    for axis, sign in product(range(dim), (-1, 1)):
        ends = [sign * axes[axis] * dtype.type(length) for length in (1, 1 - eps / 2, 1 + eps)]
        points += ends
        for size in sizes:
            across = axes[(axis + 1) % dim] * dtype.type(size)
            points += [end + across for end in ends] + [sign * axes[axis] * dtype.type(size)]
    return np.array(points, dtype), 1.0


def balanced_residues(dtype: np.dtype, dim: int) -> Cloud:
    """Let residues along and across a unit vector cancel, so that d² is 1 but for a tiny remainder of either sign.

    With a = (u, 0, 0) and b = (1, y, z) it is d² - 1 = u² - 2u + y² + z². For small random u the floats y and z are
    solved one after the other, the last one rounded down (a pair) and up (none). The cutoff is 1. Points come in
    threes: a, b with a pair, b without.
    """
    rng = np.random.default_rng(23)
    points = []
    for power in np.linspace(16, 70, 30):
        start = np.zeros(dim, dtype)
        start[0] = dtype.type(2.0 ** -(power + rng.random()))
        rest = 1 - (1 - exact(start[0])) ** 2
        end = np.zeros(dim, dtype)
        end[0] = 1
        for axis in range(1, dim):
            end[axis] = root_below(rest, dtype)
            rest -= exact(end[axis]) ** 2
        beyond = end.copy()
        beyond[-1] = np.nextafter(end[-1], dtype.type(np.inf))
        points += [start, end, beyond]
    return np.array(points, dtype), 1.0


def shifted(shift: Sequence[int], rows: Points) -> list[Fraction]:
    """Return the sum of so many lattice vectors, the rows, without rounding."""
    steps = [[int(s) * exact(value) for value in row] for s, row in zip(shift, rows, strict=True)]
    return [sum(column, Fraction(0)) for column in zip(*steps, strict=True)]


def _shift_across(rng: np.random.Generator, end: Points, rows: Points, periodic: Sequence[bool], turns: int) -> NDArray[np.int64]:
    """Return the cell that a point lies in, along periodic axes, moved by up to `turns` lattice vectors more."""
    cell = np.floor(np.linalg.solve(rows.T.astype(np.float64), end)).astype(np.int64)
    return (cell + rng.integers(-turns, turns + 1, len(end))) * np.array(periodic)


def ulp_images(
    dtype: np.dtype,
    dim: int,
    *,
    cutoff: float,
    rows: Points,
    periodic: Sequence[bool],
    turns: int,
    seed: int,
    repeats: int,
) -> Points:
    """Pair random points of the cell with images at less than 1, 2 and 3 ulp of the cutoff from them, on both sides.

    Args:
        dtype: float32 or float64.
        dim: 2 or 3.
        cutoff: Cutoff; the ulp is that of its value in the dtype.
        rows: Lattice vectors of that dtype, shape [dim, dim].
        periodic: One per lattice vector.
        turns: Partners lie in the cell, or up to so many lattice vectors from it.
        seed: Of the random numbers.
        repeats: Pairs for each of the six shells.

    Returns:
        Positions [12 * repeats, dim], points 2k and 2k + 1 being a pair through at least one face.
    """
    rng = np.random.default_rng(seed)
    radius = exact(dtype.type(cutoff))
    ulp = exact(np.spacing(dtype.type(cutoff)))
    points: list[Points] = []
    for k in [-3, -2, -1, 0, 1, 2] * repeats:
        points += _image_in_shell(rng, dtype, rows, periodic, turns, radius + k * ulp, radius + (k + 1) * ulp)
    return np.array(points, dtype)


def _image_in_shell(
    rng: np.random.Generator,
    dtype: np.dtype,
    rows: Points,
    periodic: Sequence[bool],
    turns: int,
    inner: Fraction,
    outer: Fraction,
) -> list[Points]:
    """Draw points until one has an image of another at a distance strictly between `inner` and `outer`.

    As in `_pair_in_shell`: one coordinate of the other point is solved for, that which is nearest to zero.
    """
    middle = (inner + outer) / 2
    while True:
        start = (rng.uniform(0, 1, len(rows)) @ rows).astype(dtype)
        direction = rng.normal(size=len(start))
        end = start + float(middle) * direction / np.linalg.norm(direction)
        shift = _shift_across(rng, end, rows, periodic, turns)
        if not shift.any():
            continue
        offset = shifted(shift.tolist(), rows)
        end = (end - np.array(offset, np.float64)).astype(dtype)
        axis = int(np.argmin(np.abs(end)))
        apart = [exact(b) - exact(a) + o for a, b, o in zip(start, end, offset, strict=True)]
        rest = middle**2 - sum(v**2 for k, v in enumerate(apart) if k != axis)
        if rest > 0:
            step = Fraction(math.copysign(math.sqrt(rest), direction[axis]))
            for value in neighbors_of(nearest(exact(start[axis]) + step - offset[axis], dtype)):
                end[axis] = value
                apart[axis] = exact(value) - exact(start[axis]) + offset[axis]
                if inner**2 < sum(v**2 for v in apart) < outer**2:
                    return [start, end]


def dyadic_image_ties(dtype: np.dtype, dim: int, rows: Points, turns: int) -> Cloud:
    """Pair points with images at exactly the cutoff along (1, 2, 2) or (3, 4), and one float to either side.

    Args:
        dtype: float32 or float64.
        dim: 2 or 3.
        rows: Lattice vectors, shape [dim, dim], multiples of 1/8 below 16.
        turns: Partners lie in the cell, or up to so many lattice vectors from it.

    Returns:
        Positions [160, dim] in groups of four, a point and its three partners through at least one face, and the cutoff.
    """
    rng = np.random.default_rng(29)
    triple, length = ((1, 2, 2), 3) if dim == 3 else ((3, 4), 5)
    points: list[Points] = []
    while len(points) < 160:
        start = np.rint(rng.uniform(0, 1, dim) @ rows * 256) / 256
        end = start + 0.25 * rng.permutation(triple) * rng.choice([-1, 1], dim)
        shift = _shift_across(rng, end, rows, [True] * dim, turns)
        if shift.any():
            end = (end - shift @ rows).astype(dtype)
            axis = np.argmax(np.abs(end))  # not at zero, whose neighbors are denormals
            points.append(start)
            for value in neighbors_of(end[axis]):
                points.append(end.copy())
                points[-1][axis] = value
    return np.array(points, dtype), 0.25 * length


def turned(points: Points, length: float, turns: int) -> Points:
    """Move each coordinate by up to `turns` lengths, up or down, where the sum is exact."""
    rng = np.random.default_rng(37)
    moves = rng.integers(-turns, turns + 1, points.shape) * length
    moved = points.copy()
    for at in np.ndindex(points.shape):
        here, move = float(points[at]), float(moves[at])
        there = points.dtype.type(points.dtype.type(here) + points.dtype.type(move))
        if exact(there) == exact(here) + exact(move):
            moved[at] = there
    return moved
