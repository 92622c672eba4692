"""The oracle: which pairs lie within the cutoff, decided by integers and fractions alone.

Every finite float is a whole number times a power of two. So positions and cutoff, multiplied by one common power of
two, are integers, which Python adds, multiplies and compares without ever rounding. No float and no NumPy integer takes
part in a decision.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np

Pair = tuple[int, int]


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
    positions: Any,
    cutoff: float,
    *,
    queries: Any = None,
    half: bool = False,
    include_self: bool = False,
    closed: bool = False,
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
    sources = _points(positions)
    if queries is not None and (half or include_self):
        raise ValueError("half and include_self are about positions among themselves: leave them out with queries")
    asking = sources if queries is None else _points(queries)
    if asking.shape[1] != sources.shape[1]:
        raise ValueError(f"queries have {asking.shape[1]} coordinates, positions {sources.shape[1]}: give the same")
    found = _within(_rounded(cutoff, sources.dtype), asking, sources, closed)
    if queries is None:
        found = ((i, j) for i, j in found if i < j or (i == j and include_self) or (i > j and not half))
    return set(found)


def compare(found: Any, expected: Iterable[Pair]) -> tuple[set[Pair], set[Pair]]:
    """Return the pairs that `found` misses of `expected`, and the pairs that it has beyond them.

    `found` is an iterable of (i, j), an array [m, 2], or a tuple of two arrays (i, j), each [m]. A pair that stands in
    it twice fails, because sets could not show it.
    """
    if isinstance(found, tuple) and len(found) == 2 and all(getattr(part, "ndim", 0) == 1 for part in found):
        found = zip(np.asarray(found[0]).tolist(), np.asarray(found[1]).tolist(), strict=True)
    pairs, wanted = [(int(i), int(j)) for i, j in found], set(expected)
    _refuse_repeats(pairs)
    return wanted - set(pairs), set(pairs) - wanted


def pairs_of(idx: Any, count: Any, n_sources: int) -> list[Pair]:
    """Return the pairs (i, j) of a padded list: idx int32 [n, capacity], count int32 [n], maybe above the capacity.

    Fails unless the first min(count, capacity) slots of a row hold different sources and all others hold `n_sources`.
    """
    idx, count = np.asarray(idx), np.asarray(count)
    if idx.ndim != 2 or count.shape != idx.shape[:1]:
        raise AssertionError(f"idx must be [n, capacity] and count [n]: got {idx.shape} and {count.shape}")
    if idx.dtype != np.int32 or count.dtype != np.int32:
        raise AssertionError(f"idx and count must be int32: got {idx.dtype} and {count.dtype}")
    pairs: list[Pair] = []
    for i, (row, used) in enumerate(zip(idx.tolist(), count.tolist(), strict=True)):
        if used < 0:
            raise AssertionError(f"row {i} counts {used} neighbors")
        if any(not 0 <= j < n_sources for j in row[:used]):
            raise AssertionError(f"row {i} counts {used} neighbors of {n_sources} sources, but holds {row[:used]}")
        if any(j != n_sources for j in row[used:]):
            raise AssertionError(f"unused slots of row {i} must hold {n_sources}: got {row[used:]}")
        pairs += [(i, j) for j in row[:used]]
    _refuse_repeats(pairs)
    return pairs


def _refuse_repeats(pairs: list[Pair]) -> None:
    if len(set(pairs)) == len(pairs):
        return
    seen: set[Pair] = set()
    repeated = sorted({pair for pair in pairs if pair in seen or seen.add(pair)})
    raise AssertionError(f"found more than once: {repeated[:5]} ({len(repeated)} such pairs)")


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


def _ratios(points: np.ndarray) -> dict[int, list[tuple[int, int]]]:
    """Return numerator and denominator of every coordinate of the finite points; missing axes become zeros."""
    rows = enumerate(points.tolist())
    return {i: [x.as_integer_ratio() for x in row] + [(0, 1)] * (3 - len(row)) for i, row in rows if all(map(math.isfinite, row))}


def _within(cutoff: float, queries: np.ndarray, sources: np.ndarray, closed: bool) -> Iterator[Pair]:
    """Yield every (query, source) within the cutoff: by integer cells of that edge, then by squared distance."""
    top, bottom = cutoff.as_integer_ratio()
    clouds = _ratios(queries), _ratios(sources)
    # all denominators are powers of two, so the largest is a multiple of each
    scale = max([bottom, *(q for cloud in clouds for point in cloud.values() for _, q in point)])
    asking, sites = ({i: [p * (scale // q) for p, q in point] for i, point in cloud.items()} for cloud in clouds)
    edge = top * (scale // bottom)
    cells: defaultdict[tuple[int, int, int], list[tuple[int, int, int, int]]] = defaultdict(list)
    for j, (x, y, z) in sites.items():
        cells[x // edge, y // edge, z // edge].append((j, x, y, z))
    limit = edge**2 if closed else edge**2 - 1  # of integers: d2 < r2 is d2 <= r2 - 1
    steps = list(product((-1, 0, 1), repeat=3))
    for i, (x, y, z) in asking.items():
        a, b, c = x // edge, y // edge, z // edge
        for da, db, dc in steps:
            for j, u, v, w in cells.get((a + da, b + db, c + dc), ()):
                if (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2 <= limit:
                    yield i, j
