"""What the array engine takes: to compile, for a call, for a step of a scan, and in scratch memory, beside jax-md and nvalchemi."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
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

SIDES = (10, 16, 25, 40, 64, 100)  # sites along an edge of the lattice
MOST_ON_CPU = 63**3  # particles, unless sizes are asked for
CUTOFF = 3.0  # spacings
JITTER = 0.3  # spacings
STEPS = 100  # of a scan at most, so that what a call of it takes is a small part
SCAN_S = 0.05  # that a scan is to take: fewer steps where calls are slow
SLOW_S = 0.05  # calls that take longer are repeated a fifth as often
ROUNDED = 1e-3  # share of the particles whose rows of a peer may differ: its distances are rounded
ROWS_SEEN = 50_000  # of a list, in which distances are looked at
MOST_ON_GPU = 300_000  # particles that jax-md is asked for; it took 19 GB for 250 000
COLUMNS = (
    *("platform", "n", "layout", "who", "what", "neighbors", "lower_s", "compile_s", "waited_ms", "step_ms", "scratch_mb", "wrong"),
    *("ratio", "repeats", "status", "reason", "others_cores", "device", "jax", "warp", "peer", "commit", "dirty"),
)
SHOWN = ("n", "layout", "who", "what", "lower_s", "compile_s", "waited_ms", "step_ms", "scratch_mb", "wrong", "ratio", "reason")

Function = Callable[[Array], Any]
Sides = Annotated[list[int] | None, typer.Option(min=2, max=1000, help="Sites along an edge of the lattice; several times.")]


class _Scene(NamedTuple):
    """A lattice, shuffled, and the number of neighbors of each particle."""

    x: Array
    counts: np.ndarray

    @property
    def capacity(self) -> int:
        """Slots of a row."""
        return round_capacity(int(self.counts.max()))


class _Way(NamedTuple):
    """Who does what, and in how many particles its answer is wrong; of a peer, its adapter and its distribution."""

    who: str
    what: str
    make: Callable[[_Scene], Function]
    wrong: Callable[[_Scene, Any], int]
    method: str | None = None
    package: str = "jfrnn"
    tied: bool = False  # whether a lattice full of ties is asked for, too


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
    for way in (way for way in _ways() if layout != "ties" or way.tied):
        row: table.Line = {"n": len(scene.x), "layout": layout, "who": way.who, "what": way.what}
        row["neighbors"] = round(float(scene.counts.mean()), 1)
        most = table.ask(row, way.method, _most_of_jax_md) if way.who == "jax-md" else MOST_POINTS
        if most is not None and len(scene.x) > most:
            row |= {"status": "skipped", "reason": f"is not asked for more than {most} particles"}
        answer = None if "status" in row else table.ask(row, way.method, functools.partial(_prepare, way, scene))
        if answer is not None:
            found, compiled, function, made = answer
            row |= found
            if table.judge(row, found["wrong"], 0 if way.method is None else ROUNDED * len(scene.x)):
                row |= _time(lambda compiled=compiled: compiled(scene.x), function, scene.x, made, repeats)
        if way.who == "jax-md":
            peer = row.get("waited_ms")
        if peer is not None and "waited_ms" in row:
            row["ratio"] = row["waited_ms"] / peer
        yield row


def _time(call: Callable[[], Any], function: Function, x: Array, made: Any, repeats: int) -> table.Line:  # noqa: ANN401
    """Time calls that are waited for, and steps of a scan."""
    (first,) = _measure.time_in_turns({"call": call}, 1)[0]["call"]
    rounds, steps = repeats if first <= SLOW_S else max(repeats // 5, 3), int(np.clip(SCAN_S / first, 2, STEPS))
    waited, others = _measure.time_in_turns({"call": call}, rounds)
    stepped, _ = _measure.time_in_turns({"scan": _measure.compile_scan(function, x, steps, made)}, 3)
    times = {"waited_ms": 1e3 * float(np.median(waited["call"])), "step_ms": 1e3 * float(np.median(stepped["scan"])) / steps}
    return times | {"repeats": rounds, "others_cores": others}


def _make_scene(side: int, layout: str) -> _Scene:
    from scipy.spatial import KDTree

    sites = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(side)
    moved = rng.uniform(-JITTER, JITTER, sites.shape) if layout == "jitter" else np.zeros(sites.shape)
    x = rng.permutation((sites + moved).astype(np.float32)).astype(np.float64)
    below = np.nextafter(CUTOFF, 0)  # a tree counts those at the radius
    counts = KDTree(x).query_ball_point(x, below, return_length=True, workers=-1) - 1
    return _Scene(jnp.asarray(x, jnp.float32), counts)


def _prepare(way: _Way, scene: _Scene) -> tuple[table.Line, Function, Function, Any]:
    """Compile a way and look at its answer; return the first columns of its row, the program, its function and its answer."""
    function = way.make(scene)
    cache = jax.config.jax_enable_compilation_cache  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_enable_compilation_cache", False)
    jax.clear_caches()
    begin = perf_counter()
    lowered = jax.jit(function).lower(scene.x)
    between = perf_counter()
    compiled = lowered.compile()
    end = perf_counter()
    jax.config.update("jax_enable_compilation_cache", cache)
    made = compiled(scene.x)
    wrong = way.wrong(scene, made)
    analysis = compiled.memory_analysis()
    scratch = None if analysis is None else analysis.temp_size_in_bytes / 1e6
    row: table.Line = {"wrong": wrong, "lower_s": between - begin, "compile_s": end - between, "scratch_mb": scratch}
    if way.method is not None:
        row["peer"] = _machine.versions([way.package])[way.package]
    return row, compiled, function, made


# --- who does what ----------------------------------------------------------------------------------------------------


def _density(x: Array) -> Array:
    return jfrnn.pair_sum(lambda r, i, j: jnp.maximum(1 - (r @ r) / CUTOFF**2, 0) ** 3, x, CUTOFF, backend="jax")


def _density_and_gradient(x: Array) -> tuple[Array, Array]:
    density, back = jax.vjp(_density, x)
    return density, back(jnp.ones_like(density))[0]


def _list(scene: _Scene, **options: Any) -> Function:  # noqa: ANN401
    def search(x: Array) -> tuple[Array, Array]:
        nbrs = jfrnn.search(x, CUTOFF, capacity=scene.capacity, backend="jax", **options)
        return nbrs.idx, nbrs.count

    return search


def _periodic(scene: _Scene) -> Function:
    """Return a search in a box that ends far enough from the particles that no image is a neighbor."""
    side = float(np.ptp(np.asarray(scene.x), axis=0).max()) + 2 * CUTOFF
    return _list(scene, box=jfrnn.Box([side] * 3))


def _most_of_jax_md() -> int:
    from experiments.methods import jax_md

    return jax_md.MAX_POINTS if jax.default_backend() == "cpu" else MOST_ON_GPU


def _jax_md(scene: _Scene) -> Function:
    from experiments.methods import jax_md

    update = jax_md.compile_update(scene.x, CUTOFF, jax_md.allocate(np.asarray(scene.x), CUTOFF))
    return lambda x: update(x)


def _nvalchemi(scene: _Scene) -> Function:
    from experiments.methods import nvalchemi

    return nvalchemi.compile_search(scene.x, CUTOFF, scene.capacity)


def _ways() -> Iterator[_Way]:
    """Yield the ways in the order of a table: first the one whose time others are divided by."""
    yield _Way("jax-md", "list", _jax_md, lambda scene, idx: _wrong_rows(scene, (idx, None)), "jax-md", "jax-md")
    yield _Way("jfrnn", "list", _list, _wrong_rows, tied=True)
    yield _Way("jfrnn", "counts", lambda scene: lambda x: jfrnn.count(x, CUTOFF, backend="jax"), _wrong_counts, tied=True)
    yield _Way("jfrnn", "density", lambda scene: _density, _wrong_density)
    yield _Way(
        "jfrnn", "density, gradient", lambda scene: _density_and_gradient, lambda scene, found: _wrong_density(scene, found[0])
    )
    yield _Way("jfrnn", "list in a box", _periodic, _wrong_rows)
    yield _Way("XLA", "x + 1", lambda scene: lambda x: x + 1, lambda scene, found: int((found != scene.x + 1).any(axis=1).sum()))
    yield _Way("nvalchemi", "list", _nvalchemi, _wrong_rows, "nvalchemi", "nvalchemi-toolkit-ops")


# --- right or wrong ---------------------------------------------------------------------------------------------------


def _wrong_rows(scene: _Scene, found: tuple[Array, Array | None]) -> int:
    """Count the particles whose rows are not the right number of different neighbors within the cutoff, by float64.

    All rows have to have the right number; if there are many, distances are looked at in evenly chosen ones.
    """
    n, x, rows = len(scene.x), np.asarray(scene.x, np.float64), np.asarray(found[0])
    right = (rows < n).sum(axis=1) == scene.counts
    chosen = np.linspace(0, n - 1, min(n, ROWS_SEEN)).astype(int)
    for some in np.array_split(chosen, -(-len(chosen) // 20_000)):
        idx = np.sort(rows[some], axis=1)
        good, used = ((idx[:, 1:] > idx[:, :-1]) | (idx[:, 1:] >= n)).all(axis=1), idx < n
        apart = np.square(x[np.where(used, idx, 0)] - x[some, None]).sum(axis=2)
        right[some] &= good & (~used | ((apart < CUTOFF**2) & (idx != some[:, None]))).all(axis=1)
    return int((~right).sum()) + (0 if found[1] is None else _wrong_counts(scene, found[1]))


def _wrong_counts(scene: _Scene, found: Any) -> int:  # noqa: ANN401
    return int((scene.counts != np.asarray(found)).sum())


def _wrong_density(scene: _Scene, found: Array) -> int:
    """Count the particles whose density, of evenly chosen ones, is farther from that in float64 than rounding explains."""
    from scipy.spatial import KDTree

    x = np.asarray(scene.x, np.float64)
    chosen = np.linspace(0, len(x) - 1, min(len(x), 2000)).astype(int)
    rows = KDTree(x).query_ball_point(x[chosen], CUTOFF)
    exact = np.array(
        [
            (np.maximum(1 - np.square(x[row] - x[i]).sum(axis=1) / CUTOFF**2, 0) ** 3).sum() - 1
            for i, row in zip(chosen, rows, strict=True)
        ]
    )
    return int((~(np.abs(np.asarray(found)[chosen] - exact) <= 1e-5 * exact.max())).sum())
