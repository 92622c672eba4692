"""What each option of a search costs: the same scene with one option at a time, side by side in one run."""

import csv
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import jfrnn
from experiments import _machine, _measure
from jfrnn._search.neighbor_list import rounded_capacity

COLUMNS = (
    *("platform", "backend", "n", "option", "entries", "capacity", "rounds", "list_s", "count_s", "list_ratio", "count_ratio"),
    *("others_cores", "device", "jax", "warp", "commit", "dirty"),
)


class _Option(NamedTuple):
    """One way to search: its name, positions, cutoff, and what else goes to `search` and `count`."""

    name: str
    x: Any
    cutoff: Any
    more: dict[str, Any]


def measure(folder: Path, n: int, rounds: int, backend: str, neighbors: int = 30) -> Path:
    """Write a table of seconds by option, and return its path; every option is timed once per round.

    Args:
        folder: Takes a file named after platform and backend, such as cpu_warp.csv; one that is there is replaced.
        n: Random points in a unit cube.
        rounds: Of timed runs; medians of them count.
        backend: As in `jfrnn.search`.
        neighbors: About so many each, away from faces.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{jax.default_backend()}_{backend}.csv"
    options = list(_options(n, neighbors))
    calls = [_compiled(option, backend) for option in options]
    for search, count in calls:
        jax.block_until_ready((search(), count()))
    numbered = {str(place): call for place, call in enumerate(itertools.chain.from_iterable(calls))}
    burst = 20 if jax.default_backend() == "gpu" else 1
    seconds, others = _measure.time_in_turns(numbered, rounds, burst)
    medians = np.median(list(seconds.values()), axis=1).reshape(len(options), 2)
    versions, commit, device = _machine.versions(), _machine.commit(), jax.devices()[0]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        for option, (search, _), median in zip(options, calls, medians, strict=True):
            idx, count = search()
            ratios = median / medians[0]
            writer.writerow(
                {"platform": device.platform, "backend": backend, "n": n, "option": option.name}
                | {"entries": int(np.asarray(count).sum(dtype=np.int64)), "capacity": idx.shape[1], "rounds": rounds}
                | {"list_s": f"{median[0]:.3e}", "count_s": f"{median[1]:.3e}"}
                | {"list_ratio": round(ratios[0], 2), "count_ratio": round(ratios[1], 2)}
                | {"others_cores": others, "device": device.device_kind}
                | {"jax": versions["jax"], "warp": versions["warp-lang"], **commit}
            )
    return path


def table(path: Path) -> str:
    """Return the table of a run as text."""
    columns = ["option", "entries", "capacity", "list_s", "list_ratio", "count_s", "count_ratio"]
    return pd.read_csv(path)[columns].to_string(index=False)


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
    away = random.normal(size=(n, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    distance = 10.0 ** random.uniform(-2, 0, n)
    graded = jnp.asarray(distance[:, None] * away, jnp.float32)
    radii = (3 * neighbors * math.log(100) / n) ** (1 / 3) * distance  # of neighbors, where density goes with distance^-3
    for rule in ("gather", "scatter", "either", "both", "mean"):
        name = f"a cutoff per particle over a factor of 100, {rule}"
        yield _Option(name, graded, jnp.asarray(radii, jnp.float32), {"radius_rule": rule})


def _compiled(option: _Option, backend: str) -> tuple[Callable[[], Any], Callable[[], Any]]:
    given = {name: value for name, value in option.more.items() if name != "skin"}
    skin = option.more.get("skin", 0.0)
    longest = int(jfrnn.count(option.x, option.cutoff + skin, backend=backend, **given).max())
    capacity = rounded_capacity(longest)
    given["cutoff"] = option.cutoff
    data: dict[str, Any] = {name: value for name, value in given.items() if hasattr(value, "shape")}  # operands, no constants
    more = {name: value for name, value in given.items() if name not in data}

    def listed(x: jax.Array, data: dict[str, Any]) -> tuple[jax.Array, jax.Array]:
        nbrs = jfrnn.search(x, skin=skin, capacity=capacity, backend=backend, **more, **data)
        return nbrs.idx, nbrs.count

    search = jax.jit(listed)
    count = jax.jit(lambda x, data: jfrnn.count(x, backend=backend, **more, **data))
    return lambda: search(option.x, data), lambda: count(option.x, data)
