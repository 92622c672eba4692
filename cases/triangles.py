"""Particles and walls that a search for triangles gets wrong: in 3D triangles, in 2D segments.

>>> import numpy as np
>>> given = TRIANGLE_CASES["slivers"].build(np.float32, 3)
>>> given.positions.shape, given.vertices.shape, given.faces.shape, given.cutoff
((48, 3), (48, 3), (16, 3), 1.0)
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

Points = NDArray[np.floating]
Corners = NDArray[np.floating]  # [faces, dim, dim]: the corners of each triangle or segment
Parts = tuple[Points, Corners, float]
Recipe = Callable[[np.dtype, int, np.random.Generator], Parts]


@dataclass(frozen=True)
class TriangleInput:
    """What a search for triangles is given.

    Attributes:
        positions: Particles, shape [n, dim].
        vertices: Shape [v, dim], same dtype.
        faces: Indices of vertices, shape [f, dim], int32: triangles in 3D, segments in 2D.
        cutoff: Positive, as a caller writes it: a search rounds it once to the dtype of positions.
    """

    positions: Points
    vertices: Points
    faces: NDArray[np.int32]
    cutoff: float


@dataclass(frozen=True)
class TriangleCase:
    """A named input and what is hard about it.

    Attributes:
        name: Its key in `TRIANGLE_CASES`.
        mechanism: Why it is hard, in one line.
        build: Makes the input for a dtype (float32 or float64) and a dimension (2 or 3). Same arguments, same input.
    """

    name: str
    mechanism: str
    build: Callable[[DTypeLike, int], TriangleInput]


def padded(given: TriangleInput) -> TriangleInput:
    """Return an input of the shape that all cases fit into, [48, dim], [96, dim], [32, dim], with the same pairs.

    Particles that are not finite are near nothing, and so are faces without vertices.
    """
    dim, dtype = given.positions.shape[1], given.positions.dtype
    positions, vertices = np.full((48, dim), np.nan, dtype), np.full((96, dim), np.nan, dtype)
    faces = np.full((32, dim), -1, np.int32)
    positions[: len(given.positions)], vertices[: len(given.vertices)] = given.positions, given.vertices
    faces[: len(given.faces)] = np.where(given.faces < len(given.vertices), given.faces, -1)
    return TriangleInput(positions, vertices, faces, given.cutoff)


def _case(name: str, mechanism: str, recipe: Recipe) -> TriangleCase:
    def build(dtype: DTypeLike, dim: int) -> TriangleInput:
        kind = np.dtype(dtype)
        if kind not in (np.float32, np.float64) or dim not in (2, 3):
            raise ValueError(f"a hard case is float32 or float64, in 2 or 3 dimensions: got {kind}, {dim}")
        positions, corners, cutoff = recipe(kind, dim, np.random.default_rng(17))
        faces = np.arange(corners.shape[0] * dim, dtype=np.int32).reshape(-1, dim)
        if name in _FACES:
            faces = _FACES[name](faces)
        return TriangleInput(positions.astype(kind), corners.reshape(-1, dim).astype(kind), faces, cutoff)

    return TriangleCase(name, mechanism, build)


def _mixed(rng: np.random.Generator, corners: Corners, count: int) -> Points:
    """Draw points of the shapes, some of them on sides and vertices: [count, dim]."""
    faces, dim = corners.shape[:2]
    weights = rng.dirichlet(np.ones(dim), count)
    weights[: count // 3] = np.eye(dim)[rng.integers(0, dim, count // 3)]
    weights[count // 3 : count // 2, 0] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkd->nd", weights, corners[rng.integers(0, faces, count)].astype(float))


def _directions(rng: np.random.Generator, count: int, dim: int) -> Points:
    away = rng.normal(size=(count, dim))
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def _about(rng: np.random.Generator, corners: Corners, cutoff: float, count: int = 48) -> Points:
    """Draw points at about the cutoff from points of the shapes."""
    away = _directions(rng, count, corners.shape[1]) * (cutoff * rng.choice([0.0, 0.5, 0.9, 0.999, 1.0, 1.001, 1.1], (count, 1)))
    return _mixed(rng, corners, count) + away


def _drawn(size: float, cutoff: float = 1.0, origin: float = 0.0) -> Recipe:
    def recipe(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
        corners = rng.uniform(-3, 3, (16, 1, dim)) * cutoff + rng.uniform(-0.5, 0.5, (16, dim, dim)) * size + origin
        corners = corners.astype(dtype)
        return _about(rng, corners, cutoff), corners, cutoff

    return recipe


def _thin(height: float, at_end: bool) -> Recipe:
    """Make triangles whose third vertex nearly lies on the side between the others, or on the end of it."""

    def recipe(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
        corners = rng.uniform(-3, 3, (16, dim, dim))
        share = np.zeros((16, 1)) if at_end else rng.uniform(0.1, 0.9, (16, 1))
        tip = corners[:, 0] + share * (corners[:, 1] - corners[:, 0])
        corners[:, -1] = tip + height * _directions(rng, 16, dim) * 10.0 ** rng.uniform(-3, 0, (16, 1))
        corners = corners.astype(dtype)
        return _about(rng, corners, 1.0), corners, 1.0

    return recipe


def _touched(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    """Make slivers of every thinness, each with a particle above its inside, at any height."""
    corners = rng.uniform(-3, 3, (32, dim, dim))
    tip = corners[:, 0] + rng.uniform(0.1, 0.9, (32, 1)) * (corners[:, 1] - corners[:, 0])
    corners[:, -1] = tip + _directions(rng, 32, dim) * 10.0 ** rng.uniform(-16, 0, (32, 1))
    corners = corners.astype(dtype)
    above = _directions(rng, 32, dim) * 10.0 ** rng.uniform(-16, 0, (32, 1)) * rng.integers(0, 2, (32, 1))
    return np.einsum("fk,fkd->fd", rng.dirichlet(np.ones(dim), 32), corners) + above, corners, 1.0


def _degenerate(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    corners = rng.integers(-3, 4, (16, dim, dim)).astype(float)
    corners[:4] = corners[:4, :1]  # points
    corners[4:8, 1] = corners[4:8, 0]  # segments
    corners[8:, -1] = corners[8:, 0] + (corners[8:, 1] - corners[8:, 0]) * rng.integers(-1, 3, (8, 1))  # three on a line
    return _about(rng, corners, 1.0), corners, 1.0


def _sizes(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    size = 10.0 ** np.linspace(-6, 6, 24)[:, None, None]
    corners = (rng.uniform(-1, 1, (24, 1, dim)) + rng.uniform(-1, 1, (24, dim, dim)) * size).astype(dtype)
    near = rng.uniform(-2, 2, (16, dim))
    return np.concatenate([_about(rng, corners, 1.0, 32), near]), corners, 1.0


def _on_it(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    corners = rng.integers(-8, 9, (16, dim, dim)) * 4.0
    weights = np.array([[4, 0, 0], [0, 0, 4], [2, 2, 0], [1, 0, 3], [2, 1, 1], [1, 1, 2]])[:, :dim]
    weights = np.where(weights.sum(axis=1, keepdims=True) == 4, weights, np.eye(dim, dtype=int)[0] * 4)
    points = np.einsum("wk,fkd->fwd", weights, corners[:8]) / 4
    return points.reshape(-1, dim), corners, 1.0


# whole vectors of whole length, and whole vectors across them: what is spanned across has exactly that distance
_ACROSS_3D = [
    ((2, 3, 6), (3, -2, 0), (6, 2, -3), 7),
    ((1, 2, 2), (2, -1, 0), (2, 0, -1), 3),
    ((4, 4, 7), (1, -1, 0), (7, 0, -4), 9),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0), 1),
]
_ACROSS_2D = [((3, 4), (4, -3), 5), ((5, 12), (12, -5), 13), ((8, 15), (15, -8), 17), ((0, 1), (1, 0), 1)]


def _ties(scale: float, shift: int = 0, step: int = 0) -> Recipe:
    """Put particles exactly at the cutoff from faces, sides and vertices, moved by so many units of the last place."""

    def recipe(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
        points, corners = [], []
        reach = 63 if dim == 3 else 1105  # a multiple of every length
        for row in _ACROSS_3D if dim == 3 else _ACROSS_2D:
            normal, *across = (np.array(v) for v in row[:-1])
            away, base = normal * (reach // row[-1]), rng.integers(-50, 50, dim) + shift
            shape = np.array([base - 20 * sum(across), *(base + reach * v for v in across)])
            corners.append(shape)
            points += [base + away, base - away, *(shape + away), *(shape - away), shape[0] + reach * np.eye(dim, dtype=int)[0]]
        moved = np.array(points, float).astype(dtype) * dtype.type(scale)
        for _ in range(abs(step)):
            moved = np.nextafter(moved, dtype.type(np.inf * step))
        return moved, np.array(corners, float).astype(dtype) * dtype.type(scale), reach * scale

    return recipe


def _ulps(cutoff: float, size: float, origin: float) -> Recipe:
    """Put particles at the rounded cutoff from random faces, sides and vertices: last places decide."""

    def recipe(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
        corners = (origin + rng.uniform(-3, 3, (16, 1, dim)) * cutoff + rng.uniform(-1, 1, (16, dim, dim)) * size).astype(dtype)
        of = rng.integers(0, 16, 48)
        shape = corners[of].astype(float)
        side = shape[:, 1] - shape[:, 0]
        away = np.cross(side, shape[:, 2] - shape[:, 0]) if dim == 3 else np.stack([side[:, 1], -side[:, 0]], axis=1)
        away[32:] = shape[32:, 0] - shape[32:, 1:].mean(axis=1)  # from vertices, outwards
        away *= cutoff / np.linalg.norm(away, axis=1, keepdims=True)
        weights = rng.dirichlet(np.ones(dim), 48)
        weights[16:32, -1] = 0
        weights[32:] = np.eye(dim)[0]
        weights /= weights.sum(axis=1, keepdims=True)
        points = (np.einsum("nk,nkd->nd", weights, shape) + away).astype(dtype)
        for _ in range(2):
            points = np.where(
                rng.random(points.shape) < 0.3, np.nextafter(points, dtype.type(rng.choice([-1, 1]) * np.inf)), points
            )
        return points, corners, cutoff

    return recipe


def _axis_ulps(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    radius = dtype.type(0.1)
    heights = [np.nextafter(radius, dtype.type(0)), radius, np.nextafter(radius, dtype.type(1))]
    points = np.zeros((2, 3, 4, dim), dtype)
    points[..., 0] = np.array([-1.0, -0.5, 0.25, 1.0])
    points[..., -1] = np.array([1, -1])[:, None, None] * np.array(heights)[:, None]
    corners = np.zeros((2, dim, dim), dtype)
    corners[:, 0, 0], corners[:, 1, 0] = -1, 1
    if dim == 3:
        corners[:, 2, 1] = [1, -1]
    return points.reshape(-1, dim), corners, 0.1


def _residues(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    """Hide what decides in a part of the coordinates that no sum of floats holds."""
    tiny = float(np.finfo(dtype).tiny)
    rest = [s * r for s in (-1, 1) for r in (2.0**-30, 2.0**-70, 2.0**-110, tiny, float(np.finfo(dtype).smallest_subnormal))]
    corners = np.zeros((len(rest) + 1, dim, dim))
    corners[:, 0, 0], corners[:, 1, 0] = -8, 8
    if dim == 3:
        corners[:, 2, 1] = 8
    corners[1:, :, -1] = np.array(rest)[:, None]
    points = np.zeros((8, dim))
    points[:, -1] = [1, -1, 1, -1, 1 + 2.0**-20, 1 - 2.0**-20, 0, 1]
    points[:, 0] = [0, 0, 8, -8, 0, 0, 9, tiny]
    return points, corners, 1.0


def _sheet(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    """Tile a plane, and put particles on a lattice at the cutoff from it: ties with many neighbors that share sides."""
    if dim == 2:
        ends = np.arange(-4, 5) * 0.5
        corners = np.stack([np.stack([ends[:-1], ends[1:]], axis=1), np.zeros((8, 2))], axis=2)
        places = np.stack(np.meshgrid(np.arange(-3, 3) * 0.5, [-1, -0.5, 0, 0.5, 1]), axis=-1)
        return places.reshape(-1, 2), corners, 1.0
    x, y = (grid.reshape(-1) for grid in np.meshgrid(np.arange(-2, 2), np.arange(-2, 2)))
    square = np.stack([np.stack([x + i, y + j, 0 * x], axis=1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))], axis=1)
    corners = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]]).astype(float)
    places = np.stack(np.meshgrid([-1, 0, 0.5, 1], [-2, 0, 0.5], [-1, 0, 0.5, 1]), axis=-1)
    return places.reshape(-1, 3), corners, 1.0


def _copies(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    corners = np.repeat(rng.uniform(-1, 1, (2, dim, dim)), 12, axis=0)
    corners[::2] = corners[::2, ::-1]
    return np.repeat(_about(rng, corners, 1.0, 16), 3, axis=0), corners, 1.0


def _cell_edges(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    """Put particles on multiples of the cutoff, and one unit of the last place beside them, on either side of small walls."""
    cutoff = dtype.type(0.1)
    sites = np.repeat(rng.integers(-40, 40, (16, 1)) * np.ones(dim, int), 3, axis=0).astype(dtype) * cutoff
    sites[1::3], sites[2::3] = np.nextafter(sites[1::3], dtype.type(-100)), np.nextafter(sites[2::3], dtype.type(100))
    corners = sites[::3, None] + cutoff * rng.choice([-1, 1], (16, dim, dim)) * dtype.type(0.999) * np.eye(dim, dtype=dtype)[0]
    return sites, corners, 0.1


def _not_finite(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    positions, corners, cutoff = _drawn(2.0)(dtype, dim, rng)
    corners[:4, 0, 0], corners[4, -1, -1] = np.nan, np.inf
    positions[::7, 0], positions[3, -1] = np.nan, -np.inf
    return positions, corners, cutoff


def _pointing_nowhere(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    faces[1, 0], faces[2, -1], faces[3] = -1, faces.size, 2**31 - 1
    return faces


def _extreme(cutoff32: float, cutoff64: float, size: float) -> Recipe:
    return lambda dtype, dim, rng: _drawn(size * (c := cutoff32 if dtype == np.float32 else cutoff64), c)(dtype, dim, rng)


def _huge_and_tiny(dtype: np.dtype, dim: int, rng: np.random.Generator) -> Parts:
    """Let triangles reach over the whole range of floats, around particles that are some cutoffs apart."""
    far = 2.0 ** (np.finfo(dtype).maxexp - 3)
    corners = rng.uniform(-2, 2, (12, dim, dim))
    corners[:6] *= 10.0 ** rng.uniform(3, 30, (6, 1, 1))
    corners[6:8] = np.where(rng.random((2, dim, dim)) < 0.5, far, -far) * rng.uniform(0.5, 1, (2, dim, dim))
    corners[8, 1:] *= far / 4
    return np.concatenate([rng.uniform(-3, 3, (24, dim)), _about(rng, corners[8:], 1.0, 24)]), corners, 1.0


_FACES: dict[str, Callable[[NDArray[np.int32]], NDArray[np.int32]]] = {
    "faces_out_of_range": _pointing_nowhere,
    "repeated_vertices": lambda faces: faces // 2 * 2 % faces.size,
}

TRIANGLE_CASES: dict[str, TriangleCase] = {
    case.name: case
    for case in (
        _case("random", "shapes of about the cutoff", _drawn(2.0)),
        _case("larger", "shapes of ten cutoffs", _drawn(10.0)),
        _case(
            "slivers", "the third vertex is up to 1e-9 from the opposite side: its plane is unknown to floats", _thin(1e-6, False)
        ),
        _case("slivers_1e-3", "slivers whose plane floats know, badly", _thin(1e-3, False)),
        _case("slivers_touched", "slivers from 1 to 1e-16 wide, particles as far above their insides, or on them", _touched),
        _case("needles", "two vertices nearly coincide", _thin(1e-6, True)),
        _case("degenerate", "points, segments, three vertices on a line", _degenerate),
        _case("repeated_vertices", "a face names a vertex twice", _drawn(2.0)),
        _case("size_1e6", "shapes 1e6 times larger than the cutoff: as many cells as nobody has", _drawn(1e6)),
        _case("size_1e-6", "shapes 1e6 times smaller than the cutoff", _drawn(1e-6)),
        _case("sizes", "shapes from 1e-6 to 1e6 cutoffs in one mesh", _sizes),
        _case("on_it", "particles on vertices, sides and faces: distance 0", _on_it),
        _case("ties", "whole numbers exactly at the cutoff from faces, sides and vertices", _ties(1.0)),
        _case("ties_up", "those ties, one unit of the last place away", _ties(1.0, step=1)),
        _case("ties_down", "those ties, one unit of the last place to the other side", _ties(1.0, step=-1)),
        _case("ties_far", "those ties, far from the origin", _ties(1.0, shift=10**6)),
        _case("ties_small", "those ties in units of 2^-40", _ties(2.0**-40)),
        _case("ties_spacing", "those ties in a unit that is no power of two: coordinates are rounded", _ties(1e-4)),
        _case("ulps", "the rounded cutoff from random shapes", _ulps(0.3, 1.0, 0.0)),
        _case("ulps_large", "the rounded cutoff from shapes of a hundred cutoffs", _ulps(0.01, 1.0, 0.0)),
        _case("ulps_far", "the rounded cutoff from random shapes, far from the origin", _ulps(0.3, 1.0, 1e4)),
        _case("axis_ulps", "the rounded cutoff, one unit of the last place less, and one more, from a plane at 0", _axis_ulps),
        _case("residues", "what decides is 2^-30 to a denormal beside 1", _residues),
        _case("sheet", "a lattice at the cutoff from a tiled plane: coplanar neighbors with common sides", _sheet),
        _case("copies", "the same face many times, turned over or not, and the same particle", _copies),
        _case("cell_edges", "particles on multiples of the cutoff", _cell_edges),
        _case("far", "a million cutoffs from the origin: a few units of the last place per cutoff", _drawn(2.0, 1.0, 1e6)),
        _case("farther", "where neighboring floats are a cutoff apart (float32)", _drawn(64.0, 1.0, 2.0**24)),
        _case("not_finite", "NaN and infinite vertices and particles", _not_finite),
        _case("faces_out_of_range", "faces with vertices that do not exist", _drawn(2.0)),
        _case("tiny_cutoff", "squares of lengths underflow", _extreme(2.0**-90, 2.0**-900, 2.0)),
        _case("huge_cutoff", "squares of lengths overflow", _extreme(2.0**100, 2.0**900, 2.0)),
        _case("huge_and_tiny", "vertices up to the largest float", _huge_and_tiny),
    )
}
