"""`NeighborList.edges`: flat edges with their geometry, sorted by receiver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_reverse as lists

import jfrnn


def dense(nbrs, vectors, mask, shifts):
    """Return senders, receivers, displacements, shifts and mask of all used slots, row by row."""
    idx = np.asarray(nbrs.idx)
    i, k = np.nonzero(idx < nbrs.source_count)
    return idx[i, k], i, np.asarray(vectors)[i, k], np.asarray(shifts)[i, k], np.asarray(mask)[i, k]


@pytest.mark.parametrize("kind", lists.KINDS)
@pytest.mark.parametrize("box", lists.BOXES)
def test_edges_are_the_pairs(kind, box):
    nbrs, x, q = lists.make(kind, "warp", box, skin=0.05)
    held, (m, n) = int((np.asarray(nbrs.idx) < len(x)).sum()), (nbrs.idx.shape[0], len(x))

    @jax.jit
    def all_of(nbrs, x, q):
        return nbrs.edges(x, held + 9, queries=q), (*nbrs.vectors(x, queries=q), nbrs.shifts(x, queries=q))

    edges, geometry = all_of(nbrs, x, q)
    expected = dense(nbrs, *geometry)
    for found, right in zip(edges, expected, strict=False):
        np.testing.assert_allclose(found[:held], right, atol=1e-15)
    assert (edges.senders[held:] == n).all()
    assert (edges.receivers[held:] == m).all()
    assert not np.asarray(edges.mask)[held:].any()
    assert not np.asarray(edges.displacement)[held:].any()
    assert int(edges.status) == 0
    assert (np.diff(edges.receivers) >= 0).all()


@pytest.mark.parametrize("reverse", [True, False])
@pytest.mark.parametrize(("kind", "box"), [("full", "images"), ("half", "open"), ("queries", "nearest")])
def test_derivatives_are_those_of_vectors(kind, box, reverse):
    nbrs, x, q = lists.make(kind, "warp", box, reverse=reverse, skin=0.05)
    a = jnp.asarray(lists.BOXES[box] or [1.0] * 3)

    def energy(vectors, mask):
        return jnp.sum(jnp.where(mask[..., None], jnp.sin(3 * vectors) * vectors[..., ::-1], 0))

    def by_edges(x, q, a):
        edges = nbrs.edges(x, 4000, queries=q, box=None if nbrs.box is None else jfrnn.Box(a))
        return energy(edges.displacement, edges.mask)

    def by_vectors(x, q, a):
        return energy(*nbrs.vectors(x, queries=q, box=None if nbrs.box is None else jfrnn.Box(a)))

    which = (0, 2) if q is None else (0, 1, 2)

    def derivatives(f):
        slope = jax.grad(lambda x: f(x, q, a))
        return jax.jit(lambda: (jax.grad(f, which)(x, q, a), jax.jvp(slope, (x,), (x,))[1]))()

    jax.tree.map(lambda p, r: np.testing.assert_allclose(p, r, atol=1e-11), derivatives(by_edges), derivatives(by_vectors))


@pytest.mark.parametrize("kind", ["full", "half"])
def test_neither_edges_nor_sums_over_them_scatter_derivatives(kind):
    nbrs, x, _ = lists.make(kind, "jax", "open")

    def energy(x):
        edges = nbrs.edges(x, 2000)
        return jnp.sum(jnp.where(edges.mask, jnp.sum(edges.displacement**4, -1), 0))

    text = jax.jit(jax.grad(energy)).lower(x).as_text()
    assert [line for line in text.splitlines() if "stablehlo.scatter" in line and "f64" in line] == []


def test_too_many_pairs_are_never_silent():
    nbrs, x, _ = lists.make("full", "warp")
    held = int(nbrs.count.sum())
    with pytest.raises(ValueError, match=f"Pass total={held} or more"):
        nbrs.edges(x, held - 1)
    for total in (held - 1, 0):
        edges = jax.jit(lambda nbrs, x, total=total: nbrs.edges(x, total))(nbrs, x)
        assert int(edges.status) == jfrnn.Status.TOTAL_OVERFLOW
        assert np.isnan(edges.displacement).all()


def test_sums_by_receiver():
    nbrs, x, _ = lists.make("full", "warp", "images")
    total = int(nbrs.count.sum()) + 5

    @jax.jit
    def sums(nbrs, x):
        edges = nbrs.edges(x, total)
        messages = jnp.where(edges.mask, jnp.sum(edges.displacement**2, -1), 0)
        return jax.ops.segment_sum(messages, edges.receivers, len(x), indices_are_sorted=True)

    np.testing.assert_allclose(sums(nbrs, x), jfrnn.pair_sum(lambda r, i, j: jnp.sum(r**2), x, None, neighbors=nbrs), rtol=1e-12)


def test_vmap():
    nbrs, x, _ = lists.make("full", "warp", "nearest")
    several = jnp.stack([x, x + 0.01])

    def f(x):
        return jnp.sum(nbrs.edges(x, 1500).displacement ** 3)

    np.testing.assert_allclose(jax.vmap(jax.grad(f))(several), jnp.stack([jax.grad(f)(y) for y in several]), atol=1e-12)


def test_nobody():
    x = jnp.zeros((0, 3))
    edges = jfrnn.search(x, 1.0, capacity=4).edges(x, 3)
    assert edges.senders.tolist() == edges.receivers.tolist() == [0, 0, 0]
    assert not edges.mask.any()
