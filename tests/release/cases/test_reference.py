import math
from fractions import Fraction
from itertools import combinations, product

import numpy as np
import pytest
from checked import refuses, slow
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import is_pair, pairs_of, reference_images, reference_pairs

from jfrnn.cases.hard import HARD_CASES
from jfrnn.cases.periodic import PERIODIC_CASES
from jfrnn.cases.triangles import TRIANGLE_CASES

DTYPES = (np.float32, np.float64)
DIMS = (2, 3)
BUILDS = list(product(DTYPES, DIMS))
OFTEN = [*BUILDS[1:3], *(slow(*each) for each in BUILDS[::3])]  # either width, either dimension
IN_PARTS = pytest.mark.parametrize("builds", [BUILDS[1:3], slow(BUILDS[::3])], ids=["often", "rarely"])
ULP_CASES = [name for name in HARD_CASES if name.startswith("ulp_")]


def squared(a, b):
    return sum((Fraction(y) - Fraction(x)) ** 2 for x, y in zip(a.tolist(), b.tolist(), strict=True))


def looped_pairs(queries, sources, cutoff, closed=False):
    """The definition, in two loops and without cells: also (i, i)."""
    limit = Fraction(float(sources.dtype.type(cutoff))) ** 2
    distances = {(i, j): squared(a, b) for i, a in enumerate(queries) for j, b in enumerate(sources)}
    return {pair for pair, d2 in distances.items() if d2 < limit or (closed and d2 == limit)}


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
        refuses(ValueError, "leave them out with queries", reference_pairs, sources, 1.0, queries=queries, **{option: True})


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


# The oracle, against the definition

POINTS = np.zeros((2, 3))
NONE = "positive and finite in float32"  # what is said of cutoffs


@pytest.mark.parametrize(
    ("error", "message", "arguments", "queries"),
    [
        *((ValueError, NONE, (POINTS.astype(np.float32), cutoff), None) for cutoff in (0.0, -1.0, math.nan, math.inf, 1e39, 1e-60)),
        (TypeError, "float32 or float64", (np.zeros((2, 3), int), 1.0), None),
        (ValueError, r"shape \[n, d\]", (np.zeros((2, 4)), 1.0), None),
        (ValueError, "give the same", (POINTS, 1.0), np.zeros((2, 2))),
        (ValueError, "give both the same", ([0.0, 0.0], [0.0, 0.0, 0.0], 1.0), None),
    ],
)
def test_refuses_what_it_cannot_read(error, message, arguments, queries):
    with pytest.raises(error, match=message):
        is_pair(*arguments) if len(arguments) == 3 else reference_pairs(*arguments, queries=queries)


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
    assert reference_pairs(x, cutoff, closed=closed) == {(i, j) for i, j in everything if i != j}
    assert reference_pairs(x, cutoff, closed=closed, include_self=True) == everything
    assert reference_pairs(x, cutoff, closed=closed, queries=x[::-2]) == looped_pairs(x[::-2], x, cutoff, closed)
    one_by_one = product(range(len(x)), repeat=2)
    assert {(i, j) for i, j in one_by_one if is_pair(x[i], x[j], cutoff, closed=closed)} == everything


@IN_PARTS
@pytest.mark.parametrize("name", HARD_CASES)
def test_equals_the_definition_on_hard_cases(name, builds):
    for dtype, dim in builds:
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


# Periodic images, by hand


def opposite(images):
    return {(j, i, tuple(-s for s in shift)) for i, j, shift in images}


