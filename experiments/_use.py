"""What a list costs those who use it: particles in random order or sorted, rows padded or compressed."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import jfrnn
from experiments import _measure
from jfrnn._search.neighbor_list import rounded_capacity

ORDERS = ("random", "row", "morton", "hilbert")


def order_table(points: int, rounds: int, neighbors: int = 30) -> pd.DataFrame:
    """Time a search, and a sum over the distances of its list, for the same particles in several orders.

    Args:
        points: Random points in a unit cube, float32.
        rounds: Of timed runs; medians of them count.
        neighbors: About so many each, away from faces.

    Returns:
        One row per order: milliseconds of the sort (0 for none), of the search and of the sum, and how many times faster than in
        random order search and sum together are.
    """
    random = np.random.default_rng(0)
    x, r = jnp.asarray(random.random((points, 3)), jnp.float32), (3 * neighbors / (4 * math.pi * points)) ** (1 / 3)
    capacity = rounded_capacity(int(jfrnn.count(x, r).max()))
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
    rows, first = [], milliseconds["search random"] + milliseconds["sum random"]
    for order in ORDERS:
        sort, search_ms, sum_ms = (milliseconds.get(f"{what} {order}", 0.0) for what in ("sort", "search", "sum"))
        row = {"order": order, "points": points, "sort_ms": sort, "search_ms": search_ms, "sum_ms": sum_ms}
        rows.append(row | {"gain": first / (search_ms + sum_ms)})
    return pd.DataFrame(rows)


def rows_table(points: int, rounds: int, clumps: tuple[int, ...] = (0, 100, 300, 1000, 3000)) -> pd.DataFrame:
    """Time a sum over padded rows beside one over compressed rows, while one clump makes the longest row ever longer.

    Args:
        points: Random points in a unit cube, about 30 neighbors each, float32.
        rounds: Of timed runs; medians of them count.
        clumps: So many points lie within half a cutoff of each other besides.

    Returns:
        One row per clump: longest row and mean, bytes of both kinds of rows, and milliseconds of both sums over a list that is
        there; the compressed rows are made once (`make_ms`).
    """
    random, rows = np.random.default_rng(0), []
    r = (3 * 30 / (4 * math.pi * points)) ** (1 / 3)
    for clump in clumps:
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
        row = {"longest": int(nbrs.count.max()), "mean": total / n, "padded_MB": 4e-6 * n * nbrs.capacity}
        rows.append(row | {"compressed_MB": 8e-6 * total} | {f"{name}_ms": value for name, value in milliseconds.items()})
    return pd.DataFrame(rows)


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
