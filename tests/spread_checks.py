"""Checks of arrays that are spread over 4 virtual CPU devices: `python tests/spread_checks.py NAME...`.

Prints a line of JSON for each: its name, and what was wrong, or null. What is expected is what one device finds.
"""

import os
import sys

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4"

import jax
import jax.numpy as jnp
import numpy as np
import soon
from checked import refuses
from children import check, main
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jfrnn

jax.config.update("jax_enable_x64", True)
soon.compile_soon()
jax.config.update("jax_disable_most_optimizations", True)

RNG = np.random.default_rng(0)
X, R = RNG.uniform(0, 2, (16, 2)).astype(np.float32), RNG.uniform(0.3, 0.9, 16).astype(np.float32)
CORNERS = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], np.float32)
SIDES = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])


def weight(r, i, j):
    return j * jnp.sum(r * r)


def listed(x, r):
    nbrs = jfrnn.search(x, 0.5, capacity=16, skin=0.1, active=r > 0.4)
    return nbrs, nbrs.update(x, active=r > 0.4), nbrs.overflow


def in_a_box(x, r):
    return jfrnn.count(x, 0.5, box=jfrnn.Box([2.0, 2.0])), jfrnn.count(x, 0.3, batch=(r > 0.6).astype(jnp.int32))


def summed(x, r):
    def loss(x):
        return jnp.sum(jfrnn.pair_sum(weight, x, 0.5, r))

    return jfrnn.pair_sum(weight, x, 0.5, r), jax.grad(loss)(x)


def over_lists(x, r):
    nbrs = jfrnn.search(x, 0.5, capacity=16, skin=0.1, reverse=True)
    energies = (
        lambda x: jnp.sum(jfrnn.pair_sum(weight, x, None, r, neighbors=nbrs)),
        lambda x: jnp.sum(nbrs.distances(x)[0] ** 3),
        lambda x: jnp.sum(nbrs.edges(x, 200).displacement ** 3),
    )
    return [jax.grad(energy)(x) for energy in energies]


def near_walls(x, r, backend="auto"):
    tri = jfrnn.search_triangles(x, CORNERS, SIDES, 0.4, capacity=8, backend=backend)
    return tri, tri.update(x)


QUICK = {
    "list": listed,
    "box": in_a_box,
    "sum": summed,
    "lists": over_lists,
    "walls": near_walls,
    "walls in cells": lambda x, r: near_walls(x, r, "warp"),
    "order": lambda x, r: jfrnn.sort_order(x, 0.5),
}
MORE = {
    "radii": lambda x, r: jfrnn.count(x, r),
    "distances": lambda x, r: jfrnn.search(X, 0.5, capacity=16).distances(x),
    "closest": lambda x, r: jfrnn.search_triangles(X, CORNERS, SIDES, 0.4, capacity=8).closest(x),
    "signed distance": lambda x, r: jfrnn.search_triangles(X, CORNERS, SIDES, 0.4, capacity=8).signed_distance(x),
    "jax": lambda x, r: jfrnn.search(x, 0.5, capacity=16, backend="jax"),
    "jax in a box": lambda x, r: jfrnn.count(x, 0.5, backend="jax", box=jfrnn.Box([2.0, 2.0])),
    "jax sum": lambda x, r: jfrnn.pair_sum(weight, x, 0.5, r, backend="jax"),
    "jax walls": lambda x, r: jfrnn.search_triangles(x, CORNERS, SIDES, 0.4, capacity=8, backend="jax"),
}


def as_on_one_device(cases, kind):
    """Compare eager calls and compiled ones on a mesh, in its context."""
    mesh = jax.make_mesh((4,), ("p",), axis_types=(kind,))
    for name, case in cases.items():
        expected = jax.tree.leaves(case(jnp.asarray(X), jnp.asarray(R)))
        with jax.set_mesh(mesh) if hasattr(jax, "set_mesh") else jax.sharding.use_mesh(mesh):
            x, r = (jax.device_put(a, NamedSharding(mesh, PartitionSpec("p"))) for a in (X, R))
            found = {"eager": case(x, r), "jit": jax.jit(case)(x, r)}
        for how, result in found.items():
            for one, other in zip(jax.tree.leaves(result), expected, strict=True):
                # Another program than the eager calls': fully compiled, it may join products and sums.
                near = 1e-6 if how == "jit" and jnp.issubdtype(one.dtype, jnp.floating) else 0
                np.testing.assert_allclose(one, other, rtol=near, atol=0, err_msg=f"{name}, {how}")


@check
def automatic_axes():
    as_on_one_device(QUICK, AxisType.Auto)


@check
def explicit_axes():
    as_on_one_device(QUICK, AxisType.Explicit)


@check
def more_on_automatic_axes():
    as_on_one_device(MORE, AxisType.Auto)


@check
def more_on_explicit_axes():
    as_on_one_device(MORE, AxisType.Explicit)


@check
def explicit_axes_without_a_context():
    """An array of such a mesh is gathered, and mixes with arrays that know none."""
    mesh = jax.make_mesh((4,), ("p",), axis_types=(AxisType.Explicit,))
    x = jax.device_put(X, NamedSharding(mesh, PartitionSpec("p")))
    nbrs = jfrnn.search(X, 0.5, skin=0.1)
    np.testing.assert_array_equal(jfrnn.search(x, 0.5).count, jfrnn.count(X, 0.5))
    np.testing.assert_array_equal(nbrs.update(x).idx, nbrs.idx)


