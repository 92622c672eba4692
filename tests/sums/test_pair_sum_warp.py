"""`pair_sum` with its term inside the kernel: the pairs of `search`, and the sums of the other engines."""

import functools
import warnings

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from by_numpy import add_up, in_order
from checked import slow
from marked import assert_compensated, cancelling
from test_pair_sum import CUTOFF, LENGTH, N, assert_same, everything, oracle, oracle_sum, scene, stepped, tangents_of

import jfrnn
from jfrnn._sums import translate as _translate
from jfrnn.cases.hard import HARD_CASES

fused = functools.partial(jfrnn.pair_sum, backend="warp")


# --- which pairs -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in HARD_CASES if name != "denormal_lattice"])  # whose cutoff is refused
def test_counts_are_those_of_a_search(name):
    given = HARD_CASES[name].build(np.float32, 3)
    length = LENGTH if max(len(given.positions), 0 if given.queries is None else len(given.queries)) <= LENGTH else 2048
    x = jnp.asarray(checked.padded(given.positions, length))
    queries = None if given.queries is None else jnp.asarray(checked.padded(given.queries, length))
    counts = fused(one, x, given.cutoff, queries=queries)
    expected = jfrnn.search(x, given.cutoff, queries=queries, backend="warp", capacity=1).count
    np.testing.assert_array_equal(checked.with_sums(counts, x if queries is None else queries), expected)
    assert counts.dtype == np.float32


def one(r, i, j):
    return 1.0


@pytest.mark.parametrize("box", [slow(None), jfrnn.Box([1.0] * 3)], ids=["open", "box"])
def test_integers_travel_whose_bits_are_no_usual_floats(box):
    """-0, numbers that are none and denormals, as floats: nothing may be computed with them on the way."""
    bits = np.array([0x80000000, 0x7F800001, 0xFF812345, 0x00000001, 0x7FC00000, 0x80000001], np.uint32).view(np.int32)
    x = np.random.default_rng(0).random((300, 3)).astype(np.float32)
    kinds = np.resize(bits, 300)

    def same(r, i, j):
        return [(j == k).astype(r.dtype) for k in bits]

    found = jax.jit(lambda x, kinds: fused(same, x, 0.3, kinds, box=box))(x, kinds)
    pairs = reference.reference_images(x, 0.3, matrix=np.ones(3), periodic=(box is not None,) * 3)
    i, j, _ = in_order(pairs, 3)
    expected = [np.bincount(i[kinds[j] == k], minlength=300) for k in bits]
    assert all(total.sum() > 1000 for total in expected)
    np.testing.assert_array_equal(np.stack(found), np.stack(expected))


def test_more_candidates_than_fit():
    """Sums go on where a cell has more candidates than are held at a time; compensated ones with their errors."""
    values, x = cancelling(3000), np.zeros((3000, 2), np.float32)
    both = (fused(lambda r, i, j: j, x, 1.0, values, include_self=True, compensated=c) for c in (False, True))
    assert_compensated(*both, values, worse=2)  # lanes of a GPU add up parts, which loses less


def light(r, i, j):
    return j


def heavy(r, i, j):
    """Grow with j up to 50, in more operations than are done for candidates that are no pairs."""
    return jnp.sin(j * jnp.linspace(0.01, 0.03, 8, dtype=j.dtype)).sum()


@pytest.mark.parametrize("fn", [light, slow(heavy)])
def test_extremes_among_more_candidates_than_fit(fn):
    """Of equal ones that of the smallest index; NaN is not hidden; rows without neighbors."""
    n = 3000
    values = np.random.default_rng(0).integers(0, 50, n).astype(np.float32)
    x = np.zeros((n, 2), np.float32)
    x[n - 1] = 9.0
    first, last = int(values[:-1].argmax()), int(values[:-1].argmin())
    values[7] = np.nan if fn is light else values[7]

    def extremes(m, reduce):
        return fused(fn, x, 1.0, m, reduce=reduce)

    rows = np.asarray(extremes(values, "max"))
    assert rows[-1] == -np.inf
    if fn is light:
        assert np.isnan(np.delete(rows[:-1], 7)).all()
        assert rows[7] == 49
        return
    for reduce, chosen in (("max", first), ("min", last)):
        gradient = jax.grad(lambda m, reduce=reduce: extremes(m, reduce)[:-1].sum())(jnp.asarray(values))
        others = np.nonzero(gradient)[0]
        assert len(others) == 2  # the second one is what the first one has
        assert others[0] == chosen
        np.testing.assert_allclose(gradient[chosen], (n - 2) * jax.grad(heavy, 2)(None, None, values[chosen]), rtol=1e-4)


# --- what is summed ----------------------------------------------------------------------------------------------------------