@pytest.mark.parametrize("dtype", DTYPES)
def test_hand_computed_images(dtype):
    x = np.array([[0.5, 1.0], [3.5, 1.0], [2.0, 4.0]], dtype)
    across = {(0, 1, (-1, 0)), (1, 0, (1, 0))}
    options = {"matrix": np.array([4, 5], dtype), "periodic": (True, True)}
    assert reference_images(x, 1.5, **options) == across
    assert reference_images(x, 1.0, **options) == set()
    assert reference_images(x, 1.0, closed=True, **options) == across
    assert reference_images(x, 1.5, half=True, **options) == {(0, 1, (-1, 0))}
    up = {(0, 2, (0, -1)), (1, 2, (0, -1))}  # |(1.5, 2)| = 2.5
    assert reference_images(x, 2.6, **options) - across == up | opposite(up)
    assert reference_images(x[:2], 3.25, **options) - across == {(0, 1, (0, 0)), (1, 0, (0, 0))}
    everyone = {(i, i, (0, 0)) for i in range(3)}
    assert reference_images(x, 1.5, include_self=True, **options) == across | everyone
    assert reference_images(x, 1.5, include_self=True, half=True, **options) == {(0, 1, (-1, 0))} | everyone


def test_open_axes_have_no_images():
    x = np.array([[0.5, 0.5], [3.5, 0.5], [0.5, 3.5]])
    options = {"matrix": np.full(2, 4.0)}
    assert reference_images(x, 1.5, periodic=(True, False), half=True, **options) == {(0, 1, (-1, 0))}
    assert reference_images(x, 1.5, periodic=(False, True), half=True, **options) == {(0, 2, (0, -1))}
    assert reference_images(x, 1.5, periodic=(False, False), **options) == set()
    assert reference_images(x[:1], 4.0, periodic=(True, False), closed=True, **options) == {(0, 0, (1, 0)), (0, 0, (-1, 0))}
    away = x + np.array([0.0, 1000.0])
    assert reference_images(away, 1.5, periodic=(True, False), half=True, **options) == {(0, 1, (-1, 0))}
    for row in ([0.0, 0.0], [8.0, 0.0], [np.nan, np.inf]):
        matrix = np.array([[4.0, 0.0], row])
        assert reference_images(x, 1.5, periodic=(True, False), matrix=matrix, half=True) == {(0, 1, (-1, 0))}


def test_queries_have_images_and_no_self():
    sources, queries = np.array([[0.25, 0.25]]), np.array([[0.25, 0.25], [-9.75, 10.25], [0.75, 0.25]])
    options = {"matrix": np.ones(2), "periodic": (True, True), "queries": queries}
    at = {(0, 0, (0, 0)), (1, 0, (-10, 10))}
    assert reference_images(sources, 0.5, **options) == at
    assert reference_images(sources, 0.5, closed=True, **options) == at | {(2, 0, (0, 0)), (2, 0, (1, 0))}
    for option in ("half", "include_self"):
        refuses(ValueError, "leave them out with queries", reference_images, sources, 0.5, **options, **{option: True})


def test_images_leave_out_what_is_not_finite():
    x = np.array([[0.25, 0.0], [np.nan, 0.0], [0.75, np.inf], [0.75, 0.0]])
    options = {"matrix": np.ones(2), "periodic": (True, False)}
    both = {(0, 3, (0, 0)), (0, 3, (-1, 0))}
    assert reference_images(x, 0.625, **options) == both | opposite(both)
    assert reference_images(x, 0.625, queries=x[1:3], **options) == set()


def test_matrix_and_cutoff_are_rounded_once():
    x = np.zeros((1, 2), np.float32)
    images = {(0, 0, (1, 0)), (0, 0, (-1, 0))}
    for cutoff, length in ((0.1, 0.1), (np.float32(0.1), 0.1), (0.1, np.float32(0.1))):
        options = {"matrix": [length, 1.0], "periodic": (True, True)}
        assert reference_images(x, cutoff, **options) == set()
        assert reference_images(x, cutoff, closed=True, **options) == images
    assert reference_images(x.astype(float), np.float32(0.1), matrix=[0.1, 1.0], periodic=(True, True)) == images


DEPENDENT, SHAPE = "linearly independent", r"shape \[3\] or \[3, 3\]"


