"""Searches with a box per system by Warp's kernels: sources are sorted by cell, on the CPU by XLA, and a kernel meets them."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import excluded_rows, lattice_numbers, particle_rows, periodic_kind
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn._engine.problem import Filter, Room, Rows, Search, largest_radius
from jfrnn._engine.sum_results import FoundSums, SumsOf
from jfrnn._engine.variants import (
    SumVariant,
    Variant,
    absent,
    describe_call,
    found_rows,
    huge_pages,
    names_of_cutoffs,
    plan_numbers,
    row_dims,
)
from jfrnn._geometry import Cutoffs, Lattice, Wrapped, most_cells, sort_into_boxes, unpack_turns
from jfrnn.kernels import boxes
from jfrnn.kernels._native import EXCLUDED, TABLE
from jfrnn.kernels.pair_sum_cpu import TermText

_GIVEN = ("positions", "queries", "boxes", "axes", "systems", "ids", "cells", "start")


def box_neighbors(search: Search, keep: Filter, capacity: int | Room | None) -> Rows:
    """List the neighbors of every query, or only count them (capacity=None), where each system has a box of its own."""
    m, dim, double = search.sizes[1], search.sources.shape[1], search.sources.dtype == jnp.float64
    rule = _rule_of(search)
    dims = {**row_dims(m, capacity), "count": m, "info": 2}
    kind = (search.queries is None, search.cutoff.closed, keep, periodic_kind(search.torus), True, search.excluding)
    starts = [capacity.starts] if isinstance(capacity, Room) else []
    variant = Variant(dim, double, search.cutoff.scaled, capacity is not None, *kind, bool(starts), rule)

    def on(cuda: bool) -> Callable[..., list[Array]]:
        def call(search: Search, *starts: Array) -> list[Array]:
            given = _operands(search, cuda)
            given += [*excluded_rows(search), *_cutoffs_of_pairs(search, given[_GIVEN.index("ids")])]
            return _callable(variant, cuda)(*given, *starts, output_dims=dims)

        return call

    *written, count, info = lax.platform_dependent(search, *starts, cpu=on(False), cuda=on(True))
    return found_rows(written, count, info[0], capacity)


def _operands(search: Search, cuda: bool) -> list[Array]:
    """Return what a kernel is given, in the order of `_GIVEN` (see `kernels/native/box_pairs.h`)."""
    sources, queries, batch, torus = search.sources, search.queries, search.batch, search.torus
    if batch is None or torus is None:
        raise TypeError("a search with a box per system has a batch and a lattice.")
    lattice, wrapped = torus
    rows = particle_rows(sources, wrapped.turns, None)
    asking = rows if queries is None else particle_rows(queries, wrapped.query_turns, None)
    bits = lattice.spread(jnp.asarray(lattice.periodic), 2).astype(jnp.int32) << np.arange(lattice.dim, dtype=np.int32)[None]
    turning = jnp.broadcast_to(functools.reduce(jnp.bitwise_or, bits.T), len(lattice.origin))
    numbers = _numbers(search, lattice, wrapped)
    if cuda:
        n, systems = len(sources), len(lattice.origin)
        cells, stride = most_cells(n, systems), n + boxes.PADDING
        dims = {"axes": (lattice.dim, stride), "ids": stride, "cells": (systems, 5), "start": cells + 1}
        dims |= {"scratch": boxes.scratch_words(n, systems, cells)[0]}
        sort = _sorting_callable(lattice.dim, sources.dtype == jnp.float64, periodic_kind(torus))
        axes, ids, of_system, start, _ = sort(rows, numbers, batch.sources, turning, output_dims=dims)
        return [rows, asking, numbers, axes, batch.of_queries, ids, of_system, start]
    found = sort_into_boxes(sources, queries, lattice, wrapped, batch)
    ids, gap = jnp.pad(found.order, (0, boxes.PADDING)), ((0, 0), (0, 3 - lattice.dim))
    of_system = jnp.concatenate([jnp.pad(found.counts, gap), found.first[:, None], turning[:, None]], axis=1)
    axes = jnp.stack([x[ids] for x in wrapped.sources.T])
    return [rows, asking, numbers, axes, batch.of_queries, ids, of_system, found.start]


def _rule_of(search: Search) -> str:
    return search.cutoff.rule if isinstance(search.cutoff, Cutoffs) else ""


def _cutoffs_of_pairs(search: Search, ids: Array) -> list[Array]:
    """Return what kernels read of cutoffs that differ: those of the sources, sorted, and of the queries; or a table and species."""
    cutoff = search.cutoff
    if not isinstance(cutoff, Cutoffs):
        return []
    if cutoff.kinds is not None:
        table, of_sources, of_queries = cutoff.kinds
        return [table, of_sources[ids], of_queries]
    given = (None if cutoff.sources is None else cutoff.sources[ids], cutoff.queries)
    return [jnp.zeros(1, search.sources.dtype) if x is None else x for x in given]


@kernel
def _sorting_callable(dim: int, double: bool, periodic: int) -> Call:
    """Make a function that XLA calls to sort sources on CUDA, once for a sum and its derivative."""
    scalar, words = np.float64 if double else np.float32, dict.fromkeys(("ids", "cells", "start", "scratch"), np.int32)
    name = f"jfrnn_box_sort_{dim}d_{'f64' if double else 'f32'}_{periodic}"
    given = ("positions", "boxes", "systems", "turning")
    return Call(name, given, {"axes": scalar} | words, functools.partial(_plan_sorting, dim, double, periodic))


def _plan_sorting(dim: int, double: bool, periodic: int, shapes: Shapes, multiprocessors: int) -> Plan:
    n, systems, cells = shapes["positions"][0], shapes["turning"][0], shapes["start"][0] - 1
    launches = boxes.sorting_kernels(dim, double, periodic).launches(n, cells, multiprocessors)
    clear = [Clear("scratch", 4 * boxes.scratch_words(n, systems, cells)[1]), Clear("start", 4 * (cells + 1))]
    numbers = {"n": n, "boxed": systems, "stride": shapes["axes"][1], "size": cells}
    return Plan([*clear, *(Launch(kernel, threads) for kernel, threads in launches)], numbers)


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


def _kinds(shapes: Shapes) -> int:
    """Return the species of a table."""
    return shapes[TABLE[0]][0] if TABLE[0] in shapes else 0


def _plan(variant: Variant, cuda: bool, shapes: Shapes, _: int) -> Plan:
    kind = (variant.dim, variant.double, variant.scaled, variant.lists, variant.keep.later_only, variant.periodic)
    found = boxes.rows_kernel(*kind, cuda, variant.excluding, variant.flat, variant.rule)
    numbers, m = plan_numbers(variant, shapes) | {"stride": shapes["axes"][1], "kinds": _kinds(shapes)}, shapes["queries"][0]
    launch = Launch(found, boxes.threads(m)) if cuda else share(found, m, boxes.QUERIES_AT_ONCE)
    pages = [] if cuda else huge_pages(variant, shapes)
    return Plan([Clear("info", 8), *pages, launch], numbers, absent(variant.lists, variant.flat))


# --- sums ----------------------------------------------------------------------------------------------------------------


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
        flags = search.queries is None, cutoff.closed, keep.drop_self, periodic_kind(search.torus), True
        kind = compensated, extremes, key, cuda, False, search.excluding, _rule_of(search)
        call_sums = _sum_callable(SumVariant(dim, double, cutoff.scaled, *flags, *kind), term)
        results = SumsOf(term, m, boxes.slots(m, cuda), compensated, extremes)

        def call(search: Search, shared: Array, own: Array, others: Array) -> FoundSums:
            given = _operands(search, cuda)
            ids = given[_GIVEN.index("ids")]
            given += [shared, own, _sorted_columns(search, term, others, ids)]
            given += [*excluded_rows(search), *_cutoffs_of_pairs(search, ids)]
            return results.unpack(*call_sums(*given, output_dims=results.dims() | {"info": 2})[: len(_SUMS)])

        return call

    return lax.platform_dependent(search._replace(checks={}), shared, own, others, cpu=on(False), cuda=on(True))


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
def _sum_callable(variant: SumVariant, term: TermText) -> Call:
    scalar = np.float64 if variant.double else np.float32
    results = dict.fromkeys(_SUMS, scalar) | {"info": np.int32}
    given = (
        *_GIVEN,
        "shared_values",
        "own_values",
        "columns",
        *EXCLUDED * bool(variant.excluding),
        *names_of_cutoffs(variant.rule),
    )
    name = variant.name(f"box_sums_{'cuda' if variant.cuda else 'cpu'}")
    return Call(name, given, results, functools.partial(_plan_sums, variant, term))


def _plan_sums(variant: SumVariant, term: TermText, shapes: Shapes, _: int) -> Plan:
    kind = variant.dim, variant.double, variant.scaled, variant.compensated, variant.extremes, variant.periodic
    found, cuda = boxes.sum_kernel(term, variant.key, *kind, variant.cuda, variant.excluding, variant.rule), variant.cuda
    n, m, stride = shapes["positions"][0], shapes["queries"][0], shapes["axes"][1]
    flags = {"own": int(variant.own), "closed": int(variant.closed), "drop_self": int(variant.drop_self)}
    launch = Launch(found, boxes.threads(m)) if cuda else share(found, m, boxes.QUERIES_AT_ONCE)
    return Plan(
        [launch] if cuda else [Clear("info", 8), launch], {"n": n, "m": m, "stride": stride, "kinds": _kinds(shapes), **flags}
    )
