"""Lists that are kept, by Warp's kernels and by array programming: the pairs that they find and what they sum, against NumPy."""

import dataclasses
import functools
import math
import warnings
from itertools import product

import by_numpy
import jax
import jax.numpy as jnp
import kept_scenes
import numpy as np
import pytest
import reference
from checked import slow, slowly, sparing

import jfrnn
from jfrnn._engine import ARRAYS

LISTS = {
    "open": {},
    "nearest": {"box": [1.0, 1.0, 1.0]},
    "images": {"box": [0.5, 0.6, 1.0]},
    "skewed": {"box": [[1, 0, 0], [0.3, 1.0, 0], [0.1, 0.2, 1]]},
    "skewed images": {"box": [[0.6, 0, 0], [0.3, 0.6, 0], [0.1, 0.2, 1]]},
    "short vectors": {"box": [[1, 0, 0], [9.0, 1.0, 0], [0.1, 0.2, 1]]},
    "half": {"half": True},
    "half images": {"half": True, "box": [0.5, 0.6, 1.0]},
    "half self": {"half": True, "include_self": True, "box": [0.5, 0.6, 1.0]},
    "half short vectors": {"half": True, "box": [[0.3, 0, 0], [3.0, 0.3, 0], [0.1, 0.2, 0.3]]},
    "queries": {"queries": True},
    "queries images": {"queries": True, "box": [0.5, 0.6, 1.0]},
    "gather": {"radius_rule": "gather", "box": [1.0, 1.0, 1.0]},
    "scatter": {"radius_rule": "scatter"},
    "either": {"radius_rule": "either"},
    "both": {"radius_rule": "both", "box": [0.5, 0.6, 1.0]},
    "mean": {"radius_rule": "mean"},
    "half mean": {"radius_rule": "mean", "half": True},
}
CAPACITY = {"half short vectors": 640}  # given: a program that counts would be compiled besides
REVERSED = ("half", "queries")
N, ASKING, CUTOFF = 90, 31, 0.3


def by_arrays(nbrs):
    """Return the same list, as if array programming had made it."""
    options = nbrs.problem.options._replace(engine=ARRAYS)
    return dataclasses.replace(nbrs, problem=dataclasses.replace(nbrs.problem, options=options))


def box_of(name, dtype, dim=3):
    box = LISTS[name].get("box")
    return None if box is None else np.array(box, dtype)[(slice(dim),) * np.ndim(box)]


@functools.cache
def made(name, dtype=np.float64, dim=3):
    """Return a list with a skin, positions after a motion that it allows, and queries; tests share lists and their programs."""
    rng, options, box = np.random.default_rng(5), dict(LISTS[name]), box_of(name, dtype, dim)
    x = (rng.random((N, dim)) * (box if box is not None and box.ndim == 1 else 1)).astype(dtype)
    cutoff = radii_of(dtype) if "radius_rule" in options else CUTOFF
    q = np.random.default_rng(6).random((ASKING, dim)).astype(dtype) if options.pop("queries", False) else None
    options |= {"box": None if box is None else jfrnn.Box(box), "queries": q, "skin": 0.05, "reverse": name in REVERSED}
    nbrs = jfrnn.search(x, cutoff, backend="warp", capacity=CAPACITY.get(name, 128), **options)
    nbrs.check()
    moved = x + (0.008 * np.sin(9 * np.arange(x.size))).astype(dtype).reshape(x.shape)
    return nbrs, jnp.asarray(moved), None if q is None else jnp.asarray(q)


def radii_of(dtype):
    return np.random.default_rng(7).uniform(0.1, 0.35, N).astype(dtype)


def oracle(name, x, q=None):
    """Return all pairs at these positions, (i, j, shift); of half lists, in both directions."""
    x, q = np.asarray(x), None if q is None else np.asarray(q)
    (dim, box), rule = (x.shape[1], box_of(name, x.dtype, x.shape[1])), LISTS[name].get("radius_rule")
    cell = {"matrix": np.ones(dim) if box is None else box, "periodic": (box is not None,) * dim}
    if rule is not None:
        return reference.reference_radii(x, radii_of(x.dtype), rule, queries=q, **cell)
    return reference.reference_images(x, CUTOFF, queries=q, include_self=LISTS[name].get("include_self", False), **cell)