@pytest.mark.parametrize(
    ("message", "matrix", "periodic"),
    [
        (DEPENDENT, [[1.0, 2, 3], [2, 4, 6], [0, 0, 1]], (True,) * 3),
        (DEPENDENT, [[0.0, 0, 0], [0, 1, 0], [0, 0, 1]], (True,) * 3),
        (DEPENDENT, [[1.0, 0, 0], [0, 1, 0], [1, 1, 0]], (True,) * 3),
        (DEPENDENT, [[1.0, 3.0, 0], [3.0, 9.0, 0], [0, 0, 1]], (True, True, False)),
        (DEPENDENT, [1.0, 0.0, 1.0], (True,) * 3),
        ("must be finite", [1.0, np.inf, 1.0], (True,) * 3),
        *((SHAPE, matrix, (True,) * 3) for matrix in (1.0, np.ones(2), np.ones((2, 3)))),
        *(("one bool for each of 3 axes", np.ones(3), periodic) for periodic in ((True, True), (1, 1, 1), (0, 1, 2))),
    ],
)
def test_refuses_a_lattice_that_is_none(message, matrix, periodic):
    refuses(ValueError, message, reference_images, np.zeros((2, 3)), 1e-20, matrix=np.array(matrix), periodic=periodic)


def test_takes_a_lattice_that_is_nearly_none():
    nearly = np.array([[0.1, 0.3], [0.3, 0.9]])  # three times 0.3 is not 0.9 in floats
    assert reference_images(np.zeros((1, 2)), 1e-20, matrix=nearly, periodic=(True, True)) == set()


# Periodic images, against explicit copies and symmetries


def copied_images(queries, sources, cutoff, matrix, periodic, reach, closed):
    """The definition, over every copy up to `reach` lattice vectors away."""
    limit = Fraction(float(cutoff)) ** 2
    rows = [[Fraction(value) for value in row] for row in matrix.tolist()]
    images = set()
    for shift in product(*(range(-reach, reach + 1) if axis else (0,) for axis in periodic)):
        offset = [sum(s * row[k] for s, row in zip(shift, rows)) for k in range(len(rows))]
        for (i, a), (j, b) in product(enumerate(queries.tolist()), enumerate(sources.tolist())):
            d2 = sum((Fraction(y) - Fraction(x) + o) ** 2 for x, y, o in zip(a, b, offset))
            if d2 < limit or (closed and d2 == limit):
                images.add((i, j, shift))
    return images


def without_own(images):
    return {(i, j, shift) for i, j, shift in images if i != j or any(shift)}


entry = st.one_of(st.integers(-2, 2).map(float), st.sampled_from([0.25, -0.75, 1.5, 0.1, -1 / 3, 1 + 2.0**-52, 3.0]))
place = st.one_of(st.integers(-2, 2).map(float), st.floats(-2, 2, allow_subnormal=False), st.sampled_from([0.1, -0.3, 2.0**-60]))


@st.composite
def lattices(draw, entry=entry):
    dim = draw(st.integers(1, 3))
    matrix = np.array(draw(st.lists(st.lists(entry, min_size=dim, max_size=dim), min_size=dim, max_size=dim)))
    periodic = tuple(draw(st.lists(st.booleans(), min_size=dim, max_size=dim)))
    x = np.array(draw(st.lists(st.lists(place, min_size=dim, max_size=dim), min_size=1, max_size=3)))
    return x, matrix, periodic


def gram_determinant(matrix, periodic):
    rows = [[Fraction(value) for value in row] for row, axis in zip(matrix.tolist(), periodic) if axis]
    gram = [[sum(a * b for a, b in zip(p, q)) for q in rows] for p in rows]

    def minor(square):
        if not square:
            return Fraction(1)
        return sum((-1) ** k * square[0][k] * minor([row[:k] + row[k + 1 :] for row in square[1:]]) for k in range(len(square)))

    return minor(gram)


