"""Everything on a GPU: every hard case against the oracle first, then lists, counts, steps and sums of large scenes.

A time counts only where its answer was checked: numbers of neighbors by trees in float64, and distances in evenly chosen rows.
"""

import functools
import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import typer
from pydantic import NonNegativeInt, PositiveInt

import jfrnn
from experiments import _machine, _measure
from experiments._commands import take_folder
from experiments._config import Dtype, Positive, Table, load, one_of
from experiments._library import load_warp, round_capacity
from experiments.bench import decisions, lists, table, ways

REACH, JITTER = 3.0, 0.3  # of a lattice of spacing 1: about 108 neighbors
SKIN = 0.1  # of a list that is kept, in cutoffs
MOST_LISTED, MOST_SCANNED = 20_000_000, 1_000_000  # particles


class Exactness(Table):
    """Which hard cases are decided on the device."""

    backend: Literal["jax", "warp", "hashgrid", "brute", "bvh"]
    dtypes: list[Dtype]
    dims: list[Literal[2, 3]]
    capacity: PositiveInt
    # which table of jfrnn.cases, or "sums" of whole numbers against lists
    cases: Literal["hard", "periodic", "radii", "batches", "triangles", "sums"] = "hard"
    # every case is filled up to so many rows with points that are nowhere: where queries are many, 32 of them share a warp
    least_rows: NonNegativeInt = 0


class Config(Table):
    """What is run."""

    exactness: list[Exactness]
    sizes: tuple[PositiveInt, ...] = ()
    calls: PositiveInt = 200
    steps: PositiveInt = 100
    sums: tuple[Annotated[str, one_of("way", lambda: ways.WAYS)], ...] = ()  # of a density and its gradient
    repeats: PositiveInt = 5
    seconds_per_timing: Positive = 1.0


def command(
    config: Annotated[Path, typer.Argument(help="GPU config, TOML.")],
    out: Annotated[Path, typer.Option(help="Folder of the rows.")],
) -> str:
    """Decide every hard case on the GPU, then take all timings; rows are added to OUT/rows.jsonl one by one."""
    wrong = run(load(config, Config), take_folder(out))
    said = f"{wrong} wrong; rows in {out / 'rows.jsonl'}; python -m experiments report {out} makes a table of them"
    if wrong:
        typer.echo(said)
        raise typer.Exit(1)
    return said


def run(config: Config, folder: Path) -> int:
    """Measure what the folder does not hold yet, and return the number of wrong hard cases."""
    # one pool from the start: a pool that grows hands out whole pieces, up to 128 MiB larger than what was asked for
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "true"
    jax.config.update("jax_enable_x64", True)
    about = {"versions": _machine.versions() | {"warp-lang": load_warp().__version__}}
    rows = table.fill_parts(folder, parts(config), config.model_dump(), about, describe)
    return sum(int(row.get("wrong", 0) or 0) for row in rows)


def parts(config: Config) -> Iterator[table.Part]:
    """Yield what is measured, by name, in the order in which it has to be."""
    for part in config.exactness:
        for dtype, dim in itertools.product(part.dtypes, part.dims):
            given = (part.cases, part.backend, dtype, dim, part.capacity, part.least_rows)
            yield f"exactness {part.backend} {part.cases} {dtype} {dim}D", functools.partial(decisions.rows, *given)
    if config.sizes:
        yield "bandwidth", functools.partial(bandwidth_rows, config)
    for n in config.sizes:
        yield f"jitter {n}", functools.partial(scene_rows, config, n)


def describe(row: table.Line) -> str:
    """Return a row as a line for the reader."""
    names = ("kind", "method", "layout", "points", "dtype", "dim", "cases", "wrong", "median_s", "reason")
    return " ".join(f"{name} {row[name]}" for name in names if row.get(name) is not None)


# --- timings --------------------------------------------------------------------------------------------------------------


def time_calls(config: Config, call: Callable[[], Any], calls: int | None = None) -> table.Line:
    """Time calls that are not waited for one by one; a repeat ends when the last is done."""
    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    once = time.perf_counter() - start
    calls = calls or max(1, min(config.calls, int(config.seconds_per_timing / config.repeats / max(once, 1e-9))))
    seconds = [_measure.time_in_turns({"": call}, 1, calls)[0][""][0] for _ in range(config.repeats)]
    return _measure.summarize(seconds) | {"calls": calls}


def _time_scan(config: Config, call: Callable[[], Any]) -> table.Line:
    """Time the steps of a scan."""
    seconds = time_calls(config, call, calls=3)["seconds"]
    return _measure.summarize([each / config.steps for each in seconds]) | {"steps": config.steps}


def bandwidth_rows(config: Config) -> Iterator[table.Line]:
    """Measure the ceiling: bytes read and written per second where nothing else is done."""
    x = jnp.ones(1 << 28, jnp.float32)
    copy = jax.jit(lambda x: x + 1)
    seconds = time_calls(config, lambda: copy(x), calls=10)["median_s"]
    yield {"kind": "ceiling", "method": "read and write", "bytes_per_s": 2 * x.nbytes / seconds, "median_s": seconds}


