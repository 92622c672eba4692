"""Skin, update, growth and inactive particles: after any motion the masked list holds exactly the oracle's pairs."""

from fractions import Fraction
from itertools import product

import by_numpy
import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slow, slowly, sparing
from hypothesis import given, settings
from hypothesis import strategies as st

import jfrnn
from jfrnn._search.problem import list_radius

CUTOFF, SKIN = 0.3, 0.1


update = jax.jit(jfrnn.NeighborList.update)
distances = jax.jit(jfrnn.NeighborList.distances)


def masked_pairs(nbrs, x, **options):
    """Return the pairs of a list within the true cutoff at these positions."""
    assert not nbrs.overflow
    return checked.slots_as_set(nbrs.idx, distances(nbrs, x, **options)[1])


def points(n, dim, dtype, seed=0):
    return jnp.asarray(np.random.default_rng(seed).random((n, dim)), dtype)


@given(st.floats(2**-10, 2**10, width=32), st.floats(2**-10, 2**10, width=32))
def test_radius_of_the_list_is_the_exact_sum_rounded_up(cutoff, skin):
    for dtype in (np.dtype(np.float32), np.dtype(np.float64)):
        radius = dtype.type(list_radius(cutoff, skin, dtype))
        exact = Fraction(cutoff) + Fraction(skin)
        assert Fraction(float(np.nextafter(radius, dtype.type(0)))) < exact <= Fraction(float(radius))


# the array engines take seconds to compile, and one of them is the other's twin
WARP = [("warp", dtype, dim) for dtype in (np.float32, np.float64) for dim in (2, 3)]
EACH = [WARP[1], WARP[2], ("hashgrid", np.float32, 2), ("hashgrid", np.float64, 3), ("jax", np.float32, 3)]
MORE = [WARP[0], WARP[3], ("hashgrid", np.float32, 3), ("hashgrid", np.float64, 2), ("brute", np.float32, 2)]
EACH += [slow(*more) for more in MORE]


@pytest.mark.parametrize(("backend", "dtype", "dim"), EACH)
def test_a_list_with_a_skin_holds_the_wider_pairs_and_masks_to_the_cutoff(backend, dtype, dim):
    x = points(80, dim, dtype)
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, capacity=80, backend=backend)
    wide = list_radius(float(dtype(CUTOFF)), float(dtype(SKIN)), np.dtype(dtype))
    found = set(reference.pairs_of(np.asarray(nbrs.idx), np.asarray(nbrs.count), 80))
    assert found == reference.reference_pairs(np.asarray(x), wide)
    assert masked_pairs(nbrs, x) == reference.reference_pairs(np.asarray(x), CUTOFF)


@pytest.mark.parametrize(("ulps", "rebuilds"), [(-40, 0), (0, 1), (1, 1)])
@pytest.mark.parametrize(("backend", "dtype", "dim"), [*WARP, slow("jax", np.float32, 3)])
def test_half_the_skin_is_as_far_as_a_point_may_go(ulps, rebuilds, backend, dtype, dim):
    """Two points come closer by almost the whole skin: their pair must be in the old list, or the list be made anew."""
    half = np.float64(dtype(SKIN)) / 2
    step = dtype(half + ulps * np.spacing(dtype(half)))
    start = np.zeros((2, dim), dtype)
    start[1, 0] = dtype(CUTOFF) + dtype(SKIN) - 2 * np.spacing(dtype(CUTOFF))
    nbrs = jfrnn.search(jnp.asarray(start), CUTOFF, skin=SKIN, capacity=4, backend=backend)
    moved = start.copy()
    moved[0, 0] += step
    moved[1, 0] -= step
    after = nbrs.update(jnp.asarray(moved))
    assert int(after.rebuild_count) == rebuilds
    assert masked_pairs(after, jnp.asarray(moved)) == reference.reference_pairs(moved, CUTOFF)


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 0.499, 0.5, 0.51, 2.0]), st.integers(-3, 3))
def test_adversarial_motion_misses_no_pair(backend, seed, part, ulps):
    """Every point moves by about the same length straight at another one."""
    random = np.random.default_rng(seed)
    x = random.random((64, 3)).astype(np.float32)
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, capacity=64, backend=backend)
    for _ in range(3):
        towards = x[random.permutation(64)] - x
        length = np.linalg.norm(towards, axis=1, keepdims=True)
        step = np.float32(part * SKIN)
        step = step + np.float32(ulps) * np.spacing(step)
        x = (x + step * towards / np.where(length > 0, length, 1)).astype(np.float32)
        nbrs = update(nbrs, jnp.asarray(x))
        assert masked_pairs(nbrs, jnp.asarray(x)) == reference.reference_pairs(x, CUTOFF)


