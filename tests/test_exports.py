"""Exports of a list: pairs, compressed rows, edges, jax-md's dense format; on the host and under jit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jfrnn

X = jnp.asarray(np.random.default_rng(0).random((50, 3)), jnp.float32)


@pytest.mark.parametrize("total", [0, 7, 100, 1000])
def test_exports_of_static_length(total):
    nbrs = jfrnn.search(X, 0.3)
    i, j = nbrs.pairs()
    offsets, indices = nbrs.csr()
    assert 100 < len(i) < 1000
    kept = min(total, len(i))
    rows, sources = jax.jit(lambda nbrs: nbrs.pairs(total))(nbrs)
    np.testing.assert_array_equal(rows, np.concatenate([i[:kept], np.full(total - kept, 50)]))
    np.testing.assert_array_equal(sources, np.concatenate([j[:kept], np.full(total - kept, 50)]))
    found_offsets, found_indices = jax.jit(lambda nbrs: nbrs.csr(total))(nbrs)
    np.testing.assert_array_equal(found_offsets, offsets)
    np.testing.assert_array_equal(found_indices, np.concatenate([indices[:kept], np.full(total - kept, 50)]))
    senders, receivers = nbrs.to_jraph(total)
    np.testing.assert_array_equal(senders, sources)
    np.testing.assert_array_equal(receivers, rows)
    assert {rows.dtype, sources.dtype, found_offsets.dtype, found_indices.dtype} == {np.dtype(np.int32)}


def test_rows_that_overflowed_export_what_they_hold():
    nbrs = jfrnn.search(X, 0.3, capacity=4)
    offsets, indices = nbrs.csr(300)
    used = np.minimum(nbrs.count, 4)
    np.testing.assert_array_equal(offsets, np.concatenate([[0], np.cumsum(used)]))
    np.testing.assert_array_equal(indices[: used.sum()], np.asarray(nbrs.idx)[np.arange(4) < used[:, None]])
    assert (np.asarray(indices)[used.sum() :] == 50).all()


@pytest.mark.parametrize(("m", "n"), [(0, 5), (5, 0)])
def test_empty_lists(m, n):
    nbrs = jfrnn.search(X[:n], 0.3, queries=X[:m])
    rows, sources = nbrs.pairs(3)
    np.testing.assert_array_equal(rows, [m] * 3)
    np.testing.assert_array_equal(sources, [n] * 3)


def test_vmap_equals_a_loop():
    batch = jnp.stack([X, X[::-1] * 1.5])
    nbrs = jax.vmap(lambda x: jfrnn.search(x, 0.3, capacity=50))(batch)
    rows, sources = jax.vmap(lambda nbrs: nbrs.pairs(900))(nbrs)
    for k in range(2):
        i, j = jax.tree.map(lambda leaf, k=k: leaf[k], nbrs).pairs(900)
        np.testing.assert_array_equal(rows[k], i)
        np.testing.assert_array_equal(sources[k], j)


def test_a_sum_over_edges_is_the_sum_over_slots():
    nbrs = jfrnn.search(X, 0.3)
    senders, receivers = nbrs.to_jraph(1000)
    degree = jax.ops.segment_sum(jnp.ones(1000), receivers, num_segments=51)
    np.testing.assert_array_equal(degree[:50], nbrs.count)
    assert int((senders == 50).sum()) == 1000 - int(nbrs.count.sum())


def test_dense_neighbors_of_jax_md():
    nbrs = jfrnn.search(X, 0.3)
    dense = jax.jit(lambda nbrs: nbrs.to_jax_md())(nbrs)
    np.testing.assert_array_equal(dense.idx, nbrs.idx)
    for options in ({"half": True}, {"queries": X}, {"box": jfrnn.Box([0.5] * 3)}):
        with pytest.raises(ValueError, match="Dense format cannot say"):
            jfrnn.search(X, 0.3, **options).to_jax_md()


@pytest.mark.parametrize(
    ("error", "match", "total"),
    [(TypeError, r"total must be a static int.*got float 1.5", 1.5), (ValueError, r"total must be at least 0, got -1", -1)],
)
def test_bad_totals_say_what_is_wrong(error, match, total):
    with pytest.raises(error, match=match):
        jfrnn.search(X, 0.3).pairs(total)
