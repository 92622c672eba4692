"""What is public travels: through pickle, deepcopy, a process pool, and as argument of exported programs."""

import copy
import functools
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jfrnn
from jfrnn import distributed
from jfrnn._search.exports import DenseNeighbors
from jfrnn._triangles.triangle_list import SignedDistance

X = jnp.asarray(np.random.default_rng(0).random((20, 2)), jnp.float32)
WALL = jnp.asarray([[0.2, 0.1], [0.8, 0.4], [0.5, 0.9]], jnp.float32), jnp.asarray([[0, 1], [1, 2], [2, 0]])


@functools.cache
def examples():
    """Return objects of every public class, and of what public methods return."""
    search = functools.partial(jfrnn.search, X, 0.3, capacity=24, backend="warp")
    triangles = jfrnn.search_triangles(X, *WALL, 0.2, capacity=4, backend="warp")
    particles = distributed.scatter(np.asarray(X), 0.3, {"m": np.asarray(X[:, 0])}, mesh=jax.make_mesh((1,), ("space",)))
    spread = distributed.search(particles, 0.3, capacity=24, backend="warp")
    return [
        jfrnn.Box([1.0, 2.0], (True, False), images=1),
        jfrnn.memory_plan(100, 0.1),
        search(),
        search(skin=0.05, box=jfrnn.Box([1.0, 1.0])),
        search(batch=jnp.arange(20) % 2, active=jnp.arange(20) > 3, box=jfrnn.Box([0.5, 0.6])),
        jfrnn.search(X, 0.3 * X[:, 0], capacity=24, backend="warp"),
        search().to_jax_md(),
        jfrnn.NeighborOverflowError(12, 8),
        jfrnn.Status.ROW_OVERFLOW | jfrnn.Status.NONFINITE,
        triangles,
        triangles.signed_distance(X),
        particles,
        particles.sizes,
        particles.required,
        spread,
        spread.halo,
        jfrnn.search_edges(X, 0.3, total=200, skin=0.05, exclude=jnp.array([[0, 1]]), backend="warp"),
    ]


def of_edges():
    """Return what lists give of edges."""
    edges = examples()[2].edges(X)
    return edges, edges.triplets(), examples()[2].to_jraph(X)


def assert_same(one, other):
    assert type(one) is type(other)
    assert str(one) == str(other)
    if isinstance(one, Exception):
        assert vars(one) == vars(other)
        return
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for got, wanted in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("travel", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy], ids=["pickle", "deepcopy"])
def test_every_public_object_survives(travel):
    for example in examples():
        assert_same(travel(example), example)


def test_programs_that_are_written_to_bytes_take_and_return_every_public_pytree():
    trees = [example for example in examples() if all(isinstance(x, jax.Array | np.ndarray) for x in jax.tree.leaves(example))]
    assert len(trees) >= len(examples()) - 4  # plans, errors, bits and sizes are no arrays
    for example in [*trees, *of_edges()]:
        check_written(example)


def check_written(example):
    written = jax.export.export(jax.jit(lambda x: x))(example).serialize()
    again = jax.export.deserialize(written)
    assert (again.in_tree, again.out_tree) == (jax.tree.structure(((example,), {})), jax.tree.structure(example))
    assert_same(again.call(example), jax.jit(lambda x: x)(example))


def test_every_public_class_has_an_example():
    classes = {type(example) for example in examples()}
    assert {DenseNeighbors, SignedDistance} <= classes
    public = {getattr(module, name) for module in (jfrnn, distributed) for name in module.__all__}
    assert {kind for kind in public if isinstance(kind, type)} <= classes


def test_lists_that_came_back_are_used_on():
    nbrs = pickle.loads(pickle.dumps(examples()[3]))
    assert_same(nbrs.update(X), examples()[3].update(X))
    particles, spread = pickle.loads(pickle.dumps((examples()[11], examples()[14])))
    again, _ = spread.update(particles)
    np.testing.assert_array_equal(distributed.collect(again)[0], X)


def test_a_process_pool_hears_of_an_overflow():
    short = jfrnn.search(X, 0.3, capacity=2, backend="warp")
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert pool.submit(jfrnn.NeighborList.check, examples()[2]).result(timeout=300) is None
        with pytest.raises(jfrnn.NeighborOverflowError, match="capacity=2 is too small") as raised:
            pool.submit(jfrnn.NeighborList.check, short).result(timeout=300)
    assert (raised.value.required, raised.value.capacity) == (int(short.required), 2)
