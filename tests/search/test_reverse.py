"""Reverse slots: each pair's slot the other way round, and derivatives of the geometry of a list that gather and never scatter."""

import functools
from itertools import product

import by_numpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slow, sparing
from test_kept import by_arrays

import jfrnn

BACKENDS = ["warp", "brute"]  # "brute" is as "jax" in this, and compiles sooner
BOXES = {"open": None, "nearest": [1.0, 1.0, 1.0], "images": [0.7, 0.5, 1.0]}
KINDS = {
    "full": {},
    "self": {"include_self": True},
    "half": {"half": True},
    "gather": {"radius_rule": "gather"},
    "either": {"radius_rule": "either"},
    "queries": {"queries": True},
}
CAPACITY = 64  # given: a program that counts would be compiled besides
N, ASKING, CUTOFF = 40, 17, 0.4


def options_of(kind, box="open", dtype=np.float64):
    """Return the cutoff of a list, or one per particle, and its options, queries among them."""
    rng, options = np.random.default_rng(4), dict(KINDS[kind])
    cutoff = rng.uniform(0.1, 0.4, N).astype(dtype) if "radius_rule" in options else CUTOFF
    q = rng.random((ASKING, 3)).astype(dtype) if options.pop("queries", False) else None
    return cutoff, options | {"box": None if BOXES[box] is None else jfrnn.Box(np.array(BOXES[box], dtype)), "queries": q}


def points(box="open"):
    return np.random.default_rng(3).random((N, 3)) * np.array(BOXES[box] or [1, 1, 1])


@functools.cache
def make(kind, backend, box="open", reverse=True):
    """Return a list with a skin, positions and queries: several tests, those of edges too, share lists and their programs."""
    (cutoff, options), x = options_of(kind, box), points(box)
    nbrs = jfrnn.search(x, cutoff, **options, capacity=CAPACITY, reverse=reverse, backend=backend, skin=0.05)
    nbrs.check()
    return nbrs, jnp.asarray(x), None if options["queries"] is None else jnp.asarray(options["queries"])


def traced(kind, box="open", reverse=True):
    """Return the shapes of a list, of positions and of queries, for which no program is compiled."""
    (cutoff, options), x = options_of(kind, box), points(box)
    options |= {"capacity": CAPACITY, "reverse": reverse, "backend": "warp", "skin": 0.05}
    return jax.eval_shape(lambda x: jfrnn.search(x, cutoff, **options), x), x, options["queries"]


def assert_all_slots(nbrs):
    """Fail unless the list keeps all slots of each source."""
    n, flat, kept = nbrs.source_count, np.asarray(nbrs.idx).reshape(-1), jax.tree.map(np.asarray, nbrs.reverse)
    if kept.starts is None:
        found = [row[row < len(flat)] for row in kept.slots]
    else:
        found = [kept.slots[a : a + k] for a, k in zip(kept.starts[:n], kept.lengths[:n], strict=True)]
    assert [set(slots.tolist()) for slots in found] == [set(np.flatnonzero(flat == j).tolist()) for j in range(n)]


# In all kinds of boxes the lists of the most usual kind, the others in some; by hand all.
SOME = [*product(["full"], BOXES, ["warp"]), ("self", "images", "warp"), ("half", "nearest", "warp"), ("half", "images", "warp")]
SOME += [("gather", "nearest", "warp"), ("queries", "open", "warp")]
BY_ARRAYS = [("half", "open", "brute"), slow("queries", "images", "brute")]


@pytest.mark.parametrize(("kind", "box", "backend"), [*sparing(product(KINDS, BOXES, ["warp"]), SOME), *BY_ARRAYS])
def test_each_source_has_all_its_slots(kind, box, backend):
    nbrs, *_ = make(kind, backend, box)
    assert (np.asarray(nbrs.idx) < nbrs.source_count).sum() > 100
    assert_all_slots(nbrs)


