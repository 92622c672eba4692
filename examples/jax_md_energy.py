"""A Lennard-Jones liquid of jax-md with the neighbor list of jfrnn: same energy, same forces, same trajectory.

python examples/jax_md_energy.py    (pip install -e '.[warp]' --group peers)
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax_md import energy, partition, simulate, space  # pyright: ignore[reportMissingImports]

import jfrnn

SIDE, SPACING, CUTOFF, SKIN, STEPS, DT = 8, 1.2, 2.5, 0.3, 200, 2e-3


def main() -> dict[str, float]:
    """Print and return the largest differences of energy, forces and, after some steps, positions."""
    jax.config.update("jax_enable_x64", True)
    length = SIDE * SPACING
    sites = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * SPACING
    x = jnp.asarray(sites + np.random.default_rng(0).uniform(-0.05, 0.05, sites.shape))
    displacement, shift = space.periodic(length)
    kind = {"r_cutoff": CUTOFF, "dr_threshold": SKIN, "format": partition.NeighborListFormat.Dense}
    make, lennard_jones = energy.lennard_jones_neighbor_list(displacement, length, **kind)

    theirs = make.allocate(x)
    ours = jfrnn.search(x, CUTOFF, skin=SKIN, box=jfrnn.Box([length] * 3), slack=1.25)
    energies = [lennard_jones(x, neighbor=list_) for list_ in (theirs, ours.to_jax_md())]
    forces = [jax.grad(lennard_jones)(x, neighbor=list_) for list_ in (theirs, ours.to_jax_md())]

    start, move = simulate.nve(lennard_jones, shift, DT)

    @jax.jit
    def run_theirs(state, nbrs):
        def step(_, carry):
            state, nbrs = carry
            nbrs = nbrs.update(state.position)
            return move(state, neighbor=nbrs), nbrs

        return jax.lax.fori_loop(0, STEPS, step, (state, nbrs))

    @jax.jit
    def run_ours(state, nbrs):
        def step(_, carry):
            state, nbrs = carry
            nbrs = nbrs.update(state.position)  # the one line that differs: what the energy is given
            return move(state, neighbor=nbrs.to_jax_md()), nbrs

        return jax.lax.fori_loop(0, STEPS, step, (state, nbrs))

    key = jax.random.key_data(jax.random.key(0))
    after_theirs, theirs = run_theirs(start(key, x, kT=0.5, neighbor=theirs), theirs)
    after_ours, ours = jfrnn.run_chunk(run_ours, start(key, x, kT=0.5, neighbor=ours.to_jax_md()), ours, lambda s: s.position)
    if bool(theirs.did_buffer_overflow):
        raise RuntimeError("the list of jax-md overflowed: give it more capacity_multiplier.")
    differences = {
        "energy": abs(float(energies[0] - energies[1])) / abs(float(energies[0])),
        "forces": float(jnp.abs(forces[0] - forces[1]).max() / jnp.abs(forces[0]).max()),
        "positions": float(jnp.abs(displacement_of(displacement, after_theirs.position, after_ours.position)).max()),
    }
    print(f"{len(x)} particles, {STEPS} steps, {int(ours.rebuild_count)} times a new list")
    print("\n".join(f"largest difference of {name}: {value:.1e}" for name, value in differences.items()))
    return differences


def displacement_of(displacement, a, b):
    """Return the displacements of particles between two states, [n, d]."""
    return jax.vmap(displacement)(a, b)


if __name__ == "__main__":
    main()