def test_arrays_that_are_given_twice():
    """Positions among the values are those of the search, unless particles are inactive; two names may mean one array."""
    random = np.random.default_rng(2)
    x, m = random.random((200, 3)).astype(np.float32), random.random(200).astype(np.float32)
    given, active = {"x": jnp.asarray(x), "m": jnp.asarray(m)}, m > 0.1

    def fn(r, i, j):
        return (j["x"] - i["x"] + r) * i["m"] * j["k"] * j["m"]

    r = x[None].astype(np.float64) - x[:, None]
    near = (np.linalg.norm(r, axis=-1) < 0.3) & ~np.eye(200, dtype=bool)
    for flags in (None, active):
        found = fused(fn, given["x"], 0.3, given | {"k": given["m"]}, active=flags)
        pairs = near if flags is None else near & flags & flags[:, None]
        expected = np.einsum("ijk,ij,i,j->ik", 2 * r, pairs, m, m**2)
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def of_all_kinds(scale, r, i, j):
    """Vectors and matrices, truths and integers, several summands."""
    turned = j["matrix"] @ (i["vector"] - j["vector"])
    heavy = jnp.where(j["heavy"], j["kind"] - 2 * i["kind"], 3).astype(r.dtype)
    return {"turned": turned, "outer": jnp.outer(r, j["vector"]), "rest": [scale * heavy, jnp.maximum(r, 0)]}


@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
def test_values_of_all_kinds(dtype):
    random = np.random.default_rng(1)
    x = jnp.asarray(random.random((400, 3)), dtype)
    values = {"matrix": random.standard_normal((400, 3, 3)), "vector": random.standard_normal((400, 3))}
    values = jax.tree.map(lambda v: jnp.asarray(v, dtype), values)
    values |= {"kind": jnp.asarray(random.integers(-5, 5, 400), np.int32), "heavy": jnp.asarray(random.random(400) < 0.5)}
    fn = functools.partial(of_all_kinds, jnp.asarray(1.5, dtype))
    found = fused(fn, x, 0.3, values)
    i, j, _ = in_order(reference.reference_pairs(x, 0.3), 3)
    given = x, *map(values.get, ("matrix", "vector", "kind", "heavy"))
    points, matrix, vector, kind, truth = (np.asarray(a).astype(dtype) for a in given)
    r, whole = points[j] - points[i], np.where(truth[j] > 0, kind[j] - 2 * kind[i], 3)
    terms = {"outer": r[:, :, None] * vector[j][:, None], "rest": [1.5 * whole, np.maximum(r, 0)]}
    terms["turned"] = np.einsum("pab,pb->pa", matrix[j], vector[i] - vector[j])
    assert_same(found, jax.tree.map(lambda t: add_up(t, i, 400).astype(dtype), terms), 100 * np.finfo(dtype).eps)
    again = jax.jit(lambda x: fused(fn, x, 0.3, values))(x)
    jax.tree.map(np.testing.assert_array_equal, found, again)


def test_rounding_of_a_density():
    """Against float64, of the same pairs."""
    x = jnp.asarray(np.random.default_rng(2).random((1500, 3)), np.float32)
    h = np.float32(0.2)

    def density(r, i, j):
        return jnp.maximum(float(h) ** 2 - r @ r, 0) ** 3

    pairs, none = reference.reference_pairs(x, h), np.zeros(len(x))
    exact = oracle_sum(lambda r, i, j: np.maximum(float(h) ** 2 - (r * r).sum(1), 0) ** 3, pairs, x, x, none, none)
    counts = np.bincount([i for i, _ in pairs], minlength=len(x))
    allowed = 4 * float(np.finfo(np.float32).eps) * (np.sqrt(counts) * exact + 4 * counts * float(h) ** 6)
    assert (np.abs(np.asarray(fused(density, x, h), np.float64) - exact) <= allowed).all()


# --- derivatives -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("apart", [True, False])
def test_derivatives_with_queries(apart):
    """Where they are the particles, positions of i and of j are one array, their values and derivatives are not."""
    (x, m), q = scene(1), jnp.asarray(np.asarray(scene(2)[0])[:23])
    args = (x, m, jnp.asarray(np.linspace(0.3, 0.6, 23 if apart else N)), *([q] if apart else []))
    pairs, fn = reference.reference_pairs(x, CUTOFF, queries=q if apart else x), functools.partial(cheap, 0.7)

    def sums(x, m, w, *q):
        return fused(fn, x, CUTOFF, m, queries=q[0] if apart else x, query_values=w)

    expected = oracle(stepped(cheap_terms), pairs, dict(zip("xmwq", args)), scale=0.7)
    assert_same(everything(sums, False)(args, tangents_of(args)), expected)


def cheap(scale, r, i, j):
    s = r @ r
    return {"a": scale * j * s * i, "b": (scale + s) * r * j}


def cheap_terms(scale, r, i, j):
    """Return what `cheap` is, by NumPy, in columns."""
    s, i, j = (r * r).sum(1)[:, None], i[:, None], j[:, None]
    return np.hstack([scale * j * s * i, (scale + s) * r * j])


