"""What programs for CUDA carry of calls is read as it is beside a GPU: each array has a name, and plans are made of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jfrnn
from jfrnn._engine import launch
from jfrnn._engine.plans import Clear, Launch

N, CUTOFF = 5000, 0.1  # more than all of which meet
X = np.random.default_rng(0).random((N, 3)).astype(np.float32)
RADII, SPECIES = np.full(N, CUTOFF, np.float32), np.arange(N, dtype=np.int32) % 2
FACES = np.array([[0, 1, 2], [1, 2, 3]], np.int32)
OPTIONS = {
    "plain": {},
    "queries": {"queries": X[:700] + np.float32(0.01)},
    "half": {"half": True},
    "excluded": {"exclude": np.array([[0, 1], [2, 3]])},
    "active": {"active": np.arange(N) < 4000},
    "batch": {"batch": np.arange(N, dtype=np.int32) // 100},
    "box": {"box": jfrnn.Box([1.0, 1.0, 1.0])},
    "skewed": {"box": jfrnn.Box(np.eye(3) + np.diag([0.3, 0.3], 1))},
    "images": {"box": jfrnn.Box([1.0, 1.0, 1.0], images=1)},
    "boxes": {"box": jfrnn.Box(np.ones((50, 3)), per_system=True), "batch": np.arange(N, dtype=np.int32) // 100},
    **{rule: {"cutoff": RADII, "radius_rule": rule} for rule in ("gather", "scatter", "either", "both", "mean")},
    "gather in a box": {"cutoff": RADII, "box": jfrnn.Box([1.0, 1.0, 1.0])},
    "gather in a batch": {"cutoff": RADII, "batch": np.arange(N, dtype=np.int32) // 100},
    "species": {"cutoff": np.array([[0.1, 0.05], [0.05, 0.1]], np.float32), "species": SPECIES},
}


def listed(x, cutoff=CUTOFF, **more):
    return jfrnn.search(x, cutoff, capacity=64, backend="warp", **more).idx


def counted(x, cutoff=CUTOFF, **more):
    return jfrnn.count(x, cutoff, backend="warp", **more)


def in_edges(x, cutoff=CUTOFF, **more):
    return jfrnn.search_edges(x, cutoff, total=40 * N, backend="warp", **more).senders


def summed(x, cutoff=CUTOFF, reduce="sum", half=False, **more):
    return jfrnn.pair_sum(lambda r, i, j: jnp.exp(-r @ r), x, cutoff, backend="warp", reduce=reduce, **more)


def slopes(x, **more):
    return jax.grad(lambda x: summed(x, **more).sum())(x)


def largest(x, **more):
    return summed(x, reduce="max", **more)


def kept(x, half=False, **more):
    """Return what a list gives at other positions: its mask, distances with their gradient, and a sum with its."""
    given = {"cutoff": CUTOFF} | more
    nbrs = jfrnn.search(x, capacity=64, backend="warp", reverse="queries" not in more, **given)
    where = {name: more[name] for name in ("queries", "box") if name in more}
    if "queries" in more:
        return nbrs.distances(x + 0.001, **where)
    total = lambda x: jfrnn.pair_sum(lambda r, i, j: jnp.exp(-r @ r), x, None, neighbors=nbrs, box=more.get("box")).sum()  # noqa: E731
    return jax.grad(total)(x), jax.grad(lambda x: nbrs.distances(x, **where)[0].sum())(x)


def of_walls(x):
    tri = jfrnn.search_triangles(x, X[:4], FACES, CUTOFF, capacity=4, backend="warp")
    return tri.idx, tri.closest(x)


WAYS = {"list": listed, "counts": counted, "edges": in_edges, "sum": summed, "slopes": slopes, "largest": largest, "kept": kept}
LEFT_OUT = {("slopes", "queries"), ("kept", "half"), ("kept", "active"), ("kept", "excluded"), ("kept", "batch"), ("kept", "boxes")}


def each_way():
    """Yield all ways and options, of which a part runs by default: all options with a sum, all ways with few options."""
    for way in WAYS:
        for name in OPTIONS:
            symmetric = name not in ("queries", "gather", "scatter", "gather in a box", "gather in a batch")
            if (way, name) in LEFT_OUT or (way == "kept" and not symmetric) or (way == "edges" and name == "half"):
                continue
            often = way == "sum" or name in ("plain", "box", "gather", "species")
            yield pytest.param(way, name, marks=[] if often else pytest.mark.slow)


def calls_of(fn, *given):
    """Return what a program for CUDA calls by native code, by name and recipe."""
    found, module = {}, jax.jit(fn).trace(*given).lower(lowering_platforms=("cuda",)).compiler_ir()

    def visit(op):
        attributes = op.attributes
        if "mhlo.backend_config" in attributes and "kernel" in attributes["mhlo.backend_config"]:
            config = attributes["mhlo.backend_config"]
            found[config["kernel"].value] = config["recipe"].value
        for region in op.regions:
            for block in region:
                for inner in block:
                    visit(inner.operation)

    visit(module.operation)
    return found


def assert_planned(calls):
    assert calls
    for name, recipe in calls.items():
        call, shapes = launch._read_call(name, recipe)
        plan = call.plan(shapes, 132)
        launches = [step for step in plan.steps if isinstance(step, Launch)]
        assert launches and all(step.kernel.program.cuda and step.threads >= 0 for step in launches), name
        assert all(step.array in shapes for step in plan.steps if isinstance(step, Clear)), name


@pytest.mark.parametrize(("way", "name"), list(each_way()))
def test_calls_are_read_and_planned(way, name):
    assert_planned(calls_of(lambda x: WAYS[way](x, **OPTIONS[name]), X))


def test_calls_of_walls_and_of_few_are_read_and_planned():
    assert_planned(calls_of(of_walls, X))
    for way in WAYS.values():
        assert_planned(calls_of(way, X[:100]))


@pytest.mark.skipif(jax.default_backend() != "gpu", reason="only on CUDA launches of a loop are recorded")
@pytest.mark.parametrize(("way", "name"), list(each_way()))
def test_on_a_gpu_a_loop_finds_what_single_calls_find(way, name):
    """Arrays of a loop stay where they are, so that its launches are recorded; results of single calls are held, and do not."""
    xs = jnp.asarray(X + np.random.default_rng(1).normal(scale=0.01, size=(12, *X.shape)).astype(np.float32))
    call = lambda x: WAYS[way](x, **OPTIONS[name])  # noqa: E731
    single = list(map(jax.jit(call), xs))
    _, looped = jax.jit(lambda xs: jax.lax.scan(lambda k, x: (k, call(x)), 0, xs))(xs)
    for k, each in enumerate(single):
        of_loop = jax.tree.map(lambda leaf, k=k: leaf[k], looped)
        jax.tree.map(lambda ours, its: np.testing.assert_allclose(ours, its, rtol=1e-5, atol=1e-6), of_loop, each)
