"""Steps per second of a scene by sums that search and by sums over a list that is kept, all in one process and in turns."""

import inspect
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import typer
from pydantic import Field, FiniteFloat, field_validator

from experiments import _machine, _measure
from experiments._commands import RetryFailed, RowsFolder, take_folder
from experiments._config import Dtype, Positive, Table, load
from experiments.bench import table
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene
from jfrnn.sph import solver
from jfrnn.sph.model import Model, State, make_model, make_state

_SECONDS = 2.0  # that a way runs in its turn at least, in up to five runs
MOST_ROUNDINGS = 64  # by which two ways may differ after a step, see `difference`


class Config(Table):
    """What is measured."""

    scene: str = "dam-break-3d"  # a fluid scene; walls count as particles
    nx: tuple[Annotated[int, Field(ge=2)], ...] = ()  # resolutions, as the scene takes them
    ways: tuple[Literal["pair_sum", "list"], ...] = ("pair_sum", "list")  # all are compared with the first
    dtype: Dtype = "float32"  # of all numbers
    steps: Annotated[int, Field(ge=1)] = 10  # per timed run, from the same state each time
    rounds: Annotated[int, Field(ge=1)] = 5  # timed runs of each way
    skin: Positive = 0.3  # in particle spacings
    # The fluid begins with velocities rate·(x, 0, -z) [1/s]: a column in mid-collapse, whose lists are made anew.
    rate: FiniteFloat = 1.5

    @field_validator("scene")
    @classmethod
    def _scene_exists(cls, name: str) -> str:
        if name not in fluids.FLUIDS:
            raise ValueError(f"unknown fluid scene {name!r}; allowed: {', '.join(fluids.FLUIDS)}")
        if "nx" not in inspect.signature(fluids.FLUIDS[name]).parameters:
            raise ValueError(f"fluid scene {name!r} has no nx, by which its steps are timed")
        return name


def command(
    config: Annotated[Path, typer.Argument(help="Config of steps, TOML.")] = Path("experiments/configs/sph_speed.toml"),
    out: RowsFolder = None,
    retry_failed: RetryFailed = False,
) -> str:
    """Time steps of a fluid scene by ways to find its pairs, or go on with it; then print a table."""
    given, folder = load(config, Config), take_folder(out or Path("out") / config.stem)
    jax.config.update("jax_enable_x64", given.dtype == "float64")
    parts = [(f"{given.scene} nx {nx}", partial(_rows, given, nx)) for nx in given.nx]
    asked, about = given.model_dump(exclude={"nx"}), {"versions": _machine.versions()}
    return table.report(table.fill_parts(folder, parts, asked, about, retry_failed=retry_failed), folder)


def _rows(config: Config, nx: int) -> Iterator[table.Line]:
    """Make every way ready, compare what a step of each gives, then time those that agree, in turns.

    Times are of one step, with the list's share of being made anew; `bytes` are what a compiled run takes: arguments, results and
    scratch; `difference` is that from the first way after one step.
    """
    scene, number = set_in_motion(fluids.fluid(config.scene, nx=nx), config.rate), np.dtype(config.dtype).type
    model = make_model(scene, number)
    s = jax.block_until_ready(jax.jit(solver.begin)(model, make_state(scene, number)))
    about = {"kind": "step", "scene": config.scene, "nx": nx, "particles": scene.n}
    about |= {"fluid": scene.n if scene.wall is None else int((~scene.wall).sum())}
    about |= config.model_dump(include={"dtype", "steps", "skin"})
    rows: dict[str, table.Line] = {}
    ready, reference = {}, None
    for way in config.ways:
        row = rows[way] = about | {"way": way, "status": "ok"}
        run = table.ask(row, None, partial(_prepare, row, config, model, s))
        if run is not None:
            after = run(1)
            reference = after if reference is None else reference
            row["difference"] = difference(model, reference, after)
            if row["difference"] <= MOST_ROUNDINGS:
                ready[way] = run
            else:
                row |= {"status": "failed", "reason": f"differs from {config.ways[0]} by {row['difference']:.3g} roundings"}
    seconds, others = _time_in_turns(ready, config.steps, config.rounds)
    for way, times in seconds.items():
        p10, median, p90 = (float(value) / config.steps for value in np.percentile(times, (10, 50, 90)))
        rows[way] |= {"median_s": median, "p10_s": p10, "p90_s": p90, "others_cores": others}
        rows[way] |= {"steps_per_s": 1 / median, "particle_steps_per_s": scene.n / median}
    yield from rows.values()


def set_in_motion(scene: FluidScene, rate: float) -> FluidScene:
    """Return the scene with a fluid that moves by rate·(x, 0, -z), in 2D rate·(x, -z): without divergence, along its walls."""
    flow = np.zeros_like(scene.positions)
    flow[:, 0], flow[:, -1] = rate * scene.positions[:, 0], -rate * scene.positions[:, -1]
    return replace(scene, velocities=flow if scene.wall is None else np.where(scene.wall[:, None], scene.velocities, flow))


def _prepare(row: table.Line, config: Config, model: Model, s: State) -> Callable[[int], State]:
    """Return a compiled run of so many steps, whose list does not overflow; the row says what was seen of it."""
    nbrs = solver.list_neighbors(model, s, config.skin * model.spacing) if row["way"] == "list" else None
    compiled = solver.advance.lower(model, s, nbrs, config.steps).compile()
    _, after = jax.block_until_ready(compiled(model, s, nbrs, config.steps))
    memory: Any = compiled.memory_analysis()
    if memory is not None:
        row["bytes"] = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    if after is not None:
        after.check()
        row["rebuilds"] = int(after.rebuild_count)
    return lambda steps: compiled(model, s, nbrs, steps)[0]


def _time_in_turns(runs: dict[str, Callable[[int], State]], steps: int, rounds: int) -> tuple[dict[str, list[float]], float | None]:
    """Time runs in turns, and tell how many cores others kept busy; a run is long enough not to mind whose data caches hold."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    bystanders = _measure.Bystanders()
    for _, (name, run) in itertools.product(range(rounds), runs.items()):
        seconds[name] += _measure.repeat(lambda run=run: jax.block_until_ready(run(steps).x), 1, _SECONDS, 5)[1]
    others = bystanders.cores()
    return seconds, None if others is None else round(others, 2)


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
