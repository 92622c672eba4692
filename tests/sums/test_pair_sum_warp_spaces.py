"""Fused pair sums in periodic boxes, and with a cutoff per particle: the oracle's pairs and images, and derivatives."""

import functools
from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import slow, sparing
from marked import assert_compensated, assert_marks, cancelling, marks
from test_pair_sum import CUTOFF, N, assert_same, everything, oracle, scene, smooth, smooth_slopes, tangents_of
from test_radii import LENGTH, radii_of

import jfrnn
from jfrnn._geometry.cutoffs import RULES
from jfrnn.cases.batches import BATCH_CASES
from jfrnn.cases.periodic import PERIODIC_CASES
from jfrnn.cases.radii import RADII_CASES

fused = functools.partial(jfrnn.pair_sum, backend="warp")
NEAREST = ["outside_100", "faces", "ulp_across_100"]
NAMES = [*NEAREST, "thin_slab", "skewed_3_small", "queries_many_images"]


def marked(given, box, alone, **options):
    """Return the marks of a case, lengthened so that cases share programs; `alone` it has its own, which knows the box."""
    ids = np.arange(300, dtype=given.positions.dtype)
    if given.queries is not None:
        options |= {"queries": checked.padded(given.queries, 300), "query_values": ids}

    def sums(x, options):
        return fused(marks, x, given.cutoff, ids, box=box, **options, **static)

    static = {name: options.pop(name) for name in ("closed", "include_self") if name in options}
    return (jax.jit(sums) if alone else sums)(checked.padded(given.positions, 300), options)


def assert_case(name, dtype, dim, **options):
    given = PERIODIC_CASES[name].build(dtype, dim)
    found = marked(given, jfrnn.Box(given.matrix, given.periodic), name not in NEAREST, **options)
    kind = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries}
    pairs = reference.reference_images(given.positions, given.cutoff, **kind, **options)
    assert_marks(found, pairs, given.positions, given.queries, given.matrix)


EVERY = product(PERIODIC_CASES, (np.float32, np.float64), (2, 3))


@pytest.mark.parametrize(("name", "dtype", "dim"), sparing(EVERY, [(name, np.float32, 3) for name in NAMES]))
def test_cases(name, dtype, dim):
    assert_case(name, dtype, dim)


def marks_at_work(r, i, j):
    """Take more operations than are done for candidates that are no pairs, so that pairs are packed first."""
    return marks(r, i, j) | {"more": jnp.exp(jnp.sin(r)).sum() + jnp.cos(i * j)}


@pytest.mark.parametrize("fn", [marks, slow(marks_at_work)])
def test_where_no_pair_crosses_the_box(fn):
    """Within a box pairs have no shift, and coordinates are those of the candidates; but not where particles lie outside.

    In the boxes beside it is a shift of the image alone, between wrapped positions; farther away turns are read.
    """
    lengths, ids = np.array([8.0, 9.0]), np.arange(600, dtype=np.float32)
    x = (np.random.default_rng(0).random((600, 2)) * lengths).astype(np.float32)
    outside = x + np.where(ids[:, None] == 7, 2 * lengths, 0).astype(np.float32)
    beside = x + ((ids[:, None] % 3 - 1) * lengths).astype(np.float32)
    sums = jax.jit(lambda x: fused(fn, x, 0.5, ids, box=jfrnn.Box(lengths)))
    for at in (x, outside, beside):
        pairs = reference.reference_images(at, 0.5, matrix=np.diag(lengths), periodic=(True, True))
        assert_marks(sums(at), pairs, at, matrix=lengths)


def test_displacements_of_particles_boxes_apart_are_those_of_their_coordinates():
    """Wrapped coordinates of such particles are rounded: those that were given are read, and the turns between them."""
    rng, cutoff, length = np.random.default_rng(5), 0.2, np.float32(0.7)
    x = (rng.random((5000, 3)) * length + rng.integers(170, 173, (5000, 3)) * length).astype(np.float32)
    found = fused(lambda r, i, j: r @ r, jnp.asarray(x), cutoff, box=jfrnn.Box([length] * 3))
    r = x.astype(np.float64)[None, :200] - x.astype(np.float64)[:, None]
    r -= np.round(r / length) * np.float64(length)
    squares = (r * r).sum(axis=2)
    near = (squares < np.float64(np.float32(cutoff)) ** 2) & (np.arange(5000)[:, None] != np.arange(200))
    np.testing.assert_allclose(np.asarray(found)[:200], np.where(near, squares, 0).sum(axis=0), rtol=2e-6)


@pytest.mark.parametrize("name", ["periodic", slow("periodic_images")])
def test_batches(name):
    """In a box that is traced: its image is the nearest one, or how many are looked at is said."""
    given = BATCH_CASES[name].build(np.float64, 2)
    n, images = len(given.positions), None if name == "periodic" else 1
    batch = np.concatenate([given.batch, np.zeros(300 - n, np.int32)])

    @jax.jit
    def sums(x, lengths):
        ids = np.arange(300, dtype=x.dtype)
        return fused(marks, x, given.cutoff, ids, box=jfrnn.Box(lengths, images=images), batch=batch)

    found = sums(checked.padded(given.positions, 300), given.lengths)
    pairs = reference.reference_images(given.positions, given.cutoff, matrix=given.lengths, periodic=(True, True))
    together = {(i, j, s) for i, j, s in pairs if given.batch[i] == given.batch[j]}
    assert_marks(found, together, given.positions, matrix=given.lengths)


# --- derivatives -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_derivatives_with_queries():
    """The reversed pairs have their own turns."""
    (x, m), q = scene(1), jnp.asarray(np.asarray(scene(2)[0])[:23] - np.array([3.0, 0.0]))
    args = (x, q, m, jnp.linspace(0.3, 0.6, 23), jnp.array([1.3, 1.0]))

    def sums(x, q, m, w, lengths):
        given = {"queries": q, "query_values": {"m": w}, "box": jfrnn.Box(lengths, (True, False))}
        return fused(functools.partial(smooth, 0.7), x, CUTOFF, {"m": m}, **given)

    along, pairs = tangents_of(args), reference.reference_images(x, CUTOFF, matrix=args[-1], periodic=(True, False), queries=q)
    expected = oracle(smooth_slopes, pairs, dict(zip(("x", "q", "m", "w", "lengths"), args)), along, scale=0.7)
    assert_same(everything(sums)(args, along), expected)


# --- where there is no answer ----------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnames="rule")
def open_marks(x, radii, ids, rule):
    return fused(marks, x, radii, ids, radius_rule=rule)


def assert_radii(name, dtype, dim, rule, **options):
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
def test_cases_of_radii(name, rule):
    assert assert_radii(name, np.float32, 3, rule)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "dim"), [(np.float32, 2), (np.float64, 2), (np.float32, 3), (np.float64, 3)])
@pytest.mark.parametrize("name", RADII_CASES)
def test_every_case_of_radii(name, dtype, dim):
    assert max(assert_radii(name, dtype, dim, rule) for rule in RULES)
    assert_radii(name, dtype, dim, "either", closed=True)


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
def test_derivatives_with_radii(rule, second):
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
