"""Run a scene: in chunks of steps, a snapshot, a line of energies and a picture after each, from the last snapshot on."""

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import jax
import numpy as np

import jfrnn
from experiments import _loop
from experiments._errors import UsageError
from experiments.sph import forces, frames, health, settings, snapshots, solids, solver
from experiments.sph.forces import Neighbors
from experiments.sph.model import make_model, make_state
from experiments.sph.particles import Flow, GasModel, Model, State
from jfrnn.cases.fluids import GasScene, Scene


@dataclass(frozen=True)
class How:
    """How a scene is run.

    Attributes:
        frames: Snapshots after the first.
        dtype: "float32" or "float64".
        neighbors: "pair_sum": every sum finds neighbors anew; "list": a list with a skin is updated; "auto": what is faster here.
        skin: Of the list, in particle spacings.
        pictures: Whether frames and a GIF are drawn.
    """

    frames: int = 50
    dtype: str = "float64"
    neighbors: str = "auto"
    skin: float = 0.3
    pictures: bool = True


MOST_FOR_LISTS = 1 << 18  # particles up to which sums over a list are faster on a GPU; see `faster_way`


def faster_way(platform: str, particles: int) -> str:
    """Return "pair_sum" or "list", whichever makes more steps per second in 3D, in float32 and with a skin of 0.3 spacings.

    Of 107 660 particles sums that search are faster on the CPU, by a factor of 3, and sums over a list on a GPU, by 1.3; of 1.06
    million sums that search are faster there, too, by 1.5 (`experiments/results/sph/speed_kept`, `speed_kept_h100`).
    """
    return "list" if platform != "cpu" and particles <= MOST_FOR_LISTS else "pair_sum"


def run(scene: Scene, folder: Path, how: How) -> State:
    """Run a scene from its beginning, or from the last snapshot of the folder, to its end.

    Args:
        scene: The scene.
        folder: Gets run.json, energies.csv, snapshots/STEP.npz and .vtp, frames/STEP.png, NAME.gif.
        how: Options.

    Returns:
        The last state.

    Raises:
        UsageError: The folder holds another run, or the scene cannot be run.
        DivergedError: A particle is not finite, or went through a wall.
    """
    about = settings.describe(scene) | {"dtype": how.dtype, "frames": how.frames, "given": _digest(scene)}
    try:
        model = make_model(scene, np.dtype(how.dtype).type)
        first = None if (folder / "run.json").exists() else make_state(scene, np.dtype(how.dtype).type)  # refused before
        snapshots.check_same(about, folder)
        saved = snapshots.latest(folder / "snapshots", scene)
        s, step = saved or (first or make_state(scene, np.dtype(how.dtype).type), 0)
    except ValueError as error:
        raise UsageError(f"scene {scene.name!r}: {error}") from error
    nbrs = _first_neighbors(scene, model, s, how)
    if saved is None:
        s = jax.jit(solver.begin)(model, s, nbrs)
        _keep(scene, model, s, nbrs, folder, step, how)
    with _loop.show(how.frames, round(how.frames * float(s.time) / scene.duration)) as shown:
        shown.label(scene.name)
        while (goal := _next_moment(scene, model, s, how.frames)) is not None:
            start, before, nbrs_before = perf_counter(), s, nbrs
            s, nbrs, steps = _chunk(model, s, nbrs, goal)
            jax.block_until_ready(s.x)
            seconds = perf_counter() - start
            health.check(scene, model, before, nbrs_before, s, steps, step)
            if isinstance(nbrs, jfrnn.NeighborList):
                nbrs.check()
            step += steps
            line = _keep(scene, model, s, nbrs, folder, step, how)
            text = f"t {line['time']:.4g} s · {steps / seconds:.0f} steps/s · energy {line['total']:.4g} J"
            shown.label(text + ("" if nbrs is None else f" · {int(nbrs.rebuild_count)} rebuilds"))
            shown.advance()
    if how.pictures:
        frames.animate(folder / "frames", folder / f"{scene.name}.gif")
    return s