def jitter_lattice(n: int) -> np.ndarray:
    """Return a cubic lattice of spacing 1, every point moved at random, in random order: float32 [about n, 3]."""
    random, side = np.random.default_rng(0), round(n ** (1 / 3))
    sites = np.stack(np.meshgrid(*[np.arange(side, dtype=np.float32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    sites += random.uniform(-JITTER, JITTER, sites.shape).astype(np.float32)
    random.shuffle(sites)
    return sites


def scene_rows(config: Config, n: int) -> Iterator[table.Line]:
    """Time calls, steps of a scan and sums; so many particles that a list of them would not fit, are counted and summed alone."""
    points = jitter_lattice(n)
    listed = len(points) <= MOST_LISTED
    counts = np.asarray(jfrnn.count(points, REACH, backend="warp"))
    scene = lists.make_scene(points, REACH) if listed else lists.Scene(jnp.asarray(points), REACH, counts)
    base = {"layout": "jitter", "points": len(points), "capacity": scene.capacity, "dtype": "float32"}
    base |= {"exact_directed_pairs": int(scene.counts.sum(dtype=np.int64)) if listed else None}
    for name, (make, wrong) in _CALLS.items():
        row: table.Line = {"kind": "call", "method": name, **base, "directed_pairs": int(counts.sum(dtype=np.int64))}
        if listed or name == COUNTS:
            call = table.ask(row, None, functools.partial(make, scene))
            if call is not None:
                row |= {"wrong": wrong(scene, call())} | time_calls(config, call)
            yield row
    if len(points) <= MOST_SCANNED:
        yield from _scan_rows(config, base, scene)
    yield from sum_rows(config, base, scene, listed)


def _scan_rows(config: Config, base: table.Line, scene: lists.Scene) -> Iterator[table.Line]:
    """What a step of a time loop takes: a list made anew, and updates of one with a skin."""
    made = _measure.compile_scan(lists.search(scene, backend="warp"), scene.x, config.steps)
    yield {"kind": "scan", "method": "jfrnn warp", **base} | _time_scan(config, made)
    skin = SKIN * scene.cutoff
    wider = round_capacity(int(jfrnn.count(scene.x, scene.cutoff + skin, backend="warp").max()))
    nbrs = jfrnn.search(scene.x, scene.cutoff, skin=skin, capacity=wider, backend="warp")

    @jax.jit
    def steps(x: jax.Array, nbrs: jfrnn.NeighborList, velocity: jax.Array) -> tuple[jax.Array, jax.Array]:
        def step(carry: tuple[jax.Array, jfrnn.NeighborList], _: None) -> tuple[tuple[jax.Array, jfrnn.NeighborList], None]:
            x = carry[0] + velocity
            return (x, carry[1].update(x)), None

        x, nbrs = jax.lax.scan(step, (x, nbrs), None, length=config.steps)[0]
        return x, nbrs.rebuild_count

    for name, velocity in (("keeps", 0.0), ("rebuilds", skin)):
        call = functools.partial(steps, scene.x, nbrs, jnp.asarray(velocity, jnp.float32))
        row = {"kind": "scan", "method": f"jfrnn warp, skin, {name}", **base, "capacity": wider, "rebuilds": int(call()[1])}
        yield row | _time_scan(config, call)


def sum_rows(config: Config, base: table.Line, scene: lists.Scene, listed: bool = True) -> Iterator[table.Line]:
    """A density, and with it its gradient: without a list, and over lists that are made for it."""
    masses = np.random.default_rng(0).uniform(0.5, 1.5, base["points"]).astype(np.float32)
    given = ways.Given(scene.x, jnp.asarray(masses), scene.cutoff)
    for way, gradient in itertools.product(config.sums, (False, True)):
        row: table.Line = {"kind": "sum", "method": way, "gradient": gradient, **base}
        if listed or way == "pair_sum warp":
            table.ask(row, None, functools.partial(_time_sum, config, row, given, way, gradient))
            yield row


def _time_sum(config: Config, row: table.Line, given: ways.Given, way: str, gradient: bool) -> None:
    steps = ways.WAYS[way].prepare(given, gradient, False)

    def call() -> Any:  # noqa: ANN401
        return steps.sums(given.x, given.m, None if steps.build is None else steps.build(given.x))

    if row["points"] <= MOST_SCANNED:
        row["error"] = ways.error_of(given, jax.device_get(call()), gradient)
    row |= time_calls(config, call)


def _jitted(make: Callable[..., lists.Function]) -> Callable[[lists.Scene], Callable[[], Any]]:
    return lambda scene: functools.partial(jax.jit(make(scene, backend="warp")), scene.x)


def _plain_hashgrid(scene: lists.Scene) -> Callable[[], Any]:
    """Return a call of `wp.HashGrid` as Warp's examples use it, without JAX: build, then one thread per particle."""
    from experiments.methods import hashgrid_plain

    return hashgrid_plain.start(np.asarray(scene.x), scene.cutoff, scene.capacity)


COUNTS = "jfrnn warp, counts"
_CALLS: dict[str, tuple[Callable[[lists.Scene], Callable[[], Any]], Callable[[lists.Scene, Any], int]]] = {
    "jfrnn warp": (_jitted(lists.search), lists.wrong_rows),
    COUNTS: (_jitted(lists.count), lists.wrong_counts),
    "warp HashGrid": (_plain_hashgrid, lambda scene, found: lists.wrong_counts(scene, found[1].array.numpy())),
    "nvalchemi 0.5.0 cell_list": (
        lambda scene: functools.partial(lists.nvalchemi(scene), scene.x),
        lambda scene, found: lists.wrong_counts(scene, found[1]),
    ),
}
