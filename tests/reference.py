"""The oracle: which pairs lie within the cutoff, decided by integers and fractions alone.

Every finite float is a whole number times a power of two. So positions, cutoff and lattice vectors, multiplied by one
common power of two, are integers, which Python adds, multiplies and compares without ever rounding. No float and no
NumPy integer takes part in a decision.
"""

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np

Pair = tuple[int, int]
Image = tuple[int, int, tuple[int, ...]]
"""Query i, source j, and the shift S: whole numbers of lattice vectors that the source is moved by."""
Vector = Sequence[int]


def is_pair(a: Any, b: Any, cutoff: float, *, closed: bool = False) -> bool:
    """Decide |b - a| < cutoff (closed: <=) for two points, exactly; a point that is not finite is in no pair.

    `cutoff` is rounded once to the dtype of `a`; a sequence of Python floats counts as float64.
    """
    a, b = _points([a]), _points([b])
    if a.shape != b.shape:
        raise ValueError(f"points have {a.shape[1]} and {b.shape[1]} coordinates: give both the same number")
    radius = Fraction(_rounded(cutoff, a.dtype))
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    squared = sum((Fraction(y) - Fraction(x)) ** 2 for x, y in zip(a[0].tolist(), b[0].tolist(), strict=True))
    return squared <= radius**2 if closed else squared < radius**2


def reference_pairs(
    positions: Any, cutoff: float, *, queries: Any = None, half: bool = False, include_self: bool = False, closed: bool = False
) -> set[Pair]:
    """Return every (query i, source j) with |x_j - x_i| < cutoff (closed: <=), exactly.

    Without `queries` each position asks for the others: it leaves itself out by index, so that it does find coincident
    particles. `include_self` adds (i, i); `half` keeps j > i, and the self pairs if asked for. With `queries` there is
    no self: nothing is left out, and `half` and `include_self` are refused. A point that is not finite is in no pair,
    not even with itself. `cutoff` is rounded once to the dtype of positions.

    Cost: one squared distance in integers per query and source in touching cells; 5 000 points with 30 neighbors each
    take a third of a second.

    Why the cells drop nothing: they are cubes of edge R, the integer cutoff, at floor(X / R) for integer coordinates X,
    and Python's // is exactly that. On every axis a pair has |X_j - X_i| <= R, so X_i/R - 1 <= X_j/R <= X_i/R + 1.
    Floor is monotone and floor(t + 1) = floor(t) + 1, so the cells of a pair differ by at most one on every axis.
    """
    sources, asking = _clouds(positions, queries, half or include_self)
    radius = _rounded(cutoff, sources.dtype)
    if queries is not None:
        return set(_within(radius, asking, sources, closed))
    found = {(i, j) for i, j in _within(radius, sources, sources, closed, once=True) if i < j or include_self}
    return found if half else found | {(j, i) for i, j in found}


def reference_images(
    positions: Any,
    cutoff: float,
    *,
    matrix: Any,
    periodic: Sequence[bool],
    queries: Any = None,
    half: bool = False,
    include_self: bool = False,
    closed: bool = False,
) -> set[Image]:
    """Return every (query i, source j, shift S) with |x_j - x_i + sum_k S_k A_k| < cutoff (closed: <=), exactly.

    The lattice vectors A_k are the rows of `matrix` [d, d], or the axes times `matrix` [d]; cutoff and matrix are
    rounded once to the dtype of positions. S holds d integers, 0 on every axis k that is not `periodic`, whose row is
    not looked at. S counts from the positions as given: nothing is wrapped.

    Without `queries` each position asks for all of them: (i, i, 0) is left out unless `include_self`, every other image
    of a particle is a neighbor of it like any other. `half` keeps j > i with every S, and of (i, i, S) the S whose first
    non-zero component is positive. With `queries` nothing is left out, and `half` and `include_self` are refused. A
    point that is not finite is in no pair.

    Cost: all queries times the sources in a slab of two cutoffs around each; 300 points in a box six cutoffs wide take a tenth of a
    second.

    Why nothing is missed: let b_1 ... b_p be the periodic rows and w_k a vector orthogonal to b_1 ... b_(k-1), with
    b_k w_k > 0, which Gram-Schmidt makes of b_k in integers if the rows are independent. Along w_k, a pair's vector
    v = x_j - x_i + sum_l S_l b_l has the component v w_k, to which no S_l with l < k contributes, and by Cauchy and
    Schwarz |v w_k| <= R |w_k|. So once S_p ... S_(k+1) are chosen, all S_k worth a look lie in one interval of integers:
    with u = x_j - x_i + sum_(l > k) S_l b_l, |u w_k + S_k b_k w_k| <= floor(sqrt(R² w_k w_k)), an integer on either side.
    """
    sources, asking = _clouds(positions, queries, half or include_self)
    dim = sources.shape[1]
    if len(periodic) != dim or not all(isinstance(axis, bool | np.bool_) for axis in periodic):
        raise ValueError(f"periodic must be one bool for each of {dim} axes: got {periodic}")
    rows = _rows(matrix, sources.dtype, dim)[list(map(bool, periodic))]
    edge, (vectors, ends, starts) = _integers(_rounded(cutoff, sources.dtype), rows, sources, asking)
    steps = _periodic_vectors(vectors, rows, periodic)
    options = {"own": queries is None, "half": half, "include_self": include_self}
    return {image for image, _ in _images(edge, closed, steps, ends, starts, **options)}


