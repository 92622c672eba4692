"""Steps per second of solvers that others released, beside `jfrnn.sph`: with as many particles, each with what it computes."""

import ctypes.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from experiments._commands import take_folder

WATER = 30_752  # particles of the column `dam-break-3d` at nx = 31
STEPS = 20
REPEATS = 9  # of a frame of Warp's example on a GPU, which is short
_REACH = 2.0  # spacings that particles of Warp's example see; as it is, they begin as far apart as they see, without neighbors
CONTENT = {
    "jfrnn.sph": "three sums: densities carried on with δ-SPH's diffusion, what walls show, pressure and artificial viscosity; "
    "a symplectic step as long as the Courant condition allows",
    "jfrnn.sph, cutoff of 2 spacings": "the same",
    "SPlisHSPlasH, WCSPH": "neighbors by CompactNSearch, densities summed, Tait's pressure, its force, explicit viscosity, walls "
    "as particles with volumes (Akinci et al. 2012), a semi-implicit Euler step of 0.1 ms; float32, OpenMP",
    "jax-sph": "edges of its copy of jax-md's list made anew, densities summed, pressure and viscosity of volumes (Adami et al. "
    "2013), semi-implicit Euler; 31³ particles of a periodic box that they fill, quintic kernel of 3 spacings; float32",
    "Warp, example_sph": "HashGrid built, densities summed, pressure and viscosity (Müller et al. 2003), six planes that particles "
    "bounce off, kick and drift; its smoothing length made 2 spacings, its mass that of its density at rest; float32",
}
Row = dict[str, Any]


def command(out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "sph-peers") -> str:
    """Time steps of solvers that others released and that are installed here, or go on with it; then print a table."""
    return run(take_folder(out))


def run(folder: Path) -> str:
    """Time the solvers that are installed, each in a process of its own, and write table.csv; rows with times stay."""
    path = folder / "table.csv"
    rows = pd.read_csv(path).to_dict("records") if path.exists() else []
    there = {row["solver"]: row for row in rows if not np.isnan(row["seconds"])}
    for solver in CONTENT:
        if solver not in there:
            there[solver] = {"solver": solver} | _ask(solver) | {"computes": CONTENT[solver]}
        pd.DataFrame([there[name] for name in CONTENT if name in there]).to_csv(path, index=False)
    return pd.DataFrame(list(there.values())).drop(columns="computes").to_string(index=False)


def _ask(solver: str) -> Row:
    """Measure a solver in a process of its own; its last line is the row."""
    surroundings = dict(os.environ)
    if solver.startswith("SPlisHSPlasH") and (name := ctypes.util.find_library("GL")):
        # Its wheel brings a second copy of a part of libGL, which must not be the first that is initialized.
        surroundings["LD_PRELOAD"] = name
    code = f"from experiments.sph import peers; peers.answer({solver!r})"
    done = subprocess.run([sys.executable, "-c", code], env=surroundings, capture_output=True, text=True, timeout=1800)
    if done.returncode:
        reason = done.stderr.strip().splitlines()
        return {"device": "", "seconds": float("nan"), "reason": reason[-1] if reason else f"ended with {done.returncode}"}
    return json.loads(done.stdout.strip().splitlines()[-1])


def answer(solver: str) -> None:
    """Measure a solver in this process, and print the row as JSON."""
    print("\n" + json.dumps({"reason": ""} | _MEASURE[solver]()))


def _steps(platform: str) -> int:
    """Return how many steps are timed: a step on a GPU is short."""
    return STEPS if platform == "cpu" else 50 * STEPS


