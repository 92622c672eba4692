"""What kernels are told of the box of a list, computed once: lists that renew themselves have it, here on the CPU as well."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import slow

import jfrnn
from jfrnn._engine import renew_warp
from jfrnn._engine.auto import platform_of

LENGTHS = np.array([3.0, 4.0, 3.5], np.float32)


@pytest.fixture
def as_on_cuda(monkeypatch):
    monkeypatch.setitem(renew_warp.PLATFORMS, platform_of(jnp.zeros(1)), "cuda")


def _energy(x, nbrs, cutoff=None, **more):
    return jfrnn.pair_sum(lambda r, i, j: (1 - r @ r) ** 2, x, cutoff, neighbors=nbrs, **more).sum()


def _in_numpy(x, lengths, periodic, cutoff=1.0):
    """Return the energy of all pairs of nearest images, and its derivatives in positions and lengths."""
    x, lengths = np.asarray(x, np.float64), np.asarray(lengths, np.float64)
    apart = x[None] - x[:, None]
    turns = np.rint(apart / lengths) * periodic
    apart -= turns * lengths
    over = np.where(np.eye(len(x), dtype=bool), 0, 1 - (apart**2).sum(-1))
    over = np.where(over > 1 - cutoff**2, over, 0)
    pull = 4 * over[..., None] * apart
    return (over**2).sum(), 2 * pull.sum(1), (pull * turns).sum((0, 1))


@pytest.mark.usefixtures("as_on_cuda")
@pytest.mark.parametrize("periodic", [True, slow((True, False, True))])
def test_sums_and_forces_are_those_of_the_pairs_in_the_present_box(periodic):
    x = jnp.asarray(np.random.default_rng(0).uniform(0, LENGTHS, (200, 3)), jnp.float32)
    box, other = (jfrnn.Box(LENGTHS * scale, periodic=periodic) for scale in (np.float32(1), np.float32(1.04)))
    nbrs = jfrnn.search(x, 1.0, skin=0.1, slack=1.5, box=box)
    assert nbrs.box_numbers is not None
    scanned = jax.jit(lambda x, nbrs: jax.lax.scan(lambda kept, _: (kept.update(x), None), nbrs, None, length=2)[0])(x, nbrs)
    changed = jax.jit(lambda x, nbrs, box: nbrs.update(x, box))(x, nbrs, other)
    force_of, shorter_of = jax.jit(jax.value_and_grad(_energy)), jax.jit(lambda x, kept: _energy(x, kept, cutoff=0.8))
    for kept, now in ((nbrs, box), (scanned, box), (changed, other), (nbrs.grow(x, other), other)):
        found, force = force_of(x, kept)
        right, slope, _ = _in_numpy(x, now.vectors, periodic)
        np.testing.assert_allclose(found, right, rtol=1e-5)
        np.testing.assert_allclose(force, slope, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(shorter_of(x, kept), _in_numpy(x, now.vectors, periodic, 0.8)[0], rtol=1e-5)
    stretched = jax.grad(lambda lengths: _energy(x, nbrs, box=jfrnn.Box(lengths, periodic=periodic)))(jnp.asarray(LENGTHS))
    np.testing.assert_allclose(stretched, _in_numpy(x, LENGTHS, periodic)[2], rtol=1e-3)


@pytest.mark.usefixtures("as_on_cuda")
def test_only_lists_that_renew_themselves_have_them():
    x, box = jnp.asarray(np.random.default_rng(1).uniform(0, LENGTHS, (50, 3)), jnp.float32), jfrnn.Box(LENGTHS)
    for options in ({}, {"skin": 0.1, "reverse": True}, {"skin": 0.1, "backend": "jax"}, {"skin": 0.1, "active": x[:, 0] > 1}):
        assert jfrnn.search(x, 1.0, box=box, **options).box_numbers is None
    assert jfrnn.search(x, 1.0, skin=0.1).box_numbers is None


def test_a_list_that_went_to_another_platform_keeps_its_structure(monkeypatch):
    x, box = jnp.asarray(np.random.default_rng(2).uniform(0, LENGTHS, (50, 3)), jnp.float32), jfrnn.Box(LENGTHS)
    with monkeypatch.context() as on_cuda:
        on_cuda.setitem(renew_warp.PLATFORMS, platform_of(x), "cuda")
        nbrs = jfrnn.search(x, 1.0, skin=0.1, slack=1.5, box=box)
    moved = jax.jit(lambda: jax.lax.scan(lambda kept, _: (kept.update(x, box), None), nbrs, None, length=2)[0])()
    assert jax.tree.structure(moved) == jax.tree.structure(nbrs)
    np.testing.assert_allclose(_energy(x, moved), _in_numpy(x, LENGTHS, True)[0], rtol=1e-5)


SKEWED = np.array([[3.0, 0.0, 0.0], [0.7, 4.0, 0.0], [-0.5, 0.9, 3.5]], np.float32)


@pytest.mark.parametrize(
    ("make", "vectors"),
    [
        pytest.param(jfrnn.search, SKEWED, id="skewed-search"),
        pytest.param(jfrnn.search_edges, LENGTHS, id="upright-search_edges"),
        slow(jfrnn.search, LENGTHS, id="upright-search"),
        slow(jfrnn.search_edges, SKEWED, id="skewed-search_edges"),
    ],
)
def test_lists_keep_what_was_found_of_their_boxes(make, vectors):
    x = jnp.asarray(np.random.default_rng(3).uniform(0, LENGTHS, (60, 3)), jnp.float32)
    box, other = jfrnn.Box(vectors), jfrnn.Box(vectors * np.float32(1.03))
    nbrs, there = (make(x, 1.0, skin=0.1, slack=2.0, box=each) for each in (box, other))
    assert nbrs.known is not None
    went = jax.jit(lambda x, nbrs, box: nbrs.update(x, box))(x, nbrs, other)
    stayed = jax.jit(lambda x, nbrs: nbrs.update(x))(x, nbrs)
    for kept, right in ((went, there), (nbrs.grow(x, other), there), (stayed, nbrs)):
        np.testing.assert_allclose(kept.known, right.known, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(kept.box.vectors, right.box.vectors)
    # who donates a list leaves what later searches take
    jax.jit(lambda nbrs: nbrs.update(x), donate_argnums=0)(make(x, 1.0, skin=0.1, slack=2.0, box=box))
    np.testing.assert_array_equal(make(x, 1.0, skin=0.1, slack=2.0, box=box).known, nbrs.known)
    traced = jax.jit(lambda x, box: jfrnn.search(x, 1.0, skin=0.1, box=box, capacity=40))(x, nbrs.box)
    assert jax.tree.structure(traced.box) == jax.tree.structure(nbrs.box)
    assert make(x, 1.0, box=box).known is None
    np.testing.assert_allclose(traced.known, nbrs.known, rtol=1e-5, atol=1e-6)