def reference_radii(
    positions: Any,
    radii: Any,
    rule: str,
    *,
    queries: Any = None,
    query_radii: Any = None,
    lengths: Any = None,
    matrix: Any = None,
    periodic: Sequence[bool] | None = None,
    half: bool = False,
    closed: bool = False,
) -> set[Image]:
    """Return every (query i, source j, shift S) closer than the cutoff of that pair, which a rule takes of two, exactly.

    `radii` [n] are the cutoffs of the positions, `query_radii` [m] those of the queries, all of the dtype of positions. The
    rule names what a pair's cutoff is: gather that of i, scatter that of j, either the larger, both the smaller, mean the mean.
    S is 0 without `lengths` [d], those of a periodic box, or `matrix` and `periodic`, which with `half` are as in
    `reference_images`. Without `queries`, (i, i, 0) is left out.

    Found among the images within the largest cutoff of all; then 4 |x_j - x_i + S·A|^2 is compared with (2 r)^2 in integers.
    """
    sources, asking = _clouds(positions, queries, half)
    dim, own = sources.shape[1], queries is None
    cell = np.zeros(dim) if lengths is None and matrix is None else lengths if matrix is None else matrix
    flags = [lengths is not None or matrix is not None] * dim if periodic is None else periodic
    rows = _rows(cell, sources.dtype, dim)[list(map(bool, flags))]
    cutoffs = [np.asarray(each)[None] for each in (radii, radii if query_radii is None else query_radii)]
    largest = _rounded(max(float(each.max()) for each in cutoffs), sources.dtype)
    edge, (vectors, ends, starts, *of_points) = _integers(largest, rows, sources, asking, *cutoffs)
    of_end, of_start = (numbers[0] for numbers in of_points)
    found = set()
    for image, square in _images(edge, True, _periodic_vectors(vectors, rows, flags), ends, starts, own=own, half=half):
        i, j, _ = image
        mine, other = of_start[i], of_end[j]
        double = {"gather": 2 * mine, "scatter": 2 * other, "either": 2 * max(mine, other), "both": 2 * min(mine, other)}
        limit = (mine + other if rule == "mean" else double[rule]) ** 2
        if 4 * square < limit or (closed and 4 * square == limit):
            found.add(image)
    return found


def reference_species(positions: Any, table: Any, species: Any, *, query_species: Any = None, **options: Any) -> set[Image]:
    """Return every (query i, source j, shift S) closer than the cutoff of their species, exactly.

    `table` [s, s] are cutoffs of the dtype of positions, 0 where species are no neighbors, `species` [n] and `query_species` [m]
    whole numbers. `options` are those of `reference_images`, which each different cutoff is asked for.
    """
    edges = [[float(x) for x in row] for row in np.asarray(table).tolist()]
    of_end = [int(s) for s in np.asarray(species).tolist()]
    of_start = of_end if query_species is None else [int(s) for s in np.asarray(query_species).tolist()]
    found = set()
    for cutoff in {x for row in edges for x in row if x > 0}:
        near = reference_images(positions, cutoff, **options)
        found |= {(i, j, shift) for i, j, shift in near if edges[of_start[i]][of_end[j]] == cutoff}
    if options.get("include_self"):  # everyone is its own neighbor, whatever the cutoff of its species
        points = np.asarray(positions)
        found |= {(i, i, (0,) * points.shape[1]) for i in np.flatnonzero(np.isfinite(points).all(axis=1)).tolist()}
    return found


