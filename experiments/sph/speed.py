"""Steps per second of a scene by ways to find and sum pairs, all in one process and in turns; and where a step's time goes."""

import functools
import inspect
import itertools
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field, FiniteFloat, field_validator

from experiments import _machine, _measure, _sweep
from experiments._config import Dtype, Keyed, Positive, Table
from experiments._loop import Task, fill
from experiments._rows import RowFile, TimedRow
from experiments.sph import edges
from experiments.sph import tradeoff as known_flow
from experiments.sph.stages import part_times
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene
from jfrnn.sph import solver
from jfrnn.sph.model import Model, State, make_model, make_state

Prepare = Callable[[Model, State, float], Any]
WAYS: dict[str, Prepare] = {
    "pair_sum": lambda model, s, skin: None,
    "list": solver.list_neighbors,
    "jax-sph": lambda model, s, skin: edges.of_jax_md(model, s, 0.0),
    "jax-sph, skin": edges.of_jax_md,
    "edges of jfrnn": edges.of_own_list,
}
"""What finds the pairs of each way: sums that search, our list with a skin, jax-md's list as jax-sph takes it (made anew in every
step) and with a skin, and our list; the last three as edges, summed by segments."""
_SECONDS = 2.0  # that a way runs in its turn at least, in up to five runs
MOST_ROUNDINGS = 64  # by which two ways may differ after a step, see `difference`


