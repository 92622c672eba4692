"""Run whole programs with lists of jfrnn in the place of theirs, and beside that with their own: jax-sph and nequix.

`python -m experiments.jax_md_programs CHECKOUT [--out=ROWS.csv] [PROGRAM ...]`: CHECKOUT is a clone of
https://github.com/tumaer/jax-sph; nequix is a package, and is run with random weights. It prints of each program whether it passed,
failed or was refused, by whom, and by how much its last state differs, relative to the largest number of each array.

One import is changed: that of `jax_md.partition.neighbor_list`, which jax-sph has a copy of; of
`custom_partition.neighbor_list_multi_image`, which nequix takes as an argument; and of `matscipy.neighbours.neighbour_list`.
"""

import csv
import os
import runpy
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from experiments.jax_md_tests import LISTS, ROOT, commit_of, judge

# What a case of jax-sph simulates [its units of time]: a hundred steps, more or less.
CASES = {"tgv": 0.05, "rpf": 0.05, "ldc": 0.04, "db": 0.03, "ht": 0.05, "cw": 0.1, "ut": 0.05, "cf": 5e-5, "pf": 5e-5}
PROGRAMS = (*(f"jax-sph {case}" for case in CASES), "nequix jax-md", "nequix ASE")
COLUMNS = ("program", "list", "outcome", "seconds", "difference", "reason", "version", "jax", "commit")
WIDTHS = {"hidden_irreps": "8x0e + 8x1o", "lmax": 1, "n_layers": 2, "radial_basis_size": 8, "radial_mlp_size": 16}
WIDTHS |= {"radial_mlp_layers": 2, "radial_polynomial_p": 2.0, "mlp_init_scale": 4.0, "index_weights": False, "layer_norm": True}
WIDTHS |= {"shift": 0.0, "scale": 1.0, "avg_n_neighbors": 40.0, "cutoff": 5.0}


def run(program: str, who: str, checkout: str) -> None:
    """Run a program in this process and folder, and write its last state to `state.npz`."""
    library, _, what = program.partition(" ")
    state = run_jax_sph(what, who, checkout) if library == "jax-sph" else {"jax-md": run_in_jax_md, "ASE": run_in_ase}[what](who)
    np.savez("state.npz", **state)  # pyright: ignore[reportArgumentType]


def run_jax_sph(case: str, who: str, checkout: str) -> dict[str, np.ndarray]:
    """Run `main.py` with a case."""
    folder = Path.cwd()
    sys.path.insert(0, checkout)
    os.chdir(checkout)
    if who == "jfrnn":
        from jax_sph.jax_md import partition  # pyright: ignore[reportMissingImports]

        from jfrnn import jax_md

        partition.neighbor_list = jax_md.neighbor_list
    words = [f"config=cases/{case}.yaml", f"solver.t_end={CASES[case]}", "io.write_every=25", f"io.data_path={folder}", "gpu=-1"]
    sys.argv = ["main.py", *words]
    runpy.run_path("main.py", run_name="__main__")
    os.chdir(folder)
    import h5py

    with h5py.File(max(folder.rglob("traj_*.h5"))) as last:
        return {str(name): np.asarray(values) for name, values in last.items()}


def run_in_jax_md(who: str) -> dict[str, np.ndarray]:
    """Run a crystal of salt by jax-md's NVE with nequix's energy, in a cell that its cutoff exceeds."""
    import jax
    import jax.numpy as jnp
    from jax_md import custom_partition, simulate, space  # pyright: ignore[reportMissingImports]
    from nequix.jax_md import nequix_neighbor_list  # pyright: ignore[reportMissingImports]
    from nequix.model import Nequix  # pyright: ignore[reportMissingImports]

    from jfrnn import jax_md

    atoms = salt()
    box, species = jnp.asarray(atoms.cell[:].T, jnp.float32), jnp.asarray(atoms.numbers == 17, jnp.int32)
    model = Nequix(jax.random.key(0), 2, **WIDTHS)
    displacement, shift = space.periodic_general(box)
    make = jax_md.neighbor_list_multi_image if who == "jfrnn" else custom_partition.neighbor_list_multi_image
    allocate, energy = nequix_neighbor_list(displacement, box, model, species, neighbor_list_fn=make, dr_threshold=0.2)
    nbrs = allocate.allocate(jnp.asarray(atoms.get_scaled_positions(), jnp.float32))
    init, step = simulate.nve(jax.jit(energy), shift, 1e-3)
    state = init(jax.random.key(1), jnp.asarray(atoms.get_scaled_positions(), jnp.float32), kT=0.02, mass=25.0, neighbor=nbrs)
    for _ in range(20):
        nbrs = nbrs.update(state.position)
        state = step(state, neighbor=nbrs)
    if nbrs.did_buffer_overflow:
        raise RuntimeError("the list overflowed")
    return {"position": state.position, "force": state.force, "energy": energy(state.position, nbrs)}


