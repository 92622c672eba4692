"""`NeighborList`: geometry with gradients of every order, exports, and what it refuses."""

import functools

import by_numpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses

import jfrnn


def search(points, cutoff, **options):
    """Search with one capacity for all tests, so that they share compiled programs."""
    return jfrnn.search(points, cutoff, capacity=40, **options)


@pytest.fixture
def points(dim):
    return jnp.asarray(np.random.default_rng(0).random((40, dim)))


@pytest.mark.parametrize("asked", [False, True])
def test_distances_and_vectors(points, asked):
    q = np.asarray(points)[:7] + 0.05 if asked else None
    nbrs = search(points, 0.4, queries=q)
    r, mask = map(np.asarray, nbrs.vectors(points, queries=q))
    d, same = map(np.asarray, nbrs.distances(points, queries=q))
    np.testing.assert_array_equal(mask, same)
    np.testing.assert_array_equal(mask.sum(1), nbrs.count)
    i, k = np.nonzero(mask)
    apart = np.asarray(points)[np.asarray(nbrs.idx)[i, k]] - (q if asked else np.asarray(points))[i]
    np.testing.assert_array_equal(r[i, k], apart)
    np.testing.assert_allclose(d[i, k], np.linalg.norm(apart, axis=1), rtol=1e-15)
    assert not r[~mask].any()
    assert not d[~mask].any()


def test_distances_do_not_underflow(dtype):
    tiny = np.array([[0, 0], [3e-25, 4e-25]], dtype)
    for half in (False, True):  # by a kernel, and by `norms`
        d, mask = map(np.asarray, jfrnn.search(tiny, 1e-24, half=half, capacity=2).distances(tiny))
        assert mask[0, 0]
        np.testing.assert_allclose(d[0, 0], 5e-25, rtol=1e-6)


@jax.jit
def energy(nbrs, x):
    d, mask = nbrs.distances(x)
    return jnp.sum(jnp.where(mask, (0.4 - d) ** 3, 0.0))


def test_gradients_of_first_and_second_order(points):
    """Forward over backward and backward over backward, against NumPy."""
    nbrs, direction = search(points, 0.4), np.cos(np.arange(points.size)).reshape(points.shape)

    @jax.jit
    def all_of(nbrs, x):
        slopes = functools.partial(jax.value_and_grad(energy, 1), nbrs)
        return *jax.jvp(slopes, (x,), (direction,)), jax.grad(lambda x: jnp.vdot(slopes(x)[1], direction))(x)

    pairs, x = by_numpy.in_order(reference.reference_pairs(np.asarray(points), 0.4), points.shape[1]), np.asarray(points)

    def expected(x):
        r = by_numpy.vectors_of(pairs, x, x)
        d = np.sqrt((r * r).sum(1))
        return ((0.4 - d) ** 3).sum(), by_numpy.pull(pairs, (-3 * (0.4 - d) ** 2 / d)[:, None] * r, x)

    value, forward, backward = all_of(nbrs, points)
    along = by_numpy.along(expected, x, direction)
    wanted = expected(x), along, along[1]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), (value, forward, backward), wanted)


def test_gradients_are_finite_at_coincident_points(dim):
    points = np.zeros((3, dim))
    points[2, 0] = 0.1
    nbrs = search(points, 0.4)
    slopes = functools.partial(jax.value_and_grad(energy, 1), nbrs)
    (value, gradient), hessian = jax.jit(lambda x: (slopes(x), jax.jacfwd(lambda x: slopes(x)[1])(x)))(points)
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()
    assert np.isfinite(hessian).all()
    assert nbrs.count[0] == 2


@pytest.mark.parametrize("n", [0, 1])
def test_lists_without_pairs(n, dim):
    nbrs = jfrnn.search(np.zeros((n, dim), np.float32), 1.0)
    assert nbrs.pairs()[0].shape == (0,)
    assert nbrs.csr()[0].tolist() == [0] * (n + 1)
    d, mask = nbrs.distances(jnp.zeros((n, dim), jnp.float32))
    assert d.shape == mask.shape == nbrs.idx.shape
    assert not mask.any()


def test_is_a_pytree_with_static_options(points):
    nbrs = jfrnn.search(points, 0.3, half=True)
    leaves, structure = jax.tree.flatten(nbrs)
    assert len(leaves) == 4
    again = jax.tree.unflatten(structure, leaves)
    assert (again.cutoff, again.half, again.capacity, again.source_count) == (0.3, True, nbrs.capacity, 40)
    with pytest.raises(AttributeError, match="cannot assign"):
        nbrs.cutoff = 1.0


def test_refusals(points):
    nbrs = search(points, 0.4)
    refuses(ValueError, "made without queries: leave queries out", nbrs.vectors, points, queries=points)
    refuses(TypeError, "positions must be float32 or float64", nbrs.vectors, points.astype(int))
    asked = search(points, 0.4, queries=points[:3])
    refuses(ValueError, "made with queries: pass queries=", asked.distances, points)
    with pytest.raises(TypeError, match=r"check\(\) reads values and cannot run inside jax.jit"):
        jax.jit(lambda x: jfrnn.search(x, 0.4, capacity=40).check())(points)
    batch = jax.vmap(lambda x: jfrnn.search(x, 0.4, capacity=40))(points[None])
    refuses(ValueError, "index the batch first", batch.pairs)
    for call in (batch.vectors, batch.distances, batch.shifts, batch.update, batch.grow):
        refuses(ValueError, "index the batch first", call, points)


