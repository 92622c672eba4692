"""A jet of drops onto a turning gear: distances to a wall of triangles, in the frame of the gear.

python examples/gallery/gear.py [PICTURE]
pip install -e '.[warp]' matplotlib
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jfrnn
from jfrnn.cases.meshes import gear

RADIUS, RATE, SPEED, DT, STIFF, LAST = 0.15, 4.0, 30.0, 2e-4, 2e5, 0.35


def turn(x, angle):
    """Turn points about the z axis."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return x @ jnp.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], x.dtype)


@jax.jit
def chunk(state, tri):
    """Fifty steps of drops that the wall pushes out by its normal; the list keeps the gear's tree."""

    def step(_, carry):
        (x, v, time, deepest), tri = carry
        angle = RATE * time
        seen = turn(x, -angle)  # where the gear stands still
        tri = tri.update(seen)
        wall = tri.signed_distance(seen)
        distance = jnp.where(wall.mask, wall.distance, 4 * RADIUS)
        depth = jnp.maximum(RADIUS - distance, 0)
        normal = turn(wall.normal, angle)
        moving = RATE * jnp.stack([-x[:, 1], x[:, 0], 0 * x[:, 0]], axis=1)
        slip = (v - moving) * (depth > 0)[:, None]
        v = v + DT * (STIFF * depth[:, None] * normal - 40 * slip + jnp.array([0.0, -9.81, 0.0]))
        return (x + DT * v, v, time + DT, jnp.minimum(deepest, distance.min())), tri

    return jax.lax.fori_loop(0, 50, step, (state, tri))


def main(n=800, chunks=30, faces=800):
    """Return drops, and the gear's corners and faces, at the end."""
    vertices, named = gear(12, faces, 1.0, 3.0, 3.0)
    vertices = jnp.asarray(vertices, jnp.float32)
    top = float(jnp.abs(vertices[:, 1]).max())
    random = np.random.default_rng(0)
    x = np.column_stack(
        [
            random.normal(1.0, 0.3, n),
            top + 1 + random.uniform(0, SPEED * LAST * 0.8, n),
            random.normal(0, 0.4, n),
        ]
    )
    x = jnp.asarray(x, jnp.float32)
    v = jnp.zeros_like(x).at[:, 1].set(-SPEED)
    tri = jfrnn.search_triangles(x, vertices, named, 4 * RADIUS, capacity=64)
    state = x, v, jnp.float32(0), jnp.float32(RADIUS)
    for _ in range(chunks):
        after, seen = chunk(state, tri)
        # more triangles near a drop than there are slots: grow, and run the chunk again
        while seen.overflow:
            tri = seen.grow(turn(state[0], -RATE * state[2]))
            after, seen = chunk(state, tri)
        state, tri = after, seen
    tri.check()
    print(
        f"{n} drops, {len(named)} triangles; the least distance of a center from the wall was "
        f"{float(state[3]):.3f}"
    )
    assert state[3] > -RADIUS, "a drop has passed the wall: take a smaller DT"
    return np.asarray(state[0]), np.asarray(turn(vertices, RATE * state[2])), np.asarray(named)


if __name__ == "__main__":
    x, vertices, named = main()
    figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
    axes.tripcolor(*vertices[:, :2].T, named, vertices[:, 2], cmap="Greys", vmin=-6, vmax=8)
    axes.plot(*x[:, :2].T, ".", ms=3, color="tab:orange")
    axes.set(
        aspect="equal",
        xlim=(-9, 9),
        ylim=(-8, 11),
        xticks=[],
        yticks=[],
        title="Drops of a jet are thrown off by a turning gear",
    )
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "gear.png", dpi=100)