def assert_pairs(name, nbrs, found, x, q=None):
    """Fail unless these slots of a list, by their displacements and a mask, are the oracle's pairs."""
    expected = oracle(name, x, q)
    expected = by_numpy.forward(expected) if LISTS[name].get("half") else expected
    slots = by_numpy.pairs_of_slots(nbrs.idx, *found, x, q, box_of(name, x.dtype, x.shape[1]))
    assert by_numpy.named(slots) == expected


# What is left out here, sums below and `test_box.py` ask for, or by hand.
OFTEN = [("open", np.float64), ("nearest", np.float64), ("half images", np.float64)]
OFTEN += [("gather", np.float32), ("both", np.float32)]


@pytest.mark.parametrize(("name", "dtype"), sparing(product(LISTS, (np.float32, np.float64)), OFTEN))
def test_pairs_at_new_positions(name, dtype):
    nbrs, x, q = made(name, dtype)
    found = nbrs.vectors(x, queries=q)
    assert_pairs(name, nbrs, found, x, q)
    assert 0 < np.asarray(found[1]).sum() < (np.asarray(nbrs.idx) < N).sum()


SCALES = (1.0, 1e-4, 3e-17, 1e15)  # in single precision, kernels of their own scale distances of 3e-17
LATTICES = [(np.float32, 2, False, scale) for scale in (1.0, 1e15)] + [(np.float32, 3, True, scale) for scale in (3e-17, 1e15)]
LATTICES += [(np.float64, *kind, scale) for kind in ((2, True), (3, False)) for scale in (1.0, 3e-17, 1e15)]
EVERY = product((np.float32, np.float64), (2, 3), (False, True), SCALES)


@pytest.mark.parametrize(("dtype", "dim", "closed", "scale"), sparing(EVERY, LATTICES))
def test_ties_are_decided_exactly(scale, dtype, dim, closed):
    """All points on a lattice, in a list of all of them: rows full of pairs at exactly the cutoff, or as near as floats allow."""
    grid = np.stack(np.meshgrid(*[np.arange(4)] * dim, indexing="ij"), -1).reshape(-1, dim)
    lattice = (grid * scale).astype(dtype)
    nbrs = jfrnn.search(np.zeros_like(lattice), 2 * scale, closed=closed, capacity=len(lattice), backend="warp")
    vectors, mask = nbrs.vectors(lattice)
    expected = reference.reference_pairs(lattice, 2 * scale, closed=closed)
    found = by_numpy.named(by_numpy.pairs_of_slots(nbrs.idx, vectors, mask, lattice))
    assert {pair[:2] for pair in found} == expected
    if dim == 3:  # in sums, another kernel decides
        count = jfrnn.pair_sum(lambda r, i, j: jnp.ones((), r.dtype), lattice, None, neighbors=nbrs)
        np.testing.assert_array_equal(count, np.asarray(mask).sum(1))


@pytest.mark.parametrize(
    ("dtype", "length"),
    [(np.float32, 4.0), (np.float32, 5.0), (np.float64, 4.0), slow(np.float64, 5.0)],
    ids=["f32-4.0", "f32-5.0", "f64-4.0", "f64-5.0"],
)
def test_ties_of_images_are_decided_exactly(length, dtype):
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    lengths = np.full(3, length * 0.1, dtype)
    x = (grid * 0.1).astype(dtype)
    nbrs = jfrnn.search(x, 0.2, skin=0.05, box=jfrnn.Box(lengths), capacity=96, backend="warp")
    moved = x + (length * 0.1 * np.random.default_rng(0).integers(-2, 3, x.shape)).astype(dtype)
    for each in (x, moved):
        expected = reference.reference_images(each, 0.2, matrix=lengths, periodic=(True,) * 3)
        found = by_numpy.pairs_of_slots(nbrs.idx, *nbrs.vectors(each), each, matrix=lengths)
        assert by_numpy.named(found) == expected


def summand(r, i, j):
    square = jnp.sum(r * r)
    return {"a": i["m"] * j["m"] * jnp.exp(-square), "b": r * j["v"], "c": jnp.where(square > 0.01, j["k"], 0)}


RNG = np.random.default_rng(1)
VALUES = {"m": RNG.random(N), "v": RNG.random((N, 3)), "k": np.arange(N, dtype=np.int32)}