@pytest.mark.parametrize(
    ("kind", "box", "backend"), [*sparing(product(("full", "self", "either"), BOXES, ["warp"]), SOME), ("self", "images", "brute")]
)
def test_each_image_has_its_own_reverse(kind, box, backend):
    nbrs, x, _ = make(kind, backend, box)
    rows, slots = np.asarray(nbrs.idx), np.asarray(nbrs.reverse.slots).reshape(-1)
    shifts, used = np.asarray(nbrs.shifts(x)).reshape(-1, 3), rows.reshape(-1) < N
    row = np.repeat(np.arange(N), rows.shape[1])
    np.testing.assert_array_equal(slots[slots[used]], np.flatnonzero(used))
    np.testing.assert_array_equal(row[slots[used]], rows.reshape(-1)[used])
    np.testing.assert_array_equal(shifts[slots[used]], -shifts[used])
    assert (slots[~used] == rows.size).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_pairs_that_lost_their_reverse_have_none(backend):
    x = jnp.asarray(np.random.default_rng(0).random((30, 3)))
    nbrs = jfrnn.search(x, 0.5, capacity=4, reverse=True, backend=backend)
    rows, slots = np.asarray(nbrs.idx), np.asarray(nbrs.reverse.slots)
    for (i, k), slot in np.ndenumerate(slots):
        back = np.flatnonzero(rows[rows[i, k]] == i) if rows[i, k] < 30 else []
        assert slot == (4 * rows[i, k] + back[0] if len(back) else rows.size)
    assert (slots == rows.size).any()


def cubes_of(pairs, x, sides=1.0):
    """Return the sum of the cubes of distances, and its derivatives by positions and by the sides of a box."""
    r = by_numpy.vectors_of(pairs, x, x, np.eye(3) * sides)
    square = (r * r).sum(1)
    of_r = 3 * np.sqrt(square)[:, None] * r
    return (square**1.5).sum(), by_numpy.pull(pairs, of_r, x), (of_r * pairs.shifts).sum(0)


DERIVED = [("full", "images", False), ("half", "nearest", True), ("queries", "open", False)]
DERIVED += [slow(*each) for each in (("full", "open", True), ("half", "images", False))]
DERIVED += [slow(*each) for each in (("queries", "images", True), ("gather", "open", False))]


@pytest.mark.parametrize(("kind", "box", "reverse"), DERIVED)
def test_derivatives_are_those_of_scattering(kind, box, reverse):
    """Against sums that NumPy scatters: first and second order, in positions, queries and the box."""
    nbrs, x, q = make(kind, "warp", box, reverse=reverse)
    lengths, which = np.array(BOXES[box] or [0.0] * 3), (0, 2) if q is None else (0, 1, 2)
    weight = np.cos(np.arange(nbrs.idx.size, dtype=float)).reshape(nbrs.idx.shape)

    def energy(x, q, a):
        vectors, mask = nbrs.vectors(x, queries=q, box=None if nbrs.box is None else jfrnn.Box(a))
        return jnp.sum(jnp.where(mask[..., None], weight[..., None] * jnp.sin(3 * vectors), 0))

    @jax.jit
    def derivatives(x, q, a):
        of_x = jax.grad(lambda x: energy(x, q, a))
        slope = jax.grad(lambda x: jnp.vdot(of_x(x), jnp.cos(x)))
        return nbrs.vectors(x, queries=q), jax.grad(energy, which)(x, q, a), slope(x), jax.jvp(of_x, (x,), (x,))[1]

    (vectors, mask), *found = derivatives(x, q, lengths)
    x, q = np.asarray(x), None if q is None else np.asarray(q)
    pairs, weight = by_numpy.pairs_of_slots(nbrs.idx, vectors, mask, x, q, BOXES[box]), weight[np.asarray(mask)][:, None]

    def slopes(x):
        of_r = 3 * weight * np.cos(3 * by_numpy.vectors_of(pairs, x, x if q is None else q, np.diag(lengths)))
        of_x = by_numpy.pull(pairs, of_r, x, q)
        return (of_x, (of_r * pairs.shifts).sum(0)) if q is None else (*of_x, (of_r * pairs.shifts).sum(0))

    slope = by_numpy.along(slopes, x, np.cos(x))[0] - slopes(x)[0] * np.sin(x)
    expected = [slopes(x), slope, by_numpy.along(slopes, x, x)[0]]
    jax.tree.map(lambda p, r: np.testing.assert_allclose(p, r, atol=1e-11), found, expected)


