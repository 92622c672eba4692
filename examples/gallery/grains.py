"""Grains of different sizes fall into a box: they touch where centers are closer than the sum of their radii.

python examples/gallery/grains.py [PICTURE]
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
    """Force on i from a grain that touches it: a damped spring along the line of centers, over the mass of i."""
    distance = jnp.sqrt(r @ r + 1e-12)
    away = -r / distance
    overlap = i["radius"] + j["radius"] - distance
    closing = (i["v"] - j["v"]) @ away
    reduced = 1 / (1 / i["m"] + 1 / j["m"])
    return away * reduced * (STIFF * overlap - DAMPED * closing) / i["m"]


@jax.jit
def frame(x, v, radius):
    """Forty steps; diameters are the cutoffs, and the rule "mean" makes sums of radii of them."""
    m = radius**2

    def step(_, state):
        x, v = state
        a = jfrnn.pair_sum(contact, x, 2 * radius, {"v": v, "radius": radius, "m": m}, radius_rule="mean")
        low, high = jnp.maximum(radius[:, None] - x, 0), jnp.maximum(x + radius[:, None] - jnp.array([WIDE, 1e3]), 0)
        a = a + STIFF * (low - high) - DAMPED * v * ((low > 0) | (high > 0)) + jnp.array([0.0, -9.81])
        v = v + DT * a
        return x + DT * v, v

    return jax.lax.fori_loop(0, 40, step, (x, v))


def main(across=14, up=16, frames=60):
    """Return the radii and the positions after each frame."""
    random = np.random.default_rng(0)
    pitch = WIDE / across
    sites = np.stack(np.meshgrid(np.arange(across), np.arange(up)), axis=-1).reshape(-1, 2)
    x = jnp.asarray((sites + 0.5 + random.uniform(-0.05, 0.05, sites.shape)) * pitch, jnp.float32)
    radius = jnp.asarray(pitch * random.choice([0.12, 0.25, 0.45], len(x)), jnp.float32)
    v, seen = jnp.zeros_like(x), []
    for _ in range(frames):
        seen.append(np.asarray(x))
        x, v = frame(x, v, radius)
    touching = jfrnn.search(x, 2 * radius, radius_rule="mean", half=True)
    print(f"{len(x)} grains, {len(touching.pairs()[0])} contacts at the end, speed {float(jnp.abs(v).max()):.2f} m/s")
    return np.asarray(radius), seen


if __name__ == "__main__":
    radius, seen = main(frames=75)
    pictures = []
    for x in seen[::3]:
        figure, axes = plt.subplots(figsize=(4, 4.4), layout="constrained")
        size = 2 * radius
        grains = EllipseCollection(size, size, 0 * size, units="xy", offsets=x, offset_transform=axes.transData)
        grains.set(array=radius, cmap="viridis")
        axes.add_collection(grains)
        axes.set(aspect="equal", xlim=(0, WIDE), ylim=(0, 1.15), xticks=[], yticks=[])
        figure.canvas.draw()
        pictures.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB").quantize(64))
        plt.close(figure)
    name = sys.argv[1] if len(sys.argv) > 1 else "grains.gif"
    pictures[0].save(name, save_all=True, append_images=pictures[1:], duration=80, loop=0)
