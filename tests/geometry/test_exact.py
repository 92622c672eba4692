"""The pair decision alone: any finite floats, by brute force over few points, against the oracle."""

import functools
import itertools
from fractions import Fraction

import checked
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import slow, sparing
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import jfrnn
from jfrnn._geometry.cutoffs import RANGE_OF, Radii, make_cutoff, make_cutoffs
from jfrnn._geometry.exact import _UNKNOWN, Pair, _fixed_sign, _integer_sign, is_pair_of
from jfrnn._geometry.images import images_of
from jfrnn._geometry.lattice import make_lattice, shift_pairs

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
    low, high = RANGE_OF[np.dtype(dtype)]
    return st.one_of(st.floats(low, high, width=width), st.integers(1, 100).map(float))


EACH = itertools.product(("warp", "hashgrid", "jax", "brute"), (np.float32, np.float64))
OFTEN = [("warp", np.float32), ("warp", np.float64), ("hashgrid", np.float32)]  # the array engines compile slowly


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(st.data())
@pytest.mark.parametrize(("backend", "dtype"), sparing(EACH, OFTEN))
def test_any_floats(backend, dtype, data):
    points = data.draw(hnp.arrays(dtype, (POINTS, 3), elements=floats(dtype)))
    cutoff, closed = data.draw(cutoffs(dtype)), data.draw(st.booleans())
    nbrs = jfrnn.search(points, cutoff, capacity=POINTS, closed=closed, backend=backend)
    checked.assert_exact(nbrs, points, cutoff, closed=closed)


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(st.data())
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_cutoff_is_a_distance_that_occurs(dtype, data):
    """The cutoff is one pair's distance rounded to the dtype: that pair is within half an ulp of the cutoff."""
    points = data.draw(hnp.arrays(dtype, (POINTS, 2), elements=floats(dtype)))
    ulps = data.draw(st.integers(-2, 2))
    with np.errstate(all="ignore"):
        distance = np.hypot(*(points[1] - points[0]).astype(np.float64)).astype(dtype)
    low, high = RANGE_OF[np.dtype(dtype)]
    hypothesis.assume(2 * low < distance < high / 2)
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


def signs(pair, cutoff):
    """Return what steps tell of pairs: the second one, that one axis by axis, and the third."""
    return _fixed_sign(pair, cutoff), _fixed_sign(pair, cutoff, by_axis=True), _integer_sign(pair, cutoff)


@jax.jit
def signs_in_open_space(a, b, cutoff):
    return signs(Pair(a.T, b.T), cutoff)


@functools.partial(jax.jit, static_argnames="orthogonal")
def signs_in_a_lattice(a, b, shift, matrix, cutoff, orthogonal):
    return signs(Pair(a.T, b.T, None, shift.T, matrix, orthogonal), cutoff)


@jax.jit
def signs_of_means(a, b, own, other):
    cutoffs = make_cutoffs(Radii(other, own, "mean"), False)
    return signs(Pair(a.T, b.T, cutoffs.of_pairs(cutoffs.queries, cutoffs.sources)), cutoffs)


def assert_signs(found, exact, known):
    """Fail unless the second step says the same both ways, what it knows is right, it knows enough, and the third is right."""
    sign, by_axis, integer = map(np.asarray, found)
    np.testing.assert_array_equal(by_axis, sign)
    assert np.mean(sign != _UNKNOWN) > known
    np.testing.assert_array_equal(np.where(sign == _UNKNOWN, exact, sign), exact)
    np.testing.assert_array_equal(integer, exact)


@pytest.mark.parametrize("offset", [0.0, slow(-3.0), 1e4])
def test_every_step_agrees_with_fractions(dtype, offset):
    a, b = ulp_pairs(dtype, seed=5, offset=offset)
    exact = np.array(
        [0 if reference.is_pair(p, q, 1.0, closed=True) != reference.is_pair(p, q, 1.0) else 1 - 2 * reference.is_pair(p, q, 1.0)
         for p, q in zip(a, b, strict=True)]
    )  # fmt: skip
    assert {-1, 1} <= set(exact)
    assert_signs(signs_in_open_space(a, b, make_cutoff(1.0, np.dtype(dtype), closed=False)), exact, known=0.99)


LATTICES = list(itertools.product((1.0, 2.0**-22, 2.0**39), (True, False), (np.float32, np.float64)))
# The wide integers of float64 take long to compile.
OFTEN_IN_LATTICES = [each for each in LATTICES if each[2] is np.float32 and each[1] is (each[0] == 1)]