@pytest.mark.parametrize(("kind", "box"), [("half", "nearest"), ("queries", "open")])
def test_array_programs_derive_the_same(kind, box):
    """They add the slots of each source by groups, of which the last one is not full."""
    nbrs, x, q = make(kind, "warp", box)

    def energy(x):
        vectors, mask = by_arrays(nbrs).vectors(x, queries=q)
        return jnp.sum(vectors**3), (vectors, mask)

    slopes, found = jax.jit(jax.grad(energy, has_aux=True))(x)
    pairs = by_numpy.pairs_of_slots(nbrs.idx, *found, x, q, BOXES[box])
    of_r = 3 * np.asarray(found[0])[np.asarray(found[1])] ** 2
    expected = by_numpy.pull(pairs, of_r, x, q)
    np.testing.assert_allclose(slopes, expected if q is None else expected[0], atol=1e-12)
    assert np.abs(slopes).max() > 0.1


@pytest.mark.parametrize("kind", ["full", "half"])
def test_derivatives_of_distances(kind):
    """Of first and second order, each forward and backward; in the sides of the box, too."""
    nbrs, x, _ = make(kind, "warp", "nearest")
    wave, along = np.arange(x.size).reshape(x.shape), np.array([0.3, -0.2, 0.5])
    one, other = np.sin(wave), np.cos(wave)

    def energy(x, sides):
        return jnp.sum(nbrs.distances(x, box=jfrnn.Box(sides))[0] ** 3)

    @jax.jit
    def all_of(x, sides):
        def forward(x):
            return jax.jvp(lambda x: energy(x, sides), (x,), (one,))[1]

        def backward(x):
            return jnp.vdot(jax.grad(energy)(x, sides), one)

        by_both = jax.jvp(jax.value_and_grad(energy, (0, 1)), (x, sides), (one, along))
        return nbrs.vectors(x), by_both, jax.grad(forward)(x), jax.grad(backward)(x), jax.jvp(forward, (x,), (other,))

    found, *derivatives = all_of(x, np.ones(3))
    x = np.asarray(x)
    pairs = by_numpy.pairs_of_slots(nbrs.idx, *found, x, matrix=np.ones(3))

    def values(x, sides):
        total, *slopes = cubes_of(pairs, x, sides)
        return total, tuple(slopes)

    by_both = values(x, np.ones(3)), by_numpy.along(lambda t: values(x + t * one, 1 + t * along), 0.0, 1.0)
    ahead, (bent, _) = by_numpy.along(lambda x: values(x, np.ones(3)), x, one)
    expected = [by_both, bent, bent, (ahead, np.vdot(bent, other))]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11), derivatives, expected)


@pytest.mark.parametrize(("kind", "reverse"), [("full", False), ("half", True), slow("queries", False)])
def test_derivatives_do_not_scatter(kind, reverse):
    def both(nbrs, x, q):
        f = jax.grad(lambda x: jnp.sum(by_arrays(nbrs).distances(x, queries=q)[0] ** 3))
        return jax.jvp(f, (x,), (x,))

    text = jax.jit(both).lower(*traced(kind, "images", reverse)).as_text()
    floats = [line for line in text.splitlines() if "stablehlo.scatter" in line and "f64" in line]
    assert floats == []