@settings(max_examples=60, deadline=None)
@given(lattices(), st.sampled_from([0.5, 1.0, 1.25, math.sqrt(2), 1.5]), st.booleans())
def test_images_equal_the_definition(given, cutoff, closed):
    x, matrix, periodic = given
    options = {"matrix": matrix, "periodic": periodic, "closed": closed}
    determinant = gram_determinant(matrix, periodic)
    if determinant == 0:
        refuses(ValueError, "linearly independent", reference_images, x, cutoff, **options)
        return
    if determinant < Fraction(1, 100):  # hundreds of thousands of images
        return
    found = reference_images(x, cutoff, include_self=True, **options)
    reach = {0: 0, 1: 40, 2: 12, 3: 5}[sum(periodic)]
    near = {image for image in found if max(map(abs, image[2])) <= reach}
    assert near == copied_images(x, x, cutoff, matrix, periodic, reach, closed)
    rows = [[Fraction(value) for value in row] for row in matrix.tolist()]
    for i, j, shift in found - near:
        offset = [sum(s * row[k] for s, row in zip(shift, rows)) for k in range(len(rows))]
        d2 = sum((Fraction(b) - Fraction(a) + o) ** 2 for a, b, o in zip(x[i].tolist(), x[j].tolist(), offset))
        assert d2 < Fraction(cutoff) ** 2 or (closed and d2 == Fraction(cutoff) ** 2)
        assert all(s == 0 for s, axis in zip(shift, periodic) if not axis)
    assert reference_images(x, cutoff, **options) == without_own(found)
    of_last = {(len(x) - 1 - i, j, shift) for i, j, shift in found if i >= len(x) - 2}
    assert reference_images(x, cutoff, queries=x[::-1][:2], **options) == of_last
    half = reference_images(x, cutoff, half=True, **options)
    assert half | opposite(half) == without_own(found) and not half & opposite(half)
    assert all(i < j or (i == j and next(filter(None, shift)) > 0) for i, j, shift in half)


def test_images_of_a_lattice_are_found_in_every_basis():
    """Random unimodular bases of the integer lattice, skewed and of either hand."""
    rng = np.random.default_rng(7)
    x = rng.integers(-8, 9, (4, 3)) / 4
    expected = None
    for _ in range(60):
        basis = unimodular(rng, 3, steps=int(rng.integers(0, 12)))
        found = reference_images(x, 1.5, matrix=basis.astype(float), periodic=(True,) * 3, closed=True)
        places = {(i, j, tuple((np.array(shift) @ basis).tolist())) for i, j, shift in found}
        assert len(places) == len(found)
        expected = expected or copied_images(x, x, 1.5, np.eye(3), (True,) * 3, 6, True) - {(i, i, (0, 0, 0)) for i in range(4)}
        assert places == expected


def unimodular(rng, dim, steps):
    """An integer matrix of determinant 1 or -1."""
    basis = np.eye(dim, dtype=int)
    for _ in range(steps):
        into, of = rng.choice(dim, 2, replace=False)
        basis[into] += rng.choice([-2, -1, 1, 3]) * basis[of]
        if rng.random() < 0.2:
            basis[[into, of]] = basis[[of, into]]
    return basis


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("periodic", [(True, True, True), (True, False, True), (False, True, False)])
def test_images_of_moved_particles(dtype, periodic):
    """Particle i moved by n_i A shifts S of (i, j) by n_i - n_j; exact, because all numbers are dyadic."""
    rng = np.random.default_rng(17)
    matrix = np.array([[2.0, 0.0, 0.0], [1.0, 3.0, 0.0], [-0.5, 0.75, -2.0]], dtype)
    x = (rng.integers(0, 48, (30, 3)) / 16).astype(dtype)
    turns = rng.integers(-100, 101, (30, 3)) * np.array(periodic)
    moved = x + turns.astype(dtype) @ matrix
    options = {"matrix": matrix, "periodic": periodic, "closed": True}
    before, after = reference_images(x, 1.25, **options), reference_images(moved, 1.25, **options)
    assert after == {(i, j, tuple((np.array(shift) + turns[i] - turns[j]).tolist())) for i, j, shift in before}
    assert before == opposite(before)
    assert len(before) > 60


