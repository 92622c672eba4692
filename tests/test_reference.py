import math
from fractions import Fraction
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jfrnn.cases.hard import HARD_CASES
from reference import compare, is_pair, pairs_of, reference_pairs

DTYPES = (np.float32, np.float64)
DIMS = (2, 3)
BUILDS = list(product(DTYPES, DIMS))
ULP_CASES = [name for name in HARD_CASES if name.startswith("ulp_")]


def squared(a, b):
    return sum((Fraction(y) - Fraction(x)) ** 2 for x, y in zip(a.tolist(), b.tolist(), strict=True))


def looped_pairs(queries, sources, cutoff, closed=False):
    """The definition, in two loops and without cells: also (i, i)."""
    limit = Fraction(float(sources.dtype.type(cutoff))) ** 2
    distances = {(i, j): squared(a, b) for i, a in enumerate(queries) for j, b in enumerate(sources)}
    return {pair for pair, d2 in distances.items() if d2 < limit or (closed and d2 == limit)}


def without_self(pairs):
    return {(i, j) for i, j in pairs if i != j}


def rounded(value, bits):
    """Round a fraction to so many significant bits."""
    if value == 0:
        return value
    scale = Fraction(2) ** (bits - value.numerator.bit_length() + value.denominator.bit_length())
    return round(value * scale) / scale


def decided_in(bits, a, b, cutoff, closed):
    """Decide a pair in floating-point arithmetic of so many bits, with any exponent."""
    total = Fraction(0)
    for x, y in zip(a.tolist(), b.tolist(), strict=True):
        step = rounded(Fraction(y) - Fraction(x), bits)
        total = rounded(total + rounded(step**2, bits), bits)
    limit = rounded(Fraction(float(a.dtype.type(cutoff))) ** 2, bits)
    return total <= limit if closed else total < limit


# The oracle, by hand


@pytest.mark.parametrize("dtype", DTYPES)
def test_hand_computed_pairs(dtype):
    x = np.array([[0, 0], [3, 4], [0, 5], [0, 0], [-4, 3]], dtype)
    strict = {(0, 3), (3, 0), (1, 2), (2, 1), (2, 4), (4, 2)}
    ties = {(i, j) for a, b in ((0, 1), (0, 2), (0, 4), (3, 1), (3, 2), (3, 4)) for i, j in ((a, b), (b, a))}
    assert reference_pairs(x, 5.0) == strict
    assert reference_pairs(x, 5.0, closed=True) == strict | ties
    assert reference_pairs(x, 5.0, half=True) == {(0, 3), (1, 2), (2, 4)}
    everyone = {(i, i) for i in range(5)}
    assert reference_pairs(x, 5.0, include_self=True) == strict | everyone
    assert reference_pairs(x, 5.0, include_self=True, half=True) == {(0, 3), (1, 2), (2, 4)} | everyone


def test_queries_have_no_self():
    sources = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    queries = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0], [9.0, 0.0, 0.0]])
    assert reference_pairs(sources, 1.0, queries=queries) == {(0, 0), (1, 1)}
    assert reference_pairs(sources, 1.0, queries=queries, closed=True) == {(0, 0), (0, 1), (1, 1)}
    for option in ("half", "include_self"):
        with pytest.raises(ValueError, match="leave them out with queries"):
            reference_pairs(sources, 1.0, queries=queries, **{option: True})


def test_interior_site_of_the_thesis_lattice():
    sites = np.array(list(product(range(-3, 4), repeat=3)), float)
    center = np.zeros((1, 3))
    assert len(reference_pairs(sites, 3.0, queries=center)) == 92 + 1
    assert len(reference_pairs(sites, 3.0, queries=center, closed=True)) == 122 + 1
    middle = len(sites) // 2
    among = reference_pairs(sites, 3.0)
    assert sum(i == middle for i, _ in among) == 92
    assert sum(i == middle for i, _ in reference_pairs(sites, 3.0, closed=True)) == 122


