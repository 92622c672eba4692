"""Inputs that searches in periodic boxes get wrong: images, faces, skewed cells, positions outside, mixed periodicity.

>>> import numpy as np
>>> given = PERIODIC_CASES["thin_slab"].build(np.float32, 3)
>>> given.positions.shape, given.positions.dtype, given.cutoff, given.matrix.tolist(), given.periodic, given.queries
((80, 3), dtype('float32'), 1.0, [6.5, 0.625, 7.25], (True, True, True), None)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from . import _adversarial as adversarial

Points = NDArray[np.floating]
Axes = tuple[bool, bool, bool]
Parts = tuple[Points, float, ArrayLike, Axes] | tuple[Points, float, ArrayLike, Axes, Points]
Recipe = Callable[[np.dtype, int], Parts]
Count = int | tuple[int, int]
"""Of points; if it differs, in 2D and in 3D."""


@dataclass(frozen=True)
class PeriodicInput:
    """What a search in a periodic box is given.

    Attributes:
        positions: Sources, shape [n, dim], anywhere; finite but for the cases named nonfinite.
        cutoff: Positive, as a caller writes it: a search rounds it once to the dtype of positions.
        matrix: Of that dtype: lattice vectors as rows, shape [dim, dim], or the lengths of an orthogonal box, shape [dim].
        periodic: One per lattice vector.
        queries: Shape [m, dim], same dtype; None: the positions ask for each other.
    """

    positions: Points
    cutoff: float
    matrix: Points
    periodic: tuple[bool, ...]
    queries: Points | None = None


@dataclass(frozen=True)
class PeriodicCase:
    """A named input and what is hard about it.

    Attributes:
        name: Its key in `PERIODIC_CASES`.
        mechanism: Why it is hard, in one line.
        build: Makes the input for a dtype (float32 or float64) and a dimension (2 or 3). Same arguments, same input.
    """

    name: str
    mechanism: str
    build: Callable[[DTypeLike, int], PeriodicInput]


def _case(name: str, mechanism: str, recipe: Recipe) -> PeriodicCase:
    def build(dtype: DTypeLike, dim: int) -> PeriodicInput:
        kind = np.dtype(dtype)
        if kind not in (np.float32, np.float64) or dim not in (2, 3):
            raise ValueError(f"a periodic case is float32 or float64, in 2 or 3 dimensions: got {kind}, {dim}")
        positions, cutoff, matrix, periodic, *queries = recipe(kind, dim)
        # rounded here and once, where a recipe has computed in float64
        return PeriodicInput(
            positions.astype(kind),
            cutoff,
            _leading(matrix, dim).astype(kind),
            periodic[:dim],
            queries[0].astype(kind) if queries else None,
        )

    return PeriodicCase(name, mechanism, build)


def _leading(matrix: ArrayLike, dim: int) -> Points:
    """Return the box of the first `dim` axes."""
    values = np.asarray(matrix)
    return values[:dim, :dim] if values.ndim == 2 else values[:dim]


def _rows(matrix: ArrayLike, dim: int) -> Points:
    """Return the lattice vectors as rows, lengths on the diagonal."""
    box = _leading(matrix, dim)
    return box if box.ndim == 2 else np.diag(box)


def _grid(shape: Sequence[int]) -> NDArray[np.float64]:
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, len(shape)).astype(float)


_ALL = (True, True, True)
_WIDE = (6.5, 7.25, 6.0)
_ODD = (7.3, 5.9, 6.1)


def _axes(letters: str) -> Axes:
    x, y, z = (letter in letters for letter in "xyz")
    return x, y, z


def _filled(
    box: ArrayLike,
    *,
    n: Count = (80, 180),
    cutoff: float = 1.0,
    periodic: Axes = _ALL,
    seed: int = 1,
    low: float = 0.0,
    high: float = 1.0,
    turns: tuple[int, int] = (0, 0),
) -> Recipe:
    """Fill the cell evenly, or stretch from `low` to `high` of it, and move each point by up to `turns` lattice vectors."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        rng = np.random.default_rng(seed)
        count = n if isinstance(n, int) else n[dim - 2]
        cells = rng.uniform(low, high, (count, dim)) + rng.integers(turns[0], turns[1] + 1, (count, dim))
        return cells @ _rows(box, dim), cutoff, box, periodic

    return recipe