@pytest.mark.parametrize("angle", [1e-2, 1e-4, -1e-6])
def test_images_of_a_nearly_degenerate_cell(angle):
    """(1, 0) and (1, angle) are the lattice of (1, 0) and (0, angle)."""
    x = np.array([[0.0, 0.0], [0.25, 100 * angle], [-70.0, 0.0]])
    matrix = np.array([[1.0, 0.0], [1.0, angle]])
    steps = {(i, i, (-k, k)) for i in range(3) for k in (-4, -3, -2, -1, 1, 2, 3, 4)}
    steps |= {(0, 2, (70 - k, k)) for k in range(-4, 5)} | {(2, 0, (-70 - k, k)) for k in range(-4, 5)}
    assert reference_images(x, 4.5 * abs(angle), matrix=matrix, periodic=(True, True)) == steps
    swapped = {(i, j, shift[::-1]) for i, j, shift in steps}
    assert reference_images(x, 4.5 * abs(angle), matrix=matrix[::-1], periodic=(True, True)) == swapped


def test_images_far_from_the_cell():
    x = np.array([[1e30, 0.0], [0.0, 2.0**80], [0.25, 0.25]])
    options = {"matrix": np.ones(2), "periodic": (True, True), "half": True}
    assert reference_images(x, 0.25, **options) == {(0, 1, (int(1e30), -(2**80)))}
    assert len(reference_images(x, 0.375, **options)) == 3


# Comparing


def test_pairs_of_a_padded_list():
    idx = np.array([[1, 2, 3], [0, 3, 3], [3, 3, 3]], np.int32)
    assert pairs_of(idx, np.array([2, 1, 0], np.int32), 3) == [(0, 1), (0, 2), (1, 0)]
    assert pairs_of(np.array([[1, 2]], np.int32), np.array([7], np.int32), 3) == [(0, 1), (0, 2)]  # overflow
    assert pairs_of(np.zeros((2, 0), np.int32), np.array([0, 4], np.int32), 3) == []


ROW = np.array([[1, 2, 3]], np.int32)


@pytest.mark.parametrize(
    ("idx", "count", "message"),
    [
        ([[1, 1, 3]], [2], "more than once"),
        ([[1, 2, 0]], [2], "unused slots of row 0 must hold 3"),
        ([[1, 2, -1]], [2], "unused slots"),
        ([[1, 3, 3]], [2], "but holds"),
        ([[-1, 3, 3]], [1], "but holds"),
        ([[3, 3, 3]], [-1], "counts -1"),
        (ROW.astype(np.int64), [1], "must be int32"),
        (ROW, [1, 1], r"must be \[n, capacity\]"),
    ],
)
def test_pairs_of_refuses(idx, count, message):
    refuses(AssertionError, message, pairs_of, np.array(idx, getattr(idx, "dtype", np.int32)), np.array(count, np.int32), 3)


# The hard cases


@pytest.mark.parametrize(("table", "name"), [(table, name) for table in (HARD_CASES, PERIODIC_CASES) for name in table])
def test_case_is_what_it_says(table, name):
    case, most = table[name], 2000 if table is HARD_CASES else 300
    assert case.name == name
    assert case.mechanism and "\n" not in case.mechanism
    for dtype, dim in BUILDS:
        given, again = case.build(dtype, dim), case.build(np.dtype(dtype).name, dim)
        assert given.cutoff == again.cutoff and type(given.cutoff) is float
        assert 0 < np.dtype(dtype).type(given.cutoff) < np.inf
        if table is PERIODIC_CASES:
            assert given.matrix.dtype == dtype and given.matrix.shape in ((dim,), (dim, dim))
            assert given.matrix.tobytes() == again.matrix.tobytes()
            rows = given.matrix if given.matrix.ndim == 2 else np.diag(given.matrix)
            assert np.isfinite(rows).all() and np.isfinite(np.linalg.inv(rows.astype(float))).all()
            assert type(given.periodic) is tuple and len(given.periodic) == dim and {*map(type, given.periodic)} == {bool}
        for points, repeated in ((given.positions, again.positions), (given.queries, again.queries)):
            if points is None:
                assert repeated is None
                continue
            assert points.dtype == dtype and points.ndim == 2 and points.shape[1] == dim
            assert len(points) <= most and np.isfinite(points).all() != name.startswith("nonfinite")
            assert points.tobytes() == repeated.tobytes()
            # so that a machine which flushes denormals can be told by the name of the case
            assert "denormal" in name or not ((points != 0) & (np.abs(points) < np.finfo(dtype).tiny)).any()


