"""What the array engine takes: to compile, for a call, for a step of a scan, and in scratch memory, beside jax-md and nvalchemi."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import jax
import numpy as np
import typer

import jfrnn
from experiments import _measure
from experiments._commands import MOST_POINTS
from experiments.bench import lists, table

SIDES = (10, 16, 25, 40, 64, 100)  # sites along an edge of the lattice
MOST_ON_CPU = 63**3  # particles, unless sizes are asked for
CUTOFF = 3.0  # spacings
JITTER = 0.3  # spacings
STEPS = 100  # of a scan at most, so that what a call of it takes is a small part
SCAN_S = 0.05  # that a scan is to take: fewer steps where calls are slow
SLOW_S = 0.05  # calls that take longer are repeated a fifth as often
MOST_ON_GPU = 300_000  # particles that jax-md is asked for; it took 19 GB for 250 000
COLUMNS = (
    *("platform", "n", "layout", "who", "what", "neighbors", "lower_s", "compile_s", "waited_ms", "step_ms", "scratch_mb", "wrong"),
    *("ratio", "repeats", "status", "reason", "others_cores", "device", "jax", "warp", "peer", "commit", "dirty"),
)
SHOWN = ("n", "layout", "who", "what", "lower_s", "compile_s", "waited_ms", "step_ms", "scratch_mb", "wrong", "ratio", "reason")

TIED = ("list", "counts")  # of jfrnn, which are asked for on a lattice full of ties, too
Sides = Annotated[list[int] | None, typer.Option(min=2, max=1000, help="Sites along an edge of the lattice; several times.")]


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "arrays",
    sides: Sides = None,
    repeats: Annotated[int, typer.Option(min=2, max=10_000, help="Waited calls of each.")] = 15,
) -> str:
    """Time the array engine (`backend="jax"`): lists, counts, a density, with its gradient, lists in a periodic box.

    Particles stand on a cubic lattice, shuffled, with a cutoff of 3 spacings, float32: "jitter" moves each by up to 0.3 spacings
    along each axis, "ties" none, so that 30 pairs of each are exactly at the cutoff (lists and counts alone). Programs are lowered
    and compiled without JAX's cache [s], calls waited for one by one, and steps of a compiled scan move the particles [ms];
    `scratch_mb` is what XLA says. `ratio` is to jax-md's time at the same size, and `x + 1` is the shortest call. Answers
    are compared with distances in float64; of a wrong one no time is taken. Each row is kept before the next way but one begins.
    """
    platform = jax.default_backend()
    asked = sides or [side for side in SIDES if platform != "cpu" or side**3 <= MOST_ON_CPU]
    kinds = [(side, layout) for side in asked for layout in ("jitter", "ties") if side**3 <= MOST_POINTS]
    parts = [(f"{side}^3, {layout}", functools.partial(_rows, side, layout, repeats)) for side, layout in kinds]
    frame = table.measure(out, platform, parts, [repeats, table.installed(_ways())], COLUMNS)
    return table.text(frame, SHOWN)


def _rows(side: int, layout: str, repeats: int) -> Iterator[table.Line]:
    """Measure one way after the other, so that a row is known before the next program is compiled."""
    scene, peer = _make_scene(side, layout), None
    for way in (way for way in _ways() if layout != "ties" or (way.who == "jfrnn" and way.what in TIED)):
        row: table.Line = {"n": len(scene.x), "layout": layout, "neighbors": round(float(scene.counts.mean()), 1)}
        most = table.ask(row, way.method, _most_of_jax_md) if way.who == "jax-md" else MOST_POINTS
        if most is not None and len(scene.x) > most:
            row |= {"who": way.who, "what": way.what, "status": "skipped"}
            row["reason"] = f"is not asked for more than {most} particles"
        elif (ready := table.judge(row, way, scene, functools.partial(_compile, row, scene))) is not None:
            row |= _time(ready, scene, repeats)
        if way.who == "jax-md":
            peer = row.get("waited_ms")
        if peer is not None and "waited_ms" in row:
            row["ratio"] = row["waited_ms"] / peer
        yield row


def _time(ready: table.Ready, scene: lists.Scene, repeats: int) -> table.Line:
    """Time calls that are waited for, and steps of a scan."""
    calls = {"call": ready.call}
    (first,) = _measure.time_in_turns(calls, 1)[0]["call"]
    rounds, steps = repeats if first <= SLOW_S else max(repeats // 5, 3), int(np.clip(SCAN_S / first, 2, STEPS))
    waited, others = _measure.time_in_turns(calls, rounds)
    scan = _measure.compile_scan(ready.made, scene.x, steps, ready.call())
    stepped, _ = _measure.time_in_turns({"scan": scan}, 3)
    times = {"waited_ms": 1e3 * float(np.median(waited["call"])), "step_ms": 1e3 * float(np.median(stepped["scan"])) / steps}
    return times | {"repeats": rounds, "others_cores": others}


def _make_scene(side: int, layout: str) -> lists.Scene:
    sites = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(side)
    moved = rng.uniform(-JITTER, JITTER, sites.shape) if layout == "jitter" else np.zeros(sites.shape)
    return lists.make_scene(rng.permutation((sites + moved).astype(np.float32)), CUTOFF)


def _compile(row: table.Line, scene: lists.Scene, function: lists.Function) -> Callable[[], Any]:
    """Return a compiled call; the row says how long that took, and what scratch memory a call needs."""
    cache = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)
    jax.clear_caches()
    begin = perf_counter()
    lowered = jax.jit(function).lower(scene.x)
    between = perf_counter()
    compiled = lowered.compile()
    end = perf_counter()
    jax.config.update("jax_enable_compilation_cache", cache)
    analysis = compiled.memory_analysis()
    row |= {"lower_s": between - begin, "compile_s": end - between}
    row["scratch_mb"] = None if analysis is None else analysis.temp_size_in_bytes / 1e6
    return lambda: compiled(scene.x)


# --- who does what ----------------------------------------------------------------------------------------------------


def _periodic(scene: lists.Scene) -> lists.Function:
    """Return a search in a box that ends far enough from the particles that no image is a neighbor."""
    side = float(np.ptp(np.asarray(scene.x), axis=0).max()) + 2 * CUTOFF
    return lists.search(scene, backend="jax", box=jfrnn.Box([side] * 3))


def _most_of_jax_md() -> int:
    from experiments.methods import jax_md

    return jax_md.MAX_POINTS if jax.default_backend() == "cpu" else MOST_ON_GPU


def _ways() -> Iterator[table.Way]:
    """Yield the ways in the order of a table; times are divided by those of the first."""
    ours = functools.partial(functools.partial, backend="jax")
    yield table.Way("jax-md", "list", lists.jax_md, lambda scene, idx: lists.wrong_rows(scene, (idx, None)), "jax-md", "jax-md")
    yield table.Way("jfrnn", "list", ours(lists.search), lists.wrong_rows)
    yield table.Way("jfrnn", "counts", ours(lists.count), lists.wrong_counts)
    yield table.Way("jfrnn", "density", ours(lists.density), lists.wrong_density)
    yield table.Way("jfrnn", "density, gradient", ours(lists.density_and_gradient), lists.wrong_gradient)
    yield table.Way("jfrnn", "list in a box", _periodic, lists.wrong_rows)
    moved = lambda scene, found: int((found != scene.x + 1).any(axis=1).sum())  # noqa: E731
    yield table.Way("XLA", "x + 1", lambda scene: lambda x: x + 1, moved)
    yield table.Way("nvalchemi", "list", lists.nvalchemi, lists.wrong_rows, "nvalchemi", "nvalchemi-toolkit-ops")