def _own(support: float | None) -> Row:
    import jax

    import jfrnn
    from jfrnn import sph
    from jfrnn.cases import fluids
    from jfrnn.sph.runs import How, faster_way

    scene, platform = fluids.fluid("dam-break-3d", nx=31), jax.default_backend()
    if support is not None:  # wendland2 reaches two smoothing lengths
        scene = replace(scene, physics=replace(scene.physics, smoothing=support / 2 * scene.spacing))
    model, steps = sph.make_model(scene, np.float32), _steps(platform)
    s, nbrs = jax.jit(sph.begin)(model, sph.make_state(scene, np.float32)), None
    if faster_way(platform, scene.n) == "list":
        nbrs = sph.list_neighbors(model, s, How().skin * scene.spacing)
    jax.block_until_ready(sph.advance(model, s, nbrs, steps))
    start = perf_counter()
    _, after = jax.block_until_ready(sph.advance(model, s, nbrs, steps))
    seconds = (perf_counter() - start) / steps
    if after is not None:
        after.check()
    fluid = np.ones(scene.n, bool) if scene.wall is None else ~scene.wall
    met = np.asarray(jfrnn.count(s.x, model.cutoff))[fluid].mean()
    about = {"version": jfrnn.__version__, "device": jax.devices()[0].device_kind, "fluid": int(fluid.sum())}
    return about | {"walls": int((~fluid).sum()), "neighbors": float(met), "seconds": seconds}


def _splishsplash() -> Row:
    from importlib.metadata import version

    import pysplishsplash as sph  # pyright: ignore[reportMissingImports]

    dx, step = 0.0302, 1e-4
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "box.obj").write_text(_BOX)
        scene = {
            "Configuration": {
                **{"particleRadius": dx / 2, "density0": 1000, "simulationMethod": 0, "gravitation": [0, -9.81, 0]},
                **{"timeStepSize": step, "cflMethod": 0, "stiffness": 50000, "exponent": 7, "boundaryHandlingMethod": 0},
                **{"pause": False, "stopAt": 2 * STEPS * step},
            },
            "Materials": [{"id": "Fluid", "viscosity": 0.01, "viscosityMethod": 1}],
            "RigidBodies": [
                {"geometryFile": str(folder / "box.obj"), "scale": [2, 2, 1], "translation": [0, 1, 0], "isDynamic": False}
                | {"isWall": True, "mapInvert": True}
            ],
            "FluidBlocks": [{"id": "Fluid", "denseMode": 0, "start": [-1 + dx, dx, -0.5 + dx], "end": [0, 1, 0.5 - dx]}],
        }
        (folder / "dam.json").write_text(json.dumps(scene))
        base, seen, times = sph.Exec.SimulatorBase(), {}, []

        def look() -> None:
            times.append(perf_counter())
            if len(times) == STEPS:
                simulation = sph.Simulation.getCurrent()
                n = simulation.getFluidModel(0).numActiveParticles()
                asked = range(0, n, 97)
                met = [simulation.numberOfNeighbors(0, 0, i) + simulation.numberOfNeighbors(0, 1, i) for i in asked]
                walls = simulation.getBoundaryModel(0).numberOfParticles()
                seen.update(fluid=n, walls=walls, neighbors=float(np.mean(met)))
                times[-1] = perf_counter()

        base.setTimeStepCB(look)
        base.init(sceneFile=str(folder / "dam.json"), useGui=False, outputDir=name, useCache=False, initialPause=False)
        base.run()
    seconds = float(np.median(np.diff(times[STEPS - 1 :])))
    return {"version": version("pysplishsplash"), "device": "cpu"} | seen | {"seconds": seconds}