def _some_axes(letters: str) -> Recipe:
    """Let particles lie beyond the box on both sides along its open axes, and in it along the others."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        periodic = _axes(letters)
        cells = np.random.default_rng(2).uniform(0, 1, (150, dim))
        cells = np.where(periodic[:dim], cells, 2 * cells - 0.5)
        return cells * _leading(_ODD, dim), 1.5, _ODD, periodic

    return recipe


def _faces(near_zero: Callable[[np.dtype], list[float]]) -> Recipe:
    """Put points on every face and one float before and behind it, and beside each another half a cutoff inside the box."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        rng = np.random.default_rng(3)
        lengths = _leading(_WIDE, dim).astype(dtype)
        points = []
        for axis, length in enumerate(lengths):
            for value in [
                *adversarial.neighbors_of(length),
                *adversarial.neighbors_of(-length),
                *adversarial.neighbors_of(2 * length),
                0.0,
                -0.0,
                *near_zero(dtype),
            ]:
                points.append(rng.uniform(0, 1, dim) * lengths)
                points[-1][axis] = value
                points.append(points[-1].copy())
                points[-1][axis] = 0.5 if rng.random() < 0.5 else length - dtype.type(0.5)
        return np.array(points), 1.0, lengths, _ALL

    return recipe


def _corners(dtype: np.dtype, dim: int) -> Parts:
    lengths = _leading(_WIDE, dim).astype(dtype)
    return np.array(list(product(*([0.0, *adversarial.neighbors_of(length)] for length in lengths)))), 1.0, lengths, _ALL


def _crystal(
    spacing: float,
    *,
    cutoff: float,
    shape: Sequence[int] = (7, 6, 5),
    square: Sequence[int] = (14, 12),
    offset: float = 0.0,
    periodic: Axes = _ALL,
) -> Recipe:
    """Fill a box with a cubic lattice: `shape` sites, in 2D `square`. Offset and cutoff are in units of the spacing."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        sites = shape if dim == 3 else square
        return (_grid(sites) + offset) * spacing, cutoff * spacing, np.array(sites) * spacing, periodic

    return recipe


def _primitive(rows: ArrayLike, repeats: tuple[int, int], cutoff: float, basis: Sequence[Sequence[float]] = ((0, 0, 0),)) -> Recipe:
    """Repeat a primitive cell, whose particles have the coordinates `basis` in units of its vectors."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        vectors, times = _rows(rows, dim), repeats[dim - 2]
        cells = np.concatenate([_grid([times] * dim) + np.array(place[:dim]) for place in basis])
        return cells @ vectors, cutoff, vectors * times, _ALL

    return recipe


def _ties_across(box: ArrayLike, turns: int = 0) -> Recipe:
    return lambda dtype, dim: (*adversarial.dyadic_image_ties(dtype, dim, _rows(box, dim), turns), box, _ALL)


def _ulp_images(box: ArrayLike, cutoff: float, seed: int, *, turns: int = 0, periodic: Axes = _ALL, repeats: int = 10) -> Recipe:
    def recipe(dtype: np.dtype, dim: int) -> Parts:
        rows = _rows(box, dim).astype(dtype)
        points = adversarial.ulp_images(
            dtype, dim, cutoff=cutoff, rows=rows, periodic=periodic[:dim], turns=turns, seed=seed, repeats=repeats
        )
        return points, cutoff, box, periodic

    return recipe