def test_points_that_are_not_finite_have_no_pairs():
    x = np.array([[0.0, 0.0], [0.5, np.nan], [np.inf, 0.0], [-np.inf, 0.0], [0.5, 0.0], [np.inf, 0.0]])
    assert reference_pairs(x, 1.0, include_self=True) == {(0, 0), (4, 4), (0, 4), (4, 0)}
    assert reference_pairs(x[:1], 1.0, queries=x) == {(0, 0), (4, 0)}
    assert not is_pair(x[2], x[2], 1.0, closed=True)
    assert not is_pair(x[1], x[0], 1.0)


def test_cutoff_is_rounded_once_to_the_dtype():
    tie = float(np.float32(0.7))
    assert tie < 0.7
    assert not is_pair(np.float32([0, 0]), np.float32([tie, 0]), 0.7)
    assert is_pair(np.float32([0, 0]), np.float32([tie, 0]), 0.7, closed=True)
    assert is_pair([0.0, 0.0], [tie, 0.0], 0.7)
    assert reference_pairs(np.float32([[0, 0], [tie, 0]]), 0.7) == set()
    assert reference_pairs(np.array([[0, 0], [tie, 0]]), 0.7) == {(0, 1), (1, 0)}


@pytest.mark.parametrize("residue", [2.0**-60, 2.0**-100, 2.0**-1022, 2.0**-1074])
def test_residues_decide(residue):
    origin, unit = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]
    assert is_pair(origin, unit, 1.0, closed=True)
    assert not is_pair(origin, [1.0, residue, 0.0], 1.0, closed=True)
    assert is_pair([residue, 0.0, 0.0], unit, 1.0)
    assert not is_pair([-residue, 0.0, 0.0], unit, 1.0, closed=True)
    x = np.array([origin, unit, [1.0, residue, 0.0], [residue, 0.0, 0.0]])
    near = {(1, 2), (0, 3), (1, 3)}
    assert reference_pairs(x, 1.0, half=True) - {(2, 3)} == near
    assert reference_pairs(x, 1.0, half=True, closed=True) - {(2, 3)} == near | {(0, 1)}


@pytest.mark.parametrize("cutoff", [0.0, -1.0, math.nan, math.inf, 1e39, 1e-60])
def test_refuses_a_cutoff_that_is_none(cutoff):
    with pytest.raises(ValueError, match="positive and finite in float32"):
        reference_pairs(np.zeros((2, 3), np.float32), cutoff)


def test_refuses_points_it_cannot_read():
    with pytest.raises(TypeError, match="float32 or float64"):
        reference_pairs(np.zeros((2, 3), int), 1.0)
    with pytest.raises(ValueError, match=r"shape \[n, d\]"):
        reference_pairs(np.zeros((2, 4)), 1.0)
    with pytest.raises(ValueError, match="give the same"):
        reference_pairs(np.zeros((2, 3)), 1.0, queries=np.zeros((2, 2)))
    with pytest.raises(ValueError, match="give both the same"):
        is_pair([0.0, 0.0], [0.0, 0.0, 0.0], 1.0)


# The oracle, against the definition

whole = st.integers(-6, 6).map(float)
scaled = st.builds(math.ldexp, st.sampled_from([1.0, -1.0, 1.25, 1 + 2.0**-52]), st.integers(-1074, 1000))
coordinate = st.one_of(whole, scaled, st.floats(-3, 3, allow_subnormal=True))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 3).flatmap(lambda d: st.lists(st.lists(coordinate, min_size=d, max_size=d), min_size=1, max_size=9)),
    st.one_of(st.sampled_from([1.0, 3.0, 5.0, math.sqrt(2)]), scaled.map(abs)),
    st.booleans(),
)
def test_equals_the_definition(points, cutoff, closed):
    x = np.array(points)
    everything = looped_pairs(x, x, cutoff, closed)
    assert reference_pairs(x, cutoff, closed=closed) == without_self(everything)
    assert reference_pairs(x, cutoff, closed=closed, include_self=True) == everything
    assert reference_pairs(x, cutoff, closed=closed, queries=x[::-2]) == looped_pairs(x[::-2], x, cutoff, closed)
    one_by_one = product(range(len(x)), repeat=2)
    assert {(i, j) for i, j in one_by_one if is_pair(x[i], x[j], cutoff, closed=closed)} == everything


