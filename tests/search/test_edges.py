"""`NeighborList.edges`: flat edges with their geometry, sorted by receiver; triplets of two edges that end at one particle."""

import itertools
from itertools import product

import by_numpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import test_reverse as lists
from checked import refuses, slow, sparing

import jfrnn

OFTEN = [("full", "open"), ("self", "images"), ("half", "images"), ("gather", "nearest"), ("queries", "open")]
EACH = list(product(lists.KINDS, lists.BOXES))


def oracle(kind, box, x, q=None):
    """Return all pairs (i, j, shift) of a list of `test_reverse.py` at these positions."""
    cutoff, options = lists.options_of(kind, box)
    x, q = np.asarray(x), None if q is None else np.asarray(q)
    cell = {"matrix": np.array(lists.BOXES[box] or [1.0] * 3), "periodic": (box != "open",) * 3}
    if "radius_rule" in options:
        return reference.reference_radii(x, cutoff, options["radius_rule"], queries=q, **cell)
    given = {name: options[name] for name in ("half", "include_self") if name in options}
    return reference.reference_images(x, cutoff, queries=q, **cell, **given)


@pytest.mark.parametrize(("kind", "box"), sparing(EACH, OFTEN))
def test_edges_are_the_pairs(kind, box):
    nbrs, x, q = lists.make(kind, "warp", box)
    (m, n), total = (nbrs.idx.shape[0], len(x)), int(np.asarray(nbrs.count).sum()) + 9
    x = np.asarray(x) + 0.01 * np.sin(50 * np.asarray(x))  # with pairs of the skin in the midst of rows
    both = jax.jit(lambda nbrs, x, q: (nbrs.edges(x, total, queries=q), nbrs.pairs(total, positions=x, queries=q)))
    edges, pairs = both(nbrs, x, q)
    edges, expected = jax.tree.map(np.asarray, edges), oracle(kind, box, x, q)
    held = len(expected)
    assert 0 < held < total - 9
    np.testing.assert_array_equal(pairs, (edges.receivers, edges.senders))
    found = by_numpy.Pairs(edges.receivers[:held], edges.senders[:held], edges.shift[:held])
    assert by_numpy.named(found) == expected
    apart = by_numpy.vectors_of(found, x, x if q is None else np.asarray(q), np.diag(lists.BOXES[box] or [0.0] * 3))
    np.testing.assert_allclose(edges.displacement[:held], apart, atol=1e-15)
    assert (edges.senders[held:] == n).all()
    assert (edges.receivers[held:] == m).all()
    assert (np.flatnonzero(edges.mask) == np.arange(held)).all()
    assert not any(part[held:].any() for part in (edges.displacement, edges.distance, edges.shift))
    np.testing.assert_allclose(edges.distance, np.linalg.norm(edges.displacement, axis=1), atol=1e-15)
    assert (int(edges.status), int(edges.pair_count)) == (0, held)
    assert (np.diff(edges.receivers) >= 0).all()


DERIVED = [("full", "images", True), ("half", "images", True), ("queries", "open", True)]
DERIVED += [slow(*each) for each in (("full", "images", False), ("half", "open", False), ("queries", "open", False))]


@pytest.mark.parametrize(("kind", "box", "reverse"), DERIVED)
def test_derivatives_are_those_of_vectors(kind, box, reverse):
    nbrs, x, q = lists.make(kind, "warp", box, reverse=reverse)
    lengths, which = np.array(lists.BOXES[box] or [0.0] * 3), (0, 2) if q is None else (0, 1, 2)

    def energy(x, q, a):
        edges = nbrs.edges(x, 4000, queries=q, box=None if nbrs.box is None else jfrnn.Box(a))
        r = edges.displacement
        return jnp.sum(jnp.where(edges.mask[:, None], jnp.sin(3 * r) * r[:, ::-1], 0))

    def slopes(x):
        return jax.grad(energy, which)(x, q, lengths)

    first, second = jax.jit(lambda x: jax.jvp(slopes, (x,), (x,)))(x)
    pairs, x, q = by_numpy.in_order(oracle(kind, box, x, q), 3), np.asarray(x), None if q is None else np.asarray(q)

    def expected(x):
        r = by_numpy.vectors_of(pairs, x, x if q is None else q, np.diag(lengths))
        of_r = 3 * np.cos(3 * r) * r[:, ::-1] + np.sin(3 * r)[:, ::-1]
        of_x, of_a = by_numpy.pull(pairs, of_r, x, q), (of_r * pairs.shifts).sum(0)
        return (of_x, of_a) if q is None else (*of_x, of_a)

    jax.tree.map(lambda p, r: np.testing.assert_allclose(p, r, atol=1e-11), first, expected(x))
    jax.tree.map(lambda p, r: np.testing.assert_allclose(p, r, atol=1e-11), second, by_numpy.along(expected, x, x))