def _turned(cloud: Callable[[np.dtype, int], adversarial.Cloud], turns: int) -> Recipe:
    """Move each coordinate by up to `turns` box lengths of 8, where the sum is exact."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        points, cutoff = cloud(dtype, dim)
        return adversarial.turned(points, 8.0, turns), cutoff, (8.0, 8.0, 8.0), _ALL

    return recipe


def _residues(dtype: np.dtype, dim: int) -> adversarial.Cloud:
    return adversarial.residues(dtype, dim, sizes=[2.0**-30, 2.0**-60, 2.0**-100, float(np.finfo(dtype).tiny)])


def _box_of_cutoffs(ratio: float, step: int = 0) -> Recipe:
    """Let the box be `ratio` cutoffs of 0.75 wide, or the float `step` after that; a third of the points on a grid in it."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        length = dtype.type(0.75 * ratio)
        if step:
            length = np.nextafter(length, dtype.type(np.inf if step > 0 else 0))
        n = min(150, int(120 * ratio**dim / (3 if dim == 2 else 4)))
        points = np.random.default_rng(5).uniform(0, 1, (n, dim)) * length
        points[::3] = np.rint(points[::3] / 0.375) * 0.375
        return points, 0.75, [length] * dim, _ALL

    return recipe


def _rounded_thirds(dtype: np.dtype, dim: int) -> Parts:
    points = np.random.default_rng(6).integers(-3, 6, (40, dim)) * 0.1
    points[::2] += np.random.default_rng(7).uniform(-0.04, 0.04, (20, dim))
    return points, 0.1, [0.3] * dim, _ALL


def _coincident(dtype: np.dtype, dim: int) -> Parts:
    """Put twelve particles in two places, some of them whole boxes away."""
    turns = np.random.default_rng(9).integers(-3, 4, (12, dim)).astype(float)
    return np.tile([[0.25] * dim, [0.75] * dim], (6, 1)) + turns, 1.25, [1.0] * dim, _ALL


def _half_box(ratio: float) -> Recipe:
    """Pair points half a box apart along one axis, and one float to either side; the cutoff is `ratio` boxes."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        rng = np.random.default_rng(11)
        length = dtype.type(0.7)
        half = length / dtype.type(2)
        points = []
        for turn in range(30):
            end = (rng.uniform(0.5, 1, dim) * length).astype(dtype)
            axis = turn % dim
            start = end.copy()
            start[axis] -= half  # exact, as half <= end <= 2 half
            points.append(start)
            for value in adversarial.neighbors_of(end[axis]):
                points.append(end.copy())
                points[-1][axis] = value
        return np.array(points), ratio * float(length), [length] * dim, _ALL

    return recipe


def _blobs(lengths: Sequence[float], periodic: Axes = _ALL) -> Recipe:
    """Put two blobs into opposite corners of a box."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        blob = np.random.default_rng(13).uniform(0, 0.875, (120, dim))
        blob[60:] = np.array(lengths[:dim]) - blob[60:]
        return blob, 1.0, lengths, periodic

    return recipe


def _blob_at_origin(dtype: np.dtype, dim: int) -> Parts:
    return np.random.default_rng(17).uniform(-1.25, 1.25, (150, dim)), 1.0, [1e4] * dim, _ALL


def _far_open_axis(dtype: np.dtype, dim: int) -> Parts:
    points = np.random.default_rng(19).uniform(0, 1, (150, dim)) * _leading(_WIDE, dim)
    points[:, 0] *= 0.2
    points[:, 0] += np.random.default_rng(20).choice([-1e5, 0.0, 1e6], 150)
    return points, 1.0, _WIDE, _axes("yz")


def _nonfinite(periodic: Axes) -> Recipe:
    def recipe(dtype: np.dtype, dim: int) -> Parts:
        rng = np.random.default_rng(23)
        points = rng.uniform(-0.5, 1.5, (150, dim)) * _leading(_WIDE, dim)
        points[::7, :] = np.where(rng.random((22, dim)) < 0.4, rng.choice([np.nan, np.inf, -np.inf], (22, dim)), points[::7])
        points[:3] = np.array([[np.nan], [np.inf], [-np.inf]])
        return points, 1.0, _WIDE, periodic

    return recipe


