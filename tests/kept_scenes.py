"""Scenes of lists that are kept in a box, in which nearest images are the sources themselves, or one vector away, or many."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import reference

import jfrnn


def narrow_box(side, dtype, n=4):
    """Pairs whose nearest image is another one stand hardly farther apart than those whose is not; few, so that all go one way."""
    rng, box = np.random.default_rng(5), jfrnn.Box(np.full(2, side, dtype))
    x = jnp.asarray(rng.uniform(0, side, (n, 2)), dtype)
    nbrs = jfrnn.search(x, 0.98, skin=0.02, box=box, capacity=n)
    assert nbrs.images is None
    summed = functools.partial(jfrnn.pair_sum, lambda r, i, j: jnp.append(r, 1))
    of_list = jax.jit(lambda nbrs, x: (summed(x, None, neighbors=nbrs), nbrs.distances(x)))
    for _ in range(60):
        x = jnp.asarray(rng.uniform(0, side, (n, 2)), dtype)
        found, (distances, mask) = of_list(nbrs.update(x), x)
        r = np.asarray(x, float)[None] - np.asarray(x, float)[:, None]
        r -= side * np.round(r / side)
        near = ((r**2).sum(2) < dtype(0.98) ** 2) & ~np.eye(n, dtype=bool)
        np.testing.assert_allclose(found, (near[..., None] * np.append(r, np.ones((n, n, 1)), 2)).sum(1), atol=1e-6)
        np.testing.assert_array_equal(np.sum(mask, axis=1), near.sum(1))
        np.testing.assert_allclose(np.sum(distances), np.sqrt((r**2).sum(2))[near].sum(), rtol=1e-6)


def boxes_apart(dtype, most, n=300):
    """Up to `most` vectors lie between points: 700 are more than are told apart."""
    rng, side = np.random.default_rng(6), 8.0
    x = (np.round(rng.uniform(0, side, (n, 3)) * 64) / 64).astype(dtype)  # so that whole vectors are added without rounding
    nbrs = jfrnn.search(jnp.asarray(x), 1.0, skin=0.2, box=jfrnn.Box(np.full(3, side, dtype)), capacity=16)
    turns = rng.integers(-most, most + 1, (n, 3)) * (np.arange(n) % 4 == 0)[:, None]
    apart = jnp.asarray(x + turns * side, dtype)
    nbrs = nbrs.update(apart)
    count = np.asarray(jfrnn.pair_sum(lambda r, i, j: jnp.append(r, 1), apart, None, neighbors=nbrs))
    mask, r = np.asarray(nbrs.distances(apart)[1]), x.astype(float)[None] - x.astype(float)[:, None]
    r -= side * np.round(r / side)
    near = ((r**2).sum(2) < 1) & ~np.eye(n, dtype=bool)
    if most <= 5:
        np.testing.assert_array_equal(count[:, 3], near.sum(1))
        np.testing.assert_allclose(count[:, :3], (near[..., None] * r).sum(1), atol=1e-4)
        assert int(nbrs.rebuild_count) == 0
    np.testing.assert_array_equal(mask.sum(1), count[:, 3])


def ties_in_a_wide_box(dtype, n=11):
    """Each pair is summed once, though some slots are decided once more: those of ties, and in a wide box of many others."""
    side = {np.float32: 2.0**14, np.float64: 2.0**40}[dtype]
    steps = np.array([1, 1 - 2**-9, 0.9, 1, 1 - 2**-8, 0.99, 1, 0.5, 1 + 2**-8, 1])
    x = np.zeros((n, 3), dtype)
    x[1:11, 0] = steps * np.array([1, -1] * 5)
    x[1:11:4, [0, 1]] = x[1:11:4, [1, 0]]
    x[11:] = 5
    x += np.asarray(4096, dtype)
    for closed in (False, True):
        nbrs = jfrnn.search(jnp.asarray(x), 1.0, skin=0.25, box=jfrnn.Box(np.full(3, side, dtype)), capacity=16, closed=closed)
        count = jfrnn.pair_sum(lambda r, i, j: jnp.ones((), dtype), jnp.asarray(x), None, neighbors=nbrs)
        expected = np.bincount([i for i, _ in reference.reference_pairs(x, 1.0, closed=closed)], minlength=n)
        np.testing.assert_array_equal(count, expected)
        np.testing.assert_array_equal(nbrs.distances(jnp.asarray(x))[1].sum(1), expected)
