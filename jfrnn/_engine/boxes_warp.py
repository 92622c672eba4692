"""Searches with a box per system by Warp's kernels: cells are sorted by XLA, a kernel meets them."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import lattice_numbers, particle_rows, periodic_kind
from jfrnn._engine.plans import Clear, Launch, Plan, ask_for_huge_pages, share
from jfrnn._engine.problem import Filter, Rows, Search, largest_radius
from jfrnn._engine.sum_results import FoundSums, SumsOf
from jfrnn._engine.variants import Variant, absent, describe_call, plan_numbers
from jfrnn._geometry import Lattice, Status, Wrapped, sort_into_boxes, unpack_turns
from jfrnn.kernels import boxes
from jfrnn.kernels.pair_sum_cpu import TermText

_GIVEN = ("positions", "queries", "boxes", "axes", "asked", "ids", "order", "visits", "cells", "start")


def box_neighbors(search: Search, keep: Filter, capacity: int | None) -> Rows:
    """List the neighbors of every query, or only count them (capacity=None), where each system has a box of its own."""
    m, dim, double = search.sizes[1], search.sources.shape[1], search.sources.dtype == jnp.float64
    dims = {"idx": (m, capacity), "count": m, "info": 2}
    kind = (search.queries is None, search.cutoff.closed, keep, periodic_kind(search.torus), True)
    variant = Variant(dim, double, search.cutoff.scaled, capacity is not None, *kind)

    def on(cuda: bool) -> Callable[..., list[Array]]:
        return functools.partial(_callable(variant, cuda), output_dims=dims)

    *idx, count, info = lax.platform_dependent(*_operands(search), cpu=on(False), cuda=on(True))
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
def _callable(variant: Variant, cuda: bool) -> Call:
    plan = functools.partial(_plan, variant, cuda)
    return describe_call("box_rows_cuda" if cuda else "box_rows_cpu", variant, plan, _GIVEN, more=())


def _plan(variant: Variant, cuda: bool, shapes: Shapes, _: int) -> Plan:
    kind = (variant.dim, variant.double, variant.scaled, variant.lists, variant.periodic)
    found, numbers = boxes.rows_kernel(*kind, cuda), plan_numbers(variant, shapes) | {"stride": shapes["axes"][1]}
    m = numbers["m"]
    launch = Launch(found, boxes.threads(m)) if cuda else share(found, m, boxes.QUERIES_AT_ONCE)
    pages = [] if cuda or not variant.lists else ask_for_huge_pages("idx", 4 * m * numbers["capacity"])
    return Plan([Clear("info", 8), *pages, launch], numbers, absent(variant))


# --- sums ----------------------------------------------------------------------------------------------------------------


class _SumVariant(NamedTuple):
    """All that is static about a pair sum, apart from shapes; `key` names the text."""

    dim: int
    double: bool
    scaled: bool
    own: bool
    closed: bool
    drop_self: bool
    periodic: int
    compensated: bool
    extremes: bool
    key: str
    cuda: bool


def box_sums(
    search: Search,
    keep: Filter,
    term: TermText,
    key: str,
    values: tuple[Array, Array, Array],
    compensated: bool,
    extremes: bool,
) -> FoundSums:
    """Sum a term over the pairs of a search in which each system has a box of its own, as `jfrnn._engine.warp_sums.pair_sums`."""
    (_, m), dim, double = search.sizes, search.sources.shape[1], search.sources.dtype == jnp.float64
    cutoff, shared, own, others = search.cutoff, *values

    def on(cuda: bool) -> Callable[..., FoundSums]:
        flags = search.queries is None, cutoff.closed, keep.drop_self, periodic_kind(search.torus), compensated, extremes
        call_sums = _sum_callable(_SumVariant(dim, double, cutoff.scaled, *flags, key, cuda), term)
        results = SumsOf(term, m, boxes.slots(m, cuda), compensated, extremes)

        def call(*given: Array) -> FoundSums:
            return results.unpack(*call_sums(*given, output_dims=results.dims() | {"info": 2})[: len(_SUMS)])

        return call

    given = _operands(search)
    columns = _sorted_columns(search, term, others, given[_GIVEN.index("ids")])
    return lax.platform_dependent(*given, shared, own, columns, cpu=on(False), cuda=on(True))


def _sorted_columns(search: Search, term: TermText, others: Array, ids: Array) -> Array:
    """Return what a term reads of the sources, a row for each number, sorted; turns, which `others` has packed, axis by axis."""
    columns = [others[:, k] for k in range(term.columns)]
    if search.torus is not None and term.steps:
        lattice, wrapped = search.torus
        turns = unpack_turns(wrapped.turns, lattice.dim).astype(others.dtype)
        columns += [turns[:, step.axis] for step in term.steps]
    return jnp.stack([x[ids] for x in columns]) if columns else jnp.zeros((1, 1), others.dtype)


_SUMS = ("sums", "totals", "errors", "more")  # what a kernel writes


@kernel
def _sum_callable(variant: _SumVariant, term: TermText) -> Call:
    scalar, flags = np.float64 if variant.double else np.float32, variant._asdict()
    on = [flag for flag, on in flags.items() if on is True]
    where = f"{variant.dim}d_{'f64' if variant.double else 'f32'}_{variant.periodic}"
    results = dict.fromkeys(_SUMS, scalar) | {"info": np.int32}
    given = (*_GIVEN, "shared_values", "own_values", "columns")
    return Call("_".join(["jfrnn_box_sums", where, *on, variant.key]), given, results, functools.partial(_plan_sums, variant, term))


def _plan_sums(variant: _SumVariant, term: TermText, shapes: Shapes, _: int) -> Plan:
    kind = variant.dim, variant.double, variant.scaled, variant.compensated, variant.extremes, variant.periodic
    found, cuda = boxes.sum_kernel(term, variant.key, *kind, variant.cuda), variant.cuda
    n, m, stride = shapes["positions"][0], shapes["queries"][0], shapes["axes"][1]
    flags = {"own": int(variant.own), "closed": int(variant.closed), "drop_self": int(variant.drop_self)}
    launch = Launch(found, boxes.threads(m)) if cuda else share(found, m, boxes.QUERIES_AT_ONCE)
    return Plan([launch] if cuda else [Clear("info", 8), launch], {"n": n, "m": m, "stride": stride, **flags})