def everything(nbrs, x, q, twice, compensated=False):
    """Return displacements, the mask, and sums with their derivatives: of first order, and (`twice`) those along a motion, too."""
    mine = None if q is None else {"m": VALUES["m"][:ASKING]}

    def energy(x, m, scale, q):
        sums = jfrnn.pair_sum(
            lambda r, i, j: {key: scale * y if key != "c" else y.astype(r.dtype) for key, y in summand(r, i, j).items()},
            x, None, {**VALUES, "m": m}, neighbors=nbrs, queries=q, query_values=mine, compensated=compensated,
        )  # fmt: skip
        return (sums["a"] ** 2).sum() + jnp.sin(sums["b"]).sum(), sums

    @jax.jit
    def all_of(x, m, scale, q):
        def slopes(x):
            (_, sums), slopes = jax.value_and_grad(energy, (0, 1, 2) if q is None else (0, 1, 2, 3), has_aux=True)(x, m, scale, q)
            return sums, slopes

        found = jax.jvp(slopes, (x,), (jnp.cos(x),)) if twice else slopes(x)
        return nbrs.vectors(x, queries=q), found

    return all_of(x, VALUES["m"], jnp.asarray(1.5), q)


def expected_of(name, x, q, twice):
    """Return what `everything` finds of sums, by NumPy; the derivatives along a motion by a step along the imaginary axis."""
    pairs, matrix, scale = by_numpy.in_order(oracle(name, x, q), 3), box_of(name, np.float64), 1.5
    x, q = np.asarray(x), None if q is None else np.asarray(q)
    matrix = np.diag(matrix) if matrix is not None and matrix.ndim == 1 else matrix
    i, j, rows, (m, v, k) = pairs.i, pairs.j, N if q is None else ASKING, VALUES.values()

    def slopes(x):
        r = by_numpy.vectors_of(pairs, x, x if q is None else q, matrix)
        square = (r * r).sum(1)
        near = np.exp(-square)
        terms = {"a": scale * m[i] * m[j] * near, "b": scale * r * v[j], "c": np.where(square.real > 0.01, k[j], 0) + 0 * square}
        sums = {key: by_numpy.add_up(term, i, rows) for key, term in terms.items()}
        of_a, of_b = 2 * sums["a"][i], np.cos(sums["b"])[i]
        of_r = (-2 * of_a * terms["a"])[:, None] * r + scale * of_b * v[j]
        of_m = by_numpy.add_up(scale * of_a * m[i] * near, j, N)
        of_m = of_m if q is not None else of_m + by_numpy.add_up(scale * of_a * m[j] * near, i, N)
        of_x = by_numpy.pull(pairs, of_r, x, q)
        of_scale = ((of_a * terms["a"]).sum() + (of_b * terms["b"]).sum()) / scale
        return sums, (of_x, of_m, of_scale) if q is None else (of_x[0], of_m, of_scale, of_x[1])

    return (slopes(x), by_numpy.along(slopes, x, np.cos(x))) if twice else slopes(x)


WAYS = [(name, "kernels", True) for name in ("images", "either")]  # second derivatives of the others by hand
WAYS += [("skewed images", "kernels", False), ("queries", "compensated", False)]
MORE = [("scatter", "compensated", False), ("half mean", "arrays", False)]
MORE += [(name, "compensated", True) for name in ("images", "scatter", "queries")]
MORE += [each for each in product(LISTS, ("kernels", "arrays"), (True,)) if each not in WAYS]


@pytest.mark.parametrize(("name", "way", "twice"), [*WAYS, *slowly(*MORE)])
def test_sums_and_derivatives(name, way, twice):
    """Of first order, and where kinds of lists differ in how pairs are passed on (`twice`) of second order."""
    nbrs, x, q = made(name)
    found, sums = everything(by_arrays(nbrs) if way == "arrays" else nbrs, x, q, twice, way == "compensated")
    assert_pairs(name, nbrs, found, x, q)
    expected = expected_of(name, x, q, twice)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-11), sums, expected)


EXTREMES = product(("open", "images", "queries"), ("min", "max"))


@pytest.mark.parametrize(("name", "reduce"), sparing(EXTREMES, [("images", "min"), ("queries", "max")]))
def test_extremes(name, reduce):
    nbrs, x, q = made(name)

    def energy(x):
        found = jfrnn.pair_sum(lambda r, i, j: jnp.sin(9 * r), x, None, neighbors=nbrs, queries=q, reduce=reduce)
        return jnp.sum(jnp.where(jnp.isfinite(found), found, 0) ** 2), found

    slopes, found = jax.jit(jax.grad(energy, has_aux=True))(x)
    x, q, matrix = np.asarray(x), None if q is None else np.asarray(q), box_of(name, np.float64)
    pairs = by_numpy.in_order(oracle(name, x, q), 3)
    r = by_numpy.vectors_of(pairs, x, x if q is None else q, None if matrix is None else np.diag(matrix))
    choose, none = {"max": (np.maximum, -np.inf), "min": (np.minimum, np.inf)}[reduce]
    expected = np.full((N if q is None else ASKING, 3), none)
    choose.at(expected, pairs.i, np.sin(9 * r))
    chosen = np.sin(9 * r) == expected[pairs.i]
    assert (chosen.sum(0) == np.isfinite(expected).sum(0)).all()  # no pair is as good as another one
    of_x = by_numpy.pull(pairs, np.where(chosen, 18 * np.sin(9 * r) * np.cos(9 * r), 0), x, q)
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    np.testing.assert_allclose(slopes, of_x if q is None else of_x[0], rtol=1e-12, atol=1e-13)


