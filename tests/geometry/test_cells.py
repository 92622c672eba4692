"""Cells: the exact floor, and neighbors that touch."""

from fractions import Fraction

import jax
import numpy as np
import pytest

from jfrnn._geometry import cell_line as _cells
from jfrnn._geometry.cutoffs import cutoff_range

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


def test_flushed_denormals_stay_within_the_edge_s_margin(dtype):
    """A negative denormal may count as 0 and land one cell up: the edge exceeds every cutoff by more than a denormal."""
    cutoff = dtype(np.nextafter(dtype(2 * cutoff_range(np.dtype(dtype))[0]), dtype(0)))
    assert Fraction(float(edge_of(cutoff, dtype))) - Fraction(float(cutoff)) > 2 * Fraction(float(np.finfo(dtype).tiny))
