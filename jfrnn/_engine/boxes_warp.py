"""Searches with a box per system by Warp's kernels: on the CPU by those of cells, on CUDA by kernels of their own."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import (
    as_float,
    cutoffs_of_particles,
    excluded_rows,
    lattice_numbers,
    particle_rows,
    periodic_kind,
)
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn._engine.problem import Filter, Room, Rows, Search, largest_radius
from jfrnn._engine.sum_results import FoundSums, SumsOf, beside_rows, numbers_of_values
from jfrnn._engine.variants import (
    SumVariant,
    Variant,
    absent,
    describe_call,
    found_rows,
    huge_pages,
    names_of_cutoffs,
    names_of_particles,
    plan_numbers,
    row_dims,
    size_numbers,
)
from jfrnn._geometry import Cutoffs, Lattice, Wrapped, most_cells, unpack_turns
from jfrnn._tracing import on_platform
from jfrnn.kernels import boxes, cells_cpu, pair_sum_cpu, tree_cpu
from jfrnn.kernels._native import EXCLUDED, OWN_BOXES, TABLE
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

    def on_cpu(search: Search, *starts: Array) -> list[Array]:
        given = [*_particles(search), *excluded_rows(search), *_cutoffs_of_particles(search)]
        scratch = _scratch_dims(search)
        return _cpu_callable(variant)(*given, *starts, output_dims=dims | scratch)[: -len(scratch)]

    def on_cuda(search: Search, *starts: Array) -> list[Array]:
        given = _operands(search)
        given += [*excluded_rows(search), *_cutoffs_of_pairs(search, given[_GIVEN.index("ids")])]
        return _cuda_callable(variant)(*given, *starts, output_dims=dims)

    *written, count, info = on_platform(search, *starts, cpu=on_cpu, cuda=on_cuda)
    return found_rows(written, count, info[0], capacity)


# --- on the CPU, by the kernels of cells ----------------------------------------------------------------------------------


def _particles(search: Search) -> list[Array]:
    """Return rows of sources and queries, and the numbers of each lattice, as kernels of cells read them."""
    sources, queries, batch, torus = search.sources, search.queries, search.batch, search.torus
    if batch is None or torus is None:
        raise TypeError("a search with a box per system has a batch and a lattice.")
    lattice, wrapped = torus
    systems = len(lattice.origin)
    rows = particle_rows(sources, wrapped.turns, batch.sources)
    asking = rows if queries is None else particle_rows(queries, wrapped.query_turns, batch.queries)
    last = as_float(jnp.full((systems, 1), systems - 1, jnp.int32), sources.dtype)
    return [rows, asking, jnp.concatenate([_numbers(search, lattice, wrapped, _turning(lattice)), last], axis=1)]


def _turning(lattice: Lattice) -> Array:
    """Say which axes of each system are periodic, [systems, d]."""
    return jnp.broadcast_to(lattice.spread(jnp.asarray(lattice.periodic), 2), lattice.origin.shape)


def _cutoffs_of_particles(search: Search) -> list[Array]:
    return list(cutoffs_of_particles(search.cutoff).values()) if isinstance(search.cutoff, Cutoffs) else []


def _scratch_dims(search: Search) -> dict[str, int]:
    (n, m), dim, width = search.sizes, search.sources.shape[1], search.sources.dtype.itemsize // 4
    systems = 0 if search.torus is None else len(search.torus[0].origin)
    cells = tree_cpu if _rule_of(search) else cells_cpu
    words = cells.scratch_words(n, m, dim, width, search.queries is None, systems)
    return {"scratch": words, "grids": cells_cpu.grid_words(systems, width)}


@kernel
def _cpu_callable(variant: Variant) -> Call:
    plan = functools.partial(_plan_on_cpu, variant)
    return describe_call("box_rows_cpu", variant, plan, more=("scratch", "grids"), cutoffs=names_of_particles)


def _plan_on_cpu(variant: Variant, shapes: Shapes, _: int) -> Plan:
    kind, space = (variant.dim, variant.double), {"periodic": variant.periodic, "batched": OWN_BOXES}
    more = space | {"excluding": variant.excluding, "flat": variant.flat}
    if variant.rule:
        query = tree_cpu.query_kernel(*kind, variant.rule, variant.lists, **more)
    else:
        query = cells_cpu.query_kernel(*kind, variant.scaled, variant.lists, **more)
    numbers = _with_table(plan_numbers(variant, shapes), shapes)
    steps = [*_sorting_on_cpu(variant, numbers["n"]), *huge_pages(variant, shapes), share(query, numbers["m"])]
    return Plan(steps, numbers, absent(variant.lists, variant.flat))


def _with_table(numbers: dict[str, int], shapes: Shapes) -> dict[str, int]:
    """Return the numbers of kernels of cells whose table has some entries more for each system."""
    return numbers | {"table": numbers["table"] + cells_cpu.ENTRIES * shapes["cutoff"][0]}


def _sorting_on_cpu(variant: Variant | SumVariant, n: int) -> list[Launch]:
    kind, space = (variant.dim, variant.double), {"periodic": variant.periodic, "batched": OWN_BOXES}
    if variant.rule:
        build, gather = tree_cpu.sort_kernels(*kind, variant.rule, **space)
    else:
        build, gather = cells_cpu.sort_kernels(*kind, variant.scaled, **space)
    return [Launch(build), *([share(gather, n)] if n >= cells_cpu.MANY else [])]


# --- on CUDA --------------------------------------------------------------------------------------------------------------


def _operands(search: Search) -> list[Array]:
    """Return what a kernel is given, in the order of `_GIVEN` (see `kernels/native/box_pairs.cuh`)."""
    sources, queries, batch, torus = search.sources, search.queries, search.batch, search.torus
    if batch is None or torus is None:
        raise TypeError("a search with a box per system has a batch and a lattice.")
    lattice, wrapped = torus
    rows = particle_rows(sources, wrapped.turns, None)
    asking = rows if queries is None else particle_rows(queries, wrapped.query_turns, None)
    bits = _turning(lattice).astype(jnp.int32) << np.arange(lattice.dim, dtype=np.int32)[None]
    turning = functools.reduce(jnp.bitwise_or, bits.T)
    numbers = _numbers(search, lattice, wrapped)
    n, systems = len(sources), len(lattice.origin)
    cells, stride = most_cells(n, systems), n + boxes.PADDING
    dims = {"axes": (lattice.dim, stride), "ids": stride, "cells": (systems, 5), "start": cells + 1}
    dims |= {"scratch": boxes.scratch_words(n, systems, cells)[0]}
    sort = _sorting_callable(lattice.dim, sources.dtype == jnp.float64, periodic_kind(torus))
    axes, ids, of_system, start, _ = sort(rows, numbers, batch.sources, turning, output_dims=dims)
    return [rows, asking, numbers, axes, batch.of_queries, ids, of_system, start]


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


def _numbers(search: Search, lattice: Lattice, wrapped: Wrapped, turning: Array | None = None) -> Array:
    """Return the numbers of each lattice, behind the radius, [systems, ...]; they tell which axes are `turning`, if it is given."""
    radius = jnp.reshape(jnp.asarray(largest_radius(search.cutoff)), 1)

    def of_system(lattice: Lattice, reach: Array, slack: Array, flags: Array | None) -> Array:
        return jnp.concatenate([radius, lattice_numbers(lattice, reach, slack, flags)])

    return jax.vmap(of_system)(lattice, wrapped.reach, wrapped.slack, turning)


@kernel
def _cuda_callable(variant: Variant) -> Call:
    return describe_call("box_rows_cuda", variant, functools.partial(_plan_on_cuda, variant), _GIVEN, more=())


def _kinds(shapes: Shapes) -> int:
    """Return the species of a table."""
    return shapes[TABLE[0]][0] if TABLE[0] in shapes else 0


def _plan_on_cuda(variant: Variant, shapes: Shapes, _: int) -> Plan:
    kind = (variant.dim, variant.double, variant.scaled, variant.lists, variant.keep.later_only, variant.periodic)
    found = boxes.rows_kernel(*kind, variant.excluding, variant.flat, variant.rule)
    numbers, m = plan_numbers(variant, shapes) | {"stride": shapes["axes"][1], "kinds": _kinds(shapes)}, shapes["queries"][0]
    return Plan([Clear("info", 8), Launch(found, boxes.threads(m))], numbers, absent(variant.lists, variant.flat))


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
    (n, m), dim, double = search.sizes, search.sources.shape[1], search.sources.dtype == jnp.float64
    cutoff, shared, own, others = search.cutoff, *values

    def variant_on(cuda: bool) -> SumVariant:
        flags = search.queries is None, cutoff.closed, keep.drop_self, periodic_kind(search.torus), True
        kind = compensated, extremes, key, cuda, False, search.excluding, _rule_of(search)
        return SumVariant(dim, double, cutoff.scaled, *flags, *kind)

    def on_cpu(search: Search, *values: Array) -> FoundSums:
        results, scratch = SumsOf(term, m, pair_sum_cpu.slots(m), compensated, extremes), _scratch_dims(search)
        dims = results.dims() | {"columns": max(pair_sum_cpu.sorted_numbers(term, n, dim, double), 1), "info": 2} | scratch
        given = [*_particles(search), *beside_rows(term, values), *excluded_rows(search), *_cutoffs_of_particles(search)]
        return results.unpack(*_cpu_sum_callable(variant_on(False), term)(*given, output_dims=dims)[: len(_SUMS)])

    def on_cuda(search: Search, shared: Array, own: Array, others: Array) -> FoundSums:
        results, given = SumsOf(term, m, boxes.slots(m), compensated, extremes), _operands(search)
        ids = given[_GIVEN.index("ids")]
        given += [shared, own, _sorted_columns(search, term, others, ids)]
        given += [*excluded_rows(search), *_cutoffs_of_pairs(search, ids)]
        call_sums = _cuda_sum_callable(variant_on(True), term)
        return results.unpack(*call_sums(*given, output_dims=results.dims() | {"info": 2})[: len(_SUMS)])

    return on_platform(search._replace(checks={}), shared, own, others, cpu=on_cpu, cuda=on_cuda)


def _sorted_columns(search: Search, term: TermText, others: Array, ids: Array) -> Array:
    """Return what a term reads of the sources, a row for each number, sorted; turns, which `others` has packed, axis by axis."""
    columns = [others[:, k] for k in range(term.columns)]
    if search.torus is not None and term.steps:
        lattice, wrapped = search.torus
        turns = unpack_turns(wrapped.turns, lattice.dim).astype(others.dtype)
        columns += [turns[:, step.axis] for step in term.steps]
    return jnp.stack([x[ids] for x in columns]) if columns else jnp.zeros((1, 1), others.dtype)


_SUMS = ("sums", "totals", "errors", "more")  # what a kernel writes


_VALUES = ("shared_values", "own_values")


@kernel
def _cpu_sum_callable(variant: SumVariant, term: TermText) -> Call:
    scalar, words = np.float64 if variant.double else np.float32, dict.fromkeys(("info", "scratch", "grids"), np.int32)
    given = ("positions", "queries", "cutoff", *_VALUES, "others", *EXCLUDED * bool(variant.excluding))
    plan = functools.partial(_plan_sums_on_cpu, variant, term)
    results = {**dict.fromkeys((*_SUMS, "columns"), scalar), **words}
    return Call(variant.name("box_sums_cpu"), (*given, *names_of_particles(variant.rule)), results, plan)


def _plan_sums_on_cpu(variant: SumVariant, term: TermText, shapes: Shapes, _: int) -> Plan:
    kind = variant.dim, variant.double, variant.scaled, variant.compensated
    more = {"periodic": variant.periodic, "batched": OWN_BOXES, "extremes": variant.extremes, "excluding": variant.excluding}
    query = pair_sum_cpu.query_kernel(term, variant.key, *kind, **more, rule=variant.rule)
    flags = {"closed": variant.closed, "drop_self": variant.drop_self}
    numbers = _with_table(size_numbers(shapes, variant.own), shapes) | flags | numbers_of_values(term, shapes)
    values = [share(pair_sum_cpu.sort_kernel(variant.dim, variant.double), numbers["n"])] if term.source_columns else []
    return Plan([*_sorting_on_cpu(variant, numbers["n"]), *values, share(query, numbers["m"])], numbers)


@kernel
def _cuda_sum_callable(variant: SumVariant, term: TermText) -> Call:
    scalar = np.float64 if variant.double else np.float32
    results = dict.fromkeys(_SUMS, scalar) | {"info": np.int32}
    given = (*_GIVEN, *_VALUES, "columns", *EXCLUDED * bool(variant.excluding), *names_of_cutoffs(variant.rule))
    return Call(variant.name("box_sums_cuda"), given, results, functools.partial(_plan_sums_on_cuda, variant, term))


def _plan_sums_on_cuda(variant: SumVariant, term: TermText, shapes: Shapes, _: int) -> Plan:
    kind = variant.dim, variant.double, variant.scaled, variant.compensated, variant.extremes, variant.periodic
    found = boxes.sum_kernel(term, variant.key, *kind, variant.excluding, variant.rule)
    n, m, stride = shapes["positions"][0], shapes["queries"][0], shapes["axes"][1]
    flags = {"own": int(variant.own), "closed": int(variant.closed), "drop_self": int(variant.drop_self)}
    numbers = {"n": n, "m": m, "stride": stride, "kinds": _kinds(shapes), **flags}
    return Plan([Launch(found, boxes.threads(m))], numbers)
