"""`jax.vmap` over every public function is a Python loop, or refused; `cond` and `shard_map` on one device."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import refuses, slow
from jax.sharding import PartitionSpec

import jfrnn

CUTOFF, CAPACITY, BATCH, N = 0.3, 40, 3, 40
OPTIONS = {"capacity": CAPACITY, "backend": "warp"}
SEGMENTS = jnp.asarray([[0.2, 0.1], [0.8, 0.4], [0.5, 0.9]], jnp.float32), jnp.asarray([[0, 1], [1, 2], [2, 0]])
BOX, SMALL = jfrnn.Box([1.0, 1.25]), jfrnn.Box([0.5, 0.625])


def positions(seed=0):
    return jnp.asarray(np.random.default_rng(seed).random((BATCH, N, 2)), jnp.float32)


X = positions()
LISTS = {
    "open": lambda x: jfrnn.search(x, CUTOFF, **OPTIONS),
    "skin": lambda x: jfrnn.search(x, CUTOFF, skin=0.05, **OPTIONS),
    "box": lambda x: jfrnn.search(x, CUTOFF, box=BOX, **OPTIONS),
    "images": lambda x: jfrnn.search(x, CUTOFF, box=SMALL, capacity=160, backend="warp"),
    "half": lambda x: jfrnn.search(x, CUTOFF, half=True, **OPTIONS),
    "queries": lambda x: jfrnn.search(x, CUTOFF, queries=x[:7] + 0.01, **OPTIONS),
    "active": lambda x: jfrnn.search(x, CUTOFF, active=x[:, 0] < 0.7, **OPTIONS),
    "radii": lambda x: jfrnn.search(x, 0.1 + 0.2 * x[:, 0], radius_rule="mean", **OPTIONS),
    "radii in a box": lambda x: jfrnn.search(x, 0.1 + 0.2 * x[:, 0], box=BOX, **OPTIONS),
    "batch": lambda x: jfrnn.search(x, CUTOFF, batch=(4 * x[:, 0]).astype(jnp.int32), **OPTIONS),
    "hashgrid": lambda x: jfrnn.search(x, CUTOFF, capacity=CAPACITY, backend="hashgrid"),
    "a box of its own": lambda x: jfrnn.search(x, CUTOFF, box=jfrnn.Box(1.0 + x[0]), **OPTIONS),
}


def cells(x):
    return (64 * x).astype(jnp.uint32)


FUNCTIONS = {
    **{f"search, {name}": search for name, search in LISTS.items()},
    "count": lambda x: jfrnn.count(x, CUTOFF, backend="warp"),
    "count, radii": lambda x: jfrnn.count(x, 0.1 + 0.2 * x[:, 0], backend="warp"),
    "count, batch": lambda x: jfrnn.count(x, CUTOFF, batch=(4 * x[:, 0]).astype(jnp.int32), backend="warp"),
    "count, hashgrid": lambda x: jfrnn.count(x, CUTOFF, backend="hashgrid"),
    "count, box per system": lambda x: jfrnn.count(x, CUTOFF, box=jfrnn.Box(1.0 + x[0]), backend="warp"),
    "search_edges": lambda x: jfrnn.search_edges(x, CUTOFF, total=300, backend="warp"),
    "edges of a flat list": lambda x: jfrnn.search_edges(x, CUTOFF, total=300, backend="warp").edges(x),
    "update": lambda x: LISTS["open"](x).update(x + 0.1),
    "update, skin": lambda x: LISTS["skin"](x).update(x + jnp.where(x[0, 0] > 0.5, 0.1, 0.0).astype(x.dtype)),
    "update, box": lambda x: LISTS["box"](x).update(x + 0.1),
    "vectors": lambda x: LISTS["open"](x).vectors(x),
    "vectors, images": lambda x: LISTS["images"](x).vectors(x),
    "distances": lambda x: LISTS["skin"](x).distances(x),
    "distances, radii": lambda x: LISTS["radii"](x).distances(x),
    "shifts": lambda x: LISTS["images"](x).shifts(x),
    "overflow": lambda x: jfrnn.search(x, CUTOFF, capacity=2, backend="warp").overflow,
    "pairs": lambda x: LISTS["half"](x).pairs(200),
    "csr": lambda x: LISTS["open"](x).csr(300),
    "to_jraph": lambda x: LISTS["open"](x).to_jraph(x, 300),
    "edges": lambda x: LISTS["open"](x).edges(x, 300),
    "require": lambda x: LISTS["open"](x).require(200),
    "to_jax_md": lambda x: LISTS["open"](x).to_jax_md(),
    "pair_sum": lambda x: jfrnn.pair_sum(lambda r, i, j: {"r": r * j, "s": r @ r}, x, None, x[:, 0], neighbors=LISTS["open"](x)),
    "search_triangles": lambda x: jfrnn.search_triangles(x, *SEGMENTS, 0.2, capacity=4, backend="warp"),
    "search_triangles, bvh": lambda x: jfrnn.search_triangles(x, *SEGMENTS, 0.2, capacity=4, backend="bvh"),
    "search_triangles, jax": lambda x: jfrnn.search_triangles(x, *SEGMENTS, 0.2, capacity=4, backend="jax"),
    "closest": lambda x: jfrnn.search_triangles(x, *SEGMENTS, 0.2, capacity=4, backend="warp").closest(x),
    "contacts": lambda x: jfrnn.search_triangles(x, *SEGMENTS, 0.2, capacity=4, backend="warp").contacts(x),
    "sort_order": lambda x: jfrnn.sort_order(x, 0.1),
    "morton_encode": lambda x: jfrnn.morton_encode(cells(x)),
    "morton_decode": lambda x: jfrnn.morton_decode(jfrnn.morton_encode(cells(x)), 2),
    "hilbert_encode": lambda x: jfrnn.hilbert_encode(cells(x), 7),
    "hilbert_decode": lambda x: jfrnn.hilbert_decode(jfrnn.hilbert_encode(cells(x), 7), 2, 7),
}


SLOWLY = "search_triangles, jax"  # compiled


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == SLOWLY)) for name in FUNCTIONS])
def test_vmap_is_a_loop(name):
    function = FUNCTIONS[name]
    batch = jax.tree.map(np.asarray, jax.vmap(function)(X))  # on the device, each shape compiles a program that takes a row
    for k, x in enumerate(X):
        one, expected = jax.tree.map(lambda leaf, k=k: leaf[k], batch), function(x)
        assert jax.tree.structure(one) == jax.tree.structure(expected)
        for got, wanted in zip(jax.tree.leaves(one), jax.tree.leaves(expected), strict=True):
            assert (got.shape, got.dtype) == (wanted.shape, wanted.dtype)
            if np.issubdtype(got.dtype, np.floating):  # another program may round square roots and sums otherwise
                np.testing.assert_allclose(got, wanted, rtol=1e-6)
            else:
                np.testing.assert_array_equal(got, wanted)


REFUSED = {
    "grow": lambda x: LISTS["open"](x).grow(x),
    "check": lambda x: LISTS["open"](x).check(),
    "pairs without a total": lambda x: LISTS["open"](x).pairs(),
    "run_chunk": lambda x: jfrnn.run_chunk(lambda x, n: (x, n), x, LISTS["open"](x), lambda x: x),
    "search without a capacity": lambda x: jfrnn.search(x, CUTOFF),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_needs_the_host_refuses_vmap(name):
    told = r"cannot run inside jax\.jit|capacity must be given where positions are traced"
    refuses((TypeError, ValueError), told, jax.vmap(REFUSED[name]), X)


def test_every_public_name_is_mapped_or_refused():
    """What this file knows of: a function that is new must be added to a table above."""
    said = {name.replace(",", "").split()[0] for name in (*FUNCTIONS, *REFUSED)}
    methods = {name for name, value in vars(jfrnn.NeighborList).items() if callable(value) and not name.startswith("_")}
    functions = {name for name in jfrnn.__all__ if not isinstance(getattr(jfrnn, name), type)}
    apart = {"memory_plan", "merge_vertices", "pairs_of_rows"}  # of shapes alone; on the host, before anything is searched
    assert [name for name in sorted((methods | functions) - apart) if name not in said] == []


@pytest.mark.parametrize("backend", ["warp", "hashgrid", slow("jax")])
def test_cond_and_shard_map_on_one_device(backend):
    def listed(x):
        nbrs = jfrnn.search(x, CUTOFF, capacity=CAPACITY, backend=backend)
        return nbrs.idx, nbrs.count

    expected = listed(X[0])
    chosen = jax.jit(lambda x: jax.lax.cond(x[0, 0] > -1, listed, lambda x: listed(2 * x), x))(X[0])
    mesh = jax.make_mesh((1,), ("system",), axis_types=(jax.sharding.AxisType.Auto,))
    spec = PartitionSpec("system")
    mapped = jax.jit(jax.shard_map(listed, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))(X[0])
    for got in (chosen, mapped):
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("backend", ["warp", "jax"])
def test_functions_of_pairs_close_over_what_varies_over_a_mesh(backend):
    mesh = jax.make_mesh((1,), ("system",), axis_types=(jax.sharding.AxisType.Auto,))
    spec, lengths = PartitionSpec("system"), jnp.array([0.7], X.dtype)

    def summed(x, length):
        def fn(r, i, j):
            return jnp.where(r @ r < length[0], jax.nn.relu(length[0] - r @ r), 0)

        return jfrnn.pair_sum(fn, x, CUTOFF, backend=backend)

    for fn in (summed, jax.grad(lambda x, length: summed(x, length).sum(), 1)):
        mapped = jax.shard_map(fn, mesh=mesh, in_specs=(PartitionSpec(), spec), out_specs=spec)
        np.testing.assert_array_equal(jax.jit(mapped)(X[0], lengths), fn(X[0], lengths))
    total = lambda x: jfrnn.pair_sum(lambda r, i, j: jax.lax.psum(r @ r, "system"), x, CUTOFF, backend=backend)  # noqa: E731
    with pytest.raises(TypeError, match="fn must not use psum over the axis 'system'"):
        jax.shard_map(total, mesh=mesh, in_specs=PartitionSpec(), out_specs=spec)(X[0])
