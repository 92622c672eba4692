"""One sum in many ways, a poly6 density and its gradient: without a list, over lists of several libraries, over all pairs.

`measure` does one of them in this process: a worker's.
"""

import math
from collections.abc import Callable
from time import perf_counter, sleep
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

import jfrnn
from experiments import _layouts, _machine, _measure
from experiments._library import Name, round_capacity

MOST_ROWS = 20_000  # whose error is looked at; of more particles, evenly chosen ones


class Given(NamedTuple):
    """Particle positions [m], shape [n, 3]; what each contributes, shape [n]; the cutoff [m]."""

    x: Any
    m: Any
    cutoff: float


class Steps(NamedTuple):
    """`build(x)` makes a list anew, where there is one; `sums(x, m, list or None)` uses it."""

    build: Callable[[Any], Any] | None
    sums: Callable[[Any, Any, Any], Any]


class Way(NamedTuple):
    """How a sum is made ready, and what it is able to do."""

    prepare: Callable[[Given, bool, bool], Steps]
    package: str = "jfrnn"
    compensates: bool = False
    sums: bool = True  # else it only searches


def poly6_scale(cutoff: float) -> float:
    """Return what makes that kernel's integral 1."""
    return 315 / (64 * math.pi * cutoff**3)


def poly6(cutoff: float) -> Callable[[Any, Any, Any], Any]:
    """Return a density's kernel (Müller et al. 2003, doi:10.2312/SCA03/154-159) for `jfrnn.pair_sum`."""
    scale = poly6_scale(cutoff)

    def kernel(r: Any, i: Any, j: Any) -> Any:  # noqa: ANN401
        return j * scale * jnp.maximum(1 - r @ r / cutoff**2, 0.0) ** 3

    return kernel


def over_list(kernel: Callable[[Any, Any, Any], Any], x: Any, m: Any, idx: Any) -> Any:  # noqa: ANN401
    """Sum a kernel over the rows of a padded list [n, capacity] in plain JAX; slots from n on are unused."""
    used = idx < len(x)
    j = jnp.where(used, idx, 0)
    each = jax.vmap(jax.vmap(kernel, (0, None, 0)), (0, 0, 0))
    return jnp.where(used, each(x[j] - x[:, None], m, m[j]), 0).sum(axis=1)


