"""The pair decision alone: any finite floats, by brute force over few points, against the oracle."""

import itertools

import checked
import hypothesis
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import jfrnn
from jfrnn._geometry.cutoffs import largest_cutoff, make_cutoff, smallest_cutoff
from jfrnn._geometry.exact import _UNKNOWN, Pair, _fixed_sign, _integer_sign, _threshold

POINTS = 12


def floats(dtype):
    width = np.dtype(dtype).itemsize * 8
    return st.one_of(
        st.floats(allow_nan=False, allow_infinity=False, width=width),
        st.integers(-64, 64).map(float),
        st.builds(lambda m, e: float(np.ldexp(dtype(m), e)), st.integers(-9, 9), st.integers(-120, 20)),
    )


def cutoffs(dtype):
    width = np.dtype(dtype).itemsize * 8
    low, high = smallest_cutoff(np.dtype(dtype)), largest_cutoff(np.dtype(dtype))
    return st.one_of(st.floats(low, high, width=width), st.integers(1, 100).map(float))


@pytest.mark.kernels
@hypothesis.settings(max_examples=150, deadline=None)
@hypothesis.given(st.data())
@pytest.mark.parametrize(
    ("backend", "dtype"),
    [
        *((backend, dtype) for backend in ("warp", "hashgrid") for dtype in (np.float32, np.float64)),
        *(
            pytest.param(backend, dtype, marks=pytest.mark.slow)
            for backend in ("jax", "brute")
            for dtype in (np.float32, np.float64)
        ),
    ],
)
def test_any_floats(backend, dtype, data):
    points = data.draw(hnp.arrays(dtype, (POINTS, 3), elements=floats(dtype)))
    cutoff, closed = data.draw(cutoffs(dtype)), data.draw(st.booleans())
    nbrs = jfrnn.search(points, cutoff, capacity=POINTS, closed=closed, backend=backend)
    checked.assert_exact(nbrs, points, cutoff, closed=closed)


@hypothesis.settings(max_examples=150, deadline=None)
@hypothesis.given(st.data())
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_cutoff_is_a_distance_that_occurs(dtype, data):
    """The cutoff is one pair's distance rounded to the dtype: that pair is within half an ulp of the cutoff."""
    points = data.draw(hnp.arrays(dtype, (POINTS, 2), elements=floats(dtype)))
    ulps = data.draw(st.integers(-2, 2))
    with np.errstate(all="ignore"):
        distance = np.hypot(*(points[1] - points[0]).astype(np.float64)).astype(dtype)
    hypothesis.assume(2 * smallest_cutoff(np.dtype(dtype)) < distance < largest_cutoff(np.dtype(dtype)) / 2)
    cutoff = float(distance + ulps * np.spacing(distance))
    for closed in (False, True):
        nbrs = jfrnn.search(points, cutoff, capacity=POINTS, closed=closed)
        checked.assert_exact(nbrs, points, cutoff, closed=closed)


def ulp_pairs(dtype, seed, count=256, scale=1.0, offset=0.0):
    """Pairs in random directions whose distance is within a few ulp of `scale`."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    start = (offset + scale * rng.uniform(-1, 1, (count, 3))).astype(dtype)
    return start, (start.astype(np.float64) + direction * scale).astype(dtype)


@pytest.mark.parametrize("offset", [0.0, -3.0, 1e4])
def test_every_step_agrees_with_fractions(dtype, offset):
    a, b = ulp_pairs(dtype, seed=5, offset=offset)
    cutoff = make_cutoff(1.0, np.dtype(dtype), closed=False)
    pair = Pair(jnp.asarray(a.T), jnp.asarray(b.T))
    exact = np.array(
        [0 if reference.is_pair(p, q, 1.0, closed=True) != reference.is_pair(p, q, 1.0) else 1 - 2 * reference.is_pair(p, q, 1.0)
         for p, q in zip(a, b, strict=True)]
    )  # fmt: skip
    assert {-1, 1} <= set(exact)
    np.testing.assert_array_equal(_integer_sign(pair, _threshold(pair, cutoff)), exact)
    sign = _fixed_sign(pair, _threshold(pair, cutoff))
    np.testing.assert_array_equal(_fixed_sign(pair, _threshold(pair, cutoff), by_axis=True), sign)
    assert np.mean(sign != _UNKNOWN) > 0.99
    np.testing.assert_array_equal(np.where(sign == _UNKNOWN, exact, sign), exact)


LATTICES = list(itertools.product((1.0, 2.0**-22, 2.0**39), (True, False), (np.float32, np.float64)))
OFTEN = [each for each in LATTICES if each[2] is np.float32]  # the wide integers of float64 take long to compile


@pytest.mark.parametrize(
    ("size", "orthogonal", "dtype"),
    [pytest.param(*each, marks=[pytest.mark.slow] * (each not in OFTEN)) for each in LATTICES],
)
def test_steps_agree_in_lattices(size, orthogonal, dtype):
    """Ties and near ties on a coarse lattice of points, far from the origin too, with images a few to a thousand cells away."""
    rng = np.random.default_rng(11)
    step, count = dtype(size) / 8, 4000
    matrix = (np.diag([40, 48, 56]) + (0 if orthogonal else np.array([[0, 8, 16], [24, 0, 8], [16, 8, 0]]))) * step
    shift = rng.integers(-1, 2, (count, 3)) * rng.choice([1, 500], (count, 1))
    a = rng.integers(-100, 100, (count, 3)) * step
    offset = rng.integers(-30, 31, (count, 3)) * step
    b = a + offset - (shift @ matrix.astype(np.float64))
    b[::3] += rng.integers(-2, 3, (len(b[::3]), 3)) * np.spacing(np.abs(b[::3]).astype(dtype))
    a, b, shift = (jnp.asarray(x.T.astype(dtype)) for x in (a, b, shift))
    pair = Pair(a, b, None, shift, jnp.asarray(matrix, dtype), orthogonal)
    threshold = _threshold(pair, make_cutoff(float(21 * step), np.dtype(dtype), closed=False))  # 21² = 16² + 13² + 4²
    near = jnp.asarray(np.linalg.norm(offset, axis=1) < 42 * step)  # what step 1 leaves open is no farther
    sign, exact = _fixed_sign(pair, threshold), _integer_sign(pair, threshold)
    np.testing.assert_array_equal(_fixed_sign(pair, threshold, by_axis=True), sign)
    known = (sign != _UNKNOWN) & near
    assert np.mean(known) > 0.5
    assert int((exact == 0).sum()) > 0
    np.testing.assert_array_equal(jnp.where(known, sign, 0), jnp.where(known, exact, 0))


def test_exact_ties_are_known_without_integers(dtype):
    a = jnp.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], dtype)
    b = a + jnp.array([1.0, 2.0, 2.0], dtype)
    pair = Pair(a.T, b.T)
    sign = _fixed_sign(pair, _threshold(pair, make_cutoff(3.0, np.dtype(dtype), closed=False)))
    np.testing.assert_array_equal(sign, [0, 0])


def test_pairs_are_symmetric(dtype):
    """10 000 shuffled pairs near the cutoff: (i, j) is listed if and only if (j, i) is."""
    a, b = ulp_pairs(dtype, seed=7, count=1000, scale=0.1)
    points = np.concatenate([a, b])
    i, j = jfrnn.search(points, 0.1).pairs()
    forward = set(zip(i.tolist(), j.tolist(), strict=True))
    assert len(forward) > 1000
    assert forward == {(q, p) for p, q in forward}
