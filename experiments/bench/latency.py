"""What a call costs where particles are few: waited for, and as a step of a compiled scan, beside `x + 1` and other libraries."""

import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import typer
from jax import Array

import jfrnn
from experiments import _machine, _measure
from experiments._commands import MOST_POINTS
from experiments._library import round_capacity
from experiments.bench import table

SIZES = (16, 64, 256, 1000, 4096, 32768)
MOST_ON_CPU = 4096  # particles, unless sizes are asked for
NEIGHBORS = 30  # about so many each, away from the faces of the unit cube
STEPS = (1000, 300, 100, 30, 10)  # of a scan: the most of them that take less than SCAN_S as waited calls
SCAN_S = 0.05
SLOW_S = 5e-3  # calls that take longer are repeated a tenth as often
ROUNDED = 1e-3  # share of the particles whose counts of a peer may differ: its distances are rounded
COLUMNS = (
    *("platform", "n", "who", "what", "backend", "neighbors", "waited_us", "waited_ratio", "step_us", "step_ratio", "repeats"),
    *("steps", "wrong", "status", "reason", "others_cores", "device", "jax", "warp", "peer", "commit", "dirty"),
)
SHOWN = ("n", "who", "what", "waited_us", "waited_ratio", "step_us", "step_ratio", "wrong", "reason")

Function = Callable[[Array], Any]
Sizes = Annotated[list[int] | None, typer.Option(min=2, max=MOST_POINTS, help="Numbers of particles; may be said several times.")]


class _Scene(NamedTuple):
    """Random points in the unit cube, and the answers of all pairs of them."""

    x: Array
    cutoff: float
    idx: np.ndarray  # rows of neighbors, sorted, [n, capacity]; unused slots hold n
    counts: np.ndarray
    density: np.ndarray
    gradient: np.ndarray

    @property
    def capacity(self) -> int:
        """Slots of a row."""
        return round_capacity(int(self.counts.max()))


class _Way(NamedTuple):
    """Who does what.

    Attributes:
        make: Returns a function of positions, to be compiled; None: nothing is done in a step of a scan, and x + 1 in a call.
        wrong: How many particles its answer is wrong for.
        method: Of a peer, the adapter that says whether it is installed.
        package: Of a peer, the distribution whose version is told.
    """

    who: str
    what: str
    make: Callable[[_Scene], Function] | None
    wrong: Callable[[_Scene, Any], int]
    method: str | None = None
    package: str = "jfrnn"


class _Timed(NamedTuple):
    """A way that is compiled, and whose answer is right."""

    way: _Way
    function: Function | None
    call: Callable[[], Any]
    wrong: int


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
    scene, timed, rows = _make_scene(n), dict[str, _Timed](), dict[str, table.Line]()
    for way in _ways():
        name = f"{way.who} {way.what}"
        rows[name] = {"n": n, "who": way.who, "what": way.what, "neighbors": round(float(scene.counts.mean()), 1)}
        made = table.ask(rows[name], way.method, functools.partial(_prepare, way, scene))
        if made is not None and table.judge(rows[name], made.wrong, 0 if way.method is None else ROUNDED * n):
            timed[name] = made
            rows[name] |= _tell_version(way, scene)
    for name, times in _time(scene, timed, repeats).items():
        rows[name] |= times
    floor = rows[next(iter(rows))]
    for row in rows.values():
        for kind in ("waited", "step"):
            if f"{kind}_us" in row:
                row[f"{kind}_ratio"] = round(row[f"{kind}_us"] / floor[f"{kind}_us"], 2)
        yield row


def _make_scene(n: int) -> _Scene:
    x = jnp.asarray(np.random.default_rng(n).random((n, 3)), jnp.float32)
    cutoff = float(np.float32((3 * NEIGHBORS / (4 * math.pi * n)) ** (1 / 3)))
    nbrs = jfrnn.search(x, cutoff, backend="brute")
    idx = np.sort(nbrs.idx, axis=1)
    return _Scene(x, cutoff, idx, np.asarray(nbrs.count), *_sum_rows(np.asarray(x, np.float64), idx, cutoff))


