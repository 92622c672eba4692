"""`NeighborList.edges`: flat edges with their geometry, sorted by receiver."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_reverse as lists

import jfrnn


def dense(nbrs, vectors, mask, shifts):
    """Return senders, receivers, displacements and shifts of all pairs closer than the cutoff, row by row."""
    i, k = np.nonzero(np.asarray(mask))
    return np.asarray(nbrs.idx)[i, k], i, np.asarray(vectors)[i, k], np.asarray(shifts)[i, k]


OFTEN = [
    ("full", "open"),
    ("self", "nearest"),
    ("half", "images"),
    ("gather", "nearest"),
    ("either", "images"),
    ("queries", "open"),
]


@pytest.mark.parametrize(
    ("kind", "box"),
    [
        pytest.param(kind, box, marks=[pytest.mark.slow] * ((kind, box) not in OFTEN))
        for kind, box in product(lists.KINDS, lists.BOXES)
    ],
)
def test_edges_are_the_pairs(kind, box):
    nbrs, x, q = lists.make(kind, "warp", box, skin=0.05)
    (m, n), total = (nbrs.idx.shape[0], len(x)), int(nbrs.count.sum()) + 9
    x = x + 0.01 * jnp.sin(50 * x)  # with pairs of the skin in the midst of rows

    @jax.jit
    def all_of(nbrs, x, q):
        geometry = *nbrs.vectors(x, queries=q), nbrs.shifts(x, queries=q)
        return nbrs.edges(x, total, queries=q), geometry, nbrs.pairs(total, positions=x, queries=q)

    edges, geometry, pairs = jax.device_get(all_of(nbrs, x, q))  # no program is compiled for what is compared
    expected = dense(nbrs, *geometry)
    held = len(expected[0])
    assert 0 < held < total - 9
    np.testing.assert_array_equal(pairs, (edges.receivers, edges.senders))
    np.testing.assert_array_equal(nbrs.pairs(positions=x, queries=q), expected[1::-1])
    for found, right in zip(edges, expected, strict=False):
        np.testing.assert_allclose(found[:held], right, atol=1e-15)
    assert (edges.senders[held:] == n).all()
    assert (edges.receivers[held:] == m).all()
    assert (np.flatnonzero(edges.mask) == np.arange(held)).all()
    assert not any(np.asarray(part)[held:].any() for part in (edges.displacement, edges.distance, edges.shift))
    np.testing.assert_allclose(edges.distance, np.linalg.norm(edges.displacement, axis=1), atol=1e-15)
    assert (int(edges.status), int(edges.pair_count)) == (0, held)
    assert (np.diff(edges.receivers) >= 0).all()


@pytest.mark.parametrize(
    ("kind", "box", "reverse"),
    [
        pytest.param(*each, reverse, marks=[pytest.mark.slow] * (reverse is not (each[0] == "half")))
        for each in (("full", "images"), ("half", "open"), ("queries", "nearest"))
        for reverse in (True, False)
    ],
)
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
    assert nbrs.edges(x).mask.sum() == len(nbrs.edges(x).mask) == held
    with pytest.raises(TypeError, match=r"write edges\(positions, total\)"):
        jax.jit(lambda nbrs, x: nbrs.edges(x))(nbrs, x)
    for total in (held - 1, 0):
        edges = jax.jit(lambda nbrs, x, total=total: nbrs.edges(x, total))(nbrs, x)
        assert int(edges.status) == jfrnn.Status.TOTAL_OVERFLOW
        assert int(edges.pair_count) == held
        assert np.isnan(edges.displacement).all()
        assert np.isnan(edges.distance).all()


def test_sums_by_receiver():
    nbrs, x, _ = lists.make("full", "warp", "images")
    total = int(nbrs.count.sum()) + 5

    @jax.jit
    def sums(nbrs, x):
        edges = nbrs.edges(x, total)
        messages = jnp.where(edges.mask, jnp.sum(edges.displacement**2, -1), 0)
        return jax.ops.segment_sum(messages, edges.receivers, len(x), indices_are_sorted=True)

    np.testing.assert_allclose(sums(nbrs, x), jfrnn.pair_sum(lambda r, i, j: jnp.sum(r**2), x, None, neighbors=nbrs), rtol=1e-12)


@pytest.mark.parametrize("box", ["open", "images"])
def test_a_graph_has_two_graphs(box):
    nbrs, x, _ = lists.make("full", "warp", box, skin=0.05)
    edges, graph = nbrs.edges(x, 2000), jax.jit(lambda nbrs, x: nbrs.to_jraph(x, 2000))(nbrs, x)
    assert graph._fields == ("nodes", "edges", "receivers", "senders", "globals", "n_node", "n_edge")
    assert graph.n_node.tolist() == [len(x), 1]
    assert graph.n_edge.tolist() == [int(edges.pair_count), 2000 - int(edges.pair_count)]
    np.testing.assert_array_equal(graph.nodes["positions"], np.concatenate([x, np.zeros((1, 3))]))
    found = graph.senders, graph.receivers, *(graph.edges[name] for name in ("displacement", "shift", "distance"))
    right = edges.senders, edges.receivers, edges.displacement, edges.shift, edges.distance
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-15), found, right)
    for asked, message in (({"queries": x}, "this list has queries"), ({}, "total must be a static int")):
        with pytest.raises((ValueError, TypeError), match=message):
            jfrnn.search(x, 0.2, **asked).to_jraph(x, 2.0)


def test_a_graph_is_one_of_jraph():
    jraph = pytest.importorskip("jraph")
    nbrs, x, _ = lists.make("full", "warp")
    graph = nbrs.to_jraph(x, 2000)
    assert graph._fields == jraph.GraphsTuple._fields
    net = jraph.InteractionNetwork(
        lambda edges, senders, receivers: edges["distance"] ** 2,
        lambda nodes, messages: messages,
        include_sent_messages_in_node_update=False,
    )
    sums = jfrnn.pair_sum(lambda r, i, j: jnp.sum(r**2), x, None, neighbors=nbrs)
    np.testing.assert_allclose(net(graph).nodes[: len(x)], sums, rtol=1e-12)
    whole = jraph.unpad_with_graphs(graph)
    assert (len(whole.senders), whole.n_node.tolist()) == (int(nbrs.count.sum()), [len(x)])


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
