"""What a list costs those who use it: particles in random order or sorted, rows padded or compressed."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import typer

import jfrnn
from experiments import _measure
from experiments._commands import Points, Rounds
from experiments._library import Name, round_capacity
from experiments.bench import table

ORDERS: tuple[Name, ...] = ("random", "row", "morton", "hilbert")
CLUMPS = (0, 100, 300, 1000, 3000)  # points that lie within half a cutoff of each other
NEIGHBORS = 30  # about so many each, away from the faces of the unit cube
ORDER_COLUMNS = ("order", "points", "sort_ms", "search_ms", "sum_ms", "gain")
ROW_COLUMNS = ("longest", "mean", "padded_MB", "compressed_MB", "padded_ms", "compressed_ms", "make_ms")


def command(
    points: Points = 250_000,
    rounds: Rounds = 9,
    out: Annotated[Path, typer.Option(help="Folder of the tables.")] = Path("out") / "use",
) -> str:
    """Time what uses a list: particles in random order or sorted, rows padded or compressed."""
    given = [points, rounds]
    orders = table.measure(out, "orders", [("orders", lambda: _order_rows(points, rounds))], given, ORDER_COLUMNS)
    rows = table.measure(out, "rows", [("rows", lambda: _padding_rows(points // 5, rounds))], given, ROW_COLUMNS)
    return f"{table.text(orders)}\n\n{table.text(rows)}"


def _order_rows(points: int, rounds: int) -> Iterator[table.Line]:
    """Time a search, and a sum over the distances of its list, for the same particles in several orders.

    `gain` says how many times faster than in random order search and sum together are; the sort takes 0 where there is none.
    """
    random = np.random.default_rng(0)
    x, r = jnp.asarray(random.random((points, 3)), jnp.float32), (3 * NEIGHBORS / (4 * math.pi * points)) ** (1 / 3)
    capacity = round_capacity(int(jfrnn.count(x, r).max()))
    search = jax.jit(lambda x: jfrnn.search(x, r, capacity=capacity))
    calls: dict[str, Callable[[], Any]] = {}
    for order in ORDERS:
        there = x
        if order != "random":
            sort = jax.jit(lambda x, order=order: x[jfrnn.sort_order(x, r, curve=order)])
            there = sort(x)
            calls[f"sort {order}"] = lambda sort=sort: sort(x)
        nbrs = search(there)
        calls[f"search {order}"] = lambda there=there: search(there).idx
        calls[f"sum {order}"] = lambda there=there, nbrs=nbrs: _padded_sum(there, nbrs, r)
    milliseconds = _medians(calls, rounds)
    first = milliseconds["search random"] + milliseconds["sum random"]
    for order in ORDERS:
        sort, search_ms, sum_ms = (milliseconds.get(f"{what} {order}", 0.0) for what in ("sort", "search", "sum"))
        row = {"order": order, "points": points, "sort_ms": sort, "search_ms": search_ms, "sum_ms": sum_ms}
        yield row | {"gain": first / (search_ms + sum_ms)}


def _padding_rows(points: int, rounds: int) -> Iterator[table.Line]:
    """Time a sum over padded rows beside one over compressed rows, while one clump makes the longest row ever longer.

    Both are sums over a list that is there; the compressed rows are made once (`make_ms`).
    """
    random = np.random.default_rng(0)
    r = (3 * 30 / (4 * math.pi * points)) ** (1 / 3)
    for clump in CLUMPS:
        many = np.concatenate([random.random((points, 3)), 0.5 + r / 4 * (random.random((clump, 3)) - 0.5)])
        x = jnp.asarray(many, jnp.float32)
        nbrs = jfrnn.search(x, r)
        total = int(np.asarray(nbrs.count).sum(dtype=np.int64))
        make = jax.jit(lambda nbrs, total=total: nbrs.pairs(total))
        i, j = make(nbrs)
        calls = {
            "padded": lambda x=x, nbrs=nbrs: _padded_sum(x, nbrs, r),
            "compressed": lambda x=x, i=i, j=j: _compressed_sum(x, i, j, r),
            "make": lambda make=make, nbrs=nbrs: make(nbrs),
        }
        np.testing.assert_allclose(calls["padded"](), calls["compressed"](), rtol=1e-3, atol=1e-6)
        milliseconds, n = _medians(calls, rounds), len(many)
        row = {"clump": clump, "longest": int(nbrs.count.max()), "mean": total / n, "padded_MB": 4e-6 * n * nbrs.capacity}
        yield row | {"compressed_MB": 8e-6 * total} | {f"{name}_ms": value for name, value in milliseconds.items()}


@jax.jit
def _padded_sum(x: jax.Array, nbrs: jfrnn.NeighborList, r: float) -> jax.Array:
    distances, mask = nbrs.distances(x)
    return jnp.where(mask, r - distances, 0).sum(axis=1)


@jax.jit
def _compressed_sum(x: jax.Array, i: jax.Array, j: jax.Array, r: float) -> jax.Array:
    distances = jnp.sqrt(jnp.sum((x[j] - x[i]) ** 2, axis=1))
    return jax.ops.segment_sum(r - distances, i, len(x), indices_are_sorted=True)


def _medians(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    for call in calls.values():
        jax.block_until_ready(call())
    seconds, _ = _measure.time_in_turns(calls, rounds)
    return {name: 1e3 * float(np.median(values)) for name, values in seconds.items()}