def without_excluded(found: Iterable[Image], exclude: Iterable[Sequence[int]], *, directed: bool = False) -> set[Image]:
    """Return what is left without excluded pairs, in all images; those between queries and sources have a direction."""
    apart = {(int(i), int(j)) for i, j in exclude}
    return {(i, j, s) for i, j, s in found if (i, j) not in apart and (directed or (j, i) not in apart)}


def triangle_pairs(positions: Any, vertices: Any, faces: Any, cutoff: float) -> set[Pair]:
    """Return every (particle i, face t) whose closed triangle (in 2D: segment) is closer than the cutoff, exactly.

    A particle that is not finite, and a face with a vertex that is not finite or not there, is in no pair. `cutoff` is rounded once
    to the dtype of positions. Cost: particles times faces whose boxes are within the cutoff, some 20 us each.
    """
    points, corners = _points(positions), _points(vertices)
    if points.dtype != corners.dtype or points.shape[1] != corners.shape[1]:
        raise ValueError(f"positions {points.dtype} {points.shape}, vertices {corners.dtype} {corners.shape}: give the same kind")
    edge, (asking, sites) = _integers(_rounded(cutoff, points.dtype), points, corners)
    found = set()
    for t, face in enumerate(np.asarray(faces).tolist()):
        if any(k not in sites for k in face):
            continue
        shape = [sites[k] for k in face]
        low, high = ([pick(axis) for axis in zip(*shape, strict=True)] for pick in (min, max))
        for i, point in asking.items():
            nearby = all(a - edge < x < b + edge for x, a, b in zip(point, low, high, strict=True))
            if nearby and squared_distance(point, shape) < edge**2:
                found.add((i, t))
    return found


def squared_distance(point: Sequence[int | Fraction], corners: Sequence[Sequence[int | Fraction]]) -> Fraction:
    """Return the squared distance of a point to the closed triangle, or segment, between corners, all in 3D: a rational number.

    The foot of the perpendicular on the plane is written in the coordinates of two sides (Cramer's rule); where it lies outside, or
    the corners are on one line, the nearest point is on a side.
    """
    if len(corners) == 2:
        return _squared_distance_to_segment(point, *corners)
    a, b, c = corners
    along, across, away = _minus(b, a), _minus(c, a), _minus(point, a)
    aa, ac, cc = _dot(along, along), _dot(along, across), _dot(across, across)
    pa, pc = _dot(away, along), _dot(away, across)
    area = aa * cc - ac * ac
    if area != 0:
        s, t = Fraction(cc * pa - ac * pc, area), Fraction(aa * pc - ac * pa, area)
        if s >= 0 and t >= 0 and s + t <= 1:
            rest = [w - s * u - t * v for w, u, v in zip(away, along, across, strict=True)]
            return Fraction(_dot(rest, rest))
    return min(_squared_distance_to_segment(point, *side) for side in ((a, b), (b, c), (c, a)))


def distance(point: Any, corners: Any) -> tuple[float, float]:
    """Return the distance of a point [d] to the closed shape between corners [2 or 3, d], and the largest coordinate seen from it.

    Both are rational numbers until they are rounded to double precision; squares do not leave its range.
    """
    start, *ends = ([Fraction(float(x)) for x in row] + [Fraction(0)] * (3 - len(row)) for row in (point, *corners))
    size = max(abs(x) for end in ends for x in _minus(end, start))
    return (math.sqrt(squared_distance(start, ends) / size**2) * float(size) if size else 0.0), float(size)


