"""The oracle of triangles: by hand, against figures of 60 digits and a search over points; and what hard cases claim, by it."""

from fractions import Fraction
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import distance, squared_distance, triangle_pairs

from jfrnn.cases.triangles import TRIANGLE_CASES

UNIT = [[0, 0, 0], [4, 0, 0], [0, 4, 0]]
WHOLE = st.lists(st.integers(-6, 6), min_size=3, max_size=3)


@pytest.mark.parametrize(
    ("point", "square"),
    [
        ([1, 1, 3], 9),  # above the face
        ([1, 1, 0], 0),  # on it
        ([0, 0, 0], 0),  # on a vertex
        ([2, 0, 0], 0),  # on an edge
        ([-3, -4, 0], 25),  # beyond a vertex
        ([2, -2, 1], 5),  # beyond an edge
        ([4, 4, 0], 8),  # beyond the long edge
        ([6, -1, 2], 9),  # beyond the vertex at its end
    ],
)
def test_distances_by_hand(point, square):
    for corners in permutations(UNIT):
        assert squared_distance(point, corners) == square
        size = max(abs(c - p) for corner in corners for c, p in zip(corner, point, strict=True))
        assert distance(point, corners) == (pytest.approx(square**0.5, rel=1e-15), size)


def test_distances_beyond_the_range_of_squares():
    assert distance([0.0, 3e-200], [[0.0, 0.0], [5e-324, 0.0]]) == (pytest.approx(3e-200, rel=1e-15), 3e-200)
    assert distance([0.0, 1e200], [[-1e200, 0.0], [1e200, 0.0]]) == (pytest.approx(1e200, rel=1e-15), 1e200)


def test_degenerate_triangles_by_hand():
    segment = [[0, 0, 0], [1, 1, 0], [4, 4, 0]]
    for corners in permutations(segment):
        assert squared_distance([2, 0, 0], corners) == 2
        assert squared_distance([5, 5, 1], corners) == 3
    assert squared_distance([1, 2, 2], [[0, 0, 0]] * 3) == 9
    assert squared_distance([1, 2, 2], [[0, 0, 0]] * 2) == 9


@given(WHOLE, st.lists(WHOLE, min_size=3, max_size=3))
@settings(max_examples=200, deadline=None)
def test_no_point_of_the_triangle_is_nearer(point, corners):
    """A lattice of points of the triangle comes as near as its spacing allows, and never nearer."""
    square = squared_distance(point, corners)
    steps = 12
    nearest = min(
        sum((p - Fraction(i * a + j * b + (steps - i - j) * c, steps)) ** 2 for p, a, b, c in zip(point, *corners, strict=True))
        for i in range(steps + 1)
        for j in range(steps + 1 - i)
    )
    assert square <= nearest
    size = max(sum((x - y) ** 2 for x, y in zip(a, b, strict=True)) for a in corners for b in corners)
    assert float(nearest) ** 0.5 - float(square) ** 0.5 <= size**0.5 / steps + 1e-12


@given(WHOLE, st.lists(WHOLE, min_size=3, max_size=3), st.permutations([0, 1, 2]), st.sampled_from([-1, 1]), WHOLE)
@settings(max_examples=100, deadline=None)
def test_distance_knows_no_order_axis_or_origin(point, corners, order, sign, shift):
    def moved(p):
        return [sign * p[k] + s for k, s in zip(order, shift, strict=True)]

    assert squared_distance(point, corners) == squared_distance(moved(point), [moved(corners[k]) for k in order])


def test_pairs_are_strict_and_rounded_once(dtype, dim):
    radius = float(dtype(0.1))
    positions = np.zeros((4, dim), dtype)
    positions[:, -1] = [np.nextafter(dtype(0.1), dtype(0)), radius, np.nextafter(dtype(0.1), dtype(1)), np.nan]
    vertices = np.zeros((4, dim), dtype)
    vertices[1:3, 0] = [-1, 1]
    vertices[3] = np.nan
    if dim == 2:
        faces = [[1, 2], [0, 0], [1, 3], [1, 4], [-1, 1]]
    else:
        vertices[0, 1] = 1
        faces = [[0, 1, 2], [1, 2, 1], [1, 2, 3], [1, 2, 4], [-1, 1, 2]]
    assert triangle_pairs(positions, vertices, faces, 0.1) == {(0, 0), (0, 1)}


TIES = ["ties", "ties_far", "ties_small", "sheet", "axis_ulps", "residues"]
CLOSE = ["ulps", "ulps_large", "ulps_far", "ties_up", "ties_down", "ties_spacing"]


def relative_gaps(given):
    """Yield d²/r² - 1 of every finite particle and face, rational numbers."""
    limit = Fraction(float(given.positions.dtype.type(given.cutoff))) ** 2
    lift = [[Fraction(x) for x in row] + [Fraction(0)] * (3 - len(row)) for row in given.vertices.tolist()]
    for point in given.positions.tolist():
        lifted = [Fraction(x) for x in point] + [Fraction(0)] * (3 - len(point))
        for face in given.faces.tolist():
            yield squared_distance(lifted, [lift[k] for k in face]) / limit - 1


@pytest.mark.parametrize("name", TRIANGLE_CASES)
def test_case_is_what_it_says(name, dtype, dim):
    given, again = (TRIANGLE_CASES[name].build(dtype, dim) for _ in range(2))
    assert given.positions.dtype == given.vertices.dtype == dtype
    assert given.positions.shape[1] == given.vertices.shape[1] == given.faces.shape[1] == dim
    assert given.faces.dtype == np.int32
    assert (len(given.positions) <= 48, len(given.faces) <= 32) == (True, True)  # tests pad them to common shapes
    assert np.array_equal(given.positions, again.positions, equal_nan=True)
    assert np.array_equal(given.vertices, again.vertices, equal_nan=True)
    pairs = triangle_pairs(given.positions, given.vertices, given.faces, given.cutoff)
    assert 10 < len(pairs) < len(given.positions) * len(given.faces)


@pytest.mark.parametrize("name", TIES)
def test_ties_are_exact(name, dtype, dim):
    assert sum(gap == 0 for gap in relative_gaps(TRIANGLE_CASES[name].build(dtype, dim))) >= 6


@pytest.mark.parametrize("name", CLOSE)
def test_gaps_are_a_few_last_places(name, dtype, dim):
    gaps = [float(abs(gap)) for gap in relative_gaps(TRIANGLE_CASES[name].build(dtype, dim))]
    places = np.finfo(dtype).eps * {"ulps_far": 1e6, "ulps_large": 1e3}.get(name, 8.0)
    assert sum(0 < gap < places for gap in gaps) >= 4