@pytest.mark.parametrize("name", HARD_CASES)
def test_equals_the_definition_on_hard_cases(name):
    for dtype, dim in BUILDS:
        hard = HARD_CASES[name].build(dtype, dim)
        sources = hard.positions[-20:]
        queries = sources if hard.queries is None else hard.queries[-20:]
        for closed in (False, True):
            found = reference_pairs(sources, hard.cutoff, queries=queries, closed=closed)
            assert found == looped_pairs(queries, sources, hard.cutoff, closed)


@pytest.mark.parametrize("name", HARD_CASES)
def test_is_symmetric_and_half_is_half(name):
    hard = HARD_CASES[name].build(np.float32, 3)
    pairs = reference_pairs(hard.positions, hard.cutoff)
    assert pairs == {(j, i) for i, j in pairs}
    assert reference_pairs(hard.positions, hard.cutoff, half=True) == {(i, j) for i, j in pairs if j > i}


# Comparing


def test_compare_takes_every_form():
    expected = {(0, 1), (1, 0)}
    found = [(0, 1), (2, 0)]
    i, j = np.array(found, np.int32).T
    for form in (found, iter(found), np.array(found), (i, j), tuple(found), set(found)):
        assert compare(form, expected) == ({(1, 0)}, {(2, 0)})
    assert compare([], expected) == (expected, set())
    assert compare((i[:0], j[:0]), set()) == (set(), set())
    assert all(type(k) is int for pair in compare((i, j), set())[1] for k in pair)


def test_compare_refuses_repeats():
    with pytest.raises(AssertionError, match=r"more than once: \[\(0, 1\)\]"):
        compare([(0, 1), (1, 0), (0, 1)], set())


def test_pairs_of_a_padded_list():
    idx = np.array([[1, 2, 3], [0, 3, 3], [3, 3, 3]], np.int32)
    assert pairs_of(idx, np.array([2, 1, 0], np.int32), 3) == [(0, 1), (0, 2), (1, 0)]
    assert pairs_of(np.array([[1, 2]], np.int32), np.array([7], np.int32), 3) == [(0, 1), (0, 2)]  # overflow
    assert pairs_of(np.zeros((2, 0), np.int32), np.array([0, 4], np.int32), 3) == []


@pytest.mark.parametrize(
    ("row", "count", "message"),
    [
        ([1, 1, 3], 2, "more than once"),
        ([1, 2, 0], 2, "unused slots of row 0 must hold 3"),
        ([1, 2, -1], 2, "unused slots"),
        ([1, 3, 3], 2, "but holds"),
        ([-1, 3, 3], 1, "but holds"),
        ([3, 3, 3], -1, "counts -1"),
    ],
)
def test_pairs_of_refuses(row, count, message):
    with pytest.raises(AssertionError, match=message):
        pairs_of(np.array([row], np.int32), np.array([count], np.int32), 3)


def test_pairs_of_refuses_other_shapes_and_dtypes():
    idx, count = np.zeros((2, 3), np.int32), np.zeros(2, np.int32)
    with pytest.raises(AssertionError, match="must be int32"):
        pairs_of(idx.astype(np.int64), count, 3)
    with pytest.raises(AssertionError, match=r"must be \[n, capacity\]"):
        pairs_of(idx, count[:1], 3)


# The hard cases


@pytest.mark.parametrize("name", HARD_CASES)
def test_hard_case_is_what_it_says(name):
    case = HARD_CASES[name]
    assert case.name == name
    assert case.mechanism and "\n" not in case.mechanism
    for dtype, dim in BUILDS:
        hard, again = case.build(dtype, dim), case.build(np.dtype(dtype).name, dim)
        assert hard.cutoff == again.cutoff and type(hard.cutoff) is float
        assert 0 < np.dtype(dtype).type(hard.cutoff) < np.inf
        for points, repeated in ((hard.positions, again.positions), (hard.queries, again.queries)):
            if points is None:
                assert repeated is None
                continue
            assert points.dtype == dtype and points.ndim == 2 and points.shape[1] == dim
            assert len(points) <= 2000 and np.isfinite(points).all()
            assert points.tobytes() == repeated.tobytes()
            # so that a machine which flushes denormals can be told by the name of the case
            assert "denormal" in name or not ((points != 0) & (np.abs(points) < np.finfo(dtype).tiny)).any()


