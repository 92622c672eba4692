"""Exports of a list: pairs, compressed rows, edges, jax-md's dense format; on the host and under jit."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import as_set, refuses

import jfrnn
from jfrnn._engine.rows import add_up
from jfrnn._search.exports import flat_pairs, pair_total

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
    assert {rows.dtype, sources.dtype, found_offsets.dtype, found_indices.dtype} == {np.dtype(np.int32)}


HALF = np.arange(50) % 2 == 0
KINDS = {
    "plain": {},
    "half": {"half": True},
    "self": {"include_self": True},
    "queries": {"queries": np.asarray(X)[::5] + np.float32(0.01)},
    "batch": {"batch": np.arange(50) % 3},
    "active": {"active": jnp.asarray(HALF)},
    "skin": {"skin": 0.05},
    "box": {"box": jfrnn.Box([1.0] * 3), "skin": 0.05},
    "images": {"box": jfrnn.Box([0.5, 0.55, 3.0])},
    "half images": {"box": jfrnn.Box([0.5, 0.55, 3.0]), "half": True, "skin": 0.05},
}


SLOWLY = ("images", "radii", "batch")  # compiled
ON_THE_HOST = ("queries", "box", *SLOWLY)  # asked for pairs at present positions without a total, which compiles a program more


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind in SLOWLY)) for kind in [*KINDS, "radii"]])
def test_all_that_leaves_a_list_says_the_same_pairs(kind):
    radii = kind == "radii"
    nbrs = jfrnn.search(X, 0.1 + 0.4 * X[:, 0], radius_rule="mean") if radii else jfrnn.search(X, 0.3, **KINDS[kind])
    queries = KINDS.get(kind, {}).get("queries", X)
    given = {"queries": queries} if "queries" in KINDS.get(kind, {}) else {}
    total, m = 2400, len(queries)
    i, j = nbrs.pairs()
    assert 10 < len(i) < total
    assert [part.dtype for part in (i, j, *nbrs.csr())] == [np.int32, np.int32, np.int64, np.int32]

    @jax.jit
    def all_of(nbrs, **given):
        geometry = nbrs.vectors(X, **given), nbrs.shifts(X, **given)
        return nbrs.pairs(total), nbrs.csr(total), nbrs.pairs(total, positions=X, **given), geometry

    (rows, sources), compressed, named, ((vectors, mask), shifts) = jax.tree.map(np.asarray, all_of(nbrs, **given))
    fill = np.full(total - len(i), 50), np.full(total - len(i), m)
    np.testing.assert_array_equal(rows, np.concatenate([i, fill[1]]))
    np.testing.assert_array_equal(sources, np.concatenate([j, fill[0]]))
    for offsets, indices in (nbrs.csr(), compressed):
        np.testing.assert_array_equal(np.repeat(np.arange(m), np.diff(offsets)), i)
        np.testing.assert_array_equal(indices[: len(j)], j)
        assert (indices[len(j) :] == 50).all()
    used = np.asarray(nbrs.idx) < 50
    np.testing.assert_array_equal(np.nonzero(used)[0], i)
    np.testing.assert_array_equal(np.asarray(nbrs.idx)[used], j)
    assert not (mask & ~used).any()
    assert (vectors[~mask] == 0).all()
    assert (shifts[~used] == 0).all()
    box = KINDS.get(kind, {}).get("box")
    lengths = np.zeros(3) if box is None else np.asarray(box.vectors)
    apart = np.asarray(X)[j] - np.asarray(queries)[i] + shifts[used] * lengths
    reach = 0.1 + 0.4 * float(np.max(X)) if radii else 0.3 + KINDS[kind].get("skin", 0.0)
    assert (np.linalg.norm(apart, axis=1) < reach + 1e-6).all()
    np.testing.assert_allclose(vectors[used], np.where(mask[used][:, None], apart, 0), atol=1e-6)
    if "skin" in KINDS.get(kind, {}):
        assert (used & ~mask).any()  # the skin holds pairs, which `pairs` lists and whose shifts are known
    near = i[mask[used]], j[mask[used]]
    np.testing.assert_array_equal(np.stack(named)[:, : len(near[0])], near)
    if kind in ON_THE_HOST:
        np.testing.assert_array_equal(nbrs.pairs(positions=X, **given), near)
        np.testing.assert_array_equal(nbrs.csr(positions=X, **given)[1], near[1])


def test_edges_of_images_have_their_shifts():
    x = jnp.asarray([[0.5, 0.5, 0.5], [0.9, 0.5, 0.5]], jnp.float32)
    graph = jfrnn.search(x, 1.1, box=jfrnn.Box([1.0, 1.0, 1.0])).to_jraph(x, 64)
    count = int(graph.n_edge[0])
    found = as_set(*(part[:count] for part in (graph.receivers, graph.senders, graph.edges["shift"])))
    assert found == reference.reference_images(np.asarray(x), 1.1, matrix=np.eye(3), periodic=(True,) * 3)


def test_where_pairs_are_needs_positions():
    refuses(TypeError, r"queries tell where pairs are now.*pass positions=", jfrnn.search(X, 0.3).pairs, queries=X)


def test_rows_that_overflowed_export_what_they_hold_and_carry_the_status():
    nbrs = jfrnn.search(X, 0.3, capacity=4)
    offsets, indices = jax.jit(lambda nbrs: nbrs.csr(300))(nbrs)
    used = np.minimum(nbrs.count, 4)
    np.testing.assert_array_equal(offsets, np.concatenate([[0], np.cumsum(used)]))
    np.testing.assert_array_equal(indices[: used.sum()], np.asarray(nbrs.idx)[np.arange(4) < used[:, None]])
    assert (np.asarray(indices)[used.sum() :] == 50).all()
    dense = jax.jit(lambda nbrs: nbrs.to_jax_md())(nbrs)
    assert bool(dense.did_buffer_overflow)
    assert int(dense.status) == int(nbrs.status)


@pytest.mark.parametrize(
    "leave", [lambda n: n.pairs(900), lambda n: n.csr(900), lambda n: n.to_jraph(X, 900), lambda n: n.to_jax_md()]
)
def test_a_list_that_is_not_whole_does_not_leave(leave):
    nbrs = jfrnn.search(X, 0.3, capacity=4)
    with pytest.raises(jfrnn.NeighborOverflowError, match="capacity=4 is too small") as refused:
        leave(nbrs)
    assert refused.value.required == int(nbrs.required)
    with pytest.raises(jfrnn.NeighborOverflowError, match="capacity=4 is too small"):
        jax.jit(lambda x: (leave(nbrs), x))(X)  # closed over, and so known while tracing
    leave(nbrs.grow(X))


EXPORTS = {"pairs": lambda n, t: n.pairs(t), "csr": lambda n, t: n.csr(t), "to_jraph": lambda n, t: n.to_jraph(X, t).receivers}


@pytest.mark.parametrize("export", EXPORTS)
def test_a_total_that_is_too_small_raises_outside_jit(export):
    nbrs = jfrnn.search(X, 0.3)
    held = len(nbrs.pairs()[0])
    with pytest.raises(ValueError, match=rf"total=100 is too small: the list holds {held} pairs. Pass total={held} or more"):
        EXPORTS[export](nbrs, 100)
    out = EXPORTS[export](nbrs, held)
    assert len(out[1] if isinstance(out, tuple) else out) == held


def test_a_total_that_is_too_small_sets_a_bit_that_stays():
    nbrs = jfrnn.search(X, 0.3)
    held = len(nbrs.pairs()[0])

    @functools.partial(jax.jit, static_argnames="total")
    def steps(nbrs, total):
        def step(_, nbrs):
            return nbrs.update(X).require(total)

        nbrs = jax.lax.fori_loop(0, 2, step, nbrs)
        return nbrs.update(100 * X), nbrs.pairs(total)

    enough, _ = steps(nbrs, held)
    enough.check()
    short, (rows, _) = steps(nbrs, held - 1)
    assert rows[-1] < 50
    assert jfrnn.Status(int(short.status)) == jfrnn.Status.TOTAL_OVERFLOW
    refuses(ValueError, r"more pairs than the `total` that `require` was told.*At present it holds 0", short.check)
    refuses(ValueError, f"At present it holds {held}", nbrs.require(1).check)
    nbrs.require(1).grow(X).check()


@pytest.mark.parametrize("export", EXPORTS)
def test_totals_that_int32_cannot_number_are_refused_while_tracing(export):
    nbrs = jfrnn.search(X, 0.3)
    for total in (2**31, 2**31 + 8):
        with pytest.raises(ValueError, match=rf"total must be at most 2147483647.*got {total}"):
            jax.eval_shape(lambda nbrs, total=total: EXPORTS[export](nbrs, total), nbrs)
    refuses(ValueError, "total must be at most 2147483647", nbrs.require, 2**31)


def test_sums_of_counts_never_wrap():
    """More slots than int32 can number: no array of them is made here, only what is added up."""
    capacity, counts = 2**30, np.array([5, 2**30, 0, 2**30, 2**31 - 1, 7], np.int32)
    exact = np.concatenate([[0], np.cumsum(np.minimum(counts, capacity), dtype=np.int64)])
    offsets = jax.jit(add_up)(np.minimum(counts, capacity))
    np.testing.assert_array_equal(offsets, np.minimum(exact, 2**31 - 1))
    assert (offsets.dtype, int(pair_total(jnp.asarray(counts), capacity))) == (np.int32, 2**31 - 1)
    assert int(pair_total(jnp.asarray(counts[[0, 2, 5]]), capacity)) == 12
    given = (jax.ShapeDtypeStruct(shape, np.int32) for shape in ((64_000_000, 112), (64_000_000,)))
    many = jax.eval_shape(lambda idx, count: flat_pairs(idx, count, 64_000_000, 8), *given)
    assert many[2].dtype == np.int32


def test_what_needs_the_host_says_to_pass_a_total():
    for export in ("pairs", "csr"):
        with pytest.raises(TypeError, match=rf"{export}\(\) returns as many pairs as there are.*write {export}\(total\)"):
            jax.jit(lambda nbrs, export=export: getattr(nbrs, export)())(jfrnn.search(X, 0.3))


@pytest.mark.parametrize(("m", "n"), [(0, 5), (5, 0)])
def test_empty_lists(m, n):
    nbrs = jfrnn.search(X[:n], 0.3, queries=X[:m])
    rows, sources = nbrs.pairs(3)
    np.testing.assert_array_equal(rows, [m] * 3)
    np.testing.assert_array_equal(sources, [n] * 3)


def test_dense_neighbors_of_jax_md():
    nbrs = jfrnn.search(X, 0.3)
    dense = jax.jit(lambda nbrs: nbrs.to_jax_md())(nbrs)
    np.testing.assert_array_equal(dense.idx, nbrs.idx)
    for options in ({"half": True}, {"queries": X}, {"box": jfrnn.Box([0.5] * 3)}):
        refuses(ValueError, "Dense format cannot say", jfrnn.search(X, 0.3, **options).to_jax_md)


@pytest.mark.parametrize(
    ("error", "match", "total"),
    [(TypeError, r"total must be a static int.*got float 1.5", 1.5), (ValueError, r"total must be at least 0, got -1", -1)],
)
def test_bad_totals_say_what_is_wrong(error, match, total):
    refuses(error, match, jfrnn.search(X, 0.3).pairs, total)
