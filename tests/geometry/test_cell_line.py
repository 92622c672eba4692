"""Cells numbered along a line: every candidate once, in domains that fit into the table and in others."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jfrnn._geometry import cell_line
from jfrnn._geometry.cell_line import CellAxes, cell_edge, open_axes
from jfrnn._geometry.images import Images

CUTOFF = 0.1


def runs_of(line, cells, queries, images=None):
    """Return the sources along the line, twice, and the runs of queries."""
    return line.twice(), *cell_line.line_runs(line, cells.of(jnp.asarray(queries)), images)


@functools.partial(jax.jit, static_argnums=1)
def runs_along_line(x, sources, queries):
    """Sort and look up in one program, which scenes of the same shape share."""
    axes = open_axes(cell_edge(jnp.asarray(CUTOFF, x.dtype)), x.shape[1])
    return runs_of(*cell_line.sort_along_line(x.T, axes, sources, None), queries)


def candidates(twice, start, stop, code):
    """Return the sources and image codes of each query's runs, one list per query."""
    twice, start, stop = map(np.asarray, (twice, start, stop))
    code = np.zeros_like(start) if code is None else np.asarray(code)
    rows = [list(zip(*row, strict=True)) for row in zip(start.tolist(), stop.tolist(), code.tolist(), strict=True)]
    return [[(int(twice[p]), c) for a, b, c in row for p in range(a, b)] for row in rows]


@pytest.mark.parametrize("spread", [1.0, 50.0, 1e6, 1e12, 1e30])
def test_every_pair_is_met_once(spread, dtype, dim):
    """Blobs far apart, lone particles, infinite ones, and queries that are particles or lie elsewhere."""
    rng = np.random.default_rng(7)
    blobs = rng.uniform(-spread, spread, (4, 1, dim)) + rng.uniform(-0.3, 0.3, (4, 50, dim))
    x = np.concatenate([blobs.reshape(-1, dim), rng.uniform(-spread, spread, (60, dim)), np.full((5, dim), np.inf)]).astype(dtype)
    x = rng.permutation(x)
    asked = x[rng.integers(0, len(x), 30)] + dtype(0.01)
    places = np.arange(len(x) + 30)
    points = np.concatenate([x, asked]).astype(np.float64)
    for q, found in zip(places, candidates(*runs_along_line(np.concatenate([x, asked]), len(x), places)), strict=True):
        met = [j for j, _ in found]
        assert len(met) == len(set(met))
        with np.errstate(invalid="ignore"):
            near = (np.abs(points[: len(x)] - points[q]) < CUTOFF).all(axis=1)
        assert set(np.flatnonzero(near)) <= set(met)
        assert np.isfinite(points[q]).all() or not met


def test_candidates_follow_the_particles(dtype):
    """In a domain of 10^18 cells a query reads its own blob and little else; rows that share a number are few."""
    rng = np.random.default_rng(3)
    x = (rng.uniform(0, 1e5, (200, 1, 3)) + rng.uniform(-0.05, 0.05, (200, 20, 3))).reshape(-1, 3).astype(dtype)
    _, start, stop, _ = runs_along_line(x, len(x), np.arange(len(x)))
    met = (np.asarray(stop) - np.asarray(start)).sum(axis=1)
    assert met.mean() < 20 + 81  # a run covers 9 numbers, and there are at least twice as many numbers as particles
    assert met.max() < 12 * 20


@pytest.mark.parametrize("count", [1, 2, 3])
def test_rows_keep_apart_in_every_table(count):
    """`_constants` raises AssertionError if rows overlap."""
    for bits in range(12, 31):
        strides = cell_line._constants(count, 1 << bits)
        assert all(stride % 2 == 1 for stride in strides)


@pytest.mark.parametrize(
    "images", [Images((True,) * 3, True, (1, 1, 1), True), Images((True, False, True), True, (2, 0, 1), False)]
)
@pytest.mark.parametrize("crowded", [True, False])
def test_runs_of_a_torus_meet_every_image_once(images, crowded, monkeypatch):
    """Parts of cells within reach, images told apart, against all shifts of all sources; also where numbers are shared."""
    if crowded:
        monkeypatch.setattr(cell_line, "_strides", lambda lengths, size: cell_line._constants(len(lengths) - 1, size))
    rng = np.random.default_rng(5)
    turns = np.array([4, 7, 2]) if images.nearest else np.array([1, 1, 2])
    axes = CellAxes([np.float32(0.125)] * 3, [np.float32(t) if p else None for t, p in zip(turns, images.periodic, strict=True)])
    x = rng.random((60, 3)).astype(np.float32)
    places = np.arange(len(x))

    @jax.jit
    def all_runs(x, axes):
        line, cells = cell_line.sort_along_line(x.T, axes, len(x), None)
        return runs_of(line, cells, places, images), cells.along

    runs, along = all_runs(x, axes)
    fine = np.asarray(along).astype(np.int64).T
    period = np.array([4 * turns[0], turns[1], turns[2]]) * images.periodic
    width = np.array([4, 1, 1]) * np.maximum(images.reach, 1)
    for q, found in zip(places, candidates(*runs), strict=True):
        expected = [
            (j, code)
            for code, shift in enumerate(images.shifts)
            for j in places
            if (np.abs(fine[j] + shift * period - fine[q]) <= width).all()
        ]
        assert len(found) == len(set(found))
        assert set(expected) <= set(found)


def test_a_program_does_not_grow_with_the_images():
    """One set of operations serves all pieces of a row: a program with 703 pieces took minutes to compile."""

    def length(reach):
        images, one = Images((True,) * 3, True, (reach, 2, 2), False), jnp.float32(1)
        axes = CellAxes([one / 8] * 3, [one] * 3)

        def runs(x):
            line, cells = cell_line.sort_along_line(x.T, axes, len(x), None)
            return cell_line.line_runs(line, cells, images)

        return len(jax.make_jaxpr(runs)(jnp.zeros((60, 3), jnp.float32)).eqns)

    assert length(2) == length(351)


@pytest.mark.parametrize("n", [1, 2, 5000, 20_000])
def test_key_and_index_are_sorted_as_one_word(n):
    """Up to 16 384 particles in one pass, then in two; equal keys stay in order."""
    size = cell_line.table_size(n)
    key = np.random.default_rng(n).integers(0, size + 1, n).astype(np.uint32) // 3 * 3
    key[-1] = size
    keys, order = jax.jit(cell_line._sort, static_argnums=(1, 2))(key, size, cell_line.Sorting(packed=True))
    expected = np.argsort(key, kind="stable")
    np.testing.assert_array_equal(order, expected)
    np.testing.assert_array_equal(keys, key[expected])
