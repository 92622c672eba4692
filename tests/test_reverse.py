"""Reverse slots: each pair's slot the other way round, and derivatives of the geometry of a list that gather and never scatter."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from test_kept import by_arrays

import jfrnn
from jfrnn._search.geometry import norms

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


def make(kind, backend, box="open", dtype=np.float64, reverse=True, n=40, skin=0.0):
    rng = np.random.default_rng(3)
    options, x = dict(KINDS[kind]), jnp.asarray(rng.random((n, 3)) * np.array(BOXES[box] or [1, 1, 1]), dtype)
    cutoff = jnp.asarray(rng.uniform(0.1, 0.4, n), dtype) if "radius_rule" in options else 0.4
    q = jnp.asarray(rng.random((17, 3)), dtype) if options.pop("queries", False) else None
    lattice = None if BOXES[box] is None else jfrnn.Box(np.array(BOXES[box], dtype))
    options |= {"capacity": CAPACITY, "box": lattice, "queries": q, "reverse": reverse, "backend": backend, "skin": skin}
    nbrs = jfrnn.search(x, cutoff, **options)
    nbrs.check()
    return nbrs, x, q


def slots_of(nbrs):
    """Return the slots of each source, as sets, from what the list keeps."""
    n, total = nbrs.source_count, nbrs.idx.size
    kept = jax.tree.map(np.asarray, nbrs.reverse)
    if kept.starts is None:
        return [set(row[row < total].tolist()) for row in kept.slots]
    return [set(kept.slots[a : a + k].tolist()) for a, k in zip(kept.starts[:n], kept.lengths[:n], strict=True)]


# In all kinds of boxes the lists of the most usual kind, the others in two, so that each has images or a half; by hand all.
SOME = [*(("full", box) for box in BOXES), ("self", "images"), ("half", "nearest"), ("half", "images"), ("gather", "open")]
SOME += [("gather", "images"), ("either", "nearest"), ("either", "images"), ("queries", "open"), ("queries", "images")]


def each_list(kinds):
    """Yield these kinds of lists in each box, by default those of `SOME`."""
    for kind, box in product(kinds, BOXES):
        yield pytest.param(kind, box, "warp", marks=[pytest.mark.slow] * ((kind, box) not in SOME))


@pytest.mark.parametrize(("kind", "box", "backend"), [*each_list(KINDS), ("half", "open", "brute"), ("queries", "images", "brute")])
def test_each_source_has_all_its_slots(kind, box, backend):
    nbrs, *_ = make(kind, backend, box)
    flat = np.asarray(nbrs.idx).reshape(-1)
    assert (flat < nbrs.source_count).sum() > 100
    assert slots_of(nbrs) == [set(np.flatnonzero(flat == j).tolist()) for j in range(nbrs.source_count)]


@pytest.mark.parametrize(("kind", "box", "backend"), [*each_list(("full", "self", "either")), ("self", "images", "brute")])
def test_each_image_has_its_own_reverse(kind, box, backend):
    nbrs, x, _ = make(kind, backend, box)
    rows, slots = np.asarray(nbrs.idx), np.asarray(nbrs.reverse.slots).reshape(-1)
    shifts, used = np.asarray(nbrs.shifts(x)).reshape(-1, 3), rows.reshape(-1) < 40
    row = np.repeat(np.arange(40), rows.shape[1])
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


DERIVED = [("full", "open", True), ("full", "images", False), ("half", "nearest", True), ("half", "images", False)]
DERIVED += [("queries", "images", True), ("gather", "open", False)]


@pytest.mark.parametrize(
    ("kind", "box", "reverse"), [pytest.param(*each, marks=[pytest.mark.slow] * (k % 3 == 2)) for k, each in enumerate(DERIVED)]
)
def test_derivatives_are_those_of_scattering(kind, box, reverse):
    """Against plain indexing, whose derivatives JAX scatters: first and second order, in positions, queries and the box."""
    nbrs, x, q = make(kind, "warp", box, reverse=reverse)
    shifts = nbrs.shifts(x, queries=q).astype(x.dtype)

    def energy(vectors, mask):
        weight = jnp.cos(jnp.arange(mask.size, dtype=x.dtype)).reshape(mask.shape)
        return jnp.sum(jnp.where(mask[..., None], weight[..., None] * jnp.sin(3 * vectors), 0))

    def ours(x, q, a):
        cell = None if nbrs.box is None else jfrnn.Box(a)
        return energy(*nbrs.vectors(x, queries=q, box=cell))

    def scattering(x, q, a):
        used = nbrs.idx < len(x)
        vectors = x[jnp.where(used, nbrs.idx, 0)] - (x if q is None else q)[:, None] + shifts * a
        return energy(vectors, nbrs.vectors(x, queries=q)[1])

    a, which = jnp.asarray(BOXES[box] or [0.0] * 3), (0, 2) if q is None else (0, 1, 2)

    def derivatives(f):
        of_x = jax.grad(lambda x: f(x, q, a))
        slope = jax.grad(lambda x: jnp.vdot(of_x(x), jnp.cos(x)))
        return jax.jit(lambda: (jax.grad(f, which)(x, q, a), slope(x), jax.jvp(of_x, (x,), (x,))[1]))()

    jax.tree.map(lambda p, r: np.testing.assert_allclose(p, r, atol=1e-11), derivatives(ours), derivatives(scattering))


@pytest.mark.parametrize("kind", ["half", "queries"])
def test_array_programs_derive_the_same(kind):
    """They add the slots of each source by groups, of which the last one is not full."""
    nbrs, x, q = make(kind, "warp", "nearest")
    slopes = [jax.jit(jax.grad(lambda x, k=k: jnp.sum(k.vectors(x, queries=q)[0] ** 3)))(x) for k in (nbrs, by_arrays(nbrs))]
    np.testing.assert_allclose(*slopes, atol=1e-12)
    assert np.abs(slopes[0]).max() > 0.1


@pytest.mark.parametrize("kind", ["full", "half"])
def test_against_finite_differences(kind):
    nbrs, x, _ = make(kind, "warp", "nearest", n=12)
    check_grads(jax.jit(lambda x: jnp.sum(nbrs.distances(x)[0] ** 3)), (x,), order=2, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("kind", "reverse"), [("full", False), ("half", True), ("queries", False)])
def test_derivatives_do_not_scatter(kind, reverse):
    nbrs, x, q = make(kind, "warp", "images", reverse=reverse)
    nbrs = by_arrays(nbrs)
    f = jax.grad(lambda x: jnp.sum(nbrs.distances(x, queries=q)[0] ** 3))
    text = jax.jit(lambda x: jax.jvp(f, (x,), (x,))).lower(x).as_text()
    floats = [line for line in text.splitlines() if "stablehlo.scatter" in line and "f64" in line]
    assert floats == []


@pytest.mark.parametrize("kind", ["full", "half"])
def test_vmap(kind):
    """Over positions, with one list; over lists too, which then become one."""
    nbrs, x, _ = make(kind, "warp", "nearest")
    f = jax.jit(jax.grad(lambda nbrs, x: jnp.sum(nbrs.distances(x)[0] ** 3), 1))
    several = jnp.stack([x, x + 0.01, x[::-1]])
    for each, result in zip(several, jax.vmap(f, (None, 0))(nbrs, several), strict=True):
        np.testing.assert_allclose(result, f(nbrs, each), atol=1e-13)
    lists = [jfrnn.search(each, 0.4, capacity=40, half=kind == "half", box=nbrs.box, reverse=True) for each in several]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lists)
    together, second = jax.vmap(f)(stacked, several), jax.vmap(lambda n, x: jax.jvp(lambda x: f(n, x), (x,), (x,))[1])
    for k, each in enumerate(lists):
        np.testing.assert_allclose(together[k], f(each, several[k]), atol=1e-13)
        expected = jax.jvp(lambda x, each=each: f(each, x), (several[k],), (several[k],))[1]
        np.testing.assert_allclose(second(stacked, several)[k], expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["full", "half"])
def test_updates_keep_it(kind):
    nbrs, x, _ = make(kind, "warp", "nearest", skin=0.05)
    moved = x + 0.2 * jnp.sin(9 * x)
    updated = jax.jit(lambda nbrs, x: nbrs.update(x))(nbrs, moved)
    assert updated.rebuild_count == nbrs.rebuild_count + 1
    flat = np.asarray(updated.idx).reshape(-1)
    assert slots_of(updated) == [set(np.flatnonzero(flat == j).tolist()) for j in range(40)]
    grown = updated.grow(moved, slack=2.0)
    flat = np.asarray(grown.idx).reshape(-1)
    assert slots_of(grown) == [set(np.flatnonzero(flat == j).tolist()) for j in range(40)]


@pytest.mark.parametrize("queries", [None, 17])
def test_what_it_takes_is_planned(queries):
    nbrs, *_ = make("full" if queries is None else "queries", "warp")
    plan = jfrnn.memory_plan(40, 0.4, nbrs.capacity, dtype=np.float64, queries=queries, reverse=True, backend="warp")
    assert plan.list_bytes == sum(leaf.nbytes for leaf in jax.tree.leaves(nbrs))


@pytest.mark.parametrize("kind", ["full", "half", "queries"])
def test_nobody(kind):
    x = jnp.zeros((0, 3))
    nbrs = jfrnn.search(x, 1.0, half=kind == "half", queries=x if kind == "queries" else None, reverse=True, capacity=8)
    q = x if kind == "queries" else None
    assert jax.grad(lambda x: jnp.sum(nbrs.distances(x, queries=q)[0]))(x).shape == (0, 3)


def test_too_many_slots_are_refused():
    x = jax.ShapeDtypeStruct((2**25, 3), np.float32)
    with pytest.raises(ValueError, match="numbers slots by int32"):
        jax.eval_shape(lambda x: jfrnn.search(x, 0.1, capacity=64, reverse=True), x)
    with pytest.raises(TypeError, match="reverse"):
        jfrnn.search(np.zeros((2, 3)), 1.0, reverse=1)


MEASURED = [(box, dim, 1.0) for box in BOXES for dim in (2, 3)] + [("open", 3, 1e-24), ("nearest", 3, 1e15)]
PAIRWISE = [("open", 2, 1.0, False, np.float64), ("open", 3, 1.0, True, np.float64), ("nearest", 3, 1.0, True, np.float32)]
PAIRWISE += [("images", 3, 1.0, False, np.float32), ("open", 3, 1e-24, False, np.float32)]


@pytest.mark.parametrize(
    ("box", "dim", "scale", "skinned", "dtype"),
    [
        pytest.param(*each, skinned, dtype, marks=[pytest.mark.slow] * ((*each, skinned, dtype) not in PAIRWISE))
        for each, skinned, dtype in product(MEASURED, (False, True), (np.float32, np.float64))
    ],
)
def test_distances_are_the_lengths_of_vectors(box, dim, scale, skinned, dtype):
    """Of points of which two coincide and two nearly do, in rows whose length is no multiple of four; derivatives, too."""
    rng, sides, skin = np.random.default_rng(0), np.array(BOXES[box] or [1, 1, 1])[:dim], 0.05 if skinned else 0.0
    x = rng.random((50, dim)) * sides
    x[1], x[3] = x[0], x[2] + 1e-12
    x = jnp.asarray(x * scale, dtype)
    lattice = None if BOXES[box] is None else jfrnn.Box((sides * scale).astype(dtype))
    nbrs = jfrnn.search(x, 0.3 * scale, capacity=63, skin=skin * scale, box=lattice, reverse=True, backend="warp")
    step = 0.004 * scale if skin else 0.0
    moved = x + jnp.asarray(step * np.sin(np.arange(x.size)).reshape(x.shape), dtype)

    def lengths(x):
        vectors, mask = nbrs.vectors(x)
        return norms(vectors), mask

    (ours, mask), (theirs, same) = nbrs.distances(moved), lengths(moved)
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_array_equal(mask, same)
    assert 100 < int(mask.sum()) < int((nbrs.idx < 50).sum()) + (skin == 0)
    np.testing.assert_allclose(ours, theirs, rtol=4 * eps)
    weight = jnp.asarray(rng.random(mask.shape), dtype)
    mine, other = (
        jax.jit(jax.grad(lambda x, f=f: jnp.sum(weight * jnp.sin(f(x)[0] / scale))))(moved) for f in (nbrs.distances, lengths)
    )
    np.testing.assert_allclose(mine * scale, other * scale, atol=200 * eps)


def test_derivatives_of_distances_in_the_box():
    nbrs, x, _ = make("full", "warp", "nearest")
    sides = jnp.ones(3)

    def energy(f, x, sides):
        return jnp.sum(f(x, jfrnn.Box(sides)) ** 3)

    def plain(x, box):
        vectors, mask = nbrs.vectors(x, box=box)
        return jnp.where(mask, jnp.sqrt(jnp.where(mask, jnp.sum(vectors**2, axis=-1), 1)), 0)

    def ours(x, box):
        return nbrs.distances(x, box=box)[0]

    for order in (jax.grad, jax.hessian):
        found = [order(lambda x, a, f=f: energy(f, x, a), 1)(x, sides) for f in (ours, plain)]
        np.testing.assert_allclose(*found, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("box", ["open", "images"])
def test_gradients_of_distances_store_no_displacements(box):
    nbrs, x, _ = make("full", "warp", box)
    text = jax.jit(jax.grad(lambda x: jnp.sum(nbrs.distances(x)[0] ** 3))).lower(x).as_text()
    assert f"tensor<40x{nbrs.capacity}x3x" not in text
    assert f"tensor<40x{nbrs.capacity}xf64>" in text