def test_hard_cases_refuse_other_dtypes_and_dimensions():
    for dtype, dim in ((np.float16, 3), (np.int32, 2), (np.float32, 1)):
        with pytest.raises(ValueError, match="float32 or float64, in 2 or 3"):
            HARD_CASES["uniform"].build(dtype, dim)


@pytest.mark.parametrize(("dtype", "dim"), BUILDS)
@pytest.mark.parametrize("name", ULP_CASES)
def test_ulp_pairs_straddle_the_cutoff(name, dtype, dim):
    hard = HARD_CASES[name].build(dtype, dim)
    radius, ulp = Fraction(float(dtype(hard.cutoff))), Fraction(float(np.spacing(dtype(hard.cutoff))))
    shells = []
    for a, b in zip(hard.positions[::2], hard.positions[1::2], strict=True):
        d2 = squared(a, b)
        shells += [k for k in range(-3, 3) if (radius + k * ulp) ** 2 < d2 < (radius + (k + 1) * ulp) ** 2]
        assert is_pair(a, b, hard.cutoff) == (shells[-1] < 0)
    assert [shells.count(k) for k in range(-3, 3)] == [20] * 6


@pytest.mark.parametrize("dtype", DTYPES)
def test_ulp_pairs_are_beyond_the_working_precision(dtype):
    wrong = 0
    for name, dim in product(ULP_CASES, DIMS):
        hard = HARD_CASES[name].build(dtype, dim)
        r2 = dtype(hard.cutoff) * dtype(hard.cutoff)
        for a, b in zip(hard.positions[::2], hard.positions[1::2], strict=True):
            wrong += bool(np.sum((b - a) ** 2) < r2) != is_pair(a, b, hard.cutoff)
    assert wrong >= 20  # of 960


@pytest.mark.parametrize(("dtype", "dim"), BUILDS)
@pytest.mark.parametrize("name", ["residues", "residues_denormal", "residues_balanced"])
def test_residues_are_beyond_twice_the_precision(name, dtype, dim):
    hard = HARD_CASES[name].build(dtype, dim)
    x = hard.positions
    bits = 53 if dtype == np.float32 else 106
    for closed in (False, True):
        exact = reference_pairs(x, hard.cutoff, closed=closed)
        pairs = combinations(range(len(x)), 2)
        assert any(decided_in(bits, x[i], x[j], hard.cutoff, closed) != ((i, j) in exact) for i, j in pairs)


@pytest.mark.parametrize("dim", DIMS)
def test_residues_are_beyond_float64(dim):
    hard = HARD_CASES["residues_balanced"].build(np.float32, dim)
    x = hard.positions.astype(np.float64)
    d2 = ((x[None] - x[:, None]) ** 2).sum(-1)
    assert set(zip(*map(np.ndarray.tolist, np.nonzero(d2 < 1)), strict=True)) != reference_pairs(
        hard.positions, hard.cutoff, include_self=True
    )


@pytest.mark.parametrize(("dtype", "dim"), BUILDS)
def test_balanced_residues_come_in_pairs_and_none(dtype, dim):
    hard = HARD_CASES["residues_balanced"].build(dtype, dim)
    for a, below, above in hard.positions.reshape(-1, 3, dim):
        assert is_pair(a, below, hard.cutoff)
        assert not is_pair(a, above, hard.cutoff, closed=True)
        assert abs(squared(a, below) - 1) < Fraction(np.finfo(dtype).eps.item()) / 1000


def naive_cells(x, cutoff):
    x0, r = x.min(axis=0), x.dtype.type(cutoff)
    inverse = x.dtype.type(1) / r
    return np.floor((x - x0) / r), np.floor(x * inverse - x0 * inverse)