ASKED = {
    "update": lambda nbrs, x, **given: nbrs.update(x, **given),
    "grow": lambda nbrs, x, **given: nbrs.grow(x, **given),
    "vectors": lambda nbrs, x, **given: nbrs.vectors(x, **given),
    "distances": lambda nbrs, x, **given: nbrs.distances(x, **given),
    "shifts": lambda nbrs, x, **given: nbrs.shifts(x, **given),
    "pair_sum": lambda nbrs, x, **given: jfrnn.pair_sum(lambda r, i, j: r, x, None, neighbors=nbrs, **given),
}


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize("options", [{}, {"skin": 0.1, "box": jfrnn.Box([3.0, 3.0, 3.0])}], ids=["open", "skin in a box"])
def test_a_list_is_asked_about_what_it_was_made_of(asked, options):
    x = jnp.zeros((5, 3), jnp.float32)
    nbrs = jfrnn.search(x, 0.4, capacity=8, backend="warp", **options)
    others = {
        "float32 with 3 columns, for which the list was made, got float64 with 3 columns: convert": x.astype(jnp.float64),
        "float32 with 3 columns, for which the list was made, got float32 with 2 columns": x[:, :2],
        "hold 4 particles, but the list was made for 5: make it anew": x[1:],
    }
    for match, other in others.items():
        for call in (ASKED[asked], lambda nbrs, x: jax.eval_shape(lambda x: ASKED[asked](nbrs, x), x)):
            refuses(ValueError, f"positions.*{match}", call, nbrs, other)
    if not options:
        of_queries = jfrnn.search(x, 0.4, queries=x[:3], capacity=8, backend="warp")
        with pytest.raises(ValueError, match=r"queries must be float32 with 3 columns.*got float64"):
            ASKED[asked](of_queries, x, queries=x[:3].astype(jnp.float64))
        refuses(ValueError, "queries hold 2 points, but the list was made for 3", ASKED[asked], of_queries, x, queries=x[:2])
    elif asked != "grow":
        refuses(ValueError, "box has 2 axes, but positions have 3 columns", ASKED[asked], nbrs, x, box=jfrnn.Box([3.0, 3.0]))


def test_a_list_is_printed_in_a_line():
    x = jnp.asarray([[0.0, 0.0], [0.3, 0.4], [2.0, 0.0]], jnp.float32)
    nbrs = jfrnn.search(x, 1.0, capacity=1, skin=0.25, backend="warp")
    line = "NeighborList(3 particles, capacity 1, cutoff 1, skin 0.25, engine 'warp', {} pairs, status {})"
    assert repr(nbrs) == str(nbrs) == line.format(2, "OK")
    short = jfrnn.search(jnp.zeros((3, 2), jnp.float32).at[2].set(jnp.nan), 1.0, queries=jnp.zeros((2, 2), jnp.float32), capacity=1)
    assert "2 queries of 3 particles, capacity 1" in repr(short)
    assert repr(short).endswith("4 pairs, status ROW_OVERFLOW | NONFINITE)")
    seen = []
    jax.eval_shape(lambda nbrs: seen.append(repr(nbrs)), nbrs)
    assert seen == [line.format("traced", "traced")]
    assert "shape" not in repr(jax.tree.map(lambda _: 0, nbrs))  # whatever stands where arrays stood
    slopes = jax.grad(lambda nbrs: nbrs.distances(x)[0].sum(), allow_int=True)(nbrs)
    assert repr(slopes) == line.format("float0", "float0")
    assert repr(jax.tree.map(lambda x: x.astype(jnp.float32), nbrs)) == line.format("float32", "float32")


def test_boxes_and_totals_are_taken_by_place_and_by_name():
    """On every method alike; errors name the class that the user has."""
    x, box = np.random.default_rng(0).random((20, 3)).astype(np.float32), jfrnn.Box([1.0, 1.0, 1.0])
    nbrs, flat = jfrnn.search(x, 0.3, box=box, capacity=24), jfrnn.search_edges(x, 0.3, box=box, total=64)

    def same(first, second):
        return str(jax.make_jaxpr(first)(x, box)) == str(jax.make_jaxpr(second)(x, box))

    for made in (nbrs, flat):
        calls = [made.update, made.edges] if made is flat else [made.update, made.vectors, made.distances, made.shifts]
        for call in calls:
            assert same(call, lambda x, box, call=call: call(x, box=box))
    assert not same(nbrs.vectors, lambda x, box: nbrs.vectors(x))
    for call in (nbrs.edges, nbrs.to_jraph):
        assert same(lambda x, box, call=call: call(x, 500, box), lambda x, box, call=call: call(x, total=500, box=box))
    assert int(nbrs.grow(x, box, slack=1.5).status) == 0
    for made in (nbrs, flat):
        refuses(TypeError, r"box must be a jfrnn\.Box", made.grow, x, x, slack=1.5)
        name = type(made).__name__
        for method in ("update", "grow", "edges"):
            with pytest.raises(TypeError, match=rf"^{name}\.{method}\(\) got an unexpected keyword argument 'boxes'"):
                getattr(made, method)(x, boxes=box)
        assert type(made).update.__doc__.startswith("Rebuild the list")
    refuses(TypeError, r"^NeighborList\.pairs\(\) got an unexpected keyword argument 'position'", nbrs.pairs, position=x)
    refuses(TypeError, r"box must be a jfrnn\.Box, got float32 of shape \[20, 3\]", nbrs.distances, x, x)