@pytest.mark.parametrize("kind", ["full", "half"])
def test_vmap(kind):
    """Over positions, with one list; over lists too, which then become one."""
    nbrs, x, _ = make(kind, "warp", "nearest")
    several = np.stack([x + step * np.sin(np.arange(x.size)).reshape(x.shape) for step in (0, 0.01, -0.01)])  # the skin allows it
    cutoff, options = options_of(kind, "nearest")
    options |= {"capacity": CAPACITY, "reverse": True, "backend": "warp", "skin": 0.05}
    lists = [jfrnn.search(each, cutoff, **options) for each in several]

    def slopes(nbrs, x):
        return jax.grad(lambda x: jnp.sum(nbrs.distances(x)[0] ** 3))(x)

    @jax.jit
    def all_of(nbrs, stacked, several):
        of_lists = jax.vmap(lambda nbrs, x: jax.jvp(lambda x: slopes(nbrs, x), (x,), (x,)))(stacked, several)
        return jax.vmap(slopes, (None, 0))(nbrs, several), *of_lists

    of_one, of_each, bent = all_of(nbrs, jax.tree.map(lambda *leaves: np.stack(leaves), *lists), several)
    for k, x in enumerate(several):
        images = reference.reference_images(x, CUTOFF, matrix=np.ones(3), periodic=(True,) * 3, half=kind == "half")
        expected = functools.partial(lambda pairs, x: cubes_of(pairs, x)[1], by_numpy.in_order(images, 3))
        for found in (of_one[k], of_each[k]):
            np.testing.assert_allclose(found, expected(x), atol=1e-12)
        np.testing.assert_allclose(bent[k], by_numpy.along(expected, x, x), atol=1e-11)


@pytest.mark.parametrize("kind", ["full", "half"])
def test_updates_keep_it(kind):
    nbrs, x, _ = make(kind, "warp", "nearest")
    moved = x + 0.2 * np.sin(9 * x)
    updated = jax.jit(lambda nbrs, x: nbrs.update(x))(nbrs, moved)
    assert updated.rebuild_count == nbrs.rebuild_count + 1
    for each in (updated, updated.grow(moved, slack=2.0)):
        assert_all_slots(each)


@pytest.mark.parametrize("kind", ["full", "half", "queries"])
def test_nobody(kind):
    x = jnp.zeros((0, 3))
    nbrs = jfrnn.search(x, 1.0, half=kind == "half", queries=x if kind == "queries" else None, reverse=True, capacity=8)
    q = x if kind == "queries" else None
    assert jax.grad(lambda x: jnp.sum(nbrs.distances(x, queries=q)[0]))(x).shape == (0, 3)


def test_too_many_slots_are_refused():
    x = jax.ShapeDtypeStruct((2**25, 3), np.float32)
    refuses(ValueError, "numbers slots by int32", jax.eval_shape, lambda x: jfrnn.search(x, 0.1, capacity=64, reverse=True), x)
    refuses(TypeError, "reverse", jfrnn.search, np.zeros((2, 3)), 1.0, reverse=1)
    for name, of in (("pairs", lambda nbrs, x: nbrs.pairs(10, positions=x)), ("edges", lambda nbrs, x: nbrs.edges(x, 10).mask)):
        message = rf"{name}\(\) numbers slots by int32, and this list has 2147483648"
        refuses(ValueError, message, jax.eval_shape, lambda x, of=of: of(jfrnn.search(x, 0.1, capacity=64), x), x)


MEASURED = [(box, dim, 1.0) for box in BOXES for dim in (2, 3)] + [("open", 3, 1e-24), ("nearest", 3, 1e15)]
PAIRWISE = [("open", 2, 1.0, True, np.float64), ("images", 3, 1.0, False, np.float32), ("open", 3, 1e-24, False, np.float32)]