def test_teleports_and_points_that_vanish(dtype, dim):
    x = np.asarray(points(50, dim, dtype)).copy()
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, capacity=64)
    for name, value, status in (
        ("far away", 1e6, jfrnn.Status.OK),
        ("back", 0.5, jfrnn.Status.OK),
        ("not a number", np.nan, jfrnn.Status.NONFINITE),
        ("and again", np.nan, jfrnn.Status.NONFINITE),
        ("here again", 0.5, jfrnn.Status.NONFINITE),  # sticky
    ):
        x[7] = value
        before = int(nbrs.rebuild_count)
        nbrs = update(nbrs, jnp.asarray(x))
        assert int(nbrs.rebuild_count) == before + (name != "and again"), name
        assert jfrnn.Status(int(nbrs.status)) == status, name
        assert masked_pairs(nbrs, jnp.asarray(x)) == reference.reference_pairs(x, CUTOFF), name


@pytest.mark.parametrize(("dtype", "dim"), [(np.float32, 3), (np.float64, 2), *slowly((np.float32, 2), (np.float64, 3))])
def test_queries_move_too(dtype, dim):
    x, q = np.asarray(points(60, dim, dtype)), np.asarray(points(9, dim, dtype, 1))
    nbrs = jfrnn.search(x, CUTOFF, queries=q, skin=SKIN, capacity=64)
    near, far = q + dtype(SKIN / 4), q + np.where(np.arange(9) == 3, dtype(SKIN), 0)[:, None]
    assert int(nbrs.update(x, queries=near).rebuild_count) == 0
    after = nbrs.update(x, queries=far)
    assert int(after.rebuild_count) == 1
    expected = reference.reference_pairs(np.asarray(x), CUTOFF, queries=np.asarray(far))
    assert masked_pairs(after, x, queries=far) == expected


OPTIONS = [*product([{}, {"half": True}, {"include_self": True}, {"closed": True}], ["warp", "hashgrid"])]
OPTIONS += [({"half": True, "closed": True}, "jax"), slow({"half": True, "closed": True}, "brute")]


@pytest.mark.parametrize(("options", "backend"), OPTIONS, ids=str)
def test_without_a_skin_update_is_a_search(options, backend):
    x, moved = points(60, 2, np.float32), points(60, 2, np.float32, 1)
    nbrs = jfrnn.search(x, CUTOFF, capacity=64, backend=backend, **options)
    assert nbrs.verlet is None
    with pytest.raises(ValueError, match="made without a skin"):
        _ = nbrs.rebuild_count
    after = nbrs.update(moved)
    assert jax.tree.structure(after) == jax.tree.structure(nbrs)
    expected = jfrnn.search(moved, CUTOFF, capacity=64, backend=backend, **options)
    for one, other in zip(jax.tree.leaves(after), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("backend", [slow("jax"), "warp"])
def test_in_a_scan_it_rebuilds_as_often_as_needed_and_traces_once(backend):
    x = points(80, 3, np.float32)
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, capacity=80, backend=backend)
    traces = []

    @jax.jit
    def run(x, nbrs, velocity):
        traces.append(None)

        def step(carry, _):
            x, nbrs = carry
            x = x + velocity
            nbrs = nbrs.update(x)
            distance, mask = nbrs.distances(x)
            return (x, nbrs), (mask.sum(), distance.sum())

        return jax.lax.scan(step, (x, nbrs), None, length=20)

    exact = len(reference.reference_pairs(np.asarray(x), CUTOFF))
    for velocity, rebuilds in ((0.0, 0), (0.011 / 3**0.5, 4), (0.06, 20)):  # 0.011 per step: every fifth passes 0.05
        (end, after), (pairs, _) = run(x, nbrs, jnp.float32(velocity))
        assert int(after.rebuild_count) == rebuilds
        assert abs(int(pairs[0]) - exact) <= 4  # all move alike: only what rounding does to pairs at the cutoff
        assert masked_pairs(after, end) == reference.reference_pairs(np.asarray(end), CUTOFF)
    assert len(traces) == 1