@pytest.mark.parametrize(("dtype", "dim"), BUILDS)
@pytest.mark.parametrize("name", ["split_by_cells", "split_by_cells_near"])
def test_cells_of_the_cutoff_lose_pairs(name, dtype, dim):
    hard = HARD_CASES[name].build(dtype, dim)
    pairs = [(i, i + 1) for i in range(1, len(hard.positions), 2)]
    assert set(pairs) <= reference_pairs(hard.positions, hard.cutoff)
    for half, cells in zip((pairs[:75], pairs[75:]), naive_cells(hard.positions, hard.cutoff), strict=True):
        apart = [np.abs(cells[j] - cells[i]).max() for i, j in half]
        assert len(apart) >= 50 and set(apart) == {2}


@pytest.mark.parametrize(("dtype", "dim"), BUILDS)
@pytest.mark.parametrize("name", ["cell_edges", "cell_edges_far", "cell_edges_denormal"])
def test_cell_edges_have_partners_on_both_sides(name, dtype, dim):
    hard = HARD_CASES[name].build(dtype, dim)
    decided = [is_pair(a, b, hard.cutoff) for group in hard.positions.reshape(-1, 6, dim) for a, b in product(group[:3], group[3:])]
    assert 0.2 < np.mean(decided) < 0.8
    steps = np.rint(hard.positions.astype(float) / hard.cutoff)
    coarse = np.spacing(np.abs(hard.positions).astype(dtype)).astype(float)
    assert (np.abs(hard.positions - steps * hard.cutoff) <= 4 * coarse + 4 * np.finfo(dtype).eps * hard.cutoff).all()


@pytest.mark.parametrize(("dtype", "dim"), BUILDS)
def test_ties_are_exact(dtype, dim):
    def ties(name):
        hard = HARD_CASES[name].build(dtype, dim)
        strict = reference_pairs(hard.positions, hard.cutoff, half=True)
        return reference_pairs(hard.positions, hard.cutoff, half=True, closed=True) - strict

    for name in ("integers_9", "integers_25", "integers_49", "lattice_1_at_0", "lattice_1_at_1e4"):
        assert len(ties(name)) > 700
    for name in ("integers_2", "integers_3", "integers_5", "integers_14"):
        assert not ties(name)
    assert len(ties("dyadic_ties")) == 120
    assert len(ties("cutoff_rounds_down")) == len(ties("cutoff_rounds_up")) == 100


def test_rounded_cutoffs_change_sides():
    for name, closed, unrounded in (("cutoff_rounds_down", False, True), ("cutoff_rounds_up", True, False)):
        hard = HARD_CASES[name].build(np.float32, 3)
        a, b = hard.positions[:2]
        assert is_pair(a, b, hard.cutoff, closed=closed) is not unrounded
        assert is_pair(a.astype(float), b.astype(float), hard.cutoff, closed=closed) is unrounded


@pytest.mark.parametrize(("dtype", "dim"), BUILDS)
def test_extremes_leave_the_range(dtype, dim):
    with np.errstate(all="ignore"):
        for name in ("near_max", "clump_and_largest"):
            x = HARD_CASES[name].build(dtype, dim).positions
            assert np.isinf(x.max(axis=0) - x.min(axis=0)).all()
        assert np.square(dtype(HARD_CASES["near_max"].build(dtype, dim).cutoff)) == np.inf
        assert np.square(dtype(HARD_CASES["tiny_scale"].build(dtype, dim).cutoff)) == 0
        for name in ("two_blobs_1e12", "three_blobs_1e12", "clump_and_largest", "queries_far_outside"):
            hard = HARD_CASES[name].build(dtype, dim)
            far = hard.positions if hard.queries is None else hard.queries
            assert np.abs(far).max() / hard.cutoff > 2**31


@pytest.mark.parametrize("name", HARD_CASES)
def test_hard_case_has_the_pairs_it_is_about(name):
    without = {"n_0", "n_1", "no_pairs", "queries_none_in_reach", "no_queries", "no_sources"}
    only_ties = {"cutoff_rounds_down", "cutoff_rounds_up"}
    for dtype, dim in BUILDS:
        hard = HARD_CASES[name].build(dtype, dim)
        found = reference_pairs(hard.positions, hard.cutoff, queries=hard.queries, closed=name in only_ties)
        assert bool(found) == (name not in without)