@pytest.mark.parametrize(("size", "orthogonal", "dtype"), sparing(LATTICES, OFTEN_IN_LATTICES))
def test_steps_agree_in_lattices(size, orthogonal, dtype):
    """Ties and near ties on a coarse lattice of points, far from the origin too, with images a few to a thousand cells away."""
    rng = np.random.default_rng(11)
    step, count = dtype(size) / 8, 2000
    matrix = (np.diag([40, 48, 56]) + (0 if orthogonal else np.array([[0, 8, 16], [24, 0, 8], [16, 8, 0]]))) * step
    shift = rng.integers(-1, 2, (count, 3)) * rng.choice([1, 500], (count, 1))
    a = rng.integers(-100, 100, (count, 3)) * step
    offset = rng.integers(-30, 31, (count, 3)) * step
    b = a + offset - (shift @ matrix.astype(np.float64))
    b[::3] += rng.integers(-2, 3, (len(b[::3]), 3)) * np.spacing(np.abs(b[::3]).astype(dtype))
    given = (x.astype(dtype) for x in (a, b, shift, matrix))
    cutoff = make_cutoff(float(21 * step), np.dtype(dtype), closed=False)  # 21² = 16² + 13² + 4²
    sign, by_axis, exact = map(np.asarray, signs_in_a_lattice(*given, cutoff, orthogonal=orthogonal))
    np.testing.assert_array_equal(by_axis, sign)
    near = np.linalg.norm(offset, axis=1) < 42 * step  # what step 1 leaves open is no farther
    known = (sign != _UNKNOWN) & near
    assert np.mean(known) > 0.5
    assert (exact == 0).any()
    np.testing.assert_array_equal(sign[known], exact[known])


SKEWED = np.array([[5.1, 0.013, -0.017], [0.7, 4.3, 0.011], [-0.019, 0.9, 6.7]])  # of all mantissas, and of several sizes


def ulp_images(matrix, count, far=0):
    """Points a, b and shifts S, float32, such that |b - a + S·A| is 1 but for the rounding of b; and the exact signs of that."""
    rng, matrix = np.random.default_rng(13), matrix.astype(np.float32)
    (a, offset), shift = ulp_pairs(np.float32, seed=8, count=count), rng.integers(-2, 3, (count, 3))
    shift[: count // 2] += rng.integers(-far, far + 1, (count // 2, 3))
    b = (a.astype(np.float64) + (offset.astype(np.float64) - a) - shift @ matrix.astype(np.float64)).astype(np.float32)
    rows = [[Fraction(x) for x in row] for row in matrix.tolist()]
    signs = []
    for p, q, times in zip(a.tolist(), b.tolist(), shift.tolist(), strict=True):
        moved = [sum(n * row[k] for n, row in zip(times, rows, strict=True)) for k in range(3)]
        square = sum((Fraction(y) - Fraction(x) + t) ** 2 for x, y, t in zip(p, q, moved, strict=True)) - 1
        signs.append((square > 0) - (square < 0))
    assert {-1, 1} <= set(signs)
    return a, b, shift.astype(np.float32), matrix, np.array(signs)


def test_every_step_agrees_with_fractions_in_lattices_of_all_mantissas():
    """The digits of the vectors go down to the lowest units of step 2, so that a sum of them carries."""
    a, b, shift, matrix, exact = ulp_images(SKEWED, 2000, far=500)
    found = signs_in_a_lattice(a, b, shift, matrix, make_cutoff(1.0, np.dtype(np.float32), closed=False), orthogonal=False)
    assert_signs(found, exact, known=0.9)


@pytest.mark.parametrize("skewed", [False, True])
def test_pairs_at_their_images_are_decided_exactly(skewed):
    """What decides the slots of a list in a lattice by array programs: the bound of its displacements holds for near ties."""
    a, b, shift, matrix, exact = ulp_images(SKEWED if skewed else np.diag(np.diag(SKEWED)), 256, far=50)
    box, dtype = jfrnn.Box(matrix if skewed else np.diag(matrix)), np.dtype(np.float32)
    images, asked = images_of(box, 1.0, dtype, 256), np.arange(256) % 16 > 0

    @jax.jit
    def decide(a, b, shift, cutoff):
        neighbor = jnp.arange(256, dtype=jnp.int32)[:, None]
        pairs = shift_pairs((b - a)[:, None], shift[:, None], make_lattice(box, images, dtype))
        return is_pair_of(a, b, neighbor, asked[:, None], cutoff, pairs)[:, 0], pairs.vectors[:, 0]

    found, vectors = map(np.asarray, decide(a, b, shift, make_cutoff(1.0, dtype, closed=False)))
    np.testing.assert_array_equal(found, (exact < 0) & asked)
    naive = np.square(vectors).sum(axis=1) < 1
    assert (naive != (exact < 0)).sum() > 10  # else this would prove nothing


def test_every_step_agrees_with_fractions_where_the_cutoff_is_a_mean(dtype):
    """Two radii, one of a particle, the other what is left to twice its distance from the next one."""
    (a, b), rng = ulp_pairs(dtype, seed=6), np.random.default_rng(9)
    own = rng.uniform(0.2, 1.8, len(a)).astype(dtype)
    other = (2 * np.linalg.norm(b.astype(np.longdouble) - a, axis=1) - own).astype(dtype)
    exact = []
    for p, q, r, s in zip(a.tolist(), b.tolist(), own.tolist(), other.tolist(), strict=True):
        square = 4 * sum((Fraction(y) - Fraction(x)) ** 2 for x, y in zip(p, q, strict=True)) - (Fraction(r) + Fraction(s)) ** 2
        exact.append((square > 0) - (square < 0))
    assert {-1, 1} <= set(exact)
    assert_signs(signs_of_means(a, b, own, other), np.array(exact), known=0.99)


def test_exact_ties_are_known_without_integers(dtype):
    a = np.resize(np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], dtype), (256, 3))
    b = a + np.array([1.0, 2.0, 2.0], dtype)
    sign = signs_in_open_space(a, b, make_cutoff(3.0, np.dtype(dtype), closed=False))[0]
    np.testing.assert_array_equal(sign, np.zeros(256))
