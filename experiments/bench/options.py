"""What each option of a search costs: the same scene with one option at a time, side by side in one run."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import typer

import jfrnn
from experiments import _measure
from experiments._commands import Engine, Points, Rounds
from experiments._library import round_capacity
from experiments.bench import table

COLUMNS = (
    *("platform", "backend", "n", "option", "entries", "capacity", "rounds", "list_s", "count_s", "sum_s"),
    *("list_ratio", "count_ratio", "sum_ratio"),
    *("others_cores", "device", "jax", "warp", "commit", "dirty"),
)
SHOWN = ("option", "entries", "capacity", "list_s", "list_ratio", "count_s", "count_ratio", "sum_s", "sum_ratio")
NEIGHBORS = 30  # about so many each, away from the faces of the unit cube


class _Option(NamedTuple):
    """One way to search: its name, positions, cutoff, and what else goes to `search` and `count`."""

    name: str
    x: Any
    cutoff: Any
    more: dict[str, Any]


def command(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "options",
    points: Points = 100_000,
    rounds: Rounds = 15,
    backend: Engine = "warp",
) -> str:
    """Time each option of a search beside a plain one."""
    jax.config.update("jax_enable_x64", True)
    parts = [("all options", lambda: _rows(points, rounds, backend))]
    return table.text(table.measure(out, f"{jax.default_backend()}_{backend}", parts, [points, rounds], COLUMNS), SHOWN)


def _rows(n: int, rounds: int, backend: str) -> Iterator[table.Line]:
    """Time every option once per round; medians of rounds count."""
    options = list(_options(n, NEIGHBORS))
    calls = [_compile(option, backend) for option in options]
    for each in calls:
        jax.block_until_ready([call() for call in each.values()])
    numbered = {f"{place} {what}": call for place, each in enumerate(calls) for what, call in each.items()}
    burst = 20 if jax.default_backend() == "gpu" else 1
    seconds, others = _measure.time_in_turns(numbered, rounds, burst)
    medians = {name: float(np.median(found)) for name, found in seconds.items()}
    for place, (option, each) in enumerate(zip(options, calls, strict=True)):
        idx, count = each["list"]()
        row = {"backend": backend, "n": n, "option": option.name, "entries": int(np.asarray(count).sum(dtype=np.int64))}
        row |= {"capacity": idx.shape[1], "rounds": rounds, "others_cores": others}
        row |= {f"{what}_s": medians[f"{place} {what}"] for what in each}
        yield row | {f"{what}_ratio": round(medians[f"{place} {what}"] / medians[f"0 {what}"], 2) for what in each}


def _options(n: int, neighbors: int) -> Iterator[_Option]:
    random = np.random.default_rng(0)
    points = random.random((n, 3)).astype(np.float32)
    x, r = jnp.asarray(points), (3 * neighbors / (4 * math.pi * n)) ** (1 / 3)
    yield _Option("open, whole list", x, r, {})
    yield _Option("half", x, r, {"half": True})
    yield _Option("closed", x, r, {"closed": True})
    yield _Option("include_self", x, r, {"include_self": True})
    yield _Option("float64", jnp.asarray(points, jnp.float64), r, {})
    yield _Option("as many queries", x, r, {"queries": jnp.asarray(random.random((n, 3)), jnp.float32)})
    yield _Option("a tenth inactive", x, r, {"active": jnp.asarray(random.random(n) < 0.9)})
    yield _Option("skin of a tenth", x, r, {"skin": 0.1 * r})
    yield _Option("box, periodic", x, r, {"box": jfrnn.Box([1.0, 1.0, 1.0])})
    yield _Option("box, periodic along x", x, r, {"box": jfrnn.Box([1.0, 1.0, 1.0], (True, False, False))})
    skewed = np.eye(3) + np.diag([0.3, 0.3], 1)
    yield _Option("box, skewed", x, r, {"box": jfrnn.Box(skewed)})
    yield _Option("box, images told apart", x, r, {"box": jfrnn.Box([1.0, 1.0, 1.0], images=1)})
    systems = 100
    batch = jnp.asarray(random.integers(0, systems, n), jnp.int32)
    yield _Option("batch of 100 systems, superposed", x, r * systems ** (1 / 3), {"batch": batch})
    yield _Option("a cutoff per particle, equal", x, jnp.full(n, r, jnp.float32), {})
    within = jnp.asarray(r * random.uniform(2 / 3, 4 / 3, n), jnp.float32)
    for rule in ("gather", "either"):
        yield _Option(f"a cutoff per particle within a factor of 2, {rule}", x, within, {"radius_rule": rule})
    cutoffs = jnp.asarray([[r, 0.75 * r], [0.75 * r, 0.5 * r]], jnp.float32)
    yield _Option("a cutoff per pair of two species", x, cutoffs, {"species": jnp.asarray(random.integers(0, 2, n), jnp.int32)})
    away = random.normal(size=(n, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    distance = 10.0 ** random.uniform(-2, 0, n)
    graded = jnp.asarray(distance[:, None] * away, jnp.float32)
    radii = (3 * neighbors * math.log(100) / n) ** (1 / 3) * distance  # of neighbors, where density goes with distance^-3
    for rule in ("gather", "scatter", "either", "both", "mean"):
        name = f"a cutoff per particle over a factor of 100, {rule}"
        yield _Option(name, graded, jnp.asarray(radii, jnp.float32), {"radius_rule": rule})


def _compile(option: _Option, backend: str) -> dict[str, Callable[[], Any]]:
    """Return what lists, what counts and what sums a density; half lists, and those with a skin, are no sums."""
    given = {name: value for name, value in option.more.items() if name != "skin"}
    skin = option.more.get("skin", 0.0)
    longest = int(jfrnn.count(option.x, option.cutoff + skin, backend=backend, **given).max())
    capacity = round_capacity(longest)
    given["cutoff"] = option.cutoff
    data: dict[str, Any] = {name: value for name, value in given.items() if hasattr(value, "shape")}  # operands, no constants
    more = {name: value for name, value in given.items() if name not in data}
    masses = jnp.linspace(1, 2, len(option.x), dtype=option.x.dtype)

    def list_pairs(x: jax.Array, data: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        nbrs = jfrnn.search(x, skin=skin, capacity=capacity, backend=backend, **more, **data)
        return nbrs.idx, nbrs.count

    def density(r: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
        return j * jnp.maximum(1 - r @ r, 0) ** 3

    def sum_pairs(x: jax.Array, masses: jax.Array, data: dict[str, Any]) -> jax.Array:
        of_queries = {"query_values": masses} if "queries" in data else {}
        return jfrnn.pair_sum(density, x, values=masses, backend=backend, **of_queries, **more, **data)

    search, summed = jax.jit(list_pairs), jax.jit(sum_pairs)
    count = jax.jit(lambda x, data: jfrnn.count(x, backend=backend, **more, **data))
    calls = {"list": lambda: search(option.x, data), "count": lambda: count(option.x, data)}
    if not {"half", "skin"} & set(option.more):
        calls["sum"] = lambda: summed(option.x, masses, data)
    return calls