def _queried(
    n: int,
    m: int,
    *,
    box: ArrayLike = _WIDE,
    low: float = 0.0,
    high: float = 1.0,
    turns: int = 0,
    periodic: Axes = _ALL,
    cutoff: float = 1.0,
) -> Recipe:
    """Fill the cell with sources, `low` to `high` of it with queries, and move each query by up to `turns` lattice vectors."""

    def recipe(dtype: np.dtype, dim: int) -> Parts:
        rng = np.random.default_rng(29)
        rows = _rows(box, dim)
        queries = rng.uniform(low, high, (m, dim)) + rng.integers(-turns, turns + 1, (m, dim))
        return rng.uniform(0, 1, (n, dim)) @ rows, cutoff, box, periodic, queries @ rows

    return recipe


def _queries_coincident(dtype: np.dtype, dim: int) -> Parts:
    """Query at sources, which come in twos, and at images of them one to three boxes away; all numbers are dyadic."""
    rng = np.random.default_rng(31)
    sources = np.repeat(rng.integers(0, 6 * 64, (60, dim)) / 64, 2, axis=0)
    turns = rng.integers(-3, 4, (60, dim)) * np.arange(2).repeat(30)[:, None]
    return sources, 1.0, [6.0] * dim, _ALL, sources[::2] + 6.0 * turns


def _queries_beside_slab(dtype: np.dtype, dim: int) -> Parts:
    """Query whole boxes away from the sources along the open axis: wrapped onto them, but out of reach."""
    rng = np.random.default_rng(37)
    sources = rng.uniform(0.2, 0.8, (80, dim)) * _leading(_WIDE, dim)
    queries = sources[:40].copy()
    queries[:, 0] += _WIDE[0] * rng.choice([-2, -1, 1, 3], 40)
    return sources, 1.0, _WIDE, _axes("yz"), queries


def _skewed(tilt: float, edge: float = 4.0, hand: float = 1.0) -> NDArray[np.float64]:
    return edge * np.array([[1.0, 0.0, 0.0], [tilt, hand, 0.0], [tilt / 2, tilt, 1.0]])


