"""Cells: the exact floor, neighbors that touch, gaps that close, and both ways to look a cell up."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

from jfrnn._geometry import cells as _cells
from jfrnn._geometry.cutoffs import smallest_cutoff


def edge_of(cutoff, dtype):
    return np.asarray(_cells.cell_edge(dtype(cutoff)))[()]


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
    cells = np.asarray(_cells.cell_coordinate(jnp.asarray(x), edge))
    assert [int(c) for c in cells] == [true_cell(v, edge) for v in x]


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
        too_far = np.array([Fraction(float(b)) - Fraction(float(a)) > Fraction(float(radius)) for a, b in zip(start, partner)])
        partner = np.where(too_far, np.nextafter(partner, dtype(-np.inf)), partner)
    assert not np.any([Fraction(float(b)) - Fraction(float(a)) > Fraction(float(radius)) for a, b in zip(start, partner)])
    cells = [np.asarray(_cells.cell_coordinate(jnp.asarray(x), edge), np.float64) for x in (start, partner)]
    assert np.max(cells[1] - cells[0]) <= 1
    assert np.min(cells[1] - cells[0]) >= 0


def test_gaps_close_and_contacts_stay():
    cells = jnp.array([7.0, -3.0, 8.0, 1e30, 7.0, 100.0, -np.inf])
    np.testing.assert_array_equal(_cells._squeeze_gaps(cells), [4, 2, 5, 9, 4, 7, 0])


def test_flushed_denormals_stay_within_the_edge_s_margin(dtype):
    """A negative denormal may count as 0 and land one cell up: the edge exceeds every cutoff by more than a denormal."""
    cutoff = dtype(np.nextafter(dtype(2 * smallest_cutoff(np.dtype(dtype))), dtype(0)))
    assert Fraction(float(edge_of(cutoff, dtype))) - Fraction(float(cutoff)) > 2 * Fraction(float(np.finfo(dtype).tiny))


@pytest.mark.parametrize("spread", [1.0, 1e3, 1e6, 1e12])
def test_extent_is_bounded_by_the_particles(dtype, spread):
    rng = np.random.default_rng(3)
    x = jnp.asarray(rng.uniform(-spread, spread, (3, 50)), dtype)
    coords, extent = _cells.grid_coordinates(x, _cells.open_axes(edge_of(0.5, dtype), 3), jnp.ones(50, bool))
    assert (coords >= 1).all()
    assert (coords < extent[:, None] - 1).all()
    assert (extent <= max(_cells._SMALLEST_TABLE, 2 * 50 + 2)).all()


@pytest.mark.parametrize("dense", [True, False])
def test_table_and_binary_search_find_the_same_rows(dense):
    rng = np.random.default_rng(4)
    coords = jnp.asarray(rng.integers(1, 6, (3, 80)), jnp.int32)
    finite = jnp.asarray(rng.random(80) > 0.1)
    grid = _cells.build_grid(coords, finite, jnp.array([7, 7, 7], jnp.int32), 80)
    assert grid.dense
    grid = grid._replace(dense=jnp.asarray(dense))
    if not dense:
        order = _cells.cell_order(coords, finite, grid.extent, grid.dense)
        np.testing.assert_array_equal(order, grid.order)
    x, y, z = (jnp.asarray(c, jnp.int32)[:, None] for c in rng.integers(1, 6, (3, 40)))
    start, stop = _cells.places_between(grid, [x - 1, x + 1, y, z])
    found = [set(range(a, b)) for a, b in zip(start[:, 0].tolist(), stop[:, 0].tolist(), strict=True)]
    sorted_coords = np.asarray(grid.coords).T
    for q, of_query in enumerate(found):
        near = np.abs(sorted_coords - [int(x[q, 0]), int(y[q, 0]), int(z[q, 0])]) <= [1, 0, 0]
        assert of_query == set(np.flatnonzero(near.all(axis=1)).tolist())
    assert sorted(grid.order.tolist()) == list(range(80))
    assert not finite[grid.order[int(finite.sum()) :]].any()
