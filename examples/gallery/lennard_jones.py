"""A Lennard-Jones liquid at constant energy: a list with a skin, forces by the gradient of a sum.

python examples/gallery/lennard_jones.py [PICTURE]
pip install -e '.[warp]' matplotlib
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jfrnn

CUTOFF, SKIN, DENSITY, TEMPERATURE, DT = 2.5, 0.4, 0.8442, 1.44, 0.004


def pair_energy(r, i, j):
    """Half of a pair's energy, shifted so that it ends at zero."""
    s = 1 / (r @ r) ** 3
    return 2 * (s**2 - s) - 2 * (CUTOFF**-12 - CUTOFF**-6)


def potential(x, nbrs):
    """Return the energy of all pairs."""
    return jfrnn.pair_sum(pair_energy, x, None, neighbors=nbrs).sum()


@jax.jit
def chunk(state, nbrs):
    """Fifty steps of velocity Verlet; `update` rebuilds when something has moved half the skin."""

    def step(_, carry):
        (x, v, f), nbrs = carry
        v = v + 0.5 * DT * f
        x = x + DT * v
        nbrs = nbrs.update(x)
        f = -jax.grad(potential)(x, nbrs)
        return (x, v + 0.5 * DT * f, f), nbrs

    return jax.lax.fori_loop(0, 50, step, (state, nbrs))


def main(side=8, chunks=20):
    """Return the potential and kinetic energy per particle after each chunk."""
    n = side**3
    length = (n / DENSITY) ** (1 / 3)
    sites = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    x = jnp.asarray((sites + 0.5) * length / side, jnp.float32)
    v = np.random.default_rng(0).normal(0, TEMPERATURE**0.5, x.shape).astype(np.float32)
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, box=jfrnn.Box([length] * 3), slack=1.25)
    state, energies = (x, v - v.mean(axis=0), -jax.grad(potential)(x, nbrs)), []
    for _ in range(chunks):
        state, nbrs = jfrnn.run_chunk(chunk, state, nbrs, lambda state: state[0])
        energies.append((float(potential(state[0], nbrs)) / n, float(0.5 * (state[1] ** 2).sum()) / n))
    energies = np.array(energies)
    drift = float(np.ptp(energies.sum(axis=1)))
    print(
        f"{n} particles, {50 * chunks} steps, {int(nbrs.rebuild_count)} rebuilds; the total energy "
        f"stays within {drift:.4f}"
    )
    assert drift < 0.01, "energy is not conserved: take a smaller DT"
    return energies


if __name__ == "__main__":
    energies = main()
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    time = 50 * DT * np.arange(1, len(energies) + 1)
    for values, name, style in zip(
        (*energies.T, energies.sum(axis=1)),
        ("potential", "kinetic", "total"),
        ("--", ":", "-"),
        strict=True,
    ):
        axes.plot(time, values, style, color="k" if name == "total" else "tab:blue", linewidth=2)
        axes.annotate(f" {name}", (time[-1], values[-1]), va="center")
    axes.set(
        xlabel="time",
        ylabel="energy per particle",
        title="Potential and kinetic energy fluctuate, their sum does not",
    )
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "lennard_jones.png", dpi=100)
