"""What a call costs where particles are few: waited for, and as a step of a compiled scan, beside `x + 1` and other libraries."""

import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

import jfrnn
from experiments import _measure
from experiments._commands import MOST_POINTS
from experiments.bench import lists, table

SIZES = (16, 64, 256, 1000, 4096, 32768)
MOST_ON_CPU = 4096  # particles, unless sizes are asked for
NEIGHBORS = 30  # about so many each, away from the faces of the unit cube
STEPS = (1000, 300, 100, 30, 10)  # of a scan: the most of them that take less than SCAN_S as waited calls
SCAN_S = 0.05
SLOW_S = 5e-3  # calls that take longer are repeated a tenth as often
COLUMNS = (
    *("platform", "n", "who", "what", "backend", "neighbors", "waited_us", "waited_ratio", "step_us", "step_ratio", "repeats"),
    *("steps", "wrong", "status", "reason", "others_cores", "device", "jax", "warp", "peer", "commit", "dirty"),
)
FLOOR = "jax x + 1"  # in a step of a scan it does nothing
SHOWN = ("n", "who", "what", "waited_us", "waited_ratio", "step_us", "step_ratio", "wrong", "reason")

Sizes = Annotated[list[int] | None, typer.Option(min=2, max=MOST_POINTS, help="Numbers of particles; may be said several times.")]


# --- the command ------------------------------------------------------------------------------------------------------


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "latency",
    sizes: Sizes = None,
    repeats: Annotated[int, typer.Option(min=2, max=100_000, help="Waited calls of each; scans are a twentieth as many.")] = 200,
) -> str:
    """Time calls and steps of a scan for few particles: `x + 1`, jfrnn, and jax-md and nvalchemi where they are installed.

    Points are random in the unit cube, float32, with about 30 neighbors. A call is waited for [µs]. A step of a compiled scan moves
    the particles and does the same, "x + 1" nothing else. Ratios are to "x + 1". Ways whose answers are wrong are not timed.
    """
    platform = jax.default_backend()
    asked = sizes or [n for n in SIZES if platform != "cpu" or n <= MOST_ON_CPU]
    parts = [(f"{n} particles", functools.partial(_rows, n, repeats)) for n in asked]
    frame = table.measure(out, platform, parts, [repeats, table.installed(_ways())], COLUMNS)
    return table.text(frame, SHOWN)


def _rows(n: int, repeats: int) -> Iterator[table.Line]:
    """Yield a row for each way; all of one size are timed in turns."""
    scene, ready, rows = _make_scene(n), dict[str, table.Ready](), dict[str, table.Line]()
    backend = jax.eval_shape(lambda x: jfrnn.search(x, scene.cutoff, capacity=scene.capacity), scene.x).backend
    for way in _ways():
        name = f"{way.who} {way.what}"
        rows[name] = {"n": n, "neighbors": round(float(scene.counts.mean()), 1)}
        made = table.judge(rows[name], way, scene, functools.partial(_compile, scene))
        if made is not None:
            ready[name] = made
            rows[name] |= {"backend": backend} if way.who == "jfrnn" else {}
    for name, times in _time(scene, ready, repeats).items():
        rows[name] |= times
    floor = rows[FLOOR]
    for row in rows.values():
        for kind in ("waited", "step"):
            if f"{kind}_us" in row:
                row[f"{kind}_ratio"] = round(row[f"{kind}_us"] / floor[f"{kind}_us"], 2)
        yield row


def _make_scene(n: int) -> lists.Scene:
    cutoff = float(np.float32((3 * NEIGHBORS / (4 * math.pi * n)) ** (1 / 3)))
    return lists.make_scene(np.random.default_rng(n).random((n, 3)).astype(np.float32), cutoff)


def _compile(scene: lists.Scene, function: lists.Function) -> Callable[[], Any]:
    compiled = jax.jit(function)
    return lambda: compiled(scene.x)


# --- times ------------------------------------------------------------------------------------------------------------


def _time(scene: lists.Scene, ready: dict[str, table.Ready], repeats: int) -> dict[str, table.Line]:
    """Return the columns of times, by name: calls in turns first, then scans of as many steps as calls allow."""
    waited, others = _medians({name: each.call for name, each in ready.items()}, repeats)
    steps = {name: next((k for k in STEPS if k * seconds <= SCAN_S), STEPS[-1]) for name, seconds in waited.items()}
    functions = {name: None if name == FLOOR else each.made for name, each in ready.items()}
    scans = {name: _measure.compile_scan(function, scene.x, steps[name]) for name, function in functions.items()}
    scanned, others_then = _medians(scans, max(repeats // 20, 3))
    others = max((each for each in (others, others_then) if each is not None), default=None)
    return {
        name: {"waited_us": 1e6 * waited[name], "step_us": 1e6 * scanned[name] / steps[name], "steps": steps[name]}
        | {"repeats": repeats, "others_cores": others}
        for name in ready
    }


def _medians(calls: dict[str, Callable[[], Any]], repeats: int) -> tuple[dict[str, float], float | None]:
    """Return seconds of each call, and how many cores others kept busy meanwhile; slow ones are timed by themselves."""
    first, _ = _measure.time_in_turns(calls, 1)
    slow = {name for name, (seconds,) in first.items() if seconds > SLOW_S}
    medians, busy = dict[str, float](), list[float]()
    for names, rounds in ((calls.keys() - slow, repeats), (slow, max(repeats // 10, 3))):
        seconds, others = _measure.time_in_turns({name: call for name, call in calls.items() if name in names}, rounds)
        medians |= {name: float(np.median(each)) for name, each in seconds.items()}
        busy += [] if others is None else [others]
    return medians, max(busy, default=None)


# --- who does what ----------------------------------------------------------------------------------------------------


def _ways() -> Iterator[table.Way]:
    """Yield the ways in the order of a table."""
    yield table.Way("jax", "x + 1", lambda scene: lambda x: x + 1, lambda scene, found: 0)
    yield table.Way("jfrnn", "list", lists.search, lists.wrong_rows)
    yield table.Way("jfrnn", "counts", lists.count, lists.wrong_counts)
    yield table.Way("jfrnn", "density", lists.density, lists.wrong_density)
    yield table.Way("jfrnn", "density, gradient", lists.density_and_gradient, lists.wrong_gradient)
    dense = lambda scene, idx: lists.wrong_rows(scene, (idx, None))  # noqa: E731
    yield table.Way("jax-md", "dense list", lists.jax_md, dense, "jax-md", "jax-md")
    sparse = functools.partial(lists.jax_md, sparse=True)
    yield table.Way("jax-md", "sparse list", sparse, lists.wrong_counts_of_pairs, "jax-md", "jax-md")
    ways: dict[str, str | None] = {"cells": None, "all pairs": "scalar"}
    if jax.default_backend() == "gpu":
        ways["all pairs, tiles"] = "tile"
    for what, strategy in ways.items():
        make = functools.partial(lists.nvalchemi, strategy=strategy)
        wrong = lambda scene, found: lists.wrong_counts(scene, found[1])  # noqa: E731
        yield table.Way("nvalchemi", what, make, wrong, "nvalchemi", "nvalchemi-toolkit-ops")
