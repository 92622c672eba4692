"""Crystals of different sizes, one compiled program: energies and forces per atom, in boxes smaller than the cutoff too.

With ASE, take `atoms.positions`, `atoms.cell[:]` and `atoms.pbc` instead of `fcc`.

python examples/gallery/crystals.py [PICTURE]
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jfrnn

CUTOFF, ATOMS, SLOTS = 6.0, 64, 64
DEPTH, RANGE = 0.0103, 3.40  # a Lennard-Jones argon: eV, Å


def fcc(a, cells, noise, seed=0):
    """Return positions and lattice vectors [Å] of a face-centered cubic crystal whose atoms are off their sites."""
    basis = np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    corners = np.stack(np.meshgrid(*map(np.arange, cells), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    positions = a * (corners + basis).reshape(-1, 3)
    return positions + np.random.default_rng(seed).normal(0, noise, positions.shape), a * np.diag(cells).astype(float)


def pair_energy(r, i, j):
    """Half of a pair's energy: it is met from either side."""
    s = (RANGE**2 / (r @ r)) ** 3
    return 2 * DEPTH * (s**2 - s)


@jax.jit
def energy_and_forces(positions, active, vectors):
    """One program for all structures: as many atoms, slots and images in each; the rest is data."""
    nbrs = jfrnn.search(positions, CUTOFF, box=jfrnn.Box(vectors, images=2), active=active, capacity=SLOTS)
    energy, slope = jax.value_and_grad(lambda x: jfrnn.pair_sum(pair_energy, x, None, neighbors=nbrs).sum())(positions)
    return energy, -slope, nbrs.status, nbrs.count


def main():
    """Return for each structure its atoms, its energy per atom [eV] and its largest force [eV/Å]."""
    found = []
    for cells, noise in (((1, 1, 1), 0.0), ((2, 1, 1), 0.05), ((2, 2, 2), 0.1), ((4, 2, 2), 0.1)):
        positions, vectors = fcc(5.26, cells, noise)
        padded, active = np.zeros((ATOMS, 3), np.float32), np.arange(ATOMS) < len(positions)
        padded[active] = positions
        energy, forces, status, count = energy_and_forces(padded, active, jnp.asarray(vectors, jnp.float32))
        if status != 0:
            raise RuntimeError(f"pairs are missing: {jfrnn.Status(int(status))}, longest row {int(count.max())}")
        per_atom, largest = float(energy) / len(positions), float(jnp.abs(forces).max())
        print(f"{len(positions):3} atoms, {int(count[0])} neighbors: {per_atom:.4f} eV per atom, forces up to {largest:.4f} eV/Å")
        found.append((len(positions), per_atom, largest))
    return found


if __name__ == "__main__":
    found = main()
    figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
    axes.bar([f"{atoms} atoms" for atoms, _, _ in found], [1e3 * energy for _, energy, _ in found])
    axes.set(ylabel="meV per atom", title="Argon crystals, their atoms off their sites but in the first")
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "crystals.png", dpi=100)