@check
def a_box_goes_where_the_points_are():
    """Also where transfers are guarded: a box of NumPy arrays is brought there by the library itself."""
    mesh, box = jax.make_mesh((4,), ("p",), axis_types=(AxisType.Auto,)), jfrnn.Box([2.0, 2.0])
    expected = np.asarray(jfrnn.count(X, 0.5, box=box))
    for place in (NamedSharding(mesh, PartitionSpec("p")), jax.devices()[3]):
        x = jax.device_put(X, place)
        with jax.transfer_guard("disallow"):
            found = jfrnn.count(x, 0.5, box=box), jfrnn.search(x, 0.5, box=box).count
        for each in found:
            np.testing.assert_array_equal(each, expected)


@check
def batches_on_explicit_axes():
    """They are refused, with advice that helps."""
    mesh = jax.make_mesh((4,), ("p",), axis_types=(AxisType.Explicit,))
    batch = jnp.stack([X, 0.9 * X, 0.8 * X, 0.7 * X])
    spread = jax.device_put(batch, NamedSharding(mesh, PartitionSpec("p")))
    count = jax.vmap(lambda x: jfrnn.count(x, 0.5))
    with jax.set_mesh(mesh):
        for each in (count, jax.jit(count), jax.vmap(lambda x: jfrnn.pair_sum(lambda r, i, j: r @ r, x, 0.5))):
            refuses(ValueError, "jax.vmap cannot go over an axis that is sharded", each, spread)
        gathered = jax.jit(lambda x: count(jax.sharding.reshard(x, PartitionSpec())))(spread)
    np.testing.assert_array_equal(gathered, count(batch))


MESH = jax.make_mesh((4,), ("p",), axis_types=(AxisType.Auto,))


def systems_of_devices(case):
    """Compare a function of 8 positions and numbers on each device, in `shard_map` as it is by itself, with one device."""
    x, r = jnp.concatenate([X, X[::-1] / 2]), jnp.concatenate([R, R / 2])
    spec = PartitionSpec("p")
    found = jax.jit(jax.shard_map(case, mesh=MESH, in_specs=spec, out_specs=spec))(x, r)
    alone = [jax.tree.leaves(case(x[k : k + 8], r[k : k + 8])) for k in range(0, 32, 8)]
    for one, others in zip(jax.tree.leaves(found), zip(*alone), strict=True):
        np.testing.assert_allclose(one, np.concatenate(others), rtol=1e-5, atol=1e-6)


def moving(x, r, **options):
    """A scan of updates."""

    def step(carry, _):
        x, nbrs = carry
        nbrs = nbrs.update(1.1 * x, active=r > 0.2)
        return (1.1 * x, nbrs), nbrs.count

    nbrs = jfrnn.search(x, 0.5, capacity=8, skin=0.1, active=r > 0.2, **options)
    return jax.lax.scan(step, (x, nbrs), None, length=3)[1].sum(axis=0)


@check
def shard_map_as_it_is_by_itself():
    systems_of_devices(lambda x, r: (jfrnn.count(x, 0.5), *summed(x, r)))
    systems_of_devices(moving)
    for backend in ("warp", "bvh"):
        systems_of_devices(lambda x, r, backend=backend: [tri.idx for tri in near_walls(x, r, backend)])


@check
def more_in_shard_map():
    def of_triangles(x, r):
        tri = jfrnn.search_triangles(x, CORNERS, SIDES, 0.4, capacity=8)
        return tri.count, tri.closest(x), tri.signed_distance(x)[:3]

    systems_of_devices(of_triangles)
    systems_of_devices(lambda x, r: jfrnn.count(x, r))
    systems_of_devices(lambda x, r: moving(x, r, box=jfrnn.Box([2.0, 2.0])))
    systems_of_devices(lambda x, r: jfrnn.search(x, 0.5, capacity=8, box=jfrnn.Box([2.0, 2.0])).distances(x))
    systems_of_devices(lambda x, r: jfrnn.pair_sum(weight, x, 0.5, r, reduce="max"))
    systems_of_devices(lambda x, r: jfrnn.search(x, 0.5, capacity=8, backend="jax").distances(x))
    systems_of_devices(lambda x, r: jax.vmap(lambda x: jfrnn.count(x, 0.5))(x.reshape(2, 4, 2)).reshape(8))


@check
def what_devices_share_keeps_its_gradient():
    """Of a number that all devices have, the derivative is that of the sum over all; where nothing varies, nothing does."""

    def loss(scale, x):
        return jnp.sum(jfrnn.pair_sum(lambda r, i, j: jnp.exp(-scale * jnp.sum(r * r)), x, 0.5))

    def total(scale, x):
        return jax.lax.psum(loss(scale, x), "p")

    specs = PartitionSpec(), PartitionSpec("p")
    found = jax.jit(jax.shard_map(jax.grad(total, (0, 1)), mesh=MESH, in_specs=specs, out_specs=specs))(jnp.float32(1.5), X)
    alone = [jax.grad(loss, (0, 1))(jnp.float32(1.5), X[k : k + 4]) for k in range(0, 16, 4)]
    np.testing.assert_allclose(found[0], sum(scale for scale, _ in alone), rtol=1e-5)
    np.testing.assert_allclose(found[1], np.concatenate([x for _, x in alone]), rtol=1e-5, atol=1e-6)
    spec = PartitionSpec()
    counted = jax.jit(jax.shard_map(lambda x: jfrnn.count(x, 0.5), mesh=MESH, in_specs=spec, out_specs=spec))(X)
    np.testing.assert_array_equal(counted, jfrnn.count(X, 0.5))


if __name__ == "__main__":
    main(sys.argv[1:])
