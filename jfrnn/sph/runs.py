"""Run a scene: in chunks of steps, a snapshot, a line of energies and a picture after each, from the last snapshot on."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import jax
import numpy as np
from jax import Array

import jfrnn
from jfrnn.cases.fluids import Scene
from jfrnn.sph import health, ranges, series, settings, snapshots, solids, solver
from jfrnn.sph.errors import SceneError
from jfrnn.sph.interrupts import hold_interrupts
from jfrnn.sph.model import choose_dtype, make_model, make_state
from jfrnn.sph.pairs import Neighbors
from jfrnn.sph.particles import Flow, Force, GasModel, State, active
from jfrnn.sph.probes import Probe, check_names, columns
from jfrnn.sph.progress import Progress


@dataclass(frozen=True)
class How:
    """How a scene is run.

    Attributes:
        frames: Snapshots after the first.
        dtype: "float32" or "float64"; None: float64 where JAX has it, as `jax_enable_x64` says.
        neighbors: "pair_sum": every sum finds neighbors anew; "list": a list with a skin is updated; "auto": what is faster here.
        skin: Of the list, in particle spacings.
        pictures: Whether frames and a GIF are drawn.
        lines: Lines of the tables, energies.csv and probes.csv, for each snapshot.
        hdf: Whether all snapshots also go into one file, NAME.vtkhdf; takes h5py.
    """

    frames: int = 50
    dtype: str | None = None
    neighbors: str = "auto"
    skin: float = 0.3
    pictures: bool = True
    lines: int = 1
    hdf: bool = False

    def __post_init__(self) -> None:
        """Refuse what the command line would: a `SceneError` names the field."""
        kinds = {"frames": int, "lines": int, "skin": float, "neighbors": Literal["auto", "pair_sum", "list"]}
        kinds |= {"pictures": bool, "hdf": bool}
        bounds = {"frames": ranges.MANY, "lines": ranges.MANY, "skin": ranges.SKIN}
        for name, kind in kinds.items():
            value = getattr(self, name)
            try:
                object.__setattr__(self, name, ranges.read(kind, value, bounds.get(name)))  # frozen; the text "2" is 2
            except ValueError as error:
                raise SceneError(f"{name}: got {value!r}; {error}") from error


SECONDS, MOST_STEPS = 0.5, 100_000  # between two looks at a run
MOST_FOR_LISTS = 1 << 18  # particles up to which sums over a list are faster on a GPU; see `faster_way`


def faster_way(platform: str, particles: int) -> str:
    """Return "pair_sum" or "list", whichever makes more steps per second in 3D, in float32 and with a skin of 0.3 spacings.

    Of 107 660 particles sums that search are faster on the CPU, by a factor of 3, and sums over a list on a GPU, by 1.3; of 1.06
    million sums that search are faster there, too, by 1.5 (`experiments/results/sph/speed_kept`, `speed_kept_h100`).
    """
    return "list" if platform != "cpu" and particles <= MOST_FOR_LISTS else "pair_sum"


def run(
    scene: Scene, folder: Path | str, how: How = How(), *, force: Force | None = None, probes: dict[str, Probe] | None = None
) -> State:
    """Run a scene from its beginning, or from the last snapshot of the folder, to its end.

    Ctrl-C stops it between two steps; the same call then goes on from the last snapshot, to the same end: bit by bit, or within
    rounding where sums are over a list, which is made anew. A run that has ended goes on if the scene takes longer, and has as many
    snapshots more.

    Args:
        scene: The scene.
        folder: Gets run.json, energies.csv, probes.csv, snapshots/STEP.npz and .vtp, NAME.pvd, the series of those for ParaView,
            frames/STEP.png, NAME.gif; if asked for, NAME.vtkhdf; and lock, an empty file that a run holds as long as it goes on.
        how: Options.
        force: As in `make_model`. It is no part of run.json: who goes on with a run gives the same.
        probes: Functions (model, state) -> numbers, arrays or dicts of them, inside jit, whose values are columns of probes.csv.

    Returns:
        The last state.

    Raises:
        SceneError: The folder holds another run, another run writes there now, or the scene cannot be run.
        DivergedError: A particle is not finite, or went through a wall.
        KeyboardInterrupt: Ctrl-C came.
    """
    folder, dtype = Path(folder), choose_dtype(how.dtype)
    check_names(probes or {})
    if how.hdf:
        series.check_library()
    with hold_interrupts() as stopped, ExitStack() as held:
        try:
            model, first = make_model(scene, dtype, force=force), make_state(scene, dtype)  # what is refused leaves no folder
        except SceneError as error:
            raise SceneError(f"scene {scene.name!r}: {error}") from error
        write = _Writer(scene, model, first, folder, how, probes or {})
        held.enter_context(snapshots.hold(folder))
        snapshots.check_same(_describe(scene, how, dtype), folder)
        saved = snapshots.latest(folder / "snapshots", scene)
        s, step = saved or (first, 0)
        nbrs = _first_neighbors(scene, model, s, how)
        if saved is None:
            s = jax.jit(solver.begin)(model, s, nbrs)
            write.line(s, step)
            write.snapshot(s, nbrs, step)
        else:
            write.check(s)
        write.series(step)
        moments = how.frames * how.lines
        progress = Progress(how.frames, round(how.frames * float(s.time) / scene.duration))
        start, step_before = perf_counter(), step
        while (moment := round(moments * float(s.time) / scene.duration) + 1) <= moments:
            goal = float(np.asarray(scene.duration * moment / moments, s.x.dtype))  # as the dtype rounds it
            s, nbrs, step = _go_to(goal, scene, model, s, nbrs, step, stopped)
            line = write.line(s, step)
            if moment % how.lines:
                continue
            write.snapshot(s, nbrs, step)
            rate = f"{(step - step_before) / (perf_counter() - start):.0f} steps/s"
            start, step_before = perf_counter(), step
            unit = "J" if scene.dim == len("xyz") else "J/m"
            text = f"{scene.name}: t {line['time']:.4g} s, {rate}, energy {line['total']:.4g} {unit}"
            progress.advance(text + ("" if nbrs is None else f", {int(nbrs.rebuild_count)} rebuilds"))
        progress.end()
        if how.pictures:
            from jfrnn.sph import frames

            frames.animate(folder / "frames", folder / f"{scene.name}.gif")
    return s


def _go_to(
    goal: float, scene: Scene, model: Flow, s: State, nbrs: Neighbors, step: int, stopped: Callable[[], bool]
) -> tuple[State, Neighbors, int]:
    """Run steps to a time [s], looking after about half a second whether all is well, and whether the user stops it."""
    most = 1
    while float(s.time) < goal:
        if stopped():
            raise KeyboardInterrupt
        start, before, nbrs_before = perf_counter(), s, nbrs
        s, nbrs, steps = _chunk(model, s, nbrs, goal, most)
        jax.block_until_ready(s.x)
        most = max(1, min(round(SECONDS * steps / (perf_counter() - start)), MOST_STEPS))
        health.check(scene, model, before, nbrs_before, s, steps, step)
        if isinstance(nbrs, jfrnn.NeighborList):
            nbrs.check()
        step += steps
    return s, nbrs, step


def _describe(scene: Scene, how: How, dtype: type) -> dict[str, Any]:
    """Return what a run must have in common with one that it goes on with."""
    return settings.describe(scene) | {"dtype": np.dtype(dtype).name, "frames": how.frames, "lines": how.lines}


def _first_neighbors(scene: Scene, model: Flow, s: State, how: How) -> Neighbors:
    """Return a list where sums over one are asked for or faster; refuse one where pairs change in every step, as in a gas."""
    way = faster_way(jax.default_backend(), scene.n) if how.neighbors == "auto" else how.neighbors
    nbrs = solver.list_neighbors(model, s, how.skin * scene.spacing) if way == "list" else None
    if how.neighbors == "list" and nbrs is None:
        thin = " beside its thin solid (thin=False of the solid leaves that out)" if scene.solid else ""
        raise SceneError(
            f"neighbors 'list': which pairs scene {scene.name!r} has{thin} changes in every step; take pair_sum or auto"
        )
    return nbrs


def _chunk(model: Flow, s: State, nbrs: Neighbors, goal: float, most: int) -> tuple[State, Neighbors, int]:
    """Run steps to a time [s], at most so many, and return their number; where a row of a list overflowed, all again."""
    while True:
        after, seen, steps = _chunk_of_particles(model, s, nbrs, goal, most)
        if isinstance(model, GasModel) or after.solid is None or not after.solid.overflow:
            return after, seen, int(steps)
        s = solids.grow(model, s, after.solid)


def _chunk_of_particles(model: Flow, s: State, nbrs: Neighbors, goal: float, most: int) -> tuple[State, Neighbors, Array | int]:
    if nbrs is None:
        return solver.advance_until(model, s, None, goal, most)
    there = None if active(model, s) is None else lambda carry: active(model, carry[0])

    def advance(carry: tuple[State, Array | int], nbrs: Neighbors) -> tuple[tuple[State, Array | int], Neighbors]:
        after, nbrs, steps = solver.advance_until(model, carry[0], nbrs, goal, most)
        return (after, steps), nbrs

    try:
        (after, steps), nbrs = jfrnn.run_chunk(advance, (s, 0), nbrs, lambda carry: carry[0].x, active=there)  # type: ignore[arg-type]
    except ValueError:  # particles are nowhere: `health.check` finds out since which step
        (after, steps), nbrs = advance((s, 0), nbrs)
    return after, nbrs, steps


class _Writer:
    """Writes what belongs to a moment of a run."""

    def __init__(self, scene: Scene, model: Flow, first: State, folder: Path, how: How, probes: dict[str, Probe]) -> None:
        self._scene, self._model, self._folder, self._how = scene, model, folder, how
        self._heads = columns(probes, model, first)
        self._probe = jax.jit(lambda model, s: {name: probe(model, s) for name, probe in probes.items()}) if probes else None
        self._line: dict[str, float] = {}

    def line(self, s: State, step: int) -> dict[str, float]:
        """Add a line to each table, and return the energies."""
        for name, line in self._tables(s).items():
            snapshots.add_line(line, self._folder / name, step)
        return self._line

    def check(self, s: State) -> None:
        """Refuse to go on with tables of other columns."""
        for name, line in self._tables(s).items():
            snapshots.check_columns(line, self._folder / name)

    def _tables(self, s: State) -> dict[str, dict[str, float]]:
        """Return a line of each table, by its file: numbers by the heads of their columns. The energies are kept."""
        self._line = snapshots.energies(self._model, s, self._scene)
        tables = {"energies.csv": {snapshots.head(name, s.x.shape[1]): value for name, value in self._line.items()}}
        if self._probe is None:
            return tables
        seen = [float(number) for leaf in jax.tree.leaves(self._probe(self._model, s)) for number in np.ravel(np.asarray(leaf))]
        time = {snapshots.head("time", s.x.shape[1]): self._line["time"]}
        return tables | {"probes.csv": time | dict(zip(self._heads, seen, strict=True))}

    def snapshot(self, s: State, nbrs: Neighbors, step: int) -> None:
        """Write the state of the last line, and draw it."""
        scene = self._scene
        rho, p = jax.jit(solver.density_and_pressure)(self._model, s, nbrs)
        if self._how.pictures:
            from jfrnn.sph import frames

            x, v, time = np.asarray(s.x), np.asarray(s.v), self._line["time"]
            top = max(np.linalg.norm(scene.velocities, axis=1).max(initial=0), self._line["top_speed"])
            there = snapshots.are_there(scene, s)
            frames.draw(scene, there, x, v, time, float(top), self._folder / "frames" / f"{step:09d}.png")
        snapshots.save(s, scene, np.asarray(rho), np.asarray(p), self._folder / "snapshots", step)
        self.series(step)

    def series(self, step: int) -> None:
        """Bring the series up to this step, which a kill may have kept from it: that of files, and the one file if asked for."""
        snapshots.add_to_series(self._folder / f"{self._scene.name}.pvd", self._line["time"], step)
        if self._how.hdf:
            series.follow(self._folder / f"{self._scene.name}.vtkhdf", self._folder / "snapshots", step)