@pytest.mark.parametrize("what", ["distances", slow("largest")])
def test_second_derivatives_through_a_loop(what):
    """Of the body of a loop JAX drops rules of `jax.custom_jvp` once it has applied them."""
    x = jnp.asarray(np.random.default_rng(0).random((8, 3)), jnp.float32)
    nbrs = jfrnn.search(x, 0.6, skin=0.3, capacity=8, backend="warp")

    def energy(x):
        if what == "distances":
            distances, mask = nbrs.distances(x)
            return jnp.where(mask, (0.6 - distances) ** 2, 0).sum()
        return (jfrnn.pair_sum(lambda r, i, j: (r @ r) ** 2, x, 0.6, reduce="max", backend="warp") ** 2).sum()

    def step(x, _=None):
        return x - 0.03 * jax.grad(energy)(x), None

    def by_jvp(moved):
        return jax.jvp(jax.grad(lambda x: (moved(x) ** 2).sum()), (x,), (jnp.sin(9 * x),))[1]

    straight = by_jvp(lambda x: step(x)[0])
    assert float(jnp.abs(straight).max()) > 0.1
    np.testing.assert_allclose(by_jvp(lambda x: jax.lax.scan(step, x, None, length=1)[0]), straight, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(by_jvp(lambda x: jax.vmap(lambda x: step(x)[0])(x[None])[0]), straight, rtol=1e-4, atol=1e-5)


def test_derivatives_of_distances_have_the_same_bits_in_each_call():
    """Threads share the rows, and none knows which of them it gets."""
    x = jnp.asarray(np.random.default_rng(3).random((20_000, 3)), jnp.float32)
    nbrs = jfrnn.search(x, 0.06, capacity=64, backend="warp")
    slopes = jax.jit(jax.grad(lambda x: jnp.sum(jnp.sin(40 * nbrs.distances(x)[0]))))
    first = np.asarray(slopes(x))
    assert np.count_nonzero(first) > 50_000
    for _ in range(10):
        np.testing.assert_array_equal(slopes(x), first)


@pytest.mark.parametrize(
    ("box", "dim", "scale", "skinned", "dtype"),
    sparing(((*each, *kind) for each, kind in product(MEASURED, product((False, True), (np.float32, np.float64)))), PAIRWISE),
)
def test_distances_are_the_lengths_of_vectors(box, dim, scale, skinned, dtype):
    """Of points of which two coincide and two nearly do, in rows whose length is no multiple of four; derivatives, too."""
    rng, sides, skin = np.random.default_rng(0), np.array(BOXES[box] or [1, 1, 1])[:dim], 0.05 if skinned else 0.0
    x = rng.random((50, dim)) * sides
    x[1], x[3] = x[0], x[2] + 1e-12
    x = (x * scale).astype(dtype)
    lattice = None if BOXES[box] is None else jfrnn.Box((sides * scale).astype(dtype))
    nbrs = jfrnn.search(x, 0.3 * scale, capacity=63, skin=skin * scale, box=lattice, reverse=True, backend="warp")
    step = 0.004 * scale if skin else 0.0
    moved = x + (step * np.sin(np.arange(x.size)).reshape(x.shape)).astype(dtype)
    weight = rng.random(nbrs.idx.shape).astype(dtype)

    def energy(x):
        return jnp.sum(weight * jnp.sin(nbrs.distances(x)[0] / scale))

    (vectors, mask), (found, same), slopes = jax.jit(lambda x: (nbrs.vectors(x), nbrs.distances(x), jax.grad(energy)(x)))(moved)
    mask, eps = np.asarray(mask), float(np.finfo(dtype).eps)
    np.testing.assert_array_equal(mask, same)
    assert 100 < mask.sum() < (np.asarray(nbrs.idx) < 50).sum() + (skin == 0)
    r = np.asarray(vectors, float)[mask]
    lengths, expected = np.linalg.norm(r, axis=1), np.zeros(mask.shape)
    expected[mask] = lengths
    np.testing.assert_allclose(found, expected, rtol=4 * eps)
    along = np.cos(lengths / scale) * weight[mask] / np.where(lengths > 0, lengths, 1)
    pairs = by_numpy.Pairs(*np.nonzero(mask), None)
    pairs = pairs._replace(j=np.asarray(nbrs.idx)[mask])
    np.testing.assert_allclose(slopes * dtype(scale), by_numpy.pull(pairs, along[:, None] * r, moved), atol=200 * eps)


@pytest.mark.parametrize("box", ["open", "images"])
def test_gradients_of_distances_store_no_displacements(box):
    nbrs, x, _ = traced("full", box)
    text = jax.jit(jax.grad(lambda x, nbrs: jnp.sum(nbrs.distances(x)[0] ** 3))).lower(x, nbrs).as_text()
    assert f"tensor<{N}x{nbrs.capacity}x3x" not in text
    assert f"tensor<{N}x{nbrs.capacity}xf64>" in text
