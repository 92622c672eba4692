"""A weakly compressible SPH solver on jfrnn, and a gas: a scene says what it has, and exactly that is compiled.

A scene is plain data (`FluidScene`, `GasScene`). `make_model` and `make_state` put it into JAX, `begin`, `step`, `advance` and
`rollout` make steps of it inside `jax.jit`, and `run` writes snapshots, energies and pictures as it goes. `jfrnn.sph.spread` does
the same over many devices. On the command line: `python -m jfrnn.sph run SCENE`.
"""

from jfrnn.cases.fluids import FluidScene, Gas, GasScene, Periodic, Physics, Scene, Solid, Tank, Turning, inflow, lattice
from jfrnn.sph.check import check_scene
from jfrnn.sph.errors import DivergedError, SceneError
from jfrnn.sph.files import read_solid, with_particles, with_solid
from jfrnn.sph.model import make_model, make_state
from jfrnn.sph.particles import Model, State
from jfrnn.sph.probes import flow_through, force_on_solid, force_on_walls, pressure_at, surface_height
from jfrnn.sph.relaxing import relax
from jfrnn.sph.runs import How, run
from jfrnn.sph.settings import make_scene
from jfrnn.sph.solver import advance, advance_until, begin, courant, density_and_pressure, energies, list_neighbors, rollout, step
from jfrnn.sph.toml_scenes import read_scene

__all__ = ["FluidScene", "Gas", "GasScene", "Periodic", "Physics", "Scene", "Solid", "Tank", "Turning", "inflow", "lattice"]
__all__ += ["SceneError", "check_scene", "make_scene", "read_scene", "read_solid", "relax", "with_particles", "with_solid"]
__all__ += ["DivergedError", "How", "Model", "State", "list_neighbors", "make_model", "make_state", "run"]
__all__ += ["advance", "advance_until", "begin", "courant", "density_and_pressure", "energies", "rollout", "step"]
__all__ += ["flow_through", "force_on_solid", "force_on_walls", "pressure_at", "surface_height"]
