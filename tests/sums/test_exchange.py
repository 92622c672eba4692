"""Which summands stay the same when i and j are exchanged, and that derivatives are those that they would be without that."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

import jfrnn
from jfrnn._sums import exchange, summation

N, SIDE, CUTOFF = 30, 3.0, 1.0


def smooth(r):
    return (1 - r @ r) ** 2


FUNCTIONS = {
    "even": (lambda r, i, j: smooth(r), (1,)),
    "product": (lambda r, i, j: i["q"] * j["q"] / jnp.sqrt(r @ r) * jnp.where(r @ r < 0.25, 1, smooth(r)), (1,)),
    "mean": (lambda r, i, j: (i["q"] + j["q"]) / 2 * smooth(r), (1,)),
    "odd": (lambda r, i, j: r * smooth(r), (-1,)),
    "difference": (lambda r, i, j: (j["q"] - i["q"]) * smooth(r), (-1,)),
    "differences": (lambda r, i, j: (j["v"] - i["v"]) * (r * (i["q"] + j["q"])), (1,)),
    "functions": (lambda r, i, j: jnp.cos(r[0]) * jnp.sin(r[1]) * r[2], (1,)),
    "several": (lambda r, i, j: (smooth(r), r * smooth(r)), (1, -1)),
    "mass": (lambda r, i, j: j["q"] * smooth(r), (None,)),
    "exponential": (lambda r, i, j: jnp.exp(r[0]), (None,)),
    "mixed": (lambda r, i, j: smooth(r) * (1 + r[0]), (None,)),
    "both": (lambda r, i, j: jnp.stack([smooth(r), r[0]]), (None,)),
    "part": (lambda r, i, j: jnp.maximum(r[0], 0), (None,)),
    "choice": (lambda r, i, j: jnp.where(r @ r < 0.25, r[0], smooth(r)), (None,)),
}


@pytest.fixture(name="scene")
def make_scene():
    rng = np.random.default_rng(3)
    x = rng.uniform(0, SIDE, (N, 3))
    return x, {"q": rng.uniform(0.5, 2, N), "v": rng.normal(size=(N, 3))}, rng.normal(size=(N, 3))


def weighted(fn, x, data, **options):
    sums = jax.tree.leaves(jfrnn.pair_sum(fn, x, CUTOFF, data, **options))
    return sum(jnp.sum(jnp.sin(jnp.arange(s.size, dtype=s.dtype)).reshape(s.shape) * s) for s in sums)


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_signs(name, boxed, scene, monkeypatch):
    """What is transposed is the tangent of fn, in which positions and features move."""
    fn, expected = FUNCTIONS[name]
    seen = []
    monkeypatch.setattr(summation, "signs_of", lambda term: seen.append(term) or exchange.signs_of(term))
    x, data, _ = scene
    box = jfrnn.Box(np.full(3, SIDE)) if boxed else None
    jax.make_jaxpr(jax.grad(lambda x, data: weighted(fn, x, data, box=box), (0, 1)))(x, data)
    assert exchange.signs_of(seen[0]) == expected


@pytest.mark.parametrize("name", ["even", "odd"])
def test_forces_of_weighted_sums(name, scene):
    """Cotangents of i and j, which differ, are added, or subtracted where the summand changes sign; against all pairs at once."""
    x, (fn, _), near = scene[0], FUNCTIONS[name], np.zeros((N, N), bool)
    near[tuple(zip(*reference.reference_pairs(x, CUTOFF), strict=True))] = True

    def plain(x):
        terms = jax.vmap(jax.vmap(lambda r: fn(r, None, None)))(x[None] - x[:, None])
        return jnp.sum(jnp.where(near.reshape(N, N, *[1] * (terms.ndim - 2)), terms, 0), axis=1)

    def force(sums):
        weights = jnp.sin(jnp.arange(1.0, 1 + N))
        return jax.jit(jax.grad(lambda x: jnp.sum(weights @ sums(x))))(x)

    found, expected = force(lambda x: jfrnn.pair_sum(fn, x, CUTOFF, backend="brute")), force(plain)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    assert np.abs(expected).max() > 0.1
