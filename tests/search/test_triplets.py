"""`Edges.triplets`: two edges that end at the same particle, of padded and flat lists."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jfrnn

CUTOFF, BOX = 0.45, [1.0, 1.2, 1.1]
X = np.random.default_rng(3).random((24, 3)) * BOX
BOTH = {
    "padded": lambda: jfrnn.search(X, CUTOFF, box=jfrnn.Box(BOX)).edges(X, 400),
    "flat": lambda: jfrnn.search_edges(X, CUTOFF, box=jfrnn.Box(BOX), total=400).edges(X),
}


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("kind", BOTH)
def test_triplets_are_pairs_of_edges(kind, half):
    edges = BOTH[kind]()
    receivers, held = np.asarray(edges.receivers), int(edges.pair_count)
    assert held < 400  # with padding
    around = [np.flatnonzero(receivers[:held] == i).tolist() for i in range(len(X))]
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
    with pytest.raises(ValueError, match=r"total=5 is too small"):
        edges.triplets(5, half=half)


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
    with pytest.raises(TypeError, match=r"total must be given inside jax\.jit"):
        jax.jit(lambda edges: edges.triplets().first)(edges)
    with pytest.raises(TypeError, match="half must be True or False"):
        edges.triplets(3, half=1)
