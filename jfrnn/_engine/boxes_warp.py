"""Searches with a box per system by Warp's kernels: cells are sorted by XLA, a kernel meets them."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import lattice_numbers, particle_rows, periodic_kind
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn._engine.problem import Filter, Room, Rows, Search, largest_radius
from jfrnn._engine.variants import Variant, absent, describe_call, huge_pages, plan_numbers, row_dims, split_rows
from jfrnn._geometry import Lattice, Status, Wrapped, sort_into_boxes
from jfrnn.kernels import boxes

_GIVEN = ("positions", "queries", "boxes", "axes", "asked", "ids", "order", "visits", "cells", "start")


def box_neighbors(search: Search, keep: Filter, capacity: int | Room | None) -> Rows:
    """List the neighbors of every query, or only count them (capacity=None), where each system has a box of its own."""
    m, dim, double = search.sizes[1], search.sources.shape[1], search.sources.dtype == jnp.float64
    dims = {**row_dims(m, capacity), "count": m, "info": 2}
    kind = (search.queries is None, search.cutoff.closed, keep, periodic_kind(search.torus), True)
    starts = [capacity.starts] if isinstance(capacity, Room) else []
    variant = Variant(dim, double, search.cutoff.scaled, capacity is not None, *kind, bool(starts))

    def on(cuda: bool) -> Callable[..., list[Array]]:
        return functools.partial(_callable(variant, cuda), output_dims=dims)

    *written, count, info = lax.platform_dependent(*_operands(search), *starts, cpu=on(False), cuda=on(True))
    overflow = isinstance(capacity, int) and info[0] > capacity
    status = jnp.where(overflow, Status.ROW_OVERFLOW.value, 0).astype(jnp.int32)
    return Rows(**split_rows(written), counts=count, required=info[0], status=status)


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
def _callable(variant: Variant, cuda: bool) -> Call:
    plan = functools.partial(_plan, variant, cuda)
    return describe_call("box_rows_cuda" if cuda else "box_rows_cpu", variant, plan, _GIVEN, more=())


def _plan(variant: Variant, cuda: bool, shapes: Shapes, _: int) -> Plan:
    kind = (variant.dim, variant.double, variant.scaled, variant.lists, variant.periodic)
    found, numbers = boxes.rows_kernel(*kind, cuda, variant.flat), plan_numbers(variant, shapes) | {"stride": shapes["axes"][1]}
    m = numbers["m"]
    launch = Launch(found, boxes.threads(m)) if cuda else share(found, m, boxes.QUERIES_AT_ONCE)
    pages = [] if cuda else huge_pages(variant, shapes)
    return Plan([Clear("info", 8), *pages, launch], numbers, absent(variant.lists, variant.flat))
