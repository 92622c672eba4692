"""Grains of different sizes fall into a box; they touch where radii add up to more than the distance.

python examples/gallery/grains.py [PICTURE]
pip install -e '.[warp]' matplotlib
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import EllipseCollection
from PIL import Image

import jfrnn

STIFF, DAMPED, DT, WIDE = 2e4, 20.0, 5e-4, 1.0


def contact(r, i, j):
    """Acceleration of i by a grain that touches it, a damped spring; and 1, which counts contacts."""
    distance = jnp.sqrt(r @ r + 1e-12)
    away = -r / distance
    overlap = i["radius"] + j["radius"] - distance
    closing = (i["v"] - j["v"]) @ away
    reduced = 1 / (1 / i["m"] + 1 / j["m"])
    return away * reduced * (STIFF * overlap - DAMPED * closing) / i["m"], 1.0


@jax.jit
def frame(x, v, radius):
    """Forty steps; by the rule "sum", grains closer than the sum of their radii are neighbors."""
    m = radius**2

    def step(_, state):
        x, v, _ = state
        a, touching = jfrnn.pair_sum(
            contact, x, radius, {"v": v, "radius": radius, "m": m}, radius_rule="sum"
        )
        low, high = (
            jnp.maximum(radius[:, None] - x, 0),
            jnp.maximum(x + radius[:, None] - jnp.array([WIDE, 1e3]), 0),
        )
        a = a + STIFF * (low - high) - DAMPED * v * ((low > 0) | (high > 0)) + jnp.array([0.0, -9.81])
        v = v + DT * a
        return x + DT * v, v, touching

    return jax.lax.fori_loop(0, 40, step, (x, v, 0 * radius))


def main(across=12, up=12, frames=60):
    """Return the radii and the positions after each frame."""
    random = np.random.default_rng(0)
    pitch = WIDE / across
    sites = np.stack(np.meshgrid(np.arange(across), np.arange(up)), axis=-1).reshape(-1, 2)
    x = jnp.asarray((sites + 0.5 + random.uniform(-0.05, 0.05, sites.shape)) * pitch, jnp.float32)
    radius = jnp.asarray(pitch * random.choice([0.12, 0.25, 0.45], len(x)), jnp.float32)
    v, seen = jnp.zeros_like(x), []
    for _ in range(frames):
        seen.append(np.asarray(x))
        x, v, touching = frame(x, v, radius)
    contacts, speed = int(np.sum(touching)) // 2, float(np.abs(v).max())
    print(f"{len(x)} grains, {contacts} contacts at the end, speed up to {speed:.2f} m/s")
    assert np.mean(np.asarray(x)[:, 1] < seen[0][:, 1]) > 0.5, "grains fall"
    return np.asarray(radius), seen


if __name__ == "__main__":
    radius, seen = main()
    figure, axes = plt.subplots(figsize=(4, 4.4))
    axes.set(
        aspect="equal",
        xlim=(0, WIDE),
        ylim=(0, 1.0),
        xticks=[],
        yticks=[],
        title=f"{len(radius)} grains of three sizes",
    )
    shape = 2 * radius, 2 * radius, 0 * radius
    grains = EllipseCollection(
        *shape, units="xy", offsets=seen[0], offset_transform=axes.transData, array=radius
    )
    axes.add_collection(grains)
    pictures = []
    for x in seen[::4]:
        grains.set_offsets(x)
        figure.canvas.draw()
        pictures.append(
            Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB").quantize(32)
        )
    name = sys.argv[1] if len(sys.argv) > 1 else "grains.gif"
    pictures[0].save(name, save_all=True, append_images=pictures[1:], duration=100, loop=0)