def _warp() -> Row:
    import warp
    from warp.examples.core.example_sph import Example  # pyright: ignore[reportMissingImports]

    import jfrnn

    spacing = (80.0**3 / 16 / WATER) ** (1 / 3)  # its own number of particles follows from that

    class Sized(Example):
        seen = spacing
        smoothing_length = property(lambda self: self.seen, lambda self, value: None)

    def frame() -> tuple[Example, float]:
        """Begin anew and time the second frame: its particles fall together over frames."""
        example = Sized(stage_path=None)  # pyright: ignore[reportArgumentType]
        h = example.seen = _REACH * spacing  # its particles are there: from now on they see farther
        mass = example.particle_mass = example.base_density * spacing**3
        example.density_normalization = 315 * mass / (64 * np.pi * h**9)
        example.pressure_normalization = -45 * mass / (np.pi * h**6)
        example.viscous_normalization = 45 * example.dynamic_visc * mass / (np.pi * h**6)
        example.step()
        warp.synchronize()
        start = perf_counter()
        example.step()
        warp.synchronize()
        return example, (perf_counter() - start) / example.sim_step_to_frame_ratio

    with warp.ScopedDevice("cuda:0" if warp.is_cuda_available() else "cpu") as device:
        frames = [frame() for _ in range(REPEATS if device.is_cuda else 1)]
        example, seconds = frames[-1][0], float(np.median([seconds for _, seconds in frames]))
        met = np.asarray(jfrnn.count(example.x.numpy(), example.smoothing_length)).mean()
        return {"version": warp.__version__, "device": device.name} | {
            **{"fluid": example.n, "walls": 0, "neighbors": float(met), "seconds": seconds}
        }


def _jax_sph() -> Row:
    import jax
    from jax_sph import simulate  # pyright: ignore[reportMissingImports]
    from jax_sph.defaults import defaults  # pyright: ignore[reportMissingImports]
    from omegaconf import OmegaConf  # pyright: ignore[reportMissingImports]

    import jfrnn
    from experiments import _machine

    along, times, seen = round(WATER ** (1 / 3)), [], {}

    def look(step: int, state: Any, *_: Any) -> None:  # noqa: ANN401
        """Stand where it writes its states: before each step."""
        jax.block_until_ready(state["r"])
        times.append(perf_counter())
        seen.update(x=state["r"])

    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "box.py").write_text(_CASE)
        case = {"source": "box.py", "dx": 1 / along, "dim": 3, "viscosity": 0.01}
        own = {"config": f"{name}/box.yaml", "dtype": "float32", "case": case}
        config = OmegaConf.merge(defaults, own)
        step = config.solver.cfl / along / (config.case.c_ref_factor + 1) / config.case.u_ref
        config = OmegaConf.merge(config, {"solver": {"t_end": 2 * STEPS * step}, "io": {"data_path": name, "write_type": []}})
        simulate.write_state = look
        simulate.simulate(config)
    box = jfrnn.Box([1.0] * 3)
    met = np.asarray(jfrnn.count(seen["x"], 3.0 / along, box=box)).mean()
    return {
        "version": (_machine.commit(Path(simulate.__file__).parents[1])["commit"] or "unknown")[:7],
        "device": jax.devices()[0].device_kind,
        "fluid": along**3,
        "walls": 0,
    } | {**{"neighbors": float(met), "seconds": float(np.median(np.diff(times[STEPS:])))}}


_CASE = """
import numpy as np
import jax.numpy as jnp
from jax_sph.case_setup import SimulationSetup


class BOX(SimulationSetup):
    def _box_size3D(self, n_walls):
        return np.ones(3)

    def _init_velocity3D(self, r):
        x, y, z = 2 * jnp.pi * r
        return jnp.cos(z) * jnp.array([jnp.sin(x) * jnp.cos(y), -jnp.cos(x) * jnp.sin(y), 0.0])

    def _external_acceleration_fn(self, r):
        return jnp.zeros_like(r)

    def _boundary_conditions_fn(self, state):
        return state

    _box_size2D = _init_walls_2d = _init_walls_3d = _init_velocity2D = None
"""
_BOX = "".join(f"v {x} {y} {z}\n" for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))
_BOX += "".join(f"f {a} {b} {c}\nf {a} {c} {d}\n" for a, b, c, d in (
    (1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4),
))  # fmt: skip
_MEASURE: dict[str, Callable[[], Row]] = {
    "jfrnn.sph": lambda: _own(None),
    "jfrnn.sph, cutoff of 2 spacings": lambda: _own(2.0),
    "SPlisHSPlasH, WCSPH": _splishsplash,
    "jax-sph": _jax_sph,
    "Warp, example_sph": _warp,
}