_ROTATED = np.array([[3.7, 1.9, -0.6], [-1.3, 4.1, 0.8], [0.9, -0.4, 4.3]])
_LEFT = _ROTATED[[1, 0, 2]]
# rows at least 9 cutoffs long, but the cell is 0.7 cutoffs high over the first row and over the first two
_FLAT = np.array([[11.0, 0.0, 0.0], [9.0, 0.7, 0.0], [4.0, 10.0, 0.7]])
_NARROW = 6.0 * np.array([[1.0, 0.0, 0.0], [np.cos(0.1), np.sin(0.1), 0.0], [0.5, 0.05, 1.0]])
_PARALLEL = 60.0 * np.array([[1.0, 0.0, 0.0], [1.0, 0.01, 0.0], [1.0, 0.01, 0.05]])
# 900 long, and yet a cubic lattice; and one that no float rounds well, of vectors up to 60 long in a lattice of lengths about 1
_FAR_FROM_REDUCED = 3.0 * np.array([[1.0, 0.0, 0.0], [300.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
_LONG = np.array([[1.0, 0.0, 0.0], [30.3, 1.1, 0.0], [-17.2, 21.1, 0.9]]) @ (_ROTATED / 4.4)
_FCC = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
_BCC = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])
_HEXAGONAL = np.array([[1.0, 0.0, 0.0], [0.5, 0.875, 0.0], [0.0, 0.0, 1.5]])
_DYADIC = np.array([[4.0, 0.0, 0.0], [1.25, 3.5, 0.0], [-0.75, 2.0, 4.5]])
_DYADIC_LEFT = np.array([[1.5, 4.0, 0.5], [4.5, -1.0, 0.0], [0.25, 1.0, 4.0]])


def _alone_far(dtype: np.dtype, dim: int) -> Parts:
    return np.zeros((1, dim)), 6.0, _FAR_FROM_REDUCED, _ALL


def _crowded_far(dtype: np.dtype, dim: int) -> Parts:
    cutoff = 0.485 / 3000
    points = np.random.default_rng(3).uniform(0, 3 * cutoff, (24, dim))
    points[::3, 0] += 1  # by a vector
    return points, cutoff, [[1.0, 0.0, 0.0], [3000.0, 1.0, 0.0], [0.0, 0.0, 1.0]], _ALL


_TABLE = (
    _case(
        "far_from_reduced",
        "one vector is another plus 300 times a third: far more images lie within reach of the given vectors than of short ones",
        _filled(_FAR_FROM_REDUCED, n=(20, 12), cutoff=3.5),
    ),
    _case("far_from_reduced_alone", "a cubic lattice in disguise, of which 6 neighbors and 12 more lie at ties", _alone_far),
    _case("far_from_reduced_crowded", "the minimum image would do, but for the rounding that a long vector brings", _crowded_far),
    _case(
        "far_from_reduced_turned",
        "long vectors that no float rounds well, particles up to 4 of them outside",
        _filled(_LONG, n=(20, 12), cutoff=1.1, turns=(-4, 4)),
    ),
    _case("random", "the plain case: box six cutoffs wide, particles in it", _filled(_WIDE)),
    *[
        _case(
            f"periodic_{letters or 'none'}", f"images along {letters or 'no axis'} only, particles beyond the box elsewhere", recipe
        )
        for letters, recipe in ((letters, _some_axes(letters)) for letters in ("x", "y", "z", "xy", "xz", "yz", ""))
    ],
    # outside the cell
    _case("outside", "each particle up to 5 boxes outside, both signs", _filled(_WIDE, turns=(-5, 5))),
    _case("outside_100", "each particle up to 100 boxes outside, both signs", _filled(_WIDE, turns=(-100, 100))),
    _case("outside_700", "nobody has wrapped them: up to 700 boxes outside, both signs", _filled(_WIDE, turns=(-700, 700))),
    _case("outside_400000", "farther than a float tells where in a box", _filled(_WIDE, turns=(-400_000, 400_000))),
    _case("outside_negative", "all coordinates negative: truncation is not floor", _filled(_WIDE, turns=(-3, -1))),
    _case("outside_all_by_100", "all particles in one cell 100 boxes away", _filled(_WIDE, turns=(100, 100))),
    _case(
        "outside_all_by_-100",
        "all particles in one cell 100 boxes away, negative",
        _filled(_WIDE, turns=(-100, -100)),
    ),
    _case("outside_small_box", "up to 5 boxes outside a box of 1.5 cutoffs", _filled((1.5, 1.6, 1.7), n=(60, 60), turns=(-5, 5))),
    _case("outside_skewed", "up to 3 lattice vectors outside a skewed cell", _filled(_skewed(0.5), turns=(-3, 3))),
    _case("outside_skewed_100", "up to 100 lattice vectors outside a skewed cell", _filled(_skewed(1.0), turns=(-100, 100))),
    _case("astride", "half of the particles in the cell, the others around it", _filled(_WIDE, low=-0.25, high=1.25)),
    # on the boundary
    _case("faces", "on faces at 0, L, -L, 2 L, and one float before and behind", _faces(lambda dtype: [])),
    _case(
        "faces_just_below_zero",
        "wrapped by mod, a tiny negative coordinate becomes L: a cell too far",
        _faces(lambda dtype: [-(2.0**-k) for k in (26, 40, 60, 80)]),
    ),
    _case(
        "faces_denormal",
        "denormals on both sides of the face at zero",
        _faces(lambda dtype: [float(np.finfo(dtype).smallest_subnormal) * sign for sign in (-1, 1)]),
    ),
    _case("corners", "in corners and on edges, each coordinate 0, L or a float beside L: one place but for ulps", _corners),
    # crystals that fit the box
    _case(
        "crystal_0.1", "spacing 0.1 in a box of k * 0.1: dozens of images at the cutoff but for rounding", _crystal(0.1, cutoff=3)
    ),
    _case(
        "crystal_0.1_outside",
        "the same, 31 spacings below zero",
        _crystal(0.1, cutoff=3, offset=-31),
    ),
    _case("crystal_integer", "exact ties across faces: (3, 0, 0), (1, 2, 2)", _crystal(1.0, cutoff=3)),
    _case(
        "crystal_half_box",
        "spacings and cutoff are exact, a box of 2 cutoffs: ties with two images of one particle",
        _crystal(1.0, cutoff=3, shape=(6, 6, 6), square=(6, 6)),
    ),
    _case("crystal_dyadic", "exact ties across faces at 2^-10, off the origin", _crystal(2.0**-10, cutoff=3, offset=-1000.5)),
    _case(
        "crystal_slab",
        "exact ties, an open axis between periodic ones",
        _crystal(1.0, cutoff=3, offset=-2, periodic=(True, False, True)),
    ),
    _case("hexagonal", "exact ties along lattice vectors of a skewed cell", _primitive(_HEXAGONAL, (8, 6), 3.0)),
    _case("fcc_supercell", "exact ties in a supercell of fcc vectors", _primitive(_FCC, (8, 6), 2.0)),
    _case(
        "fcc_primitive",
        "two particles in a primitive cell smaller than the cutoff",
        _primitive(_FCC, (1, 1), 4.0, ((0, 0, 0), (0.25, 0.25, 0.25))),
    ),
    _case("bcc_supercell", "exact ties, left-handed cell in 2D", _primitive(_BCC, (8, 6), 2.0)),
    # at the cutoff through the boundary
    _case("ties_across", "exact ties through faces, and one float to either side", _ties_across((4.0, 5.5, 4.5))),
    _case("ties_across_far", "the same, partners up to 3 boxes away", _ties_across((4.0, 5.5, 4.5), turns=3)),
    _case("ties_across_100", "the same, partners up to 100 boxes away", _ties_across((4.0, 5.5, 4.5), turns=100)),
    _case("ties_across_700", "the same, partners up to 700 boxes away", _ties_across((4.0, 5.5, 4.5), turns=700)),
    _case("ties_across_skewed", "exact ties through faces of a skewed cell", _ties_across(_DYADIC)),
    _case("ties_across_skewed_far", "the same, up to 3 lattice vectors away, left-handed", _ties_across(_DYADIC_LEFT, turns=3)),
    _case("ulp_across", "distances within 3 ulp of the cutoff through faces", _ulp_images(_ODD, 0.7, 1)),
    _case("ulp_across_far", "the same, partners up to 3 boxes away", _ulp_images(_ODD, 0.7, 2, turns=3)),
    _case("ulp_across_100", "the same, partners up to 100 boxes away", _ulp_images(_ODD, 0.7, 8, turns=100, repeats=5)),
    _case("ulp_across_wide_cutoff", "the same, box of 2.5 cutoffs", _ulp_images((2.51, 2.63, 2.47), 1.0, 3)),
    _case(
        "ulp_across_small_box", "the same through images, box below the cutoff", _ulp_images((0.93, 0.87, 0.91), 1.0, 4, repeats=5)
    ),
    _case(
        "ulp_across_slab", "the same, an open axis between periodic ones", _ulp_images(_ODD, 0.7, 5, periodic=(True, False, True))
    ),
    _case("ulp_across_skewed", "the same, sums of lattice vectors round", _ulp_images(_skewed(0.3, 4.1), 0.7, 6)),
    _case("ulp_across_skewed_far", "the same, up to 3 lattice vectors away", _ulp_images(_ROTATED, 0.7, 7, turns=3)),
    _case("ulp_across_skewed_100", "the same, up to 100 lattice vectors away", _ulp_images(_ROTATED, 0.7, 9, turns=100, repeats=5)),
    _case("residues_across", "through images, d² differs from r² by 2^-120 and less", _turned(_residues, 3)),
    _case("residues_across_100", "the same, up to 100 boxes away", _turned(_residues, 100)),
    _case(
        "residues_across_balanced",
        "residues along and across cancel, their remainder decides, through images",
        _turned(adversarial.balanced_residues, 3),
    ),
    # box in cutoffs
    *[
        _case(f"box_{name}_cutoffs", f"box of {words} cutoffs, ties on a grid", _box_of_cutoffs(ratio, step))
        for name, words, ratio, step in (
            ("1", "exactly 1", 1.0, 0),
            ("1.3", "1.3", 1.3, 0),
            ("1.9", "1.9", 1.9, 0),
            ("below_2", "one float below 2", 2.0, -1),
            ("2", "exactly 2", 2.0, 0),
            ("above_2", "one float above 2", 2.0, 1),
            ("2.5", "2.5", 2.5, 0),
            ("below_3", "one float below 3", 3.0, -1),
            ("3", "exactly 3", 3.0, 0),
            ("above_3", "one float above 3", 3.0, 1),
            ("4", "exactly 4", 4.0, 0),
        )
    ],
    _case("box_0.3_cutoff_0.1", "0.3 is not three times 0.1 in floats", _rounded_thirds),
    *[
        _case(
            f"cutoff_{ratio:g}_boxes",
            f"cutoff of {ratio:g} box lengths: several images of every pair",
            _filled([1.0] * 3, n=n, cutoff=ratio),
        )
        for ratio, n in ((0.6, 120), (1.0, 50), (1.5, (30, 18)), (2.5, (14, 5)))
    ],
    _case("cutoff_1.5_skewed", "several images in a skewed cell", _filled(_skewed(0.5, 1.0), n=(30, 18), cutoff=1.5)),
    _case("alone", "one particle among its own images", _filled([1.0] * 3, n=1, cutoff=2.5)),
    _case("alone_ties", "one particle, images at exactly the cutoff: (3, 0, 0), (1, 2, 2)", _filled([1.0] * 3, n=1, cutoff=3.0)),
    _case("alone_at_the_cutoff", "one particle, box of exactly one cutoff: its images are ties, no pairs", _filled([1.0] * 3, n=1)),
    _case("alone_skewed", "one particle in a skewed cell: which images are near", _filled(_skewed(1.0, 1.0), n=1, cutoff=2.0)),
    _case("alone_wide", "one particle out of reach of its images", _filled(_WIDE, n=1)),
    _case("coincident", "particles in one place, some whole boxes away: distance zero through images", _coincident),
    _case("half_box", "pairs half a box apart, cutoff half a box: an asymmetric minimum image breaks the tie", _half_box(0.5)),
    _case("half_box_both", "pairs half a box apart, cutoff beyond: two images of each", _half_box(0.55)),
    # one axis unlike another
    _case("thin_slab", "one axis shorter than the cutoff, the others wide", _filled((6.5, 0.625, 7.25), n=80)),
    _case(
        "thin_open", "one axis shorter than the cutoff, but open", _filled((6.5, 0.625, 7.25), n=80, periodic=(True, False, True))
    ),
    _case("thin_wire", "in 3D two axes shorter than the cutoff", _filled((0.75, 9.0, 0.625), n=(80, 60))),
    _case("unequal", "axes of 1.5, 40 and 4 cutoffs", _filled((1.5, 40.0, 4.0), n=150)),
    _case("unequal_1e6", "one axis of 1e6 cutoffs, mostly empty, the others short", _blobs([2.5, 1e6, 3.5])),
    # skewed cells
    *[_case(f"skewed_{tilt:g}", f"triclinic, tilt {tilt:g}", _filled(_skewed(tilt))) for tilt in (0.3, 0.5, 1.0, 3.0, -0.5)],
    _case("skewed_3_small", "tilt 3, edges of two cutoffs", _filled(_skewed(3.0, 2.0), n=(60, 60))),
    _case("rotated", "lattice vectors along no axis, matrix not triangular", _filled(_ROTATED)),
    _case("left_handed", "left-handed: the determinant is negative", _filled(_LEFT)),
    _case("left_handed_skewed", "left-handed and skewed", _filled(_skewed(0.5, hand=-1.0))),
    _case("diagonal_matrix", "an orthogonal box given as a matrix", _filled(np.diag(_WIDE))),
    _case("negative_diagonal", "an orthogonal box with a lattice vector along -y", _filled(np.diag([6.5, -7.25, 6.0]))),
    _case("flat", "vectors of 9 cutoffs and more, heights of 0.7: stencils go by heights", _filled(_FLAT, n=80)),
    _case("narrow", "an angle of 0.1 rad", _filled(_NARROW, n=80)),
    _case("nearly_parallel", "an angle of 0.01 rad, vectors of 60 cutoffs: b - a is shorter than the cutoff", _filled(_PARALLEL)),
    _case("skewed_slab", "skewed, the last axis open", _filled(_skewed(0.5), low=-0.5, high=1.5, periodic=_axes("xy"))),
    _case("skewed_slab_first", "rotated, the first axis open", _filled(_ROTATED, low=-0.5, high=1.5, periodic=_axes("yz"))),
    _case("skewed_wire", "skewed, only the second axis periodic", _filled(_skewed(1.0), low=-0.5, high=1.5, periodic=_axes("y"))),
    _case(
        "skewed_open",
        "skewed, no axis periodic: the box means nothing",
        _filled(_skewed(1.0), low=-0.5, high=1.5, periodic=_axes("")),
    ),
    # nearly empty, far, large, small
    _case("blobs", "two blobs 1e4 cutoffs apart touch through a corner", _blobs([1e4] * 3)),
    _case("blobs_one_axis", "two blobs in opposite corners, periodic along x alone: out of reach", _blobs([1e4] * 3, _axes("x"))),
    _case("blob_at_origin", "a blob around a corner of a box of 1e4 cutoffs: half of its coordinates negative", _blob_at_origin),
    _case("far_open_axis", "1e6 cutoffs along the open axis, periodic elsewhere", _far_open_axis),
    _case("tiny_scale", "squares underflow to zero", _filled(1e-25 * np.array(_WIDE), cutoff=1e-25)),
    _case("large_scale", "squares overflow in float32", _filled(1e25 * np.array(_WIDE), cutoff=1e25)),
    _case("nonfinite", "NaN and infinite coordinates are in no pair", _nonfinite(_ALL)),
    _case("nonfinite_slab", "NaN and infinite coordinates along open and periodic axes", _nonfinite((True, False, True))),
    *[_case(f"n_{n}", "edges of tiles and empty shapes", _filled([1.25] * 3, n=n)) for n in (0, 1, 2, 33)],
    # queries
    _case("queries", "queries in the cell", _queried(100, 70)),
    _case("queries_outside", "queries up to 3 boxes away", _queried(100, 70, turns=3)),
    _case("queries_outside_skewed", "queries up to 3 lattice vectors away", _queried(100, 70, turns=3, box=_skewed(0.5))),
    _case(
        "queries_many_images",
        "cutoff of 1.5 boxes, each source found several times",
        _queried(15, 20, turns=1, box=[1.0] * 3, cutoff=1.5),
    ),
    _case("queries_coincident", "distance zero is a pair, index equality means nothing, through images too", _queries_coincident),
    _case(
        "queries_none_in_reach",
        "queries beside a slab: no query has a source",
        _queried(80, 40, low=1.5, high=2.5, periodic=_axes("x")),
    ),
    _case("queries_beside_slab", "whole boxes away along the open axis: wrapped they would be found", _queries_beside_slab),
    _case("no_queries", "zero rows", _queried(50, 0)),
    _case("no_sources", "rows without candidates", _queried(0, 20)),
)

PERIODIC_CASES: dict[str, PeriodicCase] = {case.name: case for case in _TABLE}
"""Every periodic case by name."""