def _first_neighbors(scene: Scene, model: Flow, s: State, how: How) -> Neighbors:
    """Return a list where sums over one are asked for or faster; the smoothing lengths of a gas change in every step.

    Raises:
        UsageError: A list is asked for, of a gas.
    """
    if isinstance(model, GasModel):
        if how.neighbors == "list":
            raise UsageError(f"--neighbors list: the cutoffs of scene {scene.name!r} change in every step; take pair_sum or auto")
        return None
    way = faster_way(jax.default_backend(), scene.n) if how.neighbors == "auto" else how.neighbors
    return solver.list_neighbors(model, s, how.skin * scene.spacing) if way == "list" else None


def _digest(scene: Scene) -> str:
    """Return 12 hex digits that stand for the particles and the solid of a scene."""
    arrays = [scene.positions, scene.velocities, scene.masses]
    arrays += [scene.energies] if isinstance(scene, GasScene) else []
    arrays += [scene.solid.vertices, scene.solid.faces] if scene.solid else []
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()[:12]


def _chunk(model: Flow, s: State, nbrs: Neighbors, goal: float) -> tuple[State, Neighbors, int]:
    """Run steps to about a time [s], and return their number; where a row of a list overflowed, with a larger list again.

    The steps of a fluid grow slowly: their number is told by the first. Those of a gas grow fast after a blast, and are counted.
    """
    if isinstance(model, GasModel):
        after, taken = solver.advance_until(model, s, goal)
        return after, None, int(taken)
    steps = max(1, round((goal - float(s.time)) / _step_now(model, s)))
    while True:
        after, seen = _chunk_of_particles(model, s, nbrs, steps)
        if s.solid is None or after.solid is None or not after.solid.tri.overflow:
            return after, seen, steps
        larger = after.solid.tri.grow(solids.into_frame(s.x, model.turning, s.solid.angle))
        s = s._replace(solid=s.solid._replace(tri=larger))


def _chunk_of_particles(model: Model, s: State, nbrs: Neighbors, steps: int) -> tuple[State, Neighbors]:
    if nbrs is None:
        return solver.advance(model, s, None, steps)
    active = None if model.enters is None else lambda s: forces.active(model, s.time)
    try:
        return jfrnn.run_chunk(lambda s, nbrs: solver.advance(model, s, nbrs, steps), s, nbrs, lambda s: s.x, active=active)  # type: ignore[arg-type]
    except ValueError:  # particles are nowhere: `health.check` finds out since which step
        return solver.advance(model, s, nbrs, steps)


def _next_moment(scene: Scene, model: Flow, s: State, count: int) -> float | None:
    """Return the time of the next snapshot [s]; None at the end."""
    time, step = float(s.time), _step_now(model, s)
    if time > scene.duration - step / 2:
        return None
    interval = scene.duration / count
    return interval * (math.floor((time + step / 2) / interval) + 1)


def _step_now(model: Flow, s: State) -> float:
    return float(solver.courant(model, s) if model.step is None else model.step)


def _keep(scene: Scene, model: Flow, s: State, nbrs: Neighbors, folder: Path, step: int, how: How) -> dict[str, float]:
    """Write what belongs to a moment; return its energies."""
    line = snapshots.energies(model, s, scene)
    snapshots.add_line(line, folder / "energies.csv", step)
    rho, p = jax.jit(solver.density_and_pressure)(model, s, nbrs)
    if how.pictures:
        x, v = np.asarray(s.x), np.asarray(s.v)
        top = max(np.linalg.norm(scene.velocities, axis=1).max(initial=0), line["top_speed"])
        frames.draw(scene, x, v, line["time"], float(top), folder / "frames" / f"{step:09d}.png")
    snapshots.save(s, scene, np.asarray(rho), np.asarray(p), folder / "snapshots", step)
    return line
