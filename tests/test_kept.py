"""Lists that are kept, by Warp's kernels: the pairs that they find and what they sum, against array programming."""

import dataclasses
import warnings
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


def by_arrays(nbrs):
    """Return the same list, as if array programming had made it."""
    options = nbrs.problem.options._replace(engine=ARRAYS)
    return dataclasses.replace(nbrs, problem=dataclasses.replace(nbrs.problem, options=options))


def make(name, dtype=np.float64, dim=3, n=90, skin=0.05, reverse=False):
    rng, options = np.random.default_rng(5), dict(LISTS[name])
    box, queries = options.pop("box", None), options.pop("queries", False)
    box = None if box is None else np.array(box, dtype)[:dim] if np.ndim(box) == 1 else np.array(box, dtype)[:dim, :dim]
    x = rng.random((n, dim)) * (box if box is not None and box.ndim == 1 else 1)
    cutoff = jnp.asarray(rng.uniform(0.1, 0.35, n), dtype) if "radius_rule" in options else 0.3
    q = jnp.asarray(rng.random((31, dim)), dtype) if queries else None
    options |= {"box": None if box is None else jfrnn.Box(box), "queries": q, "skin": skin, "reverse": reverse}
    x = jnp.asarray(x, dtype)
    nbrs = jfrnn.search(x, cutoff, backend="warp", capacity=CAPACITY.get(name, 128), **options)
    nbrs.check()
    return nbrs, x + jnp.asarray(0.02 * np.sin(9 * np.arange(x.size)), dtype).reshape(x.shape), q


OFTEN = ("images", "either")  # in single precision too; the others by hand
PRECISIONS = [pytest.param(name, np.float64, marks=[pytest.mark.slow] * (k % 3 > 0)) for k, name in enumerate(LISTS)]
PRECISIONS += [pytest.param(name, np.float32, marks=[pytest.mark.slow] * (name not in OFTEN)) for name in LISTS]


@pytest.mark.parametrize(("name", "dtype"), PRECISIONS)
def test_pairs_at_new_positions(name, dtype):
    nbrs, x, q = make(name, dtype)
    ours, theirs = (np.asarray(each.vectors(x, queries=q)[1]) for each in (nbrs, by_arrays(nbrs)))
    np.testing.assert_array_equal(ours, theirs)
    assert 0 < ours.sum() < (np.asarray(nbrs.idx) < len(x)).sum()


PAIRWISE = [(np.float32, 2, False), (np.float32, 3, True), (np.float64, 2, True), (np.float64, 3, False)]
EVERY = [
    pytest.param(*given, marks=[pytest.mark.slow] * (given not in PAIRWISE))
    for given in product((np.float32, np.float64), (2, 3), (False, True))
]


@pytest.mark.parametrize("scale", [1.0, pytest.param(1e-4, marks=pytest.mark.slow), 3e-17, 1e15])
@pytest.mark.parametrize(("dtype", "dim", "closed"), EVERY)
def test_ties_are_decided_exactly(scale, dtype, dim, closed):
    """All points on a lattice, in a list of all of them: rows full of pairs at exactly the cutoff, or as near as floats allow."""
    grid = np.stack(np.meshgrid(*[np.arange(4)] * dim, indexing="ij"), -1).reshape(-1, dim)
    lattice = jnp.asarray((grid * scale).astype(dtype))
    nbrs = jfrnn.search(jnp.zeros_like(lattice), 2 * scale, closed=closed, backend="warp")
    mask = np.asarray(nbrs.vectors(lattice)[1])
    np.testing.assert_array_equal(mask, np.asarray(by_arrays(nbrs).vectors(lattice)[1]))
    count = jfrnn.pair_sum(lambda r, i, j: jnp.ones((), r.dtype), lattice, None, neighbors=nbrs)
    np.testing.assert_array_equal(count, mask.sum(1))


@pytest.mark.parametrize("length", [4.0, 5.0])
def test_ties_of_images_are_decided_exactly(length, dtype):
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    box = jfrnn.Box(np.full(3, length * 0.1, dtype))
    x = jnp.asarray((grid * 0.1).astype(dtype))
    nbrs = jfrnn.search(x, 0.2, skin=0.05, box=box, backend="warp")
    moved = x + jnp.asarray(length * 0.1 * np.random.default_rng(0).integers(-2, 3, x.shape), dtype)
    for each in (x, moved):
        np.testing.assert_array_equal(nbrs.vectors(each)[1], by_arrays(nbrs).vectors(each)[1])


def summand(r, i, j):
    square = jnp.sum(r * r)
    return {"a": i["m"] * j["m"] * jnp.exp(-square), "b": r * j["v"], "c": jnp.where(square > 0.01, j["k"], 0)}


TWICE = ("images", "either")  # second derivatives of the others by hand
ONCE = ("skewed images", "half mean")  # and of kinds that are like these, sums, too
SUMMED = [(name, False, True) for name in TWICE] + [(name, False, False) for name in ONCE]
SUMMED += [(name, True, False) for name in ("scatter", "queries")]
MORE = [(name, False, True) for name in LISTS if name not in TWICE] + [
    (name, True, True) for name in ("images", "scatter", "queries")
]
SUMMED += [pytest.param(*more, marks=pytest.mark.slow) for more in MORE]