def test_overflow_is_sticky_and_grow_knows_what_it_takes():
    x = points(60, 2, np.float32)
    crowd = x * np.float32(0.2)
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN)
    assert not nbrs.overflow
    crowded = nbrs.update(crowd)
    back = crowded.update(x)
    assert crowded.overflow
    assert back.overflow
    assert int(back.required) == int(crowded.required) == 59
    refuses(jfrnn.NeighborOverflowError, "one row has 59 neighbors", back.check)
    grown = back.grow(x)
    assert grown.capacity >= 59
    assert not grown.overflow
    assert grown.grow(x).capacity == grown.capacity
    assert masked_pairs(grown.update(crowd), crowd) == reference.reference_pairs(np.asarray(crowd), CUTOFF)
    with pytest.raises(TypeError, match=r"grow\(\) changes the shape of the list and cannot run inside jax.jit"):
        jax.jit(lambda nbrs, x: nbrs.grow(x))(back, x)


def test_a_chunk_is_replayed_until_its_list_was_large_enough():
    x = points(100, 2, np.float32)
    runs = []

    @jax.jit
    def squeeze(x, nbrs):
        jax.debug.callback(lambda: runs.append(None))

        def step(_, carry):
            x, nbrs = carry
            x = np.float32(0.85) * x
            return x, nbrs.update(x)

        return jax.lax.fori_loop(0, 10, step, (x, nbrs))

    end, nbrs = jfrnn.run_chunk(squeeze, x, jfrnn.search(x, CUTOFF, skin=SKIN), lambda x: x)
    jax.effects_barrier()
    assert len(runs) == 2
    assert masked_pairs(nbrs, end) == reference.reference_pairs(np.asarray(end), CUTOFF)
    once, _ = squeeze(x, nbrs)
    np.testing.assert_array_equal(once, end)
    refuses(TypeError, "jit the chunk, not the loop", jax.jit(lambda x: jfrnn.run_chunk(squeeze, x, nbrs, lambda x: x)[0]), x)
    refuses(TypeError, "nbrs must be a list of jfrnn.search or .*, got int", jfrnn.run_chunk, squeeze, x, 5, lambda x: x)
    refuses(TypeError, "positions must be a function, got int", jfrnn.run_chunk, squeeze, x, nbrs, 5)
    refuses(TypeError, "chunk must return the state and the list", jfrnn.run_chunk, lambda x, nbrs: x, x, nbrs, lambda x: x)
    refuses(ValueError, "slack must be finite and at least 1", jfrnn.run_chunk, squeeze, x, nbrs, lambda x: x, slack=0.1)


@pytest.mark.parametrize(
    ("backend", "dim"), sparing(product(("warp", "hashgrid", "jax", "brute"), (2, 3)), [("warp", 3), ("hashgrid", 2)])
)
def test_inactive_particles_have_no_neighbors_and_come_and_go(backend, dim):
    x = np.asarray(points(60, dim, np.float32)).copy()
    active = np.arange(60) < 40
    x[50:] = np.nan
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, active=active, capacity=64, backend=backend)
    np.testing.assert_array_equal(nbrs.count, jfrnn.search(x[:40], CUTOFF, skin=SKIN).count.tolist() + [0] * 20)
    assert masked_pairs(nbrs, jnp.asarray(x)) == reference.reference_pairs(x[:40], CUTOFF)
    counted = jfrnn.count(x, CUTOFF, active=active, backend=backend)
    np.testing.assert_array_equal(counted[:40], jfrnn.count(x[:40], CUTOFF, backend=backend))
    nbrs.check()
    assert int(nbrs.update(x, active=active).rebuild_count) == 0
    more = np.arange(60) < 45
    nbrs = nbrs.update(x, active=more)
    assert int(nbrs.rebuild_count) == 1
    assert masked_pairs(nbrs, jnp.asarray(x)) == reference.reference_pairs(x[:45], CUTOFF)
    nbrs.check()
    refuses(ValueError, "non-finite", nbrs.update(x, active=np.arange(60) < 51).check)


