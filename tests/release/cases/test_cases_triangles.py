"""The hard cases of triangles have the properties that they claim, by the oracle."""

from fractions import Fraction

import numpy as np
import pytest
from reference import squared_distance, triangle_pairs

from jfrnn.cases.triangles import TRIANGLE_CASES

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