@pytest.mark.parametrize("kind", ["full", "half"])
def test_neither_edges_nor_sums_over_them_scatter_derivatives(kind):
    nbrs, x, _ = lists.traced(kind)

    def energy(x, nbrs):
        edges = nbrs.edges(x, 2000)
        return jnp.sum(jnp.where(edges.mask, jnp.sum(edges.displacement**4, -1), 0))

    text = jax.jit(jax.grad(energy)).lower(x, nbrs).as_text()
    assert [line for line in text.splitlines() if "stablehlo.scatter" in line and "f64" in line] == []


def test_too_many_pairs_are_never_silent():
    nbrs, x, _ = lists.make("full", "warp")
    held = len(oracle("full", "open", x))
    refuses(ValueError, f"Pass total={held} or more", nbrs.edges, x, held - 1)
    mask = np.asarray(nbrs.edges(x).mask)
    assert (mask.sum(), len(mask)) == (held, np.asarray(nbrs.count).sum())  # room for those of the skin, too
    refuses(TypeError, r"write edges\(positions, total\)", jax.jit(lambda nbrs, x: nbrs.edges(x)), nbrs, x)
    for total in (held - 1, 0):
        edges = jax.jit(lambda nbrs, x, total=total: nbrs.edges(x, total))(nbrs, x)
        assert int(edges.status) == jfrnn.Status.TOTAL_OVERFLOW
        assert int(edges.pair_count) == held
        assert np.isnan(edges.displacement).all()
        assert np.isnan(edges.distance).all()


@pytest.mark.parametrize("box", ["open", "images"])
def test_a_graph_has_two_graphs(box):
    nbrs, x, _ = lists.make("full", "warp", box)
    edges, graph = jax.jit(lambda nbrs, x: (nbrs.edges(x, 2000), nbrs.to_jraph(x, 2000)))(nbrs, x)
    assert graph._fields == ("nodes", "edges", "receivers", "senders", "globals", "n_node", "n_edge")
    assert graph.n_node.tolist() == [len(x), 1]
    assert graph.n_edge.tolist() == [int(edges.pair_count), 2000 - int(edges.pair_count)]
    np.testing.assert_array_equal(graph.nodes["positions"], np.concatenate([x, np.zeros((1, 3))]))
    found = graph.senders, graph.receivers, *(graph.edges[name] for name in ("displacement", "shift", "distance"))
    right = edges.senders, edges.receivers, edges.displacement, edges.shift, edges.distance
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-15), found, right)
    refuses(TypeError, "total must be a static int", nbrs.to_jraph, x, 2.0)
    refuses(ValueError, "this list has queries", lists.make("queries", "warp")[0].to_jraph, x, 2000)


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
    pairs = by_numpy.in_order(oracle("full", "open", x), 3)
    r = by_numpy.vectors_of(pairs, np.asarray(x), np.asarray(x))
    np.testing.assert_allclose(net(graph).nodes[: len(x)], by_numpy.add_up((r**2).sum(1), pairs.i, len(x)), rtol=1e-12)
    whole = jraph.unpad_with_graphs(graph)
    assert (len(whole.senders), whole.n_node.tolist()) == (len(pairs.i), [len(x)])


def test_nobody():
    x = jnp.zeros((0, 3))
    edges = jfrnn.search(x, 1.0, capacity=4).edges(x, 3)
    assert edges.senders.tolist() == edges.receivers.tolist() == [0, 0, 0]
    assert not edges.mask.any()