def _sum_rows(x: np.ndarray, idx: np.ndarray, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the density of `_density`, and the gradient of the sum of all densities, over rows of neighbors in float64."""
    used = idx < len(x)
    r = (x[np.where(used, idx, 0)] - x[:, None]) / cutoff
    rest = np.where(used, np.maximum(1 - np.square(r).sum(axis=2), 0), 0)
    return (rest**3).sum(axis=1), 12 / cutoff * np.einsum("nk,nkd->nd", rest**2, r)


def _tell_version(way: _Way, scene: _Scene) -> table.Line:
    if way.method is not None:
        return {"peer": _machine.versions([way.package])[way.package]}
    if way.make is None:
        return {}
    return {"backend": jax.eval_shape(lambda x: jfrnn.search(x, scene.cutoff, capacity=scene.capacity), scene.x).backend}


def _prepare(way: _Way, scene: _Scene) -> _Timed:
    """Compile a way and look at its answer."""
    function = None if way.make is None else way.make(scene)
    compiled = jax.jit(function or (lambda x: x + 1))
    wrong = way.wrong(scene, compiled(scene.x))
    return _Timed(way, function, lambda: compiled(scene.x), wrong)


# --- times ------------------------------------------------------------------------------------------------------------


def _time(scene: _Scene, timed: dict[str, _Timed], repeats: int) -> dict[str, table.Line]:
    """Return the columns of times, by name: calls in turns first, then scans of as many steps as calls allow."""
    waited, others = _medians({name: each.call for name, each in timed.items()}, repeats)
    steps = {name: next((k for k in STEPS if k * seconds <= SCAN_S), STEPS[-1]) for name, seconds in waited.items()}
    scans = {name: _measure.compile_scan(each.function, scene.x, steps[name]) for name, each in timed.items()}
    scanned, others_then = _medians(scans, max(repeats // 20, 3))
    others = max((each for each in (others, others_then) if each is not None), default=None)
    return {
        name: {"waited_us": 1e6 * waited[name], "step_us": 1e6 * scanned[name] / steps[name], "steps": steps[name]}
        | {"repeats": repeats, "others_cores": others}
        for name in timed
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


def _density_and_gradient(cutoff: float) -> Function:
    def both(x: Array) -> tuple[Array, Array]:
        density, back = jax.vjp(_density(cutoff), x)
        return density, back(jnp.ones_like(density))[0]

    return both


def _density(cutoff: float) -> Function:
    def kernel(r: Array, _i: None, _j: None) -> Array:
        return jnp.maximum(1 - (r @ r) / cutoff**2, 0) ** 3

    return lambda x: jfrnn.pair_sum(kernel, x, cutoff)


def _list(scene: _Scene) -> Function:
    def search(x: Array) -> tuple[Array, Array]:
        nbrs = jfrnn.search(x, scene.cutoff, capacity=scene.capacity)
        return nbrs.idx, nbrs.count

    return search


def _jax_md(scene: _Scene, sparse: bool) -> Function:
    from experiments.methods import jax_md

    return jax_md.compile_update(scene.x, scene.cutoff, jax_md.allocate(np.asarray(scene.x), scene.cutoff, sparse))


def _nvalchemi(scene: _Scene, strategy: str | None) -> Function:
    from experiments.methods import nvalchemi

    if strategy is None:
        return nvalchemi.compile_search(scene.x, scene.cutoff, scene.capacity)
    return nvalchemi.compile_naive(scene.cutoff, scene.capacity, strategy)


def _ways() -> Iterator[_Way]:
    """Yield the ways in the order of a table; the first is the floor of the others."""
    yield _Way("jax", "x + 1", None, lambda scene, found: 0)
    yield _Way("jfrnn", "list", _list, _wrong_rows)
    yield _Way("jfrnn", "counts", lambda scene: lambda x: jfrnn.count(x, scene.cutoff), _wrong_counts)
    yield _Way("jfrnn", "density", lambda scene: _density(scene.cutoff), lambda scene, found: _wrong_sums(scene.density, found))
    yield _Way("jfrnn", "density, gradient", lambda scene: _density_and_gradient(scene.cutoff), _wrong_gradients)
    for what, sparse in (("dense list", False), ("sparse list", True)):
        make = functools.partial(_jax_md, sparse=sparse)
        yield _Way("jax-md", what, make, _wrong_counts_of_sparse if sparse else _wrong_counts_of_dense, "jax-md", "jax-md")
    ways: dict[str, str | None] = {"cells": None, "all pairs": "scalar"}
    if jax.default_backend() == "gpu":
        ways["all pairs, tiles"] = "tile"
    for what, strategy in ways.items():
        make = functools.partial(_nvalchemi, strategy=strategy)
        yield _Way("nvalchemi", what, make, _wrong_counts_of_rows, "nvalchemi", "nvalchemi-toolkit-ops")


# --- right or wrong ---------------------------------------------------------------------------------------------------


def _wrong_rows(scene: _Scene, found: tuple[Array, Array]) -> int:
    """Count the particles whose neighbors, as a set, or their number are others."""
    n, given = len(scene.x), (scene.idx, np.sort(found[0], axis=1))
    width = max(rows.shape[1] for rows in given)
    one, other = (np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=n) for rows in given)
    return int(((one != other).any(axis=1) | (scene.counts != np.asarray(found[1]))).sum())


def _wrong_counts(scene: _Scene, found: Any) -> int:  # noqa: ANN401
    return int((scene.counts != np.asarray(found)).sum())


def _wrong_counts_of_rows(scene: _Scene, found: tuple[Array, Array]) -> int:
    return _wrong_counts(scene, found[1])


def _wrong_counts_of_dense(scene: _Scene, idx: Array) -> int:
    return _wrong_counts(scene, (np.asarray(idx) < len(scene.x)).sum(axis=1))


def _wrong_counts_of_sparse(scene: _Scene, idx: Array) -> int:
    n, senders = len(scene.x), np.asarray(idx)[0]
    return _wrong_counts(scene, np.bincount(senders[senders < n], minlength=n))


def _wrong_sums(exact: np.ndarray, found: Array) -> int:
    """Count the particles whose sums are farther from those over all pairs than rounding explains."""
    far = np.abs(np.asarray(found) - exact) > 1e-4 * np.abs(exact).max()
    return int((far | ~np.isfinite(found)).reshape(len(exact), -1).any(axis=1).sum())


def _wrong_gradients(scene: _Scene, found: tuple[Array, Array]) -> int:
    return _wrong_sums(scene.density, found[0]) + _wrong_sums(scene.gradient, found[1])