def test_same_bits_in_a_scan_and_again():
    """Of sums over all pairs, too, which several chunks make up."""
    x = jnp.asarray(np.random.default_rng(3).random((9000, 2)), np.float32)

    def gradient(scale):
        return jax.grad(lambda s: (fused(lambda r, i, j: s * (r @ r), x, 0.03) ** 2).sum())(scale)

    scales = jnp.asarray([1.0, 2.0], np.float32)
    first, scanned = jax.jit(
        lambda scales: (jax.lax.map(gradient, scales), jax.lax.scan(lambda c, s: (c, gradient(s)), 0, scales)[1])
    )(scales)
    np.testing.assert_array_equal(first, scanned)
    first = np.asarray(first)
    assert first[1] == 2 * first[0]
    i, j = (np.asarray(k) for k in jfrnn.search(x, 0.03, backend="warp").pairs())
    squares = np.bincount(i, ((np.asarray(x, np.float64)[j] - np.asarray(x, np.float64)[i]) ** 2).sum(axis=1))
    assert float(first[0]) == pytest.approx(float(2 * (squares**2).sum()), rel=1e-5)


# --- memory, choice of the engine, errors ------------------------------------------------------------------------------------


def sorted_norm(r, i, j):
    return jnp.sort(r)[0]


X = np.zeros((4, 2), np.float32)


def test_auto_takes_the_kernel_where_it_can():
    x = scene(1)[0]

    def engine(fn, cutoff=CUTOFF, **options):
        return "jfrnn_pair_sum" in jax.jit(lambda x: jfrnn.pair_sum(fn, x, cutoff, **options)).lower(x).as_text()

    assert engine(one)
    assert engine(one, box=jfrnn.Box([2.0, 2.0]))
    assert engine(one, cutoff=np.full(N, CUTOFF))
    assert engine(lambda r, i, j: r, reduce="max")
    with pytest.warns(RuntimeWarning, match="takes the slower engine 'jax' for a pair sum: the primitive 'sort'"):
        assert not engine(sorted_norm)
    with pytest.warns(RuntimeWarning) as seen:
        jax.eval_shape(jax.grad(lambda x: jfrnn.pair_sum(sorted_norm, x, CUTOFF).sum()), x)
    assert {warning.filename for warning in seen} == {__file__}  # not a line of JAX, from which a derivative is taken


def derivative_without_translation(x):
    """A function that translates; its derivative does not."""
    return jax.grad(lambda x: fused(with_strange_slope, x, 1.0).sum())(x)


@jax.custom_jvp
def strange(r):
    return r[0]


strange.defjvp(lambda primals, tangents: (strange(*primals), jnp.sort(primals[0])[0] * tangents[0][0]))


def with_strange_slope(r, i, j):
    return strange(r)


@pytest.mark.parametrize(
    ("error", "match", "call"),
    [
        (_translate.NoTranslationError, "the primitive 'sort' has no translation", lambda: fused(sorted_norm, X, 1.0)),
        (_translate.NoTranslationError, "the primitive 'sort'", lambda: derivative_without_translation(jnp.asarray(X))),
        (TypeError, "fn returns int32: convert it, or pass backend='jax'", lambda: fused(lambda r, i, j: jnp.int32(1), X, 1.0)),
        (TypeError, "values of bool, float32, int32, fn gets or closes over float64", lambda: fused(second, X, 1.0, np.ones(4))),
    ],
)
def test_errors(error, match, call):
    with warnings.catch_warnings(), pytest.raises(error, match=match):
        call()


def second(r, i, j):
    return j.astype(np.float32)


def test_tables_are_read_by_species():
    """A sum over pairs that reads a table by both species, and its derivatives by positions and by the table."""
    x, kind = np.random.default_rng(0).random((100, 3)).astype(np.float32), (np.arange(100) % 3 - 1).astype(np.int32)
    table = np.array([[1.0, 2.0, 4.0], [3.0, 5.0, -1.0], [0.5, 7.0, 6.0]], np.float32)  # not symmetric: a derivative reads it twice

    def energy(x, table):
        sums = jfrnn.pair_sum(lambda r, i, j: table[i["kind"], j["kind"]] * (r @ r), x, 0.3, {"kind": kind}, backend="warp")
        return sums.sum(), sums

    found = jax.jit(jax.grad(energy, (0, 1), has_aux=True))(x, table)
    i, j, _ = in_order(reference.reference_pairs(x, 0.3), 3)
    r, factor = x[j] - x[i], (table[kind[i], kind[j]] + table[kind[j], kind[i]])[:, None]
    by_table = np.bincount(3 * (kind[i] % 3) + kind[j] % 3, (r**2).sum(1), 9).reshape(3, 3)
    by_place = add_up(-2 * factor * r, i, 100)
    expected = (by_place, by_table), np.bincount(i, table[kind[i], kind[j]] * (r**2).sum(1), 100)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), found, expected)
