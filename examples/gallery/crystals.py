"""Crystals of different sizes from ASE, one compiled program: energies and forces.

python examples/gallery/crystals.py [PICTURE]
pip install -e '.[warp]' matplotlib ase
"""

import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from ase.build import bulk

import jfrnn

CUTOFF, ATOMS, SLOTS = 6.0, 64, 64
DEPTH, RANGE = 0.0103, 3.40  # a Lennard-Jones argon: eV, Å


def pair_energy(r, i, j):
    """Half of a pair's energy: it is met from either side."""
    s = (RANGE**2 / (r @ r)) ** 3
    return 2 * DEPTH * (s**2 - s)


@jax.jit
def energy_and_forces(positions, active, vectors):
    """One program for all structures: as many atoms, slots and images in each; the rest is data."""
    nbrs = jfrnn.search(
        positions, CUTOFF, box=jfrnn.Box(vectors, images=2), active=active, capacity=SLOTS
    )
    energy, slope = jax.value_and_grad(
        lambda x: jfrnn.pair_sum(pair_energy, x, None, neighbors=nbrs).sum()
    )(positions)
    return energy, -slope, nbrs.status, nbrs.count


def main():
    """Return of each structure its formula, energy per atom [eV] and forces on atoms [eV/Å]."""
    found = []
    for cells, noise in (((1, 1, 1), 0.0), ((2, 1, 1), 0.05), ((2, 2, 2), 0.1), ((4, 2, 2), 0.1)):
        atoms = bulk("Ar", "fcc", a=5.26, cubic=True) * cells
        atoms.rattle(noise, seed=0)
        padded, active = np.zeros((ATOMS, 3), np.float32), np.arange(ATOMS) < len(atoms)
        padded[active] = atoms.positions
        energy, forces, status, count = energy_and_forces(
            padded, active, jnp.asarray(atoms.cell[:], jnp.float32)
        )
        if status != 0:
            raise RuntimeError(
                f"pairs are missing: {jfrnn.Status(int(status))}, longest row {int(count.max())}"
            )
        forces = np.asarray(forces)[active]
        name, per_atom = atoms.get_chemical_formula(), float(energy) / len(atoms)
        assert np.abs(forces.sum(axis=0)).max() < 1e-4, "forces of a crystal add up to zero"
        print(
            f"{name:>4}: {int(count[0])} neighbors, {per_atom:.4f} eV per atom, forces up to "
            f"{np.abs(forces).max():.4f} eV/Å"
        )
        found.append((name, per_atom, forces))
    return found


if __name__ == "__main__":
    found = main()
    figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
    for place, (_, _, forces) in enumerate(found):
        strength = 1e3 * np.linalg.norm(forces, axis=1)
        axes.plot(
            place + np.linspace(-0.3, 0.3, len(strength)), strength, "o", color="tab:blue", markersize=4
        )
    axes.set_xticks(
        range(len(found)), [f"{name}\n{1e3 * energy:.1f} meV per atom" for name, energy, _ in found]
    )
    axes.set(
        ylabel="force on each atom [meV/Å]",
        title="Four argon crystals, further from their sites towards the right",
    )
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "crystals.png", dpi=100)