class Config(Table):
    """What is measured."""

    scene: str = "dam-break-3d"  # a fluid scene; walls count as particles
    nx: tuple[Annotated[int, Field(ge=2)], ...] = ()  # resolutions, as the scene takes them
    ways: tuple[str, ...] = ("pair_sum", "list")  # of `WAYS`; all are compared with the first
    most_particles: dict[str, int] = Field(default_factory=dict)  # of ways that larger scenes are skipped for
    stages: tuple[Literal["pair_sum", "list"], ...] = ()  # ways whose stages are timed besides ...
    staged: tuple[int, ...] = ()  # ... at these resolutions; none: at all
    dtype: Dtype = "float32"  # of all numbers
    steps: Annotated[int, Field(ge=1)] = 10  # per timed run, from the same state each time
    rounds: Annotated[int, Field(ge=1)] = 5  # timed runs of each way
    skin: Positive = 0.3  # in particle spacings
    # The fluid begins with velocities rate·(x, 0, -z) [1/s]: a column in mid-collapse, whose lists are made anew.
    rate: FiniteFloat = 1.5
    tradeoff: known_flow.Config | None = None  # runs of a flow with a known answer: error against seconds

    @field_validator("scene")
    @classmethod
    def _scene_exists(cls, name: str) -> str:
        if name not in fluids.FLUIDS:
            raise ValueError(f"unknown fluid scene {name!r}; allowed: {', '.join(fluids.FLUIDS)}")
        if "nx" not in inspect.signature(fluids.FLUIDS[name]).parameters:
            raise ValueError(f"fluid scene {name!r} has no nx, by which its steps are timed")
        return name

    @field_validator("ways")
    @classmethod
    def _ways_exist(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if name not in WAYS:
                raise ValueError(f"unknown way {name!r}; allowed: {', '.join(WAYS)}")
        return names

    def specs(self) -> Iterator["Spec"]:
        """Yield the rows of steps and of stages, those of one scene side by side."""
        shared = self.model_dump(include={"scene", "dtype", "steps", "rounds", "skin", "rate"})
        for nx in self.nx:
            parts = self.stages if nx in (self.staged or self.nx) else ()
            for kind, way in itertools.chain((("step", way) for way in self.ways), (("stages", way) for way in parts)):
                yield Spec(kind=kind, way=way, nx=nx, most_particles=self.most_particles.get(way), **shared)


@dataclass(frozen=True)
class Spec(Keyed):
    """What one row measures, and how: fields as in `Config`."""

    kind: str
    way: str
    scene: str
    nx: int
    dtype: str
    steps: int
    rounds: int
    skin: float
    rate: float
    most_particles: int | None


@dataclass(kw_only=True)
class StepRow(TimedRow):
    """Steps of a scene by one way ("step"), its stages ("stages"), or a run with a known answer ("tradeoff").

    Times are of one step, with the list's share of being made anew.
    """

    kind: str
    way: str
    scene: str
    nx: int
    dtype: str
    steps: int  # of the whole run in a "tradeoff", of one timed run else
    skin: float  # in particle spacings
    particles: int | None = None  # walls included
    fluid: int | None = None  # those of the fluid
    steps_per_s: float | None = None  # by the median
    particle_steps_per_s: float | None = None  # of all particles
    rebuilds: int | None = None  # how often the list was made anew in a run; None where there is none
    bytes: int | None = None  # what the compiled run takes: arguments, results and scratch
    difference: float | None = None  # largest difference from the first way after one step, see `speed.difference`
    parts: dict[str, float] = field(default_factory=dict)  # seconds of a step by stage
    error: dict[str, float] = field(default_factory=dict)  # of a "tradeoff": by name
    seconds: float | None = None  # of a "tradeoff": the run without compilation


def run(config: Config, folder: Path, retry_failed: bool = False) -> list[StepRow]:
    """Measure what the folder does not hold yet, and return all rows of the config.

    Ways of one scene are timed in turns: where a row of them is missing, all are measured again.
    """
    tasks = []
    for (nx, kind), same in itertools.groupby(config.specs(), lambda spec: (spec.nx, spec.kind)):
        group = list(same)
        tasks.append(
            Task(tuple(x.key for x in group), f"{config.scene} · nx {nx} · {kind}", lambda _, group=group: _measure_scene(group))
        )
    for spec in () if config.tradeoff is None else config.tradeoff.specs():
        tasks.append(Task((spec.key,), f"{spec.scene} · nx {spec.nx} · {spec.way}", lambda _, spec=spec: [_flow(spec)]))
    about = {"versions": _machine.versions(["jax-md"])}
    return fill(RowFile(folder, StepRow), tasks, describe, retry_failed=retry_failed, about=about)


def _flow(spec: known_flow.Spec) -> StepRow:
    return _row(spec, "tradeoff", _sweep.ask({"do": "sph", "spec": asdict(spec)}, 3600.0, cold=False))


def _measure_scene(group: list[Spec]) -> list[StepRow]:
    """Measure the rows of one scene."""
    first = group[0]
    scene, model, s = _begin(first.scene, first.nx, first.rate, first.dtype)
    about = {"particles": scene.n, "fluid": scene.n if scene.wall is None else int((~scene.wall).sum())}
    about |= {"device": jax.devices()[0].device_kind}
    if first.kind == "step":
        return [replace(row, **about) for row in _step_rows(group, model, s)]
    rows = []
    for spec in group:
        row = _row(spec, "stages", about)
        parts, others = part_times(model, s, spec.way, spec.skin * model.spacing, spec.steps, spec.rounds)
        rows.append(replace(row, status="ok", parts=parts, others_cores=others))
    return rows


@functools.lru_cache(maxsize=1)
def _begin(name: str, nx: int, rate: float, dtype: str) -> tuple[FluidScene, Model, State]:
    """Return a moving scene and its first state; the last one is kept, since rows of it follow."""
    scene, number = set_in_motion(fluids.fluid(name, nx=nx), rate), np.dtype(dtype).type
    model = make_model(scene, number)
    return scene, model, jax.block_until_ready(jax.jit(solver.begin)(model, make_state(scene, number)))


def _row(spec: "Spec | known_flow.Spec", kind: str, seen: dict[str, Any]) -> StepRow:
    shared = {name: value for name, value in asdict(spec).items() if name in StepRow.__dataclass_fields__}
    values: dict[str, Any] = shared | {"kind": kind, "key": spec.key} | seen
    return StepRow(**values)


def set_in_motion(scene: FluidScene, rate: float) -> FluidScene:
    """Return the scene with a fluid that moves by rate·(x, 0, -z), in 2D rate·(x, -z): without divergence, along its walls."""
    flow = np.zeros_like(scene.positions)
    flow[:, 0], flow[:, -1] = rate * scene.positions[:, 0], -rate * scene.positions[:, -1]
    return replace(scene, velocities=flow if scene.wall is None else np.where(scene.wall[:, None], scene.velocities, flow))


def _step_rows(group: list[Spec], model: Model, s: State) -> list[StepRow]:
    """Make every way ready, compare what a step of each gives, then time those that agree, in turns."""
    rows, ready, reference = {}, {}, None
    for spec in group:
        row, most = _row(spec, "step", {}), spec.most_particles
        if most is not None and model.m.shape[0] > most:
            rows[spec.way] = replace(row, status="skipped", reason=f"{spec.way} is run up to {most} particles")
            continue
        try:
            run, fields = _prepare(spec, model, s)
            after = run(1)
            reference = after if reference is None else reference
            fields["difference"] = difference(model, reference, after)
            if not fields["difference"] <= MOST_ROUNDINGS:
                raise ValueError(f"differs from {group[0].way} by {fields['difference']:.3g} roundings")
            ready[spec.way], rows[spec.way] = run, replace(row, **fields)
        except ImportError as error:
            rows[spec.way] = replace(row, status="missing", reason=f"{spec.way} cannot be imported: {error}")
        except Exception as error:  # whatever a way raises, out of memory too, is the result of its row
            rows[spec.way] = replace(row, reason=f"{type(error).__name__}: {error}"[:600])
    steps = group[0].steps
    calls = {way: lambda run=run: run(steps).x for way, run in ready.items()}
    seconds, others = _time_in_turns(calls, group[0].rounds)
    for way, times in seconds.items():
        p10, median, p90 = (float(value) / steps for value in np.percentile(times, (10, 50, 90)))
        speed = {"steps_per_s": 1 / median, "particle_steps_per_s": model.m.shape[0] / median}
        rows[way] = replace(rows[way], status="ok", median_s=median, p10_s=p10, p90_s=p90, others_cores=others, **speed)
    return list(rows.values())


def _time_in_turns(calls: dict[str, Callable[[], Any]], rounds: int) -> tuple[dict[str, list[float]], float | None]:
    """Time calls in turns, and tell how many cores others kept busy; a run is long enough not to mind whose data caches hold."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    bystanders = _measure.Bystanders()
    for _, (name, call) in itertools.product(range(rounds), calls.items()):
        _, runs = _measure.repeat(lambda call=call: jax.block_until_ready(call()), 1, _SECONDS, 5)
        seconds[name] += runs
    others = bystanders.cores()
    return seconds, None if others is None else round(others, 2)


def _prepare(spec: Spec, model: Model, s: State) -> tuple[Callable[[int], State], dict[str, Any]]:
    """Return a compiled run of so many steps, whose list does not overflow, and what was seen of it."""
    nbrs = WAYS[spec.way](model, s, spec.skin * model.spacing)
    begin = perf_counter()
    compiled = solver.advance.lower(model, s, nbrs, spec.steps).compile()
    _, after = jax.block_until_ready(compiled(model, s, nbrs, spec.steps))
    seen: dict[str, Any] = {"first_s": perf_counter() - begin}
    memory: Any = compiled.memory_analysis()
    if memory is not None:
        seen["bytes"] = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    if after is not None:
        if bool(after.overflow):
            raise ValueError("the list overflowed: a row holds more than it did at first")
        seen["rebuilds"] = int(after.rebuild_count)
    return lambda steps: compiled(model, s, nbrs, steps)[0], seen


def difference(model: Model, one: State, other: State) -> float:
    """Return by how many roundings two states differ at most: of density eps ρ0, of acceleration what that makes, eps c²/dx."""
    physics, eps = model.physics, float(jnp.finfo(one.x.dtype).eps)
    speed = float(physics.sound_speed)
    units = {"rho": float(physics.density), "a": speed**2 / model.spacing, "v": speed}
    found = [0.0]
    for name, unit in units.items():
        mine, theirs = getattr(one, name), getattr(other, name)
        if mine is not None:
            found.append(float(jnp.max(jnp.abs(mine - theirs))) / (eps * unit))
    return max(found, key=lambda value: (value != value, value))  # NaN is the largest


def describe(row: StepRow) -> str:
    """Return a row as a line for the reader."""
    what = f"{row.kind:<9} {row.way:<16} {row.particles or 0:>9} particles"
    if row.status != "ok":
        return f"{what} {row.status}: {row.reason}"
    if row.kind == "stages":
        return f"{what} " + ", ".join(f"{name} {1e3 * value:.3g} ms" for name, value in row.parts.items())
    if row.kind == "tradeoff":
        return f"{what} {row.dtype} {row.seconds:.3g} s, " + ", ".join(
            f"error of {name} {100 * value:.3g} %" for name, value in row.error.items()
        )
    return f"{what} {row.steps_per_s:8.3g} steps/s, {(row.bytes or 0) / 1e6:.0f} MB, {row.difference:.2g} roundings apart"
