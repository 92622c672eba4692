"""Fused pair sums with a cutoff per particle: the pairs of the oracle, by every rule, and derivatives over the reversed ones."""

import functools

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import slow
from marked import assert_compensated, assert_marks, cancelling, marks
from test_pair_sum import N, assert_same, everything, oracle, scene, smooth, smooth_slopes, tangents_of
from test_radii import LENGTH, radii_of

import jfrnn
from jfrnn._geometry.cutoffs import RULES
from jfrnn.cases.radii import RADII_CASES

fused = functools.partial(jfrnn.pair_sum, backend="warp")


@functools.partial(jax.jit, static_argnames="rule")
def open_marks(x, radii, ids, rule):
    return fused(marks, x, radii, ids, radius_rule=rule)


def assert_case(name, dtype, dim, rule, **options):
    """Compare the marks of a case, lengthened so that cases share programs, with those of the oracle's pairs; return how many."""
    given = RADII_CASES[name].build(dtype, dim)
    ids, more = np.arange(LENGTH, dtype=dtype), dict(options)
    if given.queries is not None:
        more |= {"queries": checked.padded(given.queries, LENGTH), "query_values": ids}
    more |= {} if given.lengths is None else {"box": jfrnn.Box(given.lengths)}
    x = checked.padded(given.positions, LENGTH)
    radii = radii_of(given, rule, LENGTH)
    found = fused(marks, x, radii, ids, radius_rule=rule, **more) if more else open_marks(x, radii, ids, rule)
    kind = {"queries": given.queries, "query_radii": given.query_cutoffs, "lengths": given.lengths}
    pairs = reference.reference_radii(given.positions, given.cutoffs, rule, **kind, **options)
    assert_marks(found, pairs, given.positions, given.queries, given.lengths)
    return len(pairs)


@pytest.mark.parametrize("rule", ["mean", *(slow(rule) for rule in RULES if rule != "mean")])
@pytest.mark.parametrize("name", ["ties", "spread_100", "coincident"])
def test_open_cases(name, rule):
    assert assert_case(name, np.float32, 3, rule)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "dim"), [(np.float32, 2), (np.float64, 2), (np.float32, 3), (np.float64, 3)])
@pytest.mark.parametrize("name", RADII_CASES)
def test_every_case(name, dtype, dim):
    assert max(assert_case(name, dtype, dim, rule) for rule in RULES)
    assert_case(name, dtype, dim, "either", closed=True)


def test_more_pairs_than_are_put_down_at_a_time():
    """Sums go on, compensated ones with their errors, extremes with whose they are."""
    n, values = 1000, cancelling(1000)
    x, radii = np.zeros((n, 2), np.float32), np.linspace(0.1, 2.0, n, dtype=np.float32)

    @jax.jit
    def each(x, radii, values):
        sums = [fused(light, x, radii, values, include_self=True, compensated=c) for c in (False, True)]
        return *sums, jax.grad(lambda m: fused(light, x, radii, m, reduce="min").sum())(values)

    plain, compensated, gradient = each(x, radii, values)
    assert_compensated(plain, compensated, values)
    first, second = np.argsort(values)[:2]
    expected = np.zeros(n)
    expected[[first, second]] = n - 1, 1  # what `first` has is `second`
    np.testing.assert_array_equal(gradient, expected)


def light(r, i, j):
    return j


@pytest.mark.parametrize(("rule", "second"), [("scatter", False), *(slow(rule, True) for rule in RULES)])
def test_derivatives(rule, second):
    """In a box with several images of a pair, and turns of particles; the reversed pairs are those of another rule."""
    (x, m), fn, lengths = scene(1), functools.partial(smooth, 0.7), np.array([0.6, 1.5])
    x = jnp.asarray(np.asarray(x) + (np.arange(N) % 5 - 2.0)[:, None] * np.array([0.6, 0.0]))
    radii = jnp.asarray(0.2 + 0.4 * np.asarray(m))
    pairs = reference.reference_radii(x, radii, rule, lengths=lengths)
    assert any(i == j for i, j, _ in pairs)

    def sums(x, m, lengths):
        return fused(fn, x, radii, {"m": m}, radius_rule=rule, box=jfrnn.Box(lengths, images=(2, 1)))

    args = (x, m, jnp.asarray(lengths))
    along = tangents_of(args)
    expected = oracle(smooth_slopes, pairs, dict(zip(("x", "m", "lengths"), args)), along if second else None, scale=0.7)
    assert_same(everything(sums, second)(args, along), expected)


def test_a_box_that_no_pair_crosses_though_particles_lie_boxes_apart():
    """The shift of a pair is then that of its particles' boxes, and a derivative in the edges asks for it."""
    random, n, edges = np.random.default_rng(0), 300, np.array([64.0, 128.0, 64.0])
    near, boxes = 4 + 4 * random.random((n, 3)), random.integers(-1, 2, (n, 3)).astype(float)
    radii, x = random.uniform(0.2, 1.0, n), near + boxes * edges

    def sums(edges):
        return fused(lambda r, i, j: r @ r, x, radii, box=jfrnn.Box(edges)).sum()

    r = near[None] - near[:, None]
    square = (r**2).sum(axis=-1)
    pairs = (square < radii[:, None] ** 2) & ~np.eye(n, dtype=bool)
    shifts = boxes[:, None] - boxes[None]
    expected = (2 * r * shifts * pairs[..., None]).sum(axis=(0, 1))
    found, slopes = jax.jit(jax.value_and_grad(sums))(jnp.asarray(edges))
    np.testing.assert_allclose(found, square[pairs].sum(), rtol=1e-10)
    np.testing.assert_allclose(slopes, expected, rtol=1e-9)
