"""Cells: the exact floor, and neighbors that touch."""

from fractions import Fraction

import jax
import numpy as np
import pytest
import reference

import jfrnn
from jfrnn._geometry import cell_line as _cells
from jfrnn._geometry.cutoffs import RANGE_OF

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
    cutoff = dtype(np.nextafter(dtype(2 * RANGE_OF[np.dtype(dtype)][0]), dtype(0)))
    assert Fraction(float(edge_of(cutoff, dtype))) - Fraction(float(cutoff)) > 2 * Fraction(float(np.finfo(dtype).tiny))


@pytest.mark.parametrize("backend", ["warp", pytest.param("jax", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("dtype", "dim", "away"), [(np.float32, 3, 1e4), (np.float64, 2, 1e200)])
@pytest.mark.parametrize("order", ["shuffled", "along x"])
def test_few_particles_far_from_all_others(dtype, dim, away, order, backend):
    """A box of cells without them may be small enough where one with them is not; they have neighbors all the same."""
    random, n, cutoff = np.random.default_rng(3), 6000, 0.05 if dim == 3 else 0.012
    x = random.random((n, dim))
    x[:24] = away * random.normal(size=(24, dim))
    x[24:32] = x[:8] * (1 + 1e-7)  # closer than the cutoff at 1e4, if in float32 they are not alike, and never at 1e200
    x[32:40] = x[32:40].round() + 0.3 * cutoff * random.normal(size=(8, dim))  # on both sides of the corners
    x[40:43] = [np.r_[1e3, x[43, 1:]], np.r_[1e3 + 0.5 * cutoff, x[43, 1:]], np.r_[x[43, :-1], -1e3]]  # beside the box
    x = (x if order == "shuffled" else x[np.argsort(x[:, 0])]).astype(dtype)
    nbrs = jfrnn.search(x, cutoff, capacity=64, backend=backend)
    expected = reference.reference_pairs(x, cutoff)
    assert sorted(reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), n)) == sorted(expected)
    queries = np.concatenate([x[::7], 3 * x[::50], x[:40] + dtype(0.01)])
    counts = np.asarray(jfrnn.count(x, cutoff, queries=queries, backend=backend))
    found = [i for i, _ in reference.reference_pairs(x, cutoff, queries=queries)]
    assert counts.tolist() == np.bincount(found, minlength=len(queries)).tolist()
