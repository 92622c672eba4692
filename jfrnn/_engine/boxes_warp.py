"""Searches with a box per system by Warp's kernels: on the CPU by those of cells, on CUDA by kernels of their own."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import (
    SUMS,
    absent,
    as_float,
    cutoffs_of_particles,
    describe_call,
    describe_sums,
    excluded_rows,
    found_rows,
    huge_pages,
    kind_of_search,
    lattice_numbers,
    names_of_cutoffs,
    names_of_particles,
    particle_rows,
    periodic_kind,
    plan_numbers,
    row_dims,
    scalar_of,
    size_numbers,
    sort_on_cpu,
)
from jfrnn._engine.plans import Clear, Launch, Plan, share
from jfrnn._engine.problem import Filter, Room, Rows, Search, largest_radius
from jfrnn._engine.sum_results import FoundSums, Summed, SumsOf, Values, numbers_of_values
from jfrnn._geometry import Cutoffs, Lattice, Wrapped, most_cells, unpack_turns
from jfrnn._tracing import on_platform
from jfrnn.kernels import Kind, boxes, cells_cpu, pair_sum_cpu, tree_cpu
from jfrnn.kernels._native import TABLE
from jfrnn.kernels.pair_sum_cpu import TermText

_GIVEN = ("positions", "queries", "boxes", "axes", "systems", "ids", "cells", "start")


def box_neighbors(search: Search, keep: Filter, capacity: int | Room | None) -> Rows:
    """List the neighbors of every query, or only count them (capacity=None), where each system has a box of its own."""
    kind, m = kind_of_search(search, keep, capacity), search.sizes[1]
    dims = {**row_dims(m, capacity), "count": m, "longest": (), "bits": ()}
    starts = [capacity.starts] if isinstance(capacity, Room) else []

    def on_cpu(search: Search, *starts: Array) -> list[Array]:
        given = [*_particles(search), *excluded_rows(search), *_cutoffs_of_particles(search)]
        scratch = _scratch_dims(search)
        return _cpu_callable(kind)(*given, *starts, output_dims=dims | scratch)[: -len(scratch)]

    def on_cuda(search: Search, *starts: Array) -> list[Array]:
        given = _operands(search)
        given += [*excluded_rows(search), *_cutoffs_of_pairs(search, given[_GIVEN.index("ids")])]
        return _cuda_callable(kind)(*given, *starts, output_dims=dims)

    *written, count, longest, _ = on_platform(search, *starts, cpu=on_cpu, cuda=on_cuda)
    return found_rows(written, count, longest, capacity)


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
    cells = tree_cpu if isinstance(search.cutoff, Cutoffs) else cells_cpu
    words = cells.scratch_words(n, m, dim, width, search.queries is None, systems)
    return {"scratch": words, "grids": cells_cpu.grid_words(systems, width)}


@kernel
def _cpu_callable(kind: Kind) -> Call:
    plan = functools.partial(_plan_on_cpu, kind)
    return describe_call("box_rows_cpu", kind, plan, more=("scratch", "grids"), cutoffs=names_of_particles)


def _plan_on_cpu(kind: Kind, shapes: Shapes, _: int) -> Plan:
    query = (tree_cpu if kind.rule else cells_cpu).query_kernel(kind)
    numbers = _with_table(plan_numbers(kind, shapes), shapes)
    return Plan([*sort_on_cpu(kind, shapes, numbers), *huge_pages(kind, shapes), share(query, numbers["m"])], numbers, absent(kind))


def _with_table(numbers: dict[str, int], shapes: Shapes) -> dict[str, int]:
    """Return the numbers of kernels of cells whose table has some entries more for each system."""
    return numbers | {"table": numbers["table"] + cells_cpu.ENTRIES * shapes["cutoff"][0]}


# --- on CUDA --------------------------------------------------------------------------------------------------------------


def _operands(search: Search) -> list[Array]:
    """Return what a kernel is given, in the order of `_GIVEN` (see `kernels/native/boxes/box_pairs.cuh`)."""
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
    sort = _sorting_callable(Kind(lattice.dim, sources.dtype == jnp.float64, periodic=periodic_kind(lattice)))
    axes, ids, of_system, start, _ = sort(rows, numbers, batch.sources, turning, output_dims=dims)
    return [rows, asking, numbers, axes, batch.of_queries, ids, of_system, start]


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
def _sorting_callable(kind: Kind) -> Call:
    """Make a function that XLA calls to sort sources on CUDA, once for a sum and its derivative."""
    words = dict.fromkeys(("ids", "cells", "start", "scratch"), np.int32)
    given = ("positions", "boxes", "systems", "turning")
    return Call(f"jfrnn_box_sort_{kind.name}", given, {"axes": scalar_of(kind)} | words, functools.partial(_plan_sorting, kind))


def _plan_sorting(kind: Kind, shapes: Shapes, multiprocessors: int) -> Plan:
    n, systems, cells = shapes["positions"][0], shapes["turning"][0], shapes["start"][0] - 1
    launches = boxes.sorting_kernels(kind).launches(n, cells, multiprocessors)
    clear = [Clear("scratch", 4 * boxes.scratch_words(n, systems, cells)[1]), Clear("start", 4 * (cells + 1))]
    numbers = {"n": n, "boxed": systems, "stride": shapes["axes"][1], "size": cells}
    return Plan([*clear, *(Launch(kernel, threads) for kernel, threads in launches)], numbers)


def _numbers(search: Search, lattice: Lattice, wrapped: Wrapped, turning: Array | None = None) -> Array:
    """Return the numbers of each lattice, behind the radius, [systems, ...]; they tell which axes are `turning`, if it is given."""
    radius = jnp.reshape(jnp.asarray(largest_radius(search.cutoff)), 1)

    def of_system(lattice: Lattice, reach: Array, slack: Array, flags: Array | None) -> Array:
        return jnp.concatenate([radius, lattice_numbers(lattice, reach, slack, wrapped.most_turns, flags)])

    return jax.vmap(of_system)(lattice, wrapped.reach, wrapped.slack, turning)


@kernel
def _cuda_callable(kind: Kind) -> Call:
    return describe_call("box_rows_cuda", kind, functools.partial(_plan_on_cuda, kind), _GIVEN, more=())


def _kinds(shapes: Shapes) -> int:
    """Return the species of a table."""
    return shapes[TABLE[0]][0] if TABLE[0] in shapes else 0


def _plan_on_cuda(kind: Kind, shapes: Shapes, _: int) -> Plan:
    numbers, m = plan_numbers(kind, shapes) | {"stride": shapes["axes"][1], "kinds": _kinds(shapes)}, shapes["queries"][0]
    return Plan([Clear("longest", 4), Launch(boxes.rows_kernel(kind), boxes.threads(m))], numbers, absent(kind))


# --- sums ----------------------------------------------------------------------------------------------------------------


def box_sums(search: Search, keep: Filter, summed: Summed, values: Values) -> FoundSums:
    """Sum a term over the pairs of a search in which each system has a box of its own, as `jfrnn._engine.warp_sums.pair_sums`."""
    n, m = search.sizes
    term, key, kind = summed.term, summed.key, summed.of(kind_of_search(search, keep))

    def on_cpu(search: Search, values: Values) -> FoundSums:
        results, scratch = SumsOf(term, kind, m, pair_sum_cpu.slots(m)), _scratch_dims(search)
        columns = max(pair_sum_cpu.sorted_numbers(term, n, kind.dim, kind.double), 1)
        dims = results.dims() | {"columns": columns, "bits": ()} | scratch
        given = [*_particles(search), *values.beside_rows, *excluded_rows(search), *_cutoffs_of_particles(search)]
        return results.unpack(*_cpu_sum_callable(kind, term, key)(*given, output_dims=dims)[: len(SUMS)])

    def on_cuda(search: Search, values: Values) -> FoundSums:
        results, given = SumsOf(term, kind, m, boxes.slots(m)), _operands(search)
        ids = given[_GIVEN.index("ids")]
        given += [values.shared, values.own, _sorted_columns(search, term, values.others, ids)]
        given += [*excluded_rows(search), *_cutoffs_of_pairs(search, ids)]
        call_sums = _cuda_sum_callable(kind, term, key)
        return results.unpack(*call_sums(*given, output_dims=results.dims())[: len(SUMS)])

    return on_platform(search._replace(checks={}), values, cpu=on_cpu, cuda=on_cuda)


def _sorted_columns(search: Search, term: TermText, others: Array, ids: Array) -> Array:
    """Return what a term reads of the sources, a row for each number, sorted; turns, which `others` has packed, axis by axis."""
    columns = [others[:, k] for k in range(term.columns)]
    if search.torus is not None and term.steps:
        lattice, wrapped = search.torus
        turns = unpack_turns(wrapped.turns, lattice.dim).astype(others.dtype)
        columns += [turns[:, step.axis] for step in term.steps]
    return jnp.stack([x[ids] for x in columns]) if columns else jnp.zeros((1, 1), others.dtype)


_VALUES = ("shared_values", "own_values")


@kernel
def _cpu_sum_callable(kind: Kind, term: TermText, key: str) -> Call:
    more = {"columns": scalar_of(kind), **dict.fromkeys(("bits", "scratch", "grids"), np.int32)}
    given, plan = ("positions", "queries", "cutoff", *_VALUES, "others"), functools.partial(_plan_sums_on_cpu, kind, term, key)
    return describe_sums("box_sums_cpu", kind, key, plan, given, more)


def _plan_sums_on_cpu(kind: Kind, term: TermText, key: str, shapes: Shapes, _: int) -> Plan:
    flags = {"closed": kind.closed, "drop_self": kind.drop_self}
    numbers = _with_table(size_numbers(shapes, kind.own), shapes) | flags | numbers_of_values(term, shapes)
    values = [share(pair_sum_cpu.sort_kernel(kind.dim, kind.double), numbers["n"])] if term.source_columns else []
    query = share(pair_sum_cpu.query_kernel(kind, term, key), numbers["m"])
    return Plan([*sort_on_cpu(kind, shapes, numbers), *values, query], numbers)


@kernel
def _cuda_sum_callable(kind: Kind, term: TermText, key: str) -> Call:
    given, plan = (*_GIVEN, *_VALUES, "columns"), functools.partial(_plan_sums_on_cuda, kind, term, key)
    return describe_sums("box_sums_cuda", kind, key, plan, given, cutoffs=names_of_cutoffs)


def _plan_sums_on_cuda(kind: Kind, term: TermText, key: str, shapes: Shapes, _: int) -> Plan:
    n, m, stride = shapes["positions"][0], shapes["queries"][0], shapes["axes"][1]
    flags = {"own": int(kind.own), "closed": int(kind.closed), "drop_self": int(kind.drop_self)}
    numbers = {"n": n, "m": m, "stride": stride, "kinds": _kinds(shapes), **flags}
    return Plan([Launch(boxes.sum_kernel(kind, term, key), boxes.threads(m))], numbers)