CUTOFF, BOX = 0.45, [1.0, 1.2, 1.1]
X = np.random.default_rng(3).random((24, 3)) * BOX
BOTH = {
    "padded": lambda: jfrnn.search(X, CUTOFF, box=jfrnn.Box(BOX)).edges(X, 400),
    "flat": lambda: jfrnn.search_edges(X, CUTOFF, box=jfrnn.Box(BOX), total=400).edges(X),
    "with a skin": lambda: jfrnn.search_edges(X, CUTOFF, skin=0.05, box=jfrnn.Box(BOX), total=400).edges(X),  # among the pairs
}


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("kind", BOTH)
def test_triplets_are_pairs_of_edges(kind, half):
    edges = BOTH[kind]()
    receivers, there = np.asarray(edges.receivers), np.asarray(edges.mask)
    assert not there[-1]  # with padding
    assert there[: int(edges.pair_count)].all() == (kind != "with a skin")
    around = [np.flatnonzero((receivers == i) & there).tolist() for i in range(len(X))]
    expected = [pair for edge in around for pair in (itertools.combinations if half else itertools.permutations)(edge, 2)]
    room = len(expected) + 7
    found = jax.jit(lambda edges: edges.triplets(room, half=half))(edges)
    assert list(zip(found.first[:-7].tolist(), found.second[:-7].tolist())) == expected
    assert (found.first[-7:].tolist(), found.second[-7:].tolist()) == ([400] * 7, [400] * 7)
    assert (np.flatnonzero(found.mask) == np.arange(len(expected))).all()
    assert int(found.triplet_count) == len(expected) > 100
    assert len(edges.triplets(half=half).first) == len(expected)
    few = jax.jit(lambda edges: edges.triplets(5, half=half))(edges)
    assert (few.first.tolist(), int(few.triplet_count)) == ([a for a, _ in expected[:5]], len(expected))
    refuses(ValueError, r"total=5 is too small", edges.triplets, 5, half=half)


def test_an_energy_of_angles():
    """Its forces are those of all particles with all, as of Stillinger and Weber (1985, doi:10.1103/PhysRevB.31.5262)."""

    def term(r, s):  # of displacements to two neighbors
        a, b = jnp.sqrt(r @ r), jnp.sqrt(s @ s)
        smooth = jnp.where((a < CUTOFF) & (b < CUTOFF), ((a - CUTOFF) * (b - CUTOFF)) ** 2, 0.0)
        return smooth * (r @ s / (a * b) + 1 / 3) ** 2

    box = jnp.asarray(BOX)
    nbrs = jfrnn.search_edges(X, CUTOFF, box=jfrnn.Box(BOX), total=400)

    def energy(x):
        edges = nbrs.edges(x)
        found = edges.triplets(3000, half=True)
        r, s = (edges.displacement.at[jnp.where(found.mask, part, 0)].get() for part in (found.first, found.second))
        return jnp.where(found.mask, jax.vmap(term)(r, s), 0.0).sum()

    def expected(x):
        away = x[None] - x[:, None]
        away = away - box * jnp.round(away / box)
        i, j, k = (part.ravel() for part in np.indices((24, 24, 24)))
        used = (i != j) & (i != k) & (j < k)
        return jax.vmap(term)(away[i[used], j[used]], away[i[used], k[used]]).sum()

    found, true = (jax.jit(jax.value_and_grad(f))(jnp.asarray(X)) for f in (energy, expected))
    assert float(true[0]) > 0
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-14), found, true)


def test_nothing_and_bad_input():
    edges = jfrnn.search_edges(X, 1e-3, total=0).edges(X)
    assert edges.triplets().first.shape == (0,)
    assert edges.triplets(3).mask.tolist() == [False] * 3
    lacking = jax.jit(lambda: jfrnn.search_edges(X, CUTOFF, total=20).edges(X).triplets(9).triplet_count)()
    assert int(lacking) < 0  # as sums are NaN
    refuses(TypeError, r"total must be given inside jax\.jit", jax.jit(lambda edges: edges.triplets().first), edges)
    refuses(TypeError, "half must be True or False", edges.triplets, 3, half=1)
