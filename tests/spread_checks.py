"""Checks of arrays that are spread over 4 virtual CPU devices: `python tests/spread_checks.py NAME...`.

Prints a line of JSON for each: its name, and what was wrong, or null. What is expected is what one device finds.
"""

import json
import os
import sys
import traceback

os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=4"

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jfrnn

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)

CHECKS = {}
RNG = np.random.default_rng(0)
X, R = RNG.uniform(0, 2, (16, 2)).astype(np.float32), RNG.uniform(0.3, 0.9, 16).astype(np.float32)
CORNERS = np.array([[0, 0], [2, 0], [2, 2], [0, 2]], np.float32)
SIDES = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])


def check(fn):
    CHECKS[fn.__name__] = fn
    return fn


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


def near_walls(x, r):
    tri = jfrnn.search_triangles(x, CORNERS, SIDES, 0.4, capacity=8)
    return tri, tri.update(x)


QUICK = {"list": listed, "box": in_a_box, "sum": summed, "walls": near_walls, "order": lambda x, r: jfrnn.sort_order(x, 0.5)}
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
        with jax.set_mesh(mesh):
            x, r = (jax.device_put(a, NamedSharding(mesh, PartitionSpec("p"))) for a in (X, R))
            found = {"eager": case(x, r), "jit": jax.jit(case)(x, r)}
        for how, result in found.items():
            for one, other in zip(jax.tree.leaves(result), expected, strict=True):
                np.testing.assert_array_equal(one, other, err_msg=f"{name}, {how}")


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


def main(names):
    for name in names:
        wrong = None
        try:
            CHECKS[name]()
        except Exception:
            wrong = traceback.format_exc()
        print(json.dumps({"name": name, "wrong": wrong}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