@pytest.mark.parametrize("box", [None, jfrnn.Box([1.0, 1.0])], ids=["open", "box"])
def test_derivatives_in_a_list_are_none(box):
    """Who differentiates a state that holds a list gets those of the positions."""
    x = jnp.asarray(np.random.default_rng(4).random((9, 2)))
    nbrs = jfrnn.search(x, 0.4, skin=0.05, box=box)

    def work(x, nbrs):
        def step(state, _):
            x, nbrs = state[0], state[1].update(state[0])
            return (x - 0.01 * jax.grad(lambda x: nbrs.distances(x)[0].sum())(x), nbrs), None

        return (jax.lax.scan(step, (x, nbrs), None, length=3)[0][0] ** 2).sum()

    both = jax.jit(jax.grad(work, argnums=(0, 1), allow_int=True))(x, nbrs)
    np.testing.assert_allclose(both[0], jax.grad(work)(x, nbrs), rtol=1e-12)
    assert all(g.dtype == jax.dtypes.float0 or not g.any() for g in jax.tree.leaves(both[1]))
    jax.vjp(lambda x, nbrs: nbrs.update(x).distances(x)[0].sum(), x, nbrs)


def test_gradients_flow_around_updates():
    x = np.random.default_rng(0).random((30, 2))

    def energy(x, wait):
        nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, capacity=40, backend="brute")

        def step(carry, _):
            x, nbrs = carry
            x = x * (1 - wait)
            nbrs = nbrs.update(x)
            distance, mask = nbrs.distances(x)
            return (x, nbrs), jnp.where(mask, (CUTOFF - distance) ** 2, 0).sum()

        return jax.lax.scan(step, (x, nbrs), None, length=3)[1].sum()

    gradient, expected = jax.jit(jax.grad(energy))(x, 0.02), np.zeros(x.shape)
    for factor in 0.98 ** np.arange(1, 4):
        pairs = by_numpy.in_order(reference.reference_pairs(x * factor, CUTOFF), 2)
        r = by_numpy.vectors_of(pairs, x * factor, x * factor)
        apart = np.linalg.norm(r, axis=1)[:, None]
        expected += factor * by_numpy.pull(pairs, -2 * (CUTOFF - apart) * r / apart, x)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9, atol=1e-12)


def test_refusals(dim):
    x = points(10, dim, np.float32)
    refuses(ValueError, r"skin=-0.1 must be 0 \(no skin\) or between", jfrnn.search, x, CUTOFF, skin=-0.1)
    refuses(ValueError, "skin=nan must be 0", jfrnn.search, x, CUTOFF, skin=float("nan"))
    refuses(TypeError, "skin must be a number known while tracing, got str 'wide'", jfrnn.search, x, CUTOFF, skin="wide")
    with pytest.raises(TypeError, match="skin must be a number known while tracing, got a traced value"):
        jax.jit(lambda s: jfrnn.search(x, CUTOFF, skin=s, capacity=4))(0.1)
    with pytest.raises(TypeError, match=r"active must be an array of bool, one per particle, got int64 of shape \[10\]"):
        jfrnn.search(x, CUTOFF, active=np.ones(10, np.int64))
    with pytest.raises(ValueError, match=r"active must have shape \[10\], one bool per particle, got shape \[9\]"):
        jfrnn.search(x, CUTOFF, active=np.ones(9, bool))
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN)
    refuses(ValueError, "this list was made without active: leave active out", nbrs.update, x, active=np.ones(10, bool))
    refuses(ValueError, "this list was made with active: pass active=", jfrnn.search(x, CUTOFF, active=np.ones(10, bool)).update, x)
