"""Checks of `jfrnn.distributed` on 8 virtual CPU devices, in a process of their own: `python tests/distributed_checks.py NAME...`.

Prints a line of JSON for each: its name, and what was wrong, or null. The oracle is the search on one device, which other tests
compare with rational arithmetic.
"""

import dataclasses
import functools
import os
import sys
import warnings

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"

import jax
import jax.numpy as jnp
import numpy as np
import soon
from children import check, main

import jfrnn
from jfrnn import distributed

soon.compile_soon()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


def mesh_of(*shape):
    return jax.make_mesh(shape, ("a", "b", "c")[: len(shape)], devices=jax.devices()[: int(np.prod(shape))])


def pairs_of_one(x, radius, backend="warp", **options):
    i, j = jfrnn.search(jnp.asarray(x), radius, backend=backend, **options).pairs()
    order = np.lexsort((j, i))
    return i[order], j[order]


def same_pairs(nbrs, x, **asked):
    for ours, theirs in zip(nbrs.pairs(), pairs_of_one(x, **asked), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def whole(particles, x):
    """No particle was lost or doubled, and none changed."""
    ids = np.asarray(particles.ids)
    assert sorted(ids[ids >= 0]) == list(range(len(x)))
    np.testing.assert_array_equal(distributed.collect(particles)[0], x)


def by_id(rows, particles):
    ids = np.asarray(particles.ids)
    out = np.zeros((particles.total, *rows.shape[1:]), rows.dtype)
    out[ids[ids >= 0]] = np.asarray(rows)[ids >= 0]
    return out


def per_shard(particles):
    return np.asarray(particles.active).reshape(particles.mesh.devices.size, -1).sum(axis=1)


def found(x, radius, shape, *, box=None, along=None, backend="warp", capacity=None, skin=0.0, **options):
    """Spread, search, and compare with one device."""
    particles = distributed.scatter(x, radius, mesh=mesh_of(*shape), box=box, along=along, skin=skin)
    whole(particles, x)
    nbrs = distributed.search(particles, radius, backend=backend, capacity=capacity, skin=skin, **options)
    same_pairs(nbrs, x, radius=radius, box=box, backend=backend, skin=skin, **options)
    return particles, nbrs


def uneven(rng, n, dim, dtype):
    """Two blobs far apart, a lattice with ties at the cutoff 0.5, coincident points."""
    blob = rng.normal(0, 0.4, (n // 2, dim))
    lattice = 6 + 0.25 * rng.integers(0, 6, (n - n // 2, dim))
    return np.concatenate([blob, lattice]).astype(dtype)


def pairs_on(*numbers):
    x = uneven(np.random.default_rng(1), 160, 3, np.float32)
    for shards in numbers:
        particles, _ = found(x, 0.5, (shards,), capacity=96)
        assert per_shard(particles).sum() == len(x)


@check
def pairs_on_8_devices():
    pairs_on(8)


@check
def pairs_on_1_and_2_and_4_devices():
    pairs_on(1, 2, 4)


@check
def pairs_on_a_mesh_of_three_axes_in_a_box():
    rng = np.random.default_rng(2)
    x = rng.uniform(-2.5, 4.5, (200, 3))  # outside of the box, by up to two of its lengths
    box = jfrnn.Box([1.5, 1.25, 2.0], periodic=(True, True, False), origin=(0.25, -0.5, 0.0))
    particles, _ = found(x, 0.4, (2, 2, 2), box=box, along=(0, 1, 2), capacity=48)
    assert per_shard(particles).max() == len(x) // 8


@check
def cutoffs_wider_than_a_box_have_many_images():
    x = np.random.default_rng(3).uniform(0, 1, (24, 2)).astype(np.float32)
    found(x, 0.8, (4,), box=jfrnn.Box([1.0, 1.0]), along=(1,), capacity=96, closed=True, include_self=True)


@check
def particles_at_bounds_and_ties():
    rng = np.random.default_rng(4)
    x = 0.25 * rng.integers(-4, 5, (200, 2)).astype(np.float32)  # distances that equal the cutoff, bounds on lattice planes
    found(x, 0.75, (4, 2), capacity=96, closed=True)
    assert len(np.unique(x, axis=0)) < len(x)
    for name, (shape, size) in {"one place": ((8,), 40), "nothing": ((2,), 0)}.items():
        same = np.full((size, 2), 3.5, np.float32)
        _, nbrs = found(same, 0.1, shape, capacity=40)
        assert int(nbrs.count.sum()) == size * (size - 1), name


@check
def particles_move_across_several_shards():
    rng = np.random.default_rng(5)
    x = rng.uniform(0, 8, (160, 2))
    particles = distributed.scatter(x, 0.5, {"name": np.arange(160), "flag": x[:, 0] > 4}, mesh=mesh_of(8), along=(0,))
    for now in (8 - x, x % 1.0, np.where(x > 4, x + 1e6, x), np.full_like(x, 2.0)):
        moved = particles.replace(positions=jnp.asarray(now)[np.maximum(np.asarray(particles.ids), 0)])
        same_pairs(distributed.search(roomy(moved), 0.5, capacity=160, backend="warp"), now, radius=0.5)  # on the old shards
        settled = distributed.migrate(roomy(moved))
        whole(settled, now)
        _, values = distributed.collect(settled)
        np.testing.assert_array_equal(values["name"], np.arange(160))
        np.testing.assert_array_equal(values["flag"], x[:, 0] > 4)
        if len(np.unique(now[:, 0])) == len(now):
            assert per_shard(settled).max() == 20
            assert settled.bounds[0].shape == (7,)


def roomy(particles):
    """Return particles with room for a halo of all others, and for all on one shard."""
    sizes = distributed.Sizes(particles.total, (particles.total,) * len(particles.along), (7,) * len(particles.along))
    from jfrnn._shards.particles import resize

    return resize(particles, sizes)


@check
def room_that_is_missing_is_told_and_made():
    x = np.random.default_rng(6).uniform(0, 8, (160, 2))
    particles = distributed.scatter(x, 0.5, mesh=mesh_of(4), along=(0,), slack=1.0)
    near = particles.replace(positions=particles.positions * 0.01)  # all within reach of each other, on four shards
    nbrs = distributed.search(near, 0.5, capacity=160, backend="warp")
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.HALO_OVERFLOW | jfrnn.Status.HALO_TOO_FAR
    assert bool(nbrs.overflow)
    assert nbrs.required.hops.tolist() == [3]
    assert nbrs.required.halo.tolist() == [40]
    raises(RuntimeError, "hops", nbrs.check)
    sums = distributed.pair_sum(weight, near, 0.5, backend="warp")
    assert bool(jnp.isnan(sums).all())
    raises(RuntimeError, "hops", lambda: distributed.pair_sum(weight, near, None, neighbors=nbrs))
    short = distributed.search(particles, 0.5, capacity=1, backend="warp")
    over_a_list = jax.jit(lambda particles, nbrs: distributed.pair_sum(weight, particles, None, neighbors=nbrs))
    assert bool(jnp.isnan(over_a_list(particles, short)[particles.active]).all())
    assert int(distributed.count(near, 0.5, backend="warp").max()) == np.iinfo(np.int32).min
    grown = near.grow(nbrs)
    same_pairs(distributed.search(grown, 0.5, capacity=160, backend="warp"), x * 0.01, radius=0.5)
    rows = distributed.search(grown, 0.5, capacity=8, backend="warp")
    assert jfrnn.Status(int(rows.status)) == jfrnn.Status.ROW_OVERFLOW
    assert int(rows.required.row) == 159
    raises(RuntimeError, "row 159", rows.check)
    same_pairs(rows.grow(grown), x * 0.01, radius=0.5)
    together = grown.replace(positions=grown.positions * 0)
    settled = distributed.migrate(together)
    assert jfrnn.Status(int(settled.status)) == jfrnn.Status.SHARD_OVERFLOW
    assert int(settled.required.particles) == 160
    whole(settled, x * 0)
    settled = distributed.migrate(together.grow(settled))
    assert int(settled.status) == 0
    assert sorted(per_shard(settled)) == [0, 0, 0, 160]


@check
def what_is_missing_anywhere_is_told():
    """By a bit that one shard alone sets, across a periodic face, and until buffers have grown."""
    k = np.arange(16)
    x = np.stack([0.25 + 0.5 * k, 2.0 * (k % 4)], axis=1)
    x[12:] = [[7.0, 1.0], [7.1, 1.0], [7.2, 1.0], [7.9, 0.0]]  # three near each other, and one near the first
    box = jfrnn.Box([8.0, 8.0])
    particles = distributed.scatter(x, 0.5, mesh=mesh_of(4), box=box, along=(0,), skin=0.1)
    raises(ValueError, "reach", distributed.search, particles, 0.5, skin=0.2)
    full = distributed.search(particles, 0.5, skin=0.1, capacity=1, backend="warp")
    np.testing.assert_array_equal(by_id(full.count, particles), [1] + [0] * 11 + [2] * 3 + [1])
    assert jfrnn.Status(int(full.status)) == jfrnn.Status.ROW_OVERFLOW  # on the last shard
    ids = np.maximum(np.asarray(particles.ids), 0)
    apart = particles.replace(positions=jnp.asarray(np.where(k[:, None] > 11, [[5.0, 5.0]] + 0.7 * k[:, None] % 3, x))[ids])
    settled, kept = full.update(apart)
    assert int(kept.rebuild_count[0]) == 1
    assert jfrnn.Status(int(kept.status)) == jfrnn.Status.ROW_OVERFLOW
    assert int(kept.required.row) == 2
    again = kept.update(settled)[1]
    assert int(again.rebuild_count[0]) == 1
    swapped = np.asarray(settled.ids).copy()
    swapped[[0, 1]] = swapped[[1, 0]]
    others = dataclasses.replace(settled, ids=jax.device_put(swapped, settled.ids.sharding))
    assert int(kept.update(others)[1].rebuild_count[0]) == 2  # rows of others
    crowded = distributed.migrate(particles.replace(positions=particles.positions * 0))
    assert jfrnn.Status.SHARD_OVERFLOW in jfrnn.Status(int(crowded.status))
    back = distributed.migrate(crowded.replace(positions=particles.positions))
    assert jfrnn.Status.SHARD_OVERFLOW in jfrnn.Status(int(back.status))
    assert int(back.required.particles) == 16
    raises(RuntimeError, f"halo {[*back.sizes.halo]}, hops {[*back.sizes.hops]}: grow()", back.check)
    x[1] = [5.0, 3.0]  # from the region of the first shard into that of the third
    far = particles.replace(positions=jnp.asarray(x)[ids])
    halo = distributed.halo(far)
    assert jfrnn.Status(int(halo.status)) == jfrnn.Status.HALO_TOO_FAR
    assert halo.required.hops.tolist() == [2]
    for given in (halo, None):
        assert int(distributed.count(far, 0.5, halo=given, backend="warp").max()) == np.iinfo(np.int32).min
    x[1] = [5.0, np.nan]  # nobody's neighbor, wherever it is
    assert int(distributed.halo(particles.replace(positions=jnp.asarray(x)[ids])).status) == 0


@check
def one_function_in_two_boxes_on_two_meshes():
    """What is traced for a mesh is asked for again, to be translated for other periodic axes, on another one."""

    def pulled(r, i, j):
        return jnp.exp(-3 * jnp.sum(r * r)) * j

    x = np.random.default_rng(3).uniform(0, 4, (40, 2)).astype(np.float32)
    for shape, periodic in (((1, 2), (True, False)), ((2,), (False, True))):
        box = jfrnn.Box([4.0, 4.0], periodic=periodic)
        particles = distributed.scatter(x, 0.8, x[:, 0], mesh=mesh_of(*shape), box=box)
        found = distributed.pair_sum(pulled, particles, 0.8, particles.values, backend="warp")
        alone = jfrnn.pair_sum(pulled, jnp.asarray(x), 0.8, jnp.asarray(x[:, 0]), box=box, backend="warp")
        np.testing.assert_allclose(by_id(found, particles), alone, rtol=1e-5)


@check
def counts_beside_cuts_that_differ_and_of_strays():
    """Two slabs whose cuts lie far apart, so that ghosts go round a corner, and particles on shards far from where they are."""
    rng, k = np.random.default_rng(13), np.arange(8)
    left = np.stack([np.full(8, 3.8), np.where(k < 4, 4 + 0.4 * k, 4.5 + 0.4 * k)], axis=1)
    right = np.stack([np.full(8, 4.2), np.where(k < 4, 0.3 * k, 2.4 + 0.4 * k)], axis=1)
    corner, box = np.concatenate([left, right]), jfrnn.Box([8.0, 8.0])
    strays = [
        np.where([True, False], rng.uniform(0, 8, (16, 2)), rng.uniform(0, 0.4, (16, 2)))[:, turn] for turn in ([0, 1], [1, 0]) * 2
    ]
    counted = jax.jit(lambda particles: distributed.count(particles, 0.5, backend="warp"))
    for first in (corner, 8 - corner):
        particles = roomy(distributed.scatter(first, 0.5, mesh=mesh_of(2, 2), box=box, along=(0, 1)))
        for x in (first, *strays):
            moved = particles.replace(positions=jnp.asarray(x)[np.maximum(np.asarray(particles.ids), 0)])
            expected = jfrnn.count(jnp.asarray(x), 0.5, box=box, backend="warp")
            np.testing.assert_array_equal(by_id(counted(moved), particles), expected)
            assert int(expected.sum()) > 10


@check
def particles_that_do_not_fill_a_round_of_migration():
    """Three go to the other shard, by twos."""
    x = np.linspace(0, 8, 150)[:, None] * np.array([1.0, 0.25])
    x[[0, 1, 2, 147, 148, 149]] = x[[147, 148, 149, 0, 1, 2]]
    particles = distributed.scatter(x, 0.1, mesh=mesh_of(2))
    whole(particles, x)
    assert list(per_shard(particles)) == [75, 75]


def raises(kind, words, fn, *args, **kwargs):
    try:
        fn(*args, **kwargs)
    except kind as error:
        assert words in str(error), error
    else:
        raise AssertionError(f"no {kind.__name__}")


def weight(r, i, j):
    return jnp.maximum(1 - r @ r / 0.25, 0.0) ** 3


def density(h, r, i, j):
    return {"rho": j["m"] * jnp.maximum(1 - r @ r / h**2, 0.0) ** 3, "pull": (i["m"] - j["m"]) * r}


@check
def sums_and_their_gradients(listed=False):
    rng = np.random.default_rng(7)
    x, m, box = rng.uniform(0, 1, (60, 2)), rng.uniform(1, 2, 60), jfrnn.Box([1.0, 1.0], periodic=(True, False))
    particles = distributed.scatter(x, 0.3, {"m": m}, mesh=mesh_of(2, 2), skin=0.05, box=box)
    probe = rng.normal(0, 1, (60, 2))
    nbrs = distributed.search(particles, 0.3, skin=0.05, backend="warp") if listed else None
    halo = distributed.halo(particles)

    def scalar(sums, probe):
        return (sums["rho"] ** 2).sum() + (sums["pull"] * probe).sum()

    def on_one(x, m, h):
        return scalar(jfrnn.pair_sum(functools.partial(density, h), x, 0.3, {"m": m}, box=box, backend="warp"), jnp.asarray(probe))

    mine = jnp.asarray(probe)[np.maximum(np.asarray(particles.ids), 0)]

    def on_many(x, m, h, **given):
        at = particles.replace(positions=x)
        cutoff, given = (None, given) if "neighbors" in given else (0.3, given | {"backend": "warp"})
        return scalar(distributed.pair_sum(functools.partial(density, h), at, cutoff, {"m": m}, **given), mine)

    h = jnp.asarray(0.3)
    value, expected = jax.jit(jax.value_and_grad(on_one, (0, 1, 2)))(jnp.asarray(x), jnp.asarray(m), h)
    slopes = []
    for given in ({"halo": halo}, {"neighbors": nbrs})[: 2 if listed else 1]:
        many = jax.jit(jax.value_and_grad(functools.partial(on_many, **given), (0, 1, 2)))
        ours, (by_x, by_m, by_h) = many(particles.positions, particles.values["m"], h)
        np.testing.assert_allclose(ours, value, rtol=1e-12)
        np.testing.assert_allclose(by_id(by_x, particles), expected[0], rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(by_id(by_m, particles), expected[1], rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(by_h, expected[2], rtol=1e-10)
        slopes.append(by_x)
    step, towards = 1e-6, jnp.asarray(rng.normal(0, 1, particles.positions.shape))
    ends = [on_many(particles.positions + s * towards, particles.values["m"], h, halo=halo) for s in (step, -step)]
    np.testing.assert_allclose((ends[0] - ends[1]) / (2 * step), (slopes[0] * towards).sum(), rtol=1e-6)


@check
def sums_of_what_lies_on_the_mesh():
    """What fn closes over is spread already: JAX puts a reshard before it."""
    x = np.random.default_rng(11).uniform(0, 1, (40, 2))
    particles = distributed.scatter(x, 0.3, mesh=mesh_of(2))
    everywhere = jax.sharding.NamedSharding(particles.mesh, jax.sharding.PartitionSpec())
    h = jax.jit(lambda h: 2 * h, out_shardings=everywhere)(jnp.asarray(0.15))

    def near(h, r, i, j):
        return jnp.where(r @ r < h**2, (h - jnp.sqrt(r @ r + 0.01)) ** 2, 0)

    def on_many(particles, h):
        return distributed.pair_sum(functools.partial(near, h), particles, 0.3, backend="warp").sum()

    def on_one(h):
        return jfrnn.pair_sum(functools.partial(near, h), jnp.asarray(x), 0.3, backend="warp").sum()

    ours = jax.jit(jax.value_and_grad(on_many, 1))(particles, h)
    np.testing.assert_allclose(ours, jax.value_and_grad(on_one)(jnp.asarray(0.3)), rtol=1e-12)


@check
def sums_over_lists_and_their_gradients():
    sums_and_their_gradients(listed=True)


@check
def updates_keep_the_list_until_something_moved():
    rng = np.random.default_rng(8)
    x, v = rng.uniform(0, 4, (160, 2)), rng.normal(0, 1, (160, 2))
    particles = distributed.scatter(x, 0.5, {"v": v}, mesh=mesh_of(4), skin=0.1, slack=2.0)
    nbrs = distributed.search(particles, 0.5, skin=0.1, slack=2.0, backend="warp")

    @jax.jit
    def step(particles, nbrs):
        particles = particles.replace(positions=particles.positions + 0.005 * particles.values["v"])
        return nbrs.update(particles)

    made = []
    for k in range(1, 9):
        particles, nbrs = step(particles, nbrs)
        nbrs.check()
        particles.check()
        made.append(int(nbrs.rebuild_count[0]))
        now, values = distributed.collect(particles)
        np.testing.assert_allclose(now, x + 0.005 * k * v, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(values["v"], v)
        sums = distributed.pair_sum(weight, particles, None, neighbors=nbrs)
        expected = jfrnn.pair_sum(weight, jnp.asarray(now), 0.5, backend="warp")
        np.testing.assert_allclose(by_id(sums, particles), expected, rtol=1e-12, atol=1e-12)
    assert 0 < made[-1] < 8, made
    settled = distributed.migrate(particles.replace(positions=4 - particles.positions))
    assert bool(jnp.isnan(distributed.pair_sum(weight, settled, None, neighbors=nbrs)).all())  # rows of others
    _, again = nbrs.update(settled)
    assert int(again.rebuild_count[0]) == made[-1] + 1


@check
def particles_that_are_nowhere_stay():
    x = np.random.default_rng(9).uniform(0, 1, (80, 3)).astype(np.float32)
    x[3], x[50, 1] = np.nan, np.inf
    particles = distributed.scatter(x, 0.3, mesh=mesh_of(4))
    whole(particles, x)
    nbrs = distributed.search(particles, 0.3, capacity=40, backend="warp")
    raises(ValueError, "non-finite", nbrs.check)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE
    expected = jfrnn.search(jnp.asarray(x), 0.3, capacity=40, backend="warp").count
    np.testing.assert_array_equal(by_id(nbrs.count, particles), expected)
    for given in ({"cutoff": 0.3}, {"cutoff": None, "neighbors": nbrs}):
        sums = by_id(distributed.pair_sum(weight, particles, **given), particles)
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(sums)), [3, 50])


@check
def a_list_is_asked_about_what_it_was_made_of():
    x = np.random.default_rng(10).uniform(0, 4, (64, 2))
    here, there = (jax.device_put(x, device) for device in jax.devices()[:2])
    nbrs = jfrnn.search(here, 0.5, capacity=32, backend="warp")
    for ask in (nbrs.update, nbrs.grow, nbrs.vectors, nbrs.distances, nbrs.shifts):
        raises(ValueError, "positions lie on cpu:1, but the list on cpu:0", lambda ask=ask: ask(there))
    raises(ValueError, "move one of them", lambda: jfrnn.pair_sum(weight, there, None, neighbors=nbrs))
    particles = distributed.scatter(x, 0.5, mesh=mesh_of(4))
    spread = distributed.search(particles, 0.5, capacity=32, backend="warp")
    others = {
        "float64, 2D, in open space), got float32": distributed.scatter(x.astype(np.float32), 0.5, mesh=mesh_of(4)),
        "got float64, 2D, box with periodic": distributed.scatter(x, 0.5, mesh=mesh_of(4), box=jfrnn.Box([4.0, 4.0])),
        "particles lie on": distributed.scatter(x, 0.5, mesh=mesh_of(2)),
        "must be what jfrnn.distributed.scatter returns": x,
    }
    for words, other in others.items():
        error = TypeError if other is x else ValueError
        for ask in (spread.update, spread.grow, lambda p: distributed.pair_sum(weight, p, None, neighbors=spread)):
            raises(error, words, lambda ask=ask, other=other: ask(other))
    raises(
        ValueError, "positions must be float64 with 2 columns", lambda: particles.replace(particles.positions.astype(np.float32))
    )
    raises(ValueError, "values must have shape", lambda: particles.replace(values=jnp.zeros(3)))


@check
def walls_that_all_devices_know():
    rng = np.random.default_rng(12)
    x, vertices = rng.uniform(-1, 1, (60, 3)), jnp.asarray(rng.uniform(-1, 1, (5, 3)))
    faces = jnp.asarray([[0, 1, 2], [1, 2, 3], [2, 3, 4]])
    particles = distributed.scatter(x, 0.3, mesh=mesh_of(2))

    def counted(part, vertices, faces):
        there = jnp.where(part.active[:, None], part.positions, 1e3)
        return jfrnn.search_triangles(there, vertices, faces, 0.5, capacity=3, backend="warp").count

    counts = jax.jit(lambda p, *wall: distributed.on_each(counted, p, *wall))(particles, vertices, faces)
    expected = jfrnn.search_triangles(jnp.asarray(x), vertices, faces, 0.5, backend="warp").count
    np.testing.assert_array_equal(by_id(counts, particles), expected)
    assert int(expected.sum()) > 10


@check
def engine_of_arrays():
    x = uneven(np.random.default_rng(10), 60, 2, np.float32)
    found(x, 0.5, (2,), capacity=40, backend="jax")


@check
def wrong_arguments_are_named():
    x, mesh = np.zeros((20, 2)), mesh_of(2)
    raises(ValueError, "skewed", distributed.scatter, x, 0.1, mesh=mesh, box=jfrnn.Box([[1.0, 0.0], [0.5, 1.0]]))
    raises(TypeError, "mesh", distributed.scatter, x, 0.1, mesh=4)
    raises(ValueError, "[n, 2] or [n, 3], got [300, 4]", distributed.scatter, np.zeros((300, 4)), 0.1, mesh=mesh)
    for along in ("x", [True], [0.0], [2]):
        raises(ValueError, "along must name 1 different axes", distributed.scatter, x, 0.1, mesh=mesh, along=along)
    particles = distributed.scatter(x, 0.1, mesh=mesh, along=np.array([1]))
    assert particles.along == (1,)
    for slack in (0.1, np.nan):
        raises(ValueError, "slack must be finite and at least 1", particles.grow, slack=slack)
    raises(TypeError, "seen must be particles, lists or halos of jfrnn.distributed, got int", particles.grow, 5)
    for ask in (distributed.migrate, distributed.collect, distributed.halo):
        raises(TypeError, "particles must be what jfrnn.distributed.scatter returns, got an array", ask, x)
    raises(ValueError, "mesh", distributed.scatter, x, 0.1, mesh=mesh_of(2, 2, 2))
    raises(ValueError, "along", distributed.scatter, x, 0.1, mesh=mesh, along=(2,))
    raises(ValueError, r"values['m']", distributed.scatter, x, 0.1, {"m": np.zeros(7)}, mesh=mesh)
    raises(TypeError, "inside jax.jit", jax.jit(lambda x: distributed.scatter(x, 0.1, mesh=mesh).ids), x)
    particles = distributed.scatter(x + np.arange(20)[:, None], 0.1, mesh=mesh)
    raises(ValueError, "reach", distributed.search, particles, 0.2)
    raises(ValueError, "hashgrid", distributed.search, particles, 0.1, backend="hashgrid")
    raises(TypeError, "particles", distributed.count, x, 0.1)
    raises(ValueError, "capacity", jax.jit(lambda p: distributed.search(p, 0.1).count), particles)
    raises(ValueError, "values", distributed.pair_sum, weight, particles, 0.1, {"m": np.zeros(3)})
    raises(ValueError, "cutoff", distributed.pair_sum, weight, particles, None)
    raises(TypeError, "halo", distributed.pair_sum, weight, particles, 0.1, halo=3)
    raises(ValueError, "anew", distributed.count, roomy(particles), 0.1, halo=distributed.halo(particles))


if __name__ == "__main__":
    warnings.simplefilter("error")
    main(sys.argv[1:])
