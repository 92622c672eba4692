"""Hard cases decided on the device that JAX has, against the oracle of the tests; sums of whole numbers against lists."""

import functools
import importlib
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from experiments._library import Name
from experiments.bench import table

RULES = ("gather", "scatter", "either", "both", "mean")
SUMMED = (1, 5, 9, 14)  # numbers of a neighbor that a term reads, besides its position
_LARGEST = 512  # such that no sum of a row leaves the integers of float32
_ABOUT = {"hard": "", "periodic": ", boxes", "radii": ", a cutoff per particle"}
Pairs = list[tuple[int, int, tuple[int, ...]]]  # i, j, image; sorted
Decisions = Iterator[tuple[str, bool]]


class Case(NamedTuple):
    """A search, and the pairs that it has to find; rows are filled up with points that are nowhere."""

    name: str
    positions: np.ndarray
    options: dict[str, Any]
    expected: Pairs
    rows: int


def rows(cases: str, backend: Name, dtype: str, dim: int, capacity: int, least_rows: int = 0) -> Iterator[table.Line]:
    """Decide every case of a table of `jfrnn.cases`, or "sums"; yield one row, which says how many are wrong, and which."""
    if cases == "triangles":
        found = _decide_triangles(dtype, dim, capacity, backend)
    elif cases == "sums":
        found = _decide_sums(dtype, dim, capacity, backend, least_rows)
    else:
        found = _decide_pairs(_CASES[cases](dtype, dim), capacity, backend, least_rows)
    right = dict(found)
    wrong = [name for name, is_right in right.items() if not is_right]
    method = f"jfrnn {backend}{_ABOUT.get(cases, f', {cases}')}"
    about = {"kind": "exactness", "method": method, "dtype": dtype, "dim": dim, "least_rows": least_rows}
    yield about | {"cases": len(right), "wrong": len(wrong), "wrong_cases": wrong}


def oracle() -> Any:  # noqa: ANN401
    """Return the oracle of the tests."""
    return importlib.import_module("tests.reference")


# --- pairs ----------------------------------------------------------------------------------------------------------------


def _decide_pairs(cases: Iterator[Case], capacity: int, backend: Name, least_rows: int) -> Decisions:
    for case in cases:
        rows = max(case.rows, least_rows)
        options: dict[str, Any] = {name: value for name, value in case.options.items() if value is not None}
        options |= {name: _pad_rows(options[name], rows) for name in ("queries", "batch", "cutoff") if name in options}
        x = jnp.asarray(pad_points(case.positions, rows))
        nbrs = jfrnn.search(x, **options, capacity=capacity, backend=backend)
        yield case.name, found_pairs(nbrs, x, options.get("queries")) == case.expected


def pad_points(points: np.ndarray, rows: int) -> np.ndarray:
    """Fill up with points that are nowhere, so that cases of many sizes share a program."""
    return np.concatenate([points, np.full((max(rows - len(points), 0), points.shape[1]), np.nan, points.dtype)])


def _pad_rows(value: Any, rows: int) -> Any:  # noqa: ANN401
    """Fill up what has a value per row: queries, cutoffs and numbers of systems, which matter to no point that is nowhere."""
    if isinstance(value, tuple):
        return tuple(_pad_rows(part, rows) for part in value)
    if not isinstance(value, np.ndarray):
        return value
    if value.ndim == 2:
        return jnp.asarray(pad_points(value, rows))
    return np.concatenate([value, np.ones(rows - len(value), value.dtype) * (value.dtype.kind == "f")]).astype(value.dtype)


def found_pairs(nbrs: Any, x: Any, queries: Any) -> Pairs | None:  # noqa: ANN401
    """Return (i, j, image) of every slot in use, sorted; None where a slot that is not in use does not say so."""
    idx, count = np.asarray(nbrs.idx), np.asarray(nbrs.count)
    used = np.arange(nbrs.capacity) < count[:, None]
    if (idx[~used] != nbrs.source_count).any() or (idx[used] >= nbrs.source_count).any() or (idx < 0).any():
        return None
    i, k = np.nonzero(used)
    images = np.zeros((len(i), x.shape[1]), int)
    if nbrs.box is not None:
        images = np.asarray(nbrs.shifts(x, queries=queries))[i, k]
    return sorted(zip(i.tolist(), idx[i, k].tolist(), map(tuple, images.tolist()), strict=True))


