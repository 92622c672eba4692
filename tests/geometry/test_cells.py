"""Cells: the exact floor, neighbors that touch, gaps that close, and both ways to look a cell up."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jfrnn._geometry import cells as _cells
from jfrnn._geometry.cutoffs import smallest_cutoff

cell_edge, cell_coordinate = jax.jit(_cells.cell_edge), jax.jit(_cells.cell_coordinate)


def edge_of(cutoff, dtype):
    return np.asarray(cell_edge(dtype(cutoff)))[()]


def true_cell(x, edge):
    below = Fraction(float(abs(x))) // Fraction(float(edge))
    return -1 - below if x < 0 else below


@pytest.mark.parametrize("cutoff", [3e-4, 0.1, 1.0, 1 / 3, 7.0, 1e6])
def test_edge_exceeds_the_cutoff_slightly(dtype, cutoff):
    edge = edge_of(cutoff, dtype)
    half = 11 if dtype == np.float32 else 25
    assert dtype(cutoff) < edge <= dtype(cutoff) * (1 + 2.0**-half)


@pytest.mark.parametrize("cutoff", [3e-4, 0.1, 1.0, 1 / 3, 7.0])
def test_cell_is_the_exact_floor(dtype, cutoff):
    edge = edge_of(cutoff, dtype)
    rng = np.random.default_rng(1)
    whole = np.concatenate([np.arange(-300, 300), rng.integers(-(2**22), 2**22, 500)]).astype(np.float64)
    at_edges = (whole * float(edge)).astype(dtype)
    x = np.concatenate([np.nextafter(at_edges, dtype(-np.inf)), at_edges, np.nextafter(at_edges, dtype(np.inf))])
    x = x[(x == 0) | (abs(x) >= np.finfo(dtype).tiny)]  # XLA on CPU flushes denormals: next test but one
    x = np.concatenate([x, rng.uniform(-1e3, 1e3, 500).astype(dtype), np.array([0.0, -0.0, 1e-30, -1e-30], dtype)])
    cells = np.asarray(cell_coordinate(np.resize(x, 4000), edge))[: len(x)]
    assert [int(c) for c in cells] == [true_cell(v, edge) for v in x]


def farther(a, b, radius):
    """Say where b - a > radius, exactly: by the difference as floats have it, and by what that lost (Knuth's sum of two)."""
    difference = b - a
    back = difference - b
    lost = (b - (difference - back)) - (a + back)
    return (difference > radius) | ((difference == radius) & (lost > 0))


@pytest.mark.parametrize("cutoff", [3e-4, 0.1, 1 / 3, 7.0])
@pytest.mark.parametrize("reach", [1e2, 1e5, 1e7, 1e9, 1e15])
def test_no_pair_is_two_cells_apart(dtype, cutoff, reach):
    """Adversarial: x just below a multiple of the edge, its partner as far above as the cutoff allows."""
    edge, radius = edge_of(cutoff, dtype), dtype(cutoff)
    rng = np.random.default_rng(2)
    start = (np.round(rng.uniform(-reach, reach, 2000)) * float(edge)).astype(dtype)
    start = np.concatenate([start, np.nextafter(start, dtype(-np.inf))])
    partner = start + radius
    for _ in range(3):  # step back until no further apart than the cutoff
        partner = np.where(farther(start, partner, radius), np.nextafter(partner, dtype(-np.inf)), partner)
    some = slice(None, None, 16)
    apart = [Fraction(float(b)) - Fraction(float(a)) for a, b in zip(start[some], partner[some])]
    assert not np.any(farther(start, partner, radius))
    assert max(apart) <= Fraction(float(radius))
    cells = [np.asarray(cell_coordinate(x, edge), np.float64) for x in (start, partner)]
    assert np.max(cells[1] - cells[0]) <= 1
    assert np.min(cells[1] - cells[0]) >= 0


def test_gaps_close_and_contacts_stay():
    cells = np.array([7.0, -3.0, 8.0, 1e30, 7.0, 100.0, -np.inf])
    np.testing.assert_array_equal(jax.jit(_cells._squeeze_gaps)(cells), [4, 2, 5, 9, 4, 7, 0])


def test_flushed_denormals_stay_within_the_edge_s_margin(dtype):
    """A negative denormal may count as 0 and land one cell up: the edge exceeds every cutoff by more than a denormal."""
    cutoff = dtype(np.nextafter(dtype(2 * smallest_cutoff(np.dtype(dtype))), dtype(0)))
    assert Fraction(float(edge_of(cutoff, dtype))) - Fraction(float(cutoff)) > 2 * Fraction(float(np.finfo(dtype).tiny))


@jax.jit
def coordinates(x, edge):
    return _cells.grid_coordinates(x, _cells.open_axes(edge, 3), jnp.ones(x.shape[1], bool))


@pytest.mark.parametrize("spread", [1.0, 1e3, 1e6, 1e12])
def test_extent_is_bounded_by_the_particles(dtype, spread):
    rng = np.random.default_rng(3)
    x = rng.uniform(-spread, spread, (3, 50)).astype(dtype)
    coords, extent = map(np.asarray, coordinates(x, edge_of(0.5, dtype)))
    assert (coords >= 1).all()
    assert (coords < extent[:, None] - 1).all()
    assert (extent <= max(_cells._SMALLEST_TABLE, 2 * 50 + 2)).all()


@jax.jit
def rows_of(coords, finite, asked, dense):
    """Return the grid, the order of cells that a search among them takes, and which places of it rows of three cells take."""
    grid = _cells.build_grid(coords, finite, jnp.array([7, 7, 7], jnp.int32), 80)
    x, y, z = (c[:, None] for c in asked)
    order = _cells.cell_order(coords, finite, grid.extent, dense)
    return grid, order, *_cells.places_between(grid._replace(dense=dense), [x - 1, x + 1, y, z])


@pytest.mark.parametrize("dense", [True, False])
def test_table_and_binary_search_find_the_same_rows(dense):
    rng = np.random.default_rng(4)
    coords, finite = rng.integers(1, 6, (3, 80)).astype(np.int32), rng.random(80) > 0.1
    asked = rng.integers(1, 6, (3, 40)).astype(np.int32)
    grid, order, start, stop = rows_of(coords, finite, asked, dense)
    assert grid.dense
    np.testing.assert_array_equal(order, grid.order)
    start, stop = np.asarray(start), np.asarray(stop)
    found = [set(range(a, b)) for a, b in zip(start[:, 0].tolist(), stop[:, 0].tolist(), strict=True)]
    sorted_coords = np.asarray(grid.coords).T
    for q, of_query in enumerate(found):
        near = np.abs(sorted_coords - asked[:, q]) <= [1, 0, 0]
        assert of_query == set(np.flatnonzero(near.all(axis=1)).tolist())
    assert sorted(grid.order.tolist()) == list(range(80))
    assert not finite[np.asarray(grid.order)[finite.sum() :]].any()
