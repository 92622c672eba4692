"""Searches with a box per system by Warp's kernels: cells are sorted by XLA, a kernel meets them."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import lattice_numbers, particle_rows, periodic_kind, space_flags
from jfrnn._engine.plans import Clear, Launch, Plan, ask_for_huge_pages, share
from jfrnn._engine.problem import Filter, Rows, Search, largest_radius
from jfrnn._geometry import Lattice, Status, Wrapped, sort_into_boxes
from jfrnn.kernels import boxes

_GIVEN = ("positions", "queries", "boxes", "axes", "asked", "ids", "order", "visits", "cells", "start")


class _Variant(NamedTuple):
    """All that is static about a search, apart from shapes."""

    dim: int
    double: bool
    scaled: bool
    lists: bool
    own: bool
    closed: bool
    keep: Filter
    periodic: int
    cuda: bool


def box_neighbors(search: Search, keep: Filter, capacity: int | None) -> Rows:
    """List the neighbors of every query, or only count them (capacity=None), where each system has a box of its own."""
    dims = {"count": search.sizes[1], "info": 2}
    dims |= {} if capacity is None else {"idx": (search.sizes[1], capacity)}
    double, dim = search.sources.dtype == jnp.float64, search.sources.shape[1]
    own, kind = search.queries is None, periodic_kind(search.torus)

    def on(cuda: bool) -> Callable[..., list[Array]]:
        lists, closed, scaled = capacity is not None, search.cutoff.closed, search.cutoff.scaled
        call = _callable(_Variant(dim, double, scaled, lists, own, closed, keep, kind, cuda))
        return lambda *given: call(*given, output_dims=dims)

    count, info, *idx = lax.platform_dependent(*_operands(search), cpu=on(False), cuda=on(True))
    overflow = jnp.where(capacity is not None and info[0] > (capacity or 0), Status.ROW_OVERFLOW.value, 0)
    return Rows(idx[0] if idx else None, count, info[0], overflow.astype(jnp.int32))


def _operands(search: Search) -> list[Array]:
    """Return what the kernel is given, in the order of `_GIVEN` (see `kernels/native/box_pairs.h`)."""
    sources, queries, batch, torus = search.sources, search.queries, search.batch, search.torus
    if batch is None or torus is None:
        raise TypeError("a search with a box per system has a batch and a lattice.")
    lattice, wrapped = torus
    cells = sort_into_boxes(sources, queries, lattice, wrapped, batch)
    padded = jnp.pad(cells.order, (0, boxes.PADDING))
    order = cells.order if queries is None else lax.iota(jnp.int32, len(queries))
    rows = particle_rows(sources, wrapped.turns, None)
    asking = rows if queries is None else particle_rows(queries, wrapped.query_turns, None)
    gap = ((0, 0), (0, 3 - lattice.dim))
    visits = jnp.concatenate([batch.of_queries[:, None], jnp.pad(cells.from_cell, gap), jnp.pad(cells.visited, gap)], axis=1)
    bits = lattice.spread(jnp.asarray(lattice.periodic), 2).astype(jnp.int32) << np.arange(lattice.dim, dtype=np.int32)[None]
    turning = jnp.broadcast_to(jnp.sum(bits, axis=1, dtype=jnp.int32), cells.first.shape)
    of_system = jnp.concatenate([jnp.pad(cells.counts, gap), cells.first[:, None], turning[:, None]], axis=1)
    axes = jnp.stack([x[padded] for x in wrapped.sources.T])
    numbers = _numbers(search, lattice, wrapped)
    return [rows, asking, numbers, axes, wrapped.queries, padded, order, visits, of_system, cells.start]


def _numbers(search: Search, lattice: Lattice, wrapped: Wrapped) -> Array:
    """Return the numbers of each lattice, behind the radius, [systems, ...]."""
    radius = jnp.reshape(jnp.asarray(largest_radius(search.cutoff)), 1)

    def of_system(lattice: Lattice, reach: Array, slack: Array) -> Array:
        return jnp.concatenate([radius, lattice_numbers(lattice, reach, slack)])

    return jax.vmap(of_system)(lattice, wrapped.reach, wrapped.slack)


@kernel
def _callable(variant: _Variant) -> Call:
    flags = {"f64": variant.double, "f32": not variant.double, "scaled": variant.scaled, "list": variant.lists}
    flags |= {**space_flags(variant.periodic), "own": variant.own, "closed": variant.closed}
    flags |= {"dropself": variant.keep.drop_self, "later": variant.keep.later_only}
    name = f"jfrnn_box_rows_{'cuda' if variant.cuda else 'cpu'}_{variant.dim}d"
    results = dict.fromkeys(["count", "info", *["idx"] * variant.lists], np.int32)
    return Call("_".join([name, *(flag for flag, on in flags.items() if on)]), _GIVEN, results, functools.partial(_plan, variant))


def _plan(variant: _Variant, shapes: Shapes, _: int) -> Plan:
    n, m = shapes["positions"][0], shapes["queries"][0]
    found = boxes.rows_kernel(variant.dim, variant.double, variant.scaled, variant.lists, variant.periodic, variant.cuda)
    numbers = {"n": n, "m": m, "stride": shapes["axes"][1], "own": variant.own, "closed": variant.closed}
    numbers |= {"drop_self": variant.keep.drop_self, "later_only": variant.keep.later_only}
    numbers |= {"capacity": shapes["idx"][1] if variant.lists else 0}
    launch = Launch(found, boxes.threads(m)) if variant.cuda else share(found, m, boxes.QUERIES_AT_ONCE)
    pages = [] if variant.cuda or not variant.lists else ask_for_huge_pages("idx", 4 * m * numbers["capacity"])
    return Plan([Clear("info", 8), *pages, launch], numbers, [] if variant.lists else ["idx"])