def _hard(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.hard import HARD_CASES

    for name, closed in itertools.product(HARD_CASES, (False, True)):
        if name == "denormal_lattice":  # a denormal cutoff is refused
            continue
        given = HARD_CASES[name].build(dtype, dim)
        most = max(len(given.positions), 0 if given.queries is None else len(given.queries))
        options = {"cutoff": given.cutoff, "queries": given.queries, "closed": closed}
        expected = _plain_pairs(name, dtype, dim, closed)
        yield Case(f"{name}{'-closed' * closed}", given.positions, options, expected, 704 if most <= 704 else 2048)


@functools.lru_cache(maxsize=1024)
def _plain_pairs(name: str, dtype: str, dim: int, closed: bool) -> Pairs:
    from jfrnn.cases.hard import HARD_CASES

    given = HARD_CASES[name].build(dtype, dim)
    pairs = oracle().reference_pairs(given.positions, given.cutoff, queries=given.queries, closed=closed)
    return sorted((i, j, (0,) * dim) for i, j in pairs)


def _periodic(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.periodic import PERIODIC_CASES

    for name, half in itertools.product(PERIODIC_CASES, (False, True)):
        given = PERIODIC_CASES[name].build(dtype, dim)
        if any(given.periodic) and not (half and given.queries is not None):
            about = {"queries": given.queries, "half": half}
            box = {"matrix": given.matrix, "periodic": given.periodic}
            expected = sorted(oracle().reference_images(given.positions, given.cutoff, **about, **box))
            options = about | {"cutoff": given.cutoff, "box": jfrnn.Box(given.matrix, given.periodic)}
            yield Case(f"{name}{'-half' * half}", given.positions, options, expected, 304)


def _radii(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.radii import RADII_CASES

    for name, rule in itertools.product(RADII_CASES, RULES):
        given = RADII_CASES[name].build(dtype, dim)
        cutoff: Any = given.cutoffs
        if given.queries is not None:
            cutoff = {"gather": given.query_cutoffs, "scatter": cutoff}.get(rule, (cutoff, given.query_cutoffs))
        about = {"queries": given.queries, "query_radii": given.query_cutoffs, "lengths": given.lengths}
        expected = sorted(oracle().reference_radii(given.positions, given.cutoffs, rule, **about))
        box = None if given.lengths is None else jfrnn.Box(given.lengths)
        options = {"cutoff": cutoff, "queries": given.queries, "box": box, "radius_rule": rule}
        yield Case(f"{name}-{rule}", given.positions, options, expected, 128)


def _batches(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.batches import BATCH_CASES

    for name, closed in itertools.product(BATCH_CASES, (False, True)):
        given = BATCH_CASES[name].build(dtype, dim)
        of_queries, batch = given.batch, given.batch
        if given.query_batch is not None:
            of_queries, batch = given.query_batch, (given.batch, given.query_batch)
        matrix = np.ones(dim) if given.lengths is None else given.lengths
        about = {"matrix": matrix, "periodic": (given.lengths is not None,) * dim, "queries": given.queries, "closed": closed}
        pairs = oracle().reference_images(given.positions, given.cutoff, **about)
        expected = sorted(pair for pair in pairs if of_queries[pair[0]] == given.batch[pair[1]])
        box = None if given.lengths is None else jfrnn.Box(given.lengths)
        options = {"cutoff": given.cutoff, "queries": given.queries, "box": box, "closed": closed, "batch": batch}
        yield Case(f"{name}{'-closed' * closed}", given.positions, options, expected, 128)


_CASES = {"hard": _hard, "periodic": _periodic, "radii": _radii, "batches": _batches}

# --- triangles ------------------------------------------------------------------------------------------------------------


def _decide_triangles(dtype: str, dim: int, capacity: int, backend: Name) -> Decisions:
    """Say of every hard case whether its list is the oracle's, and its distances are as near as they are promised to be."""
    from jfrnn.cases.triangles import TRIANGLE_CASES, padded

    for name, case in TRIANGLE_CASES.items():
        plain = case.build(np.dtype(dtype), dim)
        given = padded(plain)
        x, vertices, faces = (jnp.asarray(array) for array in (given.positions, given.vertices, given.faces))
        tri = jfrnn.search_triangles(x, vertices, faces, given.cutoff, capacity=capacity, backend=backend)
        expected = oracle().triangle_pairs(plain.positions, plain.vertices, plain.faces, plain.cutoff)
        yield name, is_exact(tri, expected) and are_near(tri, x, plain)


def is_exact(tri: Any, expected: Any) -> bool:  # noqa: ANN401
    """Say whether a list holds exactly these pairs, each once, and says no less of itself."""
    idx, count, fill = np.asarray(tri.idx), np.asarray(tri.count), len(tri.faces)
    filled = np.all(idx[np.arange(tri.capacity) >= count[:, None]] == fill)
    if not filled or tri.overflow or int(tri.required) != int(count.max()):
        return False
    try:
        found = oracle().pairs_of(idx, count, fill)
    except AssertionError:  # indices out of range, or repeated
        return False
    return set(found) == set(expected)


def are_near(tri: Any, x: Any, given: Any) -> bool:  # noqa: ANN401
    """Say whether the distances of a list of particles x to their triangles are within what `TriangleList.closest` says."""
    _, distances, mask = (np.asarray(array) for array in tri.closest(x))
    if not np.array_equal(mask, np.arange(tri.capacity) < np.asarray(tri.count)[:, None]):
        return False
    idx, bound = np.asarray(tri.idx), 4 * float(np.finfo(distances.dtype).eps)
    for i, slot in np.argwhere(mask):
        exact, size = oracle().distance(given.positions[i], given.vertices[given.faces[idx[i, slot]]])
        if not abs(float(distances[i, slot]) - exact) <= bound * size:
            return False
    return True


# --- sums -----------------------------------------------------------------------------------------------------------------


def _decide_sums(dtype: str, dim: int, capacity: int, backend: Name, least_rows: int) -> Decisions:
    """Say of every scene and number of columns whether sums of whole numbers, exact in any order, and counts are those of the list.

    Lists are decided by the oracle. Scenes of fewer rows than the least are filled up with points that are nowhere.
    """
    random = np.random.default_rng(1)

    def is_right(x: np.ndarray, cutoff: float, columns: int, capacity: int = capacity, **options: Any) -> bool:  # noqa: ANN401
        if "queries" in options:
            options["queries"] = pad_points(options["queries"], least_rows)
        else:
            n, x = len(x), pad_points(x, least_rows)
            options |= {"batch": np.pad(options["batch"], (0, len(x) - n))} if "batch" in options else {}
        n, points = len(x), jnp.asarray(x)
        weights = random.integers(1, _LARGEST, (n, columns)).astype(dtype)
        nbrs = jfrnn.search(points, cutoff, capacity=capacity, backend="warp", **options)
        if nbrs.overflow:
            return False
        expected = np.concatenate([weights, np.zeros((1, columns), dtype)])[np.minimum(np.asarray(nbrs.idx), n)].sum(axis=1)
        asked = options.get("queries", x)
        more = {"query_values": jnp.zeros((len(asked), columns), dtype)} if "queries" in options else {}
        sums, pairs = jfrnn.pair_sum(
            lambda r, i, j: (j, 1 + 0 * r[0]), points, cutoff, jnp.asarray(weights), backend=backend, **more, **options
        )
        nowhere = np.isnan(asked).any(axis=1)  # such rows have no sum
        expected[nowhere] = np.nan
        count = np.where(nowhere, np.nan, np.asarray(nbrs.count)).astype(dtype)
        return np.array_equal(sums, expected, equal_nan=True) and np.array_equal(pairs, count, equal_nan=True)

    for columns in SUMMED:
        for name, x, cutoff, options in _scenes(random, dtype, dim):
            yield f"{name}-{columns}", is_right(x, cutoff, columns, **options)
    if jax.default_backend() != "cpu" and dim == 3:  # more threads than Warp puts into one row of a grid
        yield "large-5", is_right(_lattice(257, 3, dtype), 1.1, 5, capacity=8)


def _lattice(side: int, dim: int, dtype: str) -> np.ndarray:
    return np.stack(np.meshgrid(*[np.arange(side, dtype=dtype)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)


def _scenes(random: np.random.Generator, dtype: str, dim: int) -> Iterator[tuple[str, np.ndarray, float, dict[str, Any]]]:
    """Yield names, positions, cutoffs and options of searches with up to 256 neighbors."""
    x = random.random((3000, dim)).astype(dtype)
    cutoff = {2: 0.06, 3: 0.15}[dim]
    beyond = (random.random((1501, dim)) * 1.3 - 0.1).astype(dtype)
    yield "one", x[:1], cutoff, {}
    yield "open", x, cutoff, {}
    yield "self", x, cutoff, {"include_self": True}
    yield "box", x, cutoff, {"box": jfrnn.Box((1.0,) * dim)}
    yield "batch", x, cutoff, {"batch": random.integers(0, 3, len(x)).astype(np.int32)}
    yield "queries", x, cutoff, {"queries": beyond}
    if dim == 3:
        yield "skewed", x, cutoff, {"box": jfrnn.Box(np.array([[1, 0.3, 0], [0, 1, 0.2], [0.1, 0, 1]]))}
    sites = _lattice(12, dim, "float64")
    yield "ties", (0.1 * sites).astype(dtype), 0.3, {}
    yield "ties-closed", sites.astype(dtype), 3.0, {"closed": True}
    clump = np.concatenate([0.01 * random.normal(size=(150, dim)), 50 * random.random((500, dim))])
    yield "clump", clump.astype(dtype), 0.012, {}
    broken = x.copy()
    broken[::7] = np.nan
    yield "nan", broken, cutoff, {}