@pytest.mark.parametrize("case", [HARD_CASES["uniform"], PERIODIC_CASES["random"], TRIANGLE_CASES["random"]])
def test_cases_refuse_other_dtypes_and_dimensions(case):
    for dtype, dim in ((np.float16, 3), (np.int32, 2), (np.float32, 1)):
        refuses(ValueError, "float32 or float64, in 2 or 3", case.build, dtype, dim)


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
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


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
@pytest.mark.parametrize("name", ["residues", "residues_denormal", "residues_balanced"])
def test_residues_are_beyond_twice_the_precision(name, dtype, dim):
    hard = HARD_CASES[name].build(dtype, dim)
    x = hard.positions
    bits = 53 if dtype == np.float32 else 106
    for closed in (False, True):
        exact = reference_pairs(x, hard.cutoff, closed=closed)
        pairs = combinations(range(len(x)), 2)
        assert any(decided_in(bits, x[i], x[j], hard.cutoff, closed) != ((i, j) in exact) for i, j in pairs)


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
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


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
@pytest.mark.parametrize("name", ["split_by_cells", "split_by_cells_near"])
def test_cells_of_the_cutoff_lose_pairs(name, dtype, dim):
    hard = HARD_CASES[name].build(dtype, dim)
    pairs = [(i, i + 1) for i in range(1, len(hard.positions), 2)]
    assert set(pairs) <= reference_pairs(hard.positions, hard.cutoff)
    for half, cells in zip((pairs[:75], pairs[75:]), naive_cells(hard.positions, hard.cutoff), strict=True):
        apart = [np.abs(cells[j] - cells[i]).max() for i, j in half]
        assert len(apart) >= 50 and set(apart) == {2}


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
@pytest.mark.parametrize("name", ["cell_edges", "cell_edges_far", "cell_edges_denormal"])
def test_cell_edges_have_partners_on_both_sides(name, dtype, dim):
    hard = HARD_CASES[name].build(dtype, dim)
    decided = [is_pair(a, b, hard.cutoff) for group in hard.positions.reshape(-1, 6, dim) for a, b in product(group[:3], group[3:])]
    assert 0.2 < np.mean(decided) < 0.8
    steps = np.rint(hard.positions.astype(float) / hard.cutoff)
    coarse = np.spacing(np.abs(hard.positions).astype(dtype)).astype(float)
    assert (np.abs(hard.positions - steps * hard.cutoff) <= 4 * coarse + 4 * np.finfo(dtype).eps * hard.cutoff).all()


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
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


@pytest.mark.parametrize(("dtype", "dim"), OFTEN)
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


@IN_PARTS
@pytest.mark.parametrize("name", HARD_CASES)
def test_hard_case_has_the_pairs_it_is_about(name, builds):
    without = {"n_0", "n_1", "no_pairs", "queries_none_in_reach", "no_queries", "no_sources"}
    only_ties = {"cutoff_rounds_down", "cutoff_rounds_up"}
    for dtype, dim in builds:
        hard = HARD_CASES[name].build(dtype, dim)
        found = reference_pairs(hard.positions, hard.cutoff, queries=hard.queries, closed=name in only_ties)
        assert bool(found) == (name not in without)