@pytest.mark.parametrize(("name", "compensated", "twice"), SUMMED)
def test_sums_and_derivatives(name, compensated, twice):
    """Of first order, and where kinds of lists differ in how pairs are passed on (`twice`) of second order."""
    nbrs, x, q = make(name, reverse=name in ("half", "queries"))
    rng, n = np.random.default_rng(1), len(x)
    values = {"m": jnp.asarray(rng.random(n)), "v": jnp.asarray(rng.random((n, 3))), "k": jnp.arange(n, dtype=jnp.int32)}
    mine = None if q is None else {"m": values["m"][:31]}

    def total(nbrs, x, m, q, scale):
        sums = jfrnn.pair_sum(
            lambda r, i, j: {key: scale * y if key != "c" else y.astype(r.dtype) for key, y in summand(r, i, j).items()},
            x, None, {**values, "m": m}, neighbors=nbrs, queries=q, query_values=mine, compensated=compensated,
        )  # fmt: skip
        return jnp.sum(sums["a"] ** 2) + jnp.sum(jnp.sin(sums["b"])), sums

    which = (1, 2, 4) if q is None else (1, 2, 3, 4)

    @jax.jit
    def all_of(nbrs, x, m, q, scale):
        first = jax.grad(lambda *given: total(*given)[0], which)

        def slope(x):
            return jax.grad(lambda x: total(nbrs, x, m, q, scale)[0])(x)

        second = jax.jvp(slope, (x,), (jnp.cos(x),))[1] if twice else None
        return total(nbrs, x, m, q, scale), first(nbrs, x, m, q, scale), second

    given = (x, values["m"], q, jnp.asarray(1.5))
    ours, theirs = all_of(nbrs, *given), all_of(by_arrays(nbrs), *given)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-11), ours, theirs)


@pytest.mark.parametrize(
    ("name", "reduce"),
    [
        *(("open", "max"), ("images", "min"), ("queries", "max")),
        *(pytest.param(*more, marks=pytest.mark.slow) for more in (("open", "min"), ("images", "max"), ("queries", "min"))),
    ],
)
def test_extremes(name, reduce):
    nbrs, x, q = make(name)

    def found(nbrs, x):
        return jfrnn.pair_sum(lambda r, i, j: jnp.sin(9 * r), x, None, neighbors=nbrs, queries=q, reduce=reduce)

    def of_both(nbrs):
        finite = lambda x: jnp.sum(jnp.where(jnp.isfinite(found(nbrs, x)), found(nbrs, x), 0) ** 2)  # noqa: E731
        return jax.jit(lambda x: (found(nbrs, x), jax.grad(finite)(x)))(x)

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), of_both(nbrs), of_both(by_arrays(nbrs)))


@pytest.mark.parametrize("symmetry", ["symmetric", "antisymmetric"])
@pytest.mark.parametrize("name", ["nearest", "half images"])
def test_symmetry(name, symmetry):
    nbrs, x, _ = make(name)
    sums = [
        jfrnn.pair_sum(lambda r, i, j: r * jnp.sum(r**4), x, None, neighbors=each, symmetry=symmetry)
        for each in (nbrs, by_arrays(nbrs))
    ]
    np.testing.assert_allclose(*sums, atol=1e-15)


def test_in_two_dimensions_and_single_precision():
    nbrs, x, _ = make("nearest", np.float32, dim=2)
    for fn in (lambda r, i, j: jnp.exp(-jnp.sum(r * r)), lambda r, i, j: r * j[:, None] + i[0]):
        values = None if fn(x[0], jnp.zeros(5, x.dtype), jnp.zeros(5, x.dtype)).ndim == 0 else jnp.ones((len(x), 5), x.dtype)
        sums = [jfrnn.pair_sum(fn, x, None, values, neighbors=each) for each in (nbrs, by_arrays(nbrs))]
        np.testing.assert_allclose(*sums, rtol=2e-6)


def test_the_kernel_sums():
    """The program has a call of the library and no loop of array programming."""
    nbrs, x, _ = make("nearest")
    text = (
        jax.jit(jax.grad(lambda x: jnp.sum(jfrnn.pair_sum(lambda r, i, j: jnp.sum(r**4), x, None, neighbors=nbrs))))
        .lower(x)
        .as_text()
    )
    assert "jfrnn_kept_sums" in text
    assert "stablehlo.while" not in text


def test_what_has_no_translation_warns_once():
    nbrs, x, _ = make("open")

    def fn(r, i, j):
        return jax.scipy.special.gammaln(1 + jnp.sum(r * r))

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        sums = jfrnn.pair_sum(fn, x, None, neighbors=nbrs)
        jax.grad(lambda x: jnp.sum(jfrnn.pair_sum(fn, x, None, neighbors=nbrs)))(x)
    assert len([each for each in told if "has no translation" in str(each.message)]) == 2  # one for each sum, none for derivatives
    assert all(each.filename == __file__ for each in told)
    np.testing.assert_allclose(sums, jfrnn.pair_sum(fn, x, 0.3, backend="jax"), rtol=1e-12)


def test_vmap():
    nbrs, x, _ = make("half images")

    def total(x):
        return jax.grad(lambda x: jnp.sum(jfrnn.pair_sum(lambda r, i, j: jnp.sum(r**4), x, None, neighbors=nbrs)))(x)

    several = jnp.stack([x, x + 0.01])
    np.testing.assert_allclose(jax.vmap(total)(several), jnp.stack([total(x), total(x + 0.01)]), rtol=1e-12)


def test_particles_that_are_not_finite(dtype):
    nbrs, x, _ = make("nearest", dtype)
    x = x.at[3, 0].set(jnp.nan).at[7, 1].set(jnp.inf)
    for each in (nbrs, by_arrays(nbrs)):
        mask = np.asarray(each.vectors(x)[1])
        assert not mask[[3, 7]].any()
        assert not np.isin(np.asarray(nbrs.idx)[mask], [3, 7]).any()
    sums = np.asarray(jfrnn.pair_sum(lambda r, i, j: jnp.sum(r * r), x, None, neighbors=nbrs))
    assert np.flatnonzero(np.isnan(sums)).tolist() == [3, 7]