def test_in_two_dimensions_and_single_precision():
    nbrs, x, _ = made("nearest", np.float32, dim=2)

    @jax.jit
    def all_of(x):
        near = jfrnn.pair_sum(lambda r, i, j: jnp.exp(-jnp.sum(r * r)), x, None, neighbors=nbrs)
        of_values = jfrnn.pair_sum(lambda r, i, j: r * j[:, None] + i[0], x, None, jnp.ones((N, 5), x.dtype), neighbors=nbrs)
        return nbrs.vectors(x), near, of_values

    found, near, of_values = all_of(x)
    assert_pairs("nearest", nbrs, found, x)
    pairs = by_numpy.in_order(oracle("nearest", x), 2)
    r = by_numpy.vectors_of(pairs, np.asarray(x, float), np.asarray(x, float), np.eye(2))
    np.testing.assert_allclose(near, by_numpy.add_up(np.exp(-(r * r).sum(1)), pairs.i, N), rtol=2e-6)
    expected = np.broadcast_to(by_numpy.add_up(r + 1, pairs.i, N)[:, None], (N, 5, 2))
    np.testing.assert_allclose(of_values, expected, rtol=2e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("side", [2.06, 2.4])
def test_in_a_box_as_narrow_as_it_may_be(side, dtype):
    kept_scenes.narrow_box(side, dtype)


@pytest.mark.parametrize("most", [1, 5, 700])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_pairs_whose_points_lie_boxes_apart(dtype, most):
    kept_scenes.boxes_apart(dtype, most)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_ties_beside_pairs_that_a_wide_box_leaves_in_doubt(dtype):
    kept_scenes.ties_in_a_wide_box(dtype)


def test_the_kernel_sums():
    """The program has a call of the library and no loop of array programming."""
    nbrs, x, _ = made("nearest")
    slopes = jax.jit(jax.grad(lambda x: jnp.sum(jfrnn.pair_sum(lambda r, i, j: jnp.sum(r**4), x, None, neighbors=nbrs))))
    text = slopes.lower(x).as_text()
    assert "jfrnn_kept_sums" in text
    assert "stablehlo.while" not in text


def test_what_has_no_translation_warns_once():
    nbrs, x, _ = made("open")

    def fn(r, i, j):
        return jax.scipy.special.gammaln(1 + jnp.sum(r * r))

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        sums = jfrnn.pair_sum(fn, x, None, neighbors=nbrs)
        jax.eval_shape(jax.grad(lambda x: jnp.sum(jfrnn.pair_sum(fn, x, None, neighbors=nbrs))), x)
    assert len([each for each in told if "has no translation" in str(each.message)]) == 2  # one for each sum, none for derivatives
    assert all(each.filename == __file__ for each in told)
    pairs = by_numpy.in_order(oracle("open", x), 3)
    square = (by_numpy.vectors_of(pairs, np.asarray(x), np.asarray(x)) ** 2).sum(1)
    terms = np.array([math.lgamma(1 + x) for x in square.tolist()])
    np.testing.assert_allclose(sums, by_numpy.add_up(terms, pairs.i, N), rtol=1e-12)


@pytest.mark.parametrize("dtype", [slow(np.float32), np.float64])
def test_particles_that_are_not_finite(dtype):
    nbrs, x, _ = made("nearest", dtype)
    x = np.array(x)
    x[3, 0], x[7, 1] = np.nan, np.inf
    sums = jax.jit(lambda x: jfrnn.pair_sum(lambda r, i, j: jnp.sum(r * r), x, None, neighbors=nbrs))(x)
    assert np.flatnonzero(np.isnan(sums)).tolist() == [3, 7]
    for each in (nbrs, by_arrays(nbrs)):
        assert_pairs("nearest", each, each.vectors(x), x)
