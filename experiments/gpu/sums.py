"""Pair sums in a run on a GPU: sums of whole numbers, exact in any order, against those over lists, which the oracle decides."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jfrnn
from experiments._library import Name

COLUMNS = (1, 5, 9, 14)  # numbers of a neighbor that a term reads, besides its position
_LARGEST = 512  # such that no sum of a row leaves the integers of float32


def decisions(dtype: str, dim: int, capacity: int, backend: Name, least_rows: int = 0) -> Iterator[tuple[str, bool]]:
    """Say of every scene, and of every number of columns, whether sums and counts of pairs are those of the list.

    Scenes of fewer rows than the least are filled up with points that are nowhere.
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
        queries = options.get("queries")
        more = {} if queries is None else {"query_values": jnp.zeros((len(queries), columns), dtype)}
        sums, pairs = jfrnn.pair_sum(
            lambda r, i, j: (j, 1 + 0 * r[0]), points, cutoff, jnp.asarray(weights), backend=backend, **more, **options
        )
        asked = options.get("queries", x)
        nowhere = np.isnan(asked).any(axis=1)  # such rows have no sum
        expected[nowhere] = np.nan
        count = np.where(nowhere, np.nan, np.asarray(nbrs.count)).astype(dtype)
        return np.array_equal(sums, expected, equal_nan=True) and np.array_equal(pairs, count, equal_nan=True)

    for columns in COLUMNS:
        for name, x, cutoff, options in _scenes(random, dtype, dim):
            yield f"{name}-{columns}", is_right(x, cutoff, columns, **options)
    if jax.default_backend() != "cpu" and dim == 3:  # more threads than Warp puts into one row of a grid
        yield "large-5", is_right(_lattice(257, 3, dtype), 1.1, 5, capacity=8)


def pad_points(points: np.ndarray, rows: int) -> np.ndarray:
    """Fill up with points that are nowhere, so that cases of many sizes share a program."""
    return np.concatenate([points, np.full((max(rows - len(points), 0), points.shape[1]), np.nan, points.dtype)])


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