def winding_number(point: Any, vertices: Any, faces: Any) -> int | None:
    """Return how often triangles, in 2D segments, wind around a point, in exact arithmetic; None where it is on one of them.

    A ray leaves some of them and enters others. One that meets a side or a vertex, in 2D an end, is turned a little.
    """
    ratios = [[float(x).as_integer_ratio() for x in row] for row in (*vertices, point)]
    unit = max(below for row in ratios for _, below in row)
    *corners, origin = [[above * (unit // below) for above, below in row] for row in ratios]
    shapes = [[_minus(corners[v], origin) for v in face] for face in faces if len(set(face)) == len(face)]
    for turn in range(1, 50):
        ray = [211, 2 * turn + 1, -6 * turn][: len(origin)]
        parts = [_crossing(ray, shape) for shape in shapes]
        if None not in parts:
            return sum(part for part in parts if part is not None)
    return None


def _crossing(ray: Sequence[int], shape: Sequence[Sequence[int]]) -> int | None:
    """Return 1 where a ray from the origin leaves a shape, -1 where it enters, 0 where it passes by; None where this is unclear."""
    dim = len(ray)
    sides = [_determinant([ray if c == k else x for c, x in enumerate(shape)]) for k in range(dim)]
    height = _determinant(shape)
    if all(side > 0 for side in sides) or all(side < 0 for side in sides):
        sign = 1 if sides[0] > 0 else -1
        return None if height == 0 else sign * (height * sign > 0)
    one_way, other_way = any(side > 0 for side in sides), any(side < 0 for side in sides)
    return 0 if one_way and other_way else None


def is_parted(point: Any, end: Any, corners: Any) -> bool:
    """Say whether the segment between two points meets the closed triangle, in 2D segment, between corners, at one point: exactly.

    The point at which it meets the plane is a rational number, and so are its shares of the corners: Cramer's rule.
    """
    start, end, *shape = ([Fraction(float(x)) for x in row] for row in (point, end, *corners))
    along, base = _minus(end, start), shape[-1]
    columns = [*(_minus(corner, base) for corner in shape[:-1]), [-x for x in along]]
    rows, right = [list(row) for row in zip(*columns, strict=True)], _minus(start, base)
    whole = _determinant(rows)
    if whole == 0:
        return False
    parts = [
        _determinant([[right[k] if c == which else x for c, x in enumerate(row)] for k, row in enumerate(rows)])
        for which in range(len(rows))
    ]
    *shares, place = [part / whole for part in parts]
    return all(share >= 0 for share in shares) and sum(shares) <= 1 and 0 <= place <= 1


def _determinant(rows: Sequence[Sequence[int]]) -> int:
    if len(rows) == 2:
        return rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]
    a, b, c = rows
    return sum(a[i] * (b[j] * c[k] - b[k] * c[j]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)))


def _squared_distance_to_segment(point: Sequence[Any], a: Sequence[Any], b: Sequence[Any]) -> Fraction:
    along, away = _minus(b, a), _minus(point, a)
    length = _dot(along, along)
    t = min(max(Fraction(_dot(away, along), length), Fraction(0)), Fraction(1)) if length != 0 else Fraction(0)
    rest = [w - t * u for w, u in zip(away, along, strict=True)]
    return Fraction(_dot(rest, rest))


def _minus(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [x - y for x, y in zip(a, b, strict=True)]


def pairs_of(idx: Any, count: Any, n_sources: int) -> list[Pair]:
    """Return the pairs (i, j) of a padded list: idx int32 [n, capacity], count int32 [n], maybe above the capacity.

    Fails unless the first min(count, capacity) slots of a row hold different sources and all others hold `n_sources`.
    """
    idx, count = np.asarray(idx), np.asarray(count)
    if idx.ndim != 2 or count.shape != idx.shape[:1]:
        raise AssertionError(f"idx must be [n, capacity] and count [n]: got {idx.shape} and {count.shape}")
    if idx.dtype != np.int32 or count.dtype != np.int32:
        raise AssertionError(f"idx and count must be int32: got {idx.dtype} and {count.dtype}")
    filled = np.arange(idx.shape[1]) < count[:, None]
    strange = np.where(filled, (idx < 0) | (idx >= n_sources), idx != n_sources).any(axis=1) | (count < 0)
    for i in np.flatnonzero(strange)[:1].tolist():
        row, used = idx[i].tolist(), int(count[i])
        if used < 0:
            raise AssertionError(f"row {i} counts {used} neighbors")
        if any(not 0 <= j < n_sources for j in row[:used]):
            raise AssertionError(f"row {i} counts {used} neighbors of {n_sources} sources, but holds {row[:used]}")
        raise AssertionError(f"unused slots of row {i} must hold {n_sources}: got {row[used:]}")
    rows, found = np.nonzero(filled)[0], idx[filled]
    pairs = list(zip(rows.tolist(), found.tolist(), strict=True))
    if len(np.unique(rows * (n_sources + 1) + found)) < len(pairs):
        _refuse_repeats(pairs)
    return pairs


def _refuse_repeats(pairs: list[Pair]) -> set[Pair]:
    """Return the pairs as a set, if each stands there once."""
    once = set(pairs)
    if len(once) == len(pairs):
        return once
    seen: set[Pair] = set()
    repeated = sorted({pair for pair in pairs if pair in seen or seen.add(pair)})
    raise AssertionError(f"found more than once: {repeated[:5]} ({len(repeated)} such pairs)")


def _clouds(positions: Any, queries: Any, about_self: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the sources and the points that ask for them."""
    sources = _points(positions)
    if queries is not None and about_self:
        raise ValueError("half and include_self are about positions among themselves: leave them out with queries")
    asking = sources if queries is None else _points(queries)
    if asking.shape[1] != sources.shape[1]:
        raise ValueError(f"queries have {asking.shape[1]} coordinates, positions {sources.shape[1]}: give the same")
    return sources, asking


def _points(values: Any) -> np.ndarray:
    points = np.asarray(values)
    if points.dtype not in (np.float32, np.float64):
        raise TypeError(f"points must be float32 or float64: got {points.dtype}")
    if points.ndim != 2 or not 1 <= points.shape[1] <= 3:
        raise ValueError(f"points must have shape [n, d] with d = 1, 2 or 3: got {points.shape}")
    return points


def _rounded(cutoff: float, dtype: np.dtype) -> float:
    with np.errstate(over="ignore", under="ignore"):
        radius = float(dtype.type(cutoff))
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(f"cutoff must be positive and finite in {dtype}: got {cutoff}")
    return radius


def _rows(matrix: Any, dtype: np.dtype, dim: int) -> np.ndarray:
    rows = np.asarray(matrix)
    if rows.shape not in ((dim,), (dim, dim)):
        raise ValueError(f"matrix must have shape [{dim}] or [{dim}, {dim}]: got {rows.shape}")
    rows = rows.astype(dtype)
    if rows.ndim == 2:
        return rows
    square = np.zeros((dim, dim), dtype)
    np.fill_diagonal(square, rows)
    return square


def _ratios(points: np.ndarray) -> dict[int, list[tuple[int, int]]]:
    """Return numerator and denominator of every coordinate of the finite points; missing axes become zeros."""
    rows = enumerate(points.tolist())
    return {i: [x.as_integer_ratio() for x in row] + [(0, 1)] * (3 - len(row)) for i, row in rows if all(map(math.isfinite, row))}


def _integers(cutoff: float, *clouds: np.ndarray) -> tuple[int, list[dict[int, list[int]]]]:
    """Return the cutoff and the finite points of every cloud, multiplied by one power of two that makes all integers."""
    top, bottom = cutoff.as_integer_ratio()
    ratios = [_ratios(cloud) for cloud in clouds]
    # all denominators are powers of two, so the largest is a multiple of each
    scale = max([bottom, *(q for cloud in ratios for point in cloud.values() for _, q in point)])
    scaled = [{i: [p * (scale // q) for p, q in point] for i, point in cloud.items()} for cloud in ratios]
    return top * (scale // bottom), scaled


def _within(cutoff: float, queries: np.ndarray, sources: np.ndarray, closed: bool, once: bool = False) -> Iterator[Pair]:
    """Yield every (query i, source j) within the cutoff: by integer cells of that edge, then by squared distance.

    `once` leaves out those with j < i: of points among themselves, they are as far apart as (j, i).
    """
    edge, (asking, sites) = _integers(cutoff, queries, sources)
    cells: defaultdict[tuple[int, int, int], list[tuple[int, int, int, int]]] = defaultdict(list)
    for j, (x, y, z) in sites.items():
        cells[x // edge, y // edge, z // edge].append((j, x, y, z))
    limit = edge**2 if closed else edge**2 - 1  # of integers: d2 < r2 is d2 <= r2 - 1
    steps = list(product((-1, 0, 1), repeat=3))
    for i, (x, y, z) in asking.items():
        a, b, c = x // edge, y // edge, z // edge
        for da, db, dc in steps:
            for j, u, v, w in cells.get((a + da, b + db, c + dc), ()):
                if (j >= i or not once) and (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2 <= limit:
                    yield i, j


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _periodic_vectors(vectors: dict[int, list[int]], rows: np.ndarray, periodic: Sequence[bool]) -> list[list[int] | None]:
    """Return the lattice vector of each axis in integers, None where it is not periodic."""
    if len(vectors) < len(rows):
        raise ValueError(f"periodic rows of the matrix must be finite: got {rows.tolist()}")
    of_rows = iter(vectors.values())
    return [next(of_rows) if axis else None for axis in periodic]


def _images(
    edge: int,
    closed: bool,
    vectors: list[list[int] | None],
    ends: dict[int, list[int]],
    starts: dict[int, list[int]],
    *,
    own: bool,
    half: bool,
    include_self: bool = False,
) -> Iterator[tuple[Image, int]]:
    """Yield every image within the cutoff and its squared distance, in integers, as `reference_images` says."""
    axes = [k for k, vector in enumerate(vectors) if vector is not None]
    levels = _levels([vector for vector in vectors if vector is not None], edge)
    limit = edge**2 if closed else edge**2 - 1  # of integers: d2 < r2 is d2 <= r2 - 1
    zero = (0,) * len(vectors)
    for i, j, between in _in_slabs(edge, levels, ends, starts):
        if own and j < i:
            continue  # the negative vectors of (j, i) are as long: they come with those of (i, j)
        for steps, square in _shifts(between, levels, limit):
            shift = zero
            if any(steps):
                moved = dict(zip(axes, steps, strict=True))
                shift = tuple(moved.get(k, 0) for k in range(len(vectors)))
            if own and i == j and ((shift == zero and not include_self) or (half and shift < zero)):
                continue
            yield (i, j, shift), square
            if own and i < j and not half:
                yield (j, i, tuple(-s for s in shift)), square


def _in_slabs(
    edge: int, levels: list["Level"], ends: dict[int, list[int]], starts: dict[int, list[int]]
) -> Iterator[tuple[int, int, Vector]]:
    """Yield i, j and x_j - x_i of those that are near each other along one direction: the first axis, or the last level's normal.

    Along that normal, images of j lie a height apart. One of them is within the reach of i only where what is left of the
    components after division by the height differs by no more than the reach, or by no less than the height without it.
    """
    normal, height, reach = ((1, 0, 0), None, edge) if not levels else levels[-1][1:]
    sites = sorted((_dot(x, normal) if height is None else _dot(x, normal) % height, j, x) for j, x in ends.items())
    along = [site[0] for site in sites]
    for i, (x, y, z) in starts.items():
        here = _dot((x, y, z), normal)
        if height is None:
            parts = [(here - reach, here + reach)]
        elif 2 * reach + 1 >= height:
            parts = [(0, height)]
        else:
            here %= height
            parts = [(here + k * height - reach, here + k * height + reach) for k in (-1, 0, 1)]
        for low, high in parts:
            for _, j, (u, v, w) in sites[bisect_left(along, low) : bisect_right(along, high)]:
                yield i, j, (u - x, v - y, w - z)


Level = tuple[Vector, Vector, int, int]
"""A lattice vector b, a normal w to those before it, b w, and the largest |v w| of a v within the cutoff."""


def _levels(rows: list[Vector], edge: int) -> list[Level]:
    levels: list[Level] = []
    for row in rows:
        normal = row
        for _, other, _, _ in levels:
            across, along = _dot(other, other), _dot(normal, other)
            normal = [across * n - along * o for n, o in zip(normal, other, strict=True)]
        if not any(normal):
            raise ValueError("periodic rows of the matrix must be linearly independent")
        common = math.gcd(*normal)
        normal = [n // common for n in normal]
        levels.append((row, normal, _dot(row, normal), math.isqrt(edge**2 * _dot(normal, normal))))
    return levels


def _shifts(v: Vector, levels: list[Level], limit: int) -> Iterator[tuple[tuple[int, ...], int]]:
    """Yield the shifts, one integer per lattice vector, that bring v to a squared length of at most `limit`, and that length."""
    if not levels:
        if (square := _dot(v, v)) <= limit:
            yield (), square
        return
    *rest, (row, normal, height, reach) = levels
    here = _dot(v, normal)
    for s in range(-((reach + here) // height), (reach - here) // height + 1):
        moved = [x + s * step for x, step in zip(v, row, strict=True)] if s else v
        if not rest:
            if (square := _dot(moved, moved)) <= limit:
                yield (s,), square
            continue
        for others, square in _shifts(moved, rest, limit):
            yield (*others, s), square