def reference(given: Given, rows: np.ndarray, gradient: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return of some particles sums in float64, sums of absolute values, and numbers of neighbors; independent of the library.

    Ties at the cutoff need no decision: the kernel and its gradient are 0 there.
    """
    x, m, h = np.asarray(given.x, np.float64), np.asarray(given.m, np.float64), given.cutoff
    found = KDTree(x).query_ball_point(x[rows], h)
    place, j = np.repeat(np.arange(len(rows)), [len(row) for row in found]), np.concatenate([*found]).astype(np.int64)
    place, j = place[j != rows[place]], j[j != rows[place]]
    r = x[j] - x[rows[place]]
    inside, scale = np.maximum(1 - (r**2).sum(axis=1) / h**2, 0), poly6_scale(h)
    terms = (m[j] * scale * inside**3)[:, None]
    if gradient:
        terms = np.hstack([terms, ((m[j] + m[rows[place]]) * scale * 6 / h**2 * inside**2)[:, None] * r])
    sums, sizes = (
        np.stack([np.bincount(place, column, len(rows)) for column in columns.T], axis=1) for columns in (terms, np.abs(terms))
    )
    return sums, sizes, np.bincount(place, minlength=len(rows))


def error_of(given: Given, found: Any, gradient: bool) -> float:  # noqa: ANN401
    """Return the largest error of sums against float64, over the sum of |terms|, in eps·sqrt(number of neighbors).

    What the terms are rounded by is in it: of few neighbors, all of them near the cutoff, a multiple of what summing takes.
    """
    n = len(given.x)
    rows = np.unique(np.linspace(0, n - 1, min(n, MOST_ROWS)).astype(np.int64))
    exact, size, count = reference(given, rows, gradient)
    columns = [np.asarray(found[0])[:, None], np.asarray(found[1])] if gradient else [np.asarray(found)[:, None]]
    error = np.abs(np.hstack(columns)[rows].astype(np.float64) - exact)
    allowed = np.finfo(columns[0].dtype).eps * np.sqrt(count)[:, None] * size
    if (error[allowed == 0] != 0).any() or not np.isfinite(error).all():
        raise ValueError("a particle without neighbors has a sum, or a sum is not finite")
    return float((error[allowed > 0] / allowed[allowed > 0]).max(initial=0.0))


def measure(spec: dict[str, Any]) -> dict[str, Any]:
    """Return what this process can know of a row, a failure too; the spec is one of `sums.Config`."""
    way, most = WAYS[spec["way"]], spec["most_points"]
    row: dict[str, Any] = {"versions": _machine.versions([way.package])}
    try:
        scene = _layouts.make(
            spec["layout"], fill=1.0, **{name: spec[name] for name in ("spacing", "cutoff_ratio", "dtype", "seed")}
        )
        row["points"] = n = len(scene.positions)
        if most is not None and n > most:
            return row | {"status": "skipped", "reason": f"{n} points; {spec['way']} is run up to {most}"}
        _measure_way(way, spec, scene.positions, float(scene.positions.dtype.type(scene.cutoff)), row)
        row["status"] = "ok"
    except ImportError as error:
        row |= {"status": "missing", "reason": f"{spec['way']} cannot be imported: {error}"}
    except Exception as error:  # whatever a way raises is the result of its row
        row |= {"status": "failed", "reason": f"{type(error).__name__}: {error}"[:600]}
    return row


def _measure_way(way: Way, spec: dict[str, Any], positions: np.ndarray, cutoff: float, row: dict[str, Any]) -> None:
    """Run once to compile, then for the time, once for the memory; fill the row as far as it comes."""
    jax.config.update("jax_enable_x64", spec["dtype"] == "float64")
    masses = np.random.default_rng(spec["seed"]).uniform(0.5, 1.5, len(positions)).astype(positions.dtype)
    given = Given(jnp.asarray(positions), jnp.asarray(masses), cutoff)
    device = _measure.DeviceMemory()
    steps, building = way.prepare(given, spec["gradient"], spec["compensated"]), []

    def once() -> Any:  # noqa: ANN401
        begin = perf_counter()
        made = None if steps.build is None else jax.block_until_ready(steps.build(given.x))
        building.append(perf_counter() - begin)
        return jax.block_until_ready(steps.sums(given.x, given.m, made))

    begin = perf_counter()
    once()
    row["first_s"] = perf_counter() - begin
    building.clear()
    bystanders = _measure.Bystanders()
    found, seconds = _measure.repeat(once, spec["repeats"], spec["min_seconds"], spec["max_repeats"])
    row |= {name: value for name, value in _measure.summarize(seconds).items() if name != "seconds"}
    row |= {"others_cores": bystanders.cores(), "cutoff": cutoff, "device": jax.devices()[0].device_kind}
    if steps.build is not None:
        row["build_s"] = float(np.median(building))
    row["sum_s"] = float(np.median(np.subtract(seconds, building)))
    if way.sums:
        row["error"] = error_of(given, found, spec["gradient"])
    del found
    _measure.forget_freed_memory()
    once()
    sleep(0.2)  # threads of XLA give back what a call took after its result is there
    memory = _measure.PeakMemory()
    once()
    row |= {"peak_bytes": memory.peak() - memory.start, "memory_source": memory.source}
    if (peak := device.peak()) is not None:  # compiling does not raise it
        row |= {"peak_bytes": peak, "memory_source": "device"}


# --- the ways ---------------------------------------------------------------------------------------------------------


def _compile(density: Callable[[Any, Any, Any], Any], gradient: bool) -> Callable[[Any, Any, Any], Any]:
    """Return a jitted density(x, m, made), or it and the gradient of the sum of all densities in x."""
    if not gradient:
        return jax.jit(density)

    def total(x: Any, m: Any, made: Any) -> Any:  # noqa: ANN401
        sums = density(x, m, made)
        return sums.sum(), sums

    def both(x: Any, m: Any, made: Any) -> Any:  # noqa: ANN401
        slope, sums = jax.grad(total, has_aux=True)(x, m, made)
        return sums, slope

    return jax.jit(both)


def _steps_without_list(backend: Name) -> Callable[[Given, bool, bool], Steps]:
    def prepare(given: Given, gradient: bool, compensated: bool) -> Steps:
        kernel, cutoff = poly6(given.cutoff), given.cutoff

        def density(x: Any, m: Any, made: Any) -> Any:  # noqa: ANN401
            return jfrnn.pair_sum(kernel, x, cutoff, m, compensated=compensated, backend=backend)

        return Steps(None, _compile(density, gradient))

    return prepare


def _capacity(given: Given) -> int:
    return round_capacity(int(jfrnn.count(given.x, given.cutoff).max()))


def _our_list(given: Given) -> Callable[[Any], Any]:
    capacity, cutoff = _capacity(given), given.cutoff
    return jax.jit(lambda x: jfrnn.search(x, cutoff, capacity=capacity))


def _our_flat_list(given: Given) -> Callable[[Any], Any]:
    total, cutoff = jfrnn.search_edges(given.x, given.cutoff).total, given.cutoff
    return jax.jit(lambda x: jfrnn.search_edges(x, cutoff, total=total))


def _jax_md(given: Given) -> Callable[[Any], Any]:
    from experiments.methods import jax_md

    return jax_md.compile_update(given.x, given.cutoff)


def _nvalchemi(given: Given) -> Callable[[Any], Any]:
    from experiments.methods import nvalchemi

    capacity = _capacity(given)
    search = nvalchemi.compile_search(given.x, given.cutoff, capacity)

    def build(x: Any) -> Any:  # noqa: ANN401
        idx, count = search(x)
        return jnp.where(jnp.arange(capacity) < count[:, None], idx, len(x))

    return jax.jit(build)


def _plain_sum_over(
    make: Callable[[Given], Callable[[Any], Any]], rows: Callable[[Any], Any] = lambda idx: idx
) -> Callable[[Given, bool, bool], Steps]:
    def prepare(given: Given, gradient: bool, _: bool) -> Steps:
        kernel = poly6(given.cutoff)
        return Steps(make(given), _compile(lambda x, m, made: over_list(kernel, x, m, rows(made)), gradient))

    return prepare


def _pair_sum_over(make: Callable[[Given], Callable[[Any], Any]]) -> Callable[[Given, bool, bool], Steps]:
    def prepare(given: Given, gradient: bool, compensated: bool) -> Steps:
        kernel = poly6(given.cutoff)

        def density(x: Any, m: Any, nbrs: Any) -> Any:  # noqa: ANN401
            return jfrnn.pair_sum(kernel, x, None, m, neighbors=nbrs, compensated=compensated)

        return Steps(make(given), _compile(density, gradient))

    return prepare


def _scipy(given: Given, *_: bool) -> Steps:
    points = np.asarray(given.x, np.float64)
    return Steps(None, lambda x, m, made: KDTree(points).query_pairs(given.cutoff, output_type="ndarray"))


WAYS = {
    "pair_sum warp": Way(_steps_without_list("warp"), compensates=True),
    "pair_sum jax": Way(_steps_without_list("jax"), compensates=True),
    "brute force": Way(_steps_without_list("brute"), compensates=True),
    "list, sum": Way(_plain_sum_over(_our_list, lambda nbrs: nbrs.idx)),
    "list, pair_sum": Way(_pair_sum_over(_our_list), compensates=True),
    "jax-md list, sum": Way(_plain_sum_over(_jax_md), "jax-md"),
    "nvalchemi list, sum": Way(_plain_sum_over(_nvalchemi), "nvalchemi-toolkit-ops"),
    "scipy pairs alone": Way(_scipy, "scipy", sums=False),
    "flat list, pair_sum": Way(_pair_sum_over(_our_flat_list), compensates=True),
}