def run_in_ase(who: str) -> dict[str, np.ndarray]:
    """Ask nequix's calculator of ASE for energy, forces and stress."""
    import jax
    from matscipy import neighbours  # pyright: ignore[reportMissingImports]

    from jfrnn import matscipy

    if who == "jfrnn":
        neighbours.neighbour_list = matscipy.neighbour_list
    from nequix.calculator import NequixCalculator  # pyright: ignore[reportMissingImports]
    from nequix.model import Nequix, save_model  # pyright: ignore[reportMissingImports]

    save_model("random.nqx", Nequix(jax.random.key(0), 2, **WIDTHS), WIDTHS | {"atomic_numbers": [11, 17]})
    atoms = salt()
    atoms.calc = NequixCalculator(model_path="random.nqx", use_kernel=False)
    return {"energy": np.array(atoms.get_potential_energy()), "force": atoms.get_forces(), "stress": atoms.get_stress()}


def salt() -> Any:  # noqa: ANN401
    """Return a cell of eight atoms of salt that are not where the crystal has them."""
    from ase.build import bulk

    atoms = bulk("NaCl", "rocksalt", a=5.64, cubic=True)
    atoms.rattle(0.1, seed=0)
    return atoms


def attempt(program: str, who: str, checkout: Path) -> tuple[str, float, str, dict[str, np.ndarray]]:
    """Run a program in a process and an empty folder of its own; return outcome, seconds, reason and last state."""
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "MPLBACKEND": "agg"}
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        code = f"from experiments import jax_md_programs as own; own.run({program!r}, {who!r}, {str(checkout)!r})"
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment, cwd=folder
        )
        seconds, written = time.monotonic() - began, Path(folder) / "state.npz"
        if done.returncode:
            return judge(done.stderr), seconds, done.stderr.strip().splitlines()[-1][:200], {}
        with np.load(written) as state:
            return "passed", seconds, "", dict(state)


def largest_difference(state: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> float:
    """Return by how much two states differ, relative to the largest number of each array; NaN counts as infinite."""
    pairs = [(np.asarray(state[name], float), np.asarray(x, float)) for name, x in other.items()]
    each = [np.abs(a - b).max(initial=0) / max(np.abs(b).max(initial=0), 1e-300) for a, b in pairs if not (a == b).all()]
    return float(np.nan_to_num(max(each, default=0.0), nan=np.inf))


def main(words: list[str]) -> None:
    """Run programs with both lists, and print what became of them."""
    from importlib.metadata import version

    out = [word.partition("=")[2] for word in words if word.startswith("--out=")]
    names = [word for word in words if not word.startswith("--")]
    if not names or not (Path(names[0]) / "main.py").is_file() or set(names[1:]) - set(PROGRAMS):
        raise SystemExit(f"{__doc__}\nPROGRAM is one of: {', '.join(map(repr, PROGRAMS))}")
    checkout, rows = Path(names[0]).resolve(), []
    for program in names[1:] or PROGRAMS:
        library = program.partition(" ")[0]
        from_where = commit_of(checkout) if library == "jax-sph" else version(library)
        own: dict[str, np.ndarray] = {}
        for who in LISTS:
            outcome, seconds, reason, state = attempt(program, who, checkout)
            own = own or state
            apart = f"{largest_difference(state, own):.1e}" if state and own else ""
            rows.append((program, who, outcome, f"{seconds:.1f}", apart, reason, from_where, version("jax"), commit_of(ROOT)))
            print(f"{program}, {who}: {outcome}, {seconds:.1f} s, differs by {apart or 'what is not known'} {reason}", flush=True)
    if out:
        with Path(out[-1]).open("w", newline="") as file:
            csv.writer(file).writerows((COLUMNS, *rows))


if __name__ == "__main__":
    main(sys.argv[1:])
