"""Particles on four devices, here virtual ones of a CPU, move from device to device in a time loop.

XLA_FLAGS=--xla_force_host_platform_device_count=4 python examples/gallery/devices.py [PICTURE]
pip install -e '.[warp]' matplotlib
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jfrnn import distributed

CUTOFF, SKIN, DT = 0.08, 0.02, 0.01


def push(r, i, j):
    """Neighbors push each other away."""
    return -r * jnp.maximum(1 - r @ r / CUTOFF**2, 0.0)


@jax.jit
def chunk(particles, nbrs):
    """Twenty steps: neighbors push, all turn; where `update` rebuilds, particles change devices."""

    def step(_, carry):
        particles, nbrs = carry
        x = particles.positions
        v = 20 * distributed.pair_sum(push, particles, None, neighbors=nbrs)
        v = v + jnp.stack([0.5 - x[:, 1], x[:, 0] - 0.5], axis=1)
        return nbrs.update(particles.replace(x + DT * v))

    return jax.lax.fori_loop(0, 20, step, (particles, nbrs))


def main(n=1000, chunks=2):
    """Return positions, and the device that each particle is on at the end."""
    x = np.random.default_rng(0).uniform(0, 1, (n, 2)).astype(np.float32)
    mesh = jax.make_mesh((jax.device_count(),), ("x",))
    particles = distributed.scatter(x, CUTOFF, mesh=mesh, skin=SKIN)
    nbrs = distributed.search(particles, CUTOFF, skin=SKIN, slack=1.5)
    for _ in range(chunks):
        while True:
            after, seen = chunk(particles, nbrs)
            if not (after.overflow | seen.overflow):
                break
            particles = particles.grow(after, seen)
            nbrs = seen.grow(particles)
        particles, nbrs = after, seen
    ids = np.asarray(particles.ids).reshape(jax.device_count(), -1)
    device = np.empty(n, int)
    for k, row in enumerate(ids):
        device[row[row >= 0]] = k
    print(
        f"{n} particles on {jax.device_count()} devices: {np.bincount(device).tolist()}, "
        f"{len(nbrs.pairs()[0])} pairs"
    )
    particles.check()
    nbrs.check()
    return distributed.collect(particles)[0], device


if __name__ == "__main__":
    x, device = main()
    figure, axes = plt.subplots(figsize=(5, 5), layout="constrained")
    axes.scatter(*x.T, c=device, cmap="viridis", s=6)
    axes.set(
        aspect="equal",
        title=f"{len(x)} particles, each in the color of its device",
        xticks=[],
        yticks=[],
    )
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "devices.png", dpi=100)
