"""Warp inside JAX where cutoffs differ from particle to particle: lists, counts and sums over cells of many sizes."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine.cores import PLACES_PER_THREAD, on_every_core
from jfrnn._engine.cuda import Command
from jfrnn._engine.launch import Kernel, kernel
from jfrnn._engine.operands import lattice_numbers, particle_rows, periodic_kind, space_flags
from jfrnn._engine.problem import Filter, Rows, Search
from jfrnn._engine.serving import on_cpu, on_cuda, stand_in
from jfrnn._engine.start import WarpArray, WarpKernel, kernels_of, load_warp
from jfrnn._engine.sum_results import SumsOf, TermText
from jfrnn._geometry import GROUPS, HALVINGS, Levels


class _LevelVariant(NamedTuple):
    """All that is static about a call with a cutoff per particle, apart from shapes."""

    dim: int
    double: bool
    lists: bool
    own: bool
    closed: bool
    keep: Filter
    rule: str
    periodic: int
    batched: bool
    cuda: bool


def level_neighbors(search: Search, levels: Levels, keep: Filter, capacity: int | None) -> Rows:
    """Search with a cutoff per particle, among sources that XLA has sorted; capacity=None only counts."""

    def on(cuda: bool) -> Callable[[Search, Levels], Rows]:
        return functools.partial(_call_levels, cuda, keep, capacity)

    return lax.platform_dependent(search._replace(checks={}), levels, cpu=on(False), cuda=on(True))


def _call_levels(cuda: bool, keep: Filter, capacity: int | None, search: Search, levels: Levels) -> Rows:
    lists, (_, m) = capacity is not None, search.sizes
    variant = _variant_of(search, keep, lists, cuda)
    dims: dict[str, Any] = {"count": m, "info": 2} | ({"idx": (m, capacity)} if lists else {})
    *idx, count, info = _level_callable(variant)(*_operands(search, levels), output_dims=dims)
    overflow = info[0] > capacity if lists else jnp.zeros((), bool)
    return Rows(idx[0] if lists else None, count, info[0], overflow.astype(jnp.int32))  # Status.ROW_OVERFLOW


def level_sums(
    search: Search,
    levels: Levels,
    keep: Filter,
    term: TermText,
    key: str,
    values: tuple[Array, Array, Array],
    compensated: bool,
    extremes: bool,
) -> tuple[Array, Array, Array]:
    """Sum a term as `jfrnn._engine.warp_sums.pair_sums` does, on the CPU, among sources that XLA has sorted."""

    def sums_on_cpu(search: Search, levels: Levels, values: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        (shared, own, others), (_, m) = values, search.sizes
        results = SumsOf(term, m, kernels_of("pair_sum_levels").slots(m), compensated, extremes)
        call = _sum_callable(_variant_of(search, keep, False, False), results, key)
        columns = jnp.zeros(1, others.dtype) if term.source_columns == 0 else others[levels.order].T.reshape(-1)
        operands = _operands(search, levels)
        return results.unpacked(*call(*operands, shared, own, columns, output_dims=results.dims() | {"info": 2})[:3])

    return lax.platform_dependent(search._replace(checks={}), levels, values, cpu=sums_on_cpu)


def _variant_of(search: Search, keep: Filter, lists: bool, cuda: bool) -> _LevelVariant:
    sources, cutoffs = search.sources, search.cutoffs
    kind = (search.queries is None, cutoffs.closed, keep, cutoffs.rule, periodic_kind(search.torus), search.batch is not None, cuda)
    return _LevelVariant(sources.shape[1], sources.dtype == jnp.float64, lists, *kind)


def _operands(search: Search, levels: Levels) -> list[Array]:
    """Return what the kernels read, in the order of `_inputs`."""
    sources, queries, cutoffs, torus = search.sources, search.queries, search.cutoffs, search.torus
    given, dim, padding = sources if queries is None else queries, sources.shape[1], kernels_of("levels").PADDING

    def ordered(x: Array | None, order: Array, more: int) -> Array:
        return jnp.zeros(1, sources.dtype) if x is None else jnp.pad(x[order], (0, more)).reshape(-1)

    raw = [jnp.zeros((1, 1), sources.dtype)] * 2
    points, rows = sources, given
    if torus is not None:
        points, rows = torus[1].sources, torus[1].queries
        raw = [particle_rows(sources, torus[1].turns, None), particle_rows(given, torus[1].query_turns, None)]
    line = (0, 3 - dim)
    largest = jnp.zeros(GROUPS, sources.dtype) if levels.largest is None else levels.largest
    numbers = [] if torus is None else [lattice_numbers(*torus)]
    numbers += [largest, *(jnp.pad(x, line) for x in (levels.widths, levels.axes.scale, levels.axes.margin))]
    passes = jnp.int32(1) if levels.passes is None else levels.passes
    extent = levels.grid.extent
    header = [jnp.pad(extent, (0, 4 - extent.size)), levels.grid.dense.astype(jnp.int32)[None], passes[None]]
    return [
        *raw,
        jnp.pad(points[levels.order].T, ((0, 0), (0, padding))).reshape(-1),
        ordered(cutoffs.sources, levels.order, padding),
        levels.order,
        lax.bitcast_convert_type(levels.keys, jnp.int32),
        levels.grid.coords.reshape(-1),
        levels.grid.table,
        jnp.concatenate(header),
        jnp.concatenate([cutoffs.largest[None], *numbers]),
        rows[levels.query_order].T.reshape(-1),
        ordered(cutoffs.queries, levels.query_order, 0),
        levels.query_order,
        levels.query_top.reshape(-1),
        levels.query_place.reshape(-1),
    ]


def _inputs(double: bool) -> dict[str, Any]:
    """Return Warp's types of what `_operands` returns."""
    wp = load_warp()
    scalar = wp.float64 if double else wp.float32
    points, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    types = {"positions": points, "queries": points}
    types |= {"axes": reals, "radii": reals, "ids": ints, "keys": ints, "top": ints, "table": ints, "header": ints}
    types |= {"cutoff": reals, "query_axes": reals, "query_radii": reals, "query_ids": ints, "query_top": ints}
    return types | {"places": ints}


def _name(name: str, variant: _LevelVariant, **more: bool) -> str:
    flags = {"f64": variant.double, "f32": not variant.double, "list": variant.lists, "own": variant.own}
    flags |= {"closed": variant.closed, "dropself": variant.keep.drop_self, "later": variant.keep.later_only, variant.rule: True}
    flags |= {**space_flags(variant.periodic), "batched": variant.batched}
    return "_".join([f"jfrnn_{name}_{variant.dim}d", *(flag for flag, on in {**flags, **more}.items() if on)])


@kernel
def _level_callable(variant: _LevelVariant) -> Kernel:
    wp, types = load_warp(), _inputs(variant.double)
    ints = wp.array(dtype=wp.int32)
    types |= {"idx": wp.array2d(dtype=wp.int32)} if variant.lists else {}
    types |= {"count": ints, "info": ints}
    name = _name(f"levels_{'cuda' if variant.cuda else 'cpu'}", variant)
    if not variant.cuda:
        return on_cpu(name, functools.partial(_run_levels_on_cpu, variant), types, 2 + variant.lists)
    if wp.is_cuda_available():
        for launched, block in ((_level_kernel(variant), kernels_of("levels").BLOCK), (kernels_of("levels").clear, 2)):
            kernels_of("_load").load_module(launched.module, wp.get_cuda_device(), block)
    return on_cuda(name, types, 2 + variant.lists, functools.partial(_level_commands, variant))


@kernel
def _sum_callable(variant: _LevelVariant, results: SumsOf, key: str) -> Kernel:
    wp, types = load_warp(), _inputs(variant.double)
    rows, reals = types["positions"], types["axes"]
    types |= {"shared_values": reals, "own_values": rows, "columns": reals}
    types |= {"sums": rows, "totals": reals, "errors": reals, "info": wp.array(dtype=wp.int32)}
    kind = {"compensated": results.compensated, "extremes": results.extremes}

    def run(*arrays: WarpArray) -> None:
        of_search = variant.dim, variant.double, variant.rule, GROUPS, HALVINGS, results.compensated, variant.periodic
        make = kernels_of("pair_sum_levels").query_kernel
        query = make(results.term, key, *of_search, variant.batched, results.extremes)
        n, m = len(arrays[4]), len(arrays[12])
        flags = variant.own, variant.closed, variant.keep.drop_self, variant.keep.later_only
        arrays[-1].zero_()
        on_every_core(query, [*arrays, n, m, *map(int, flags)], -(-m // PLACES_PER_THREAD))

    return on_cpu(_name("pair_sum_levels_cpu", variant, **kind, **{key: True}), run, types, 4)


def _level_kernel(variant: _LevelVariant) -> WarpKernel:
    kind = (variant.dim, variant.double, variant.lists, variant.rule, GROUPS, HALVINGS, variant.periodic, variant.batched)
    return kernels_of("levels").query_kernel(*kind)


def _level_arguments(variant: _LevelVariant, arrays: Sequence[Any]) -> list[Any]:
    """Return what the kernel takes."""
    *inputs, count, info = arrays
    n, m, capacity = len(inputs[4]), len(count), inputs[-1].shape[1] if variant.lists else 0
    if not variant.lists:
        inputs.append(stand_in(count, m))
    flags = [int(variant.own), int(variant.closed), int(variant.keep.drop_self), int(variant.keep.later_only)]
    return [*inputs, count, info, n, m, capacity, *flags]


def _run_levels_on_cpu(variant: _LevelVariant, *arrays: WarpArray) -> None:
    arrays[-1].zero_()
    places = len(arrays[-2])
    on_every_core(_level_kernel(variant), _level_arguments(variant, arrays), -(-places // PLACES_PER_THREAD))


def _level_commands(variant: _LevelVariant, *arrays: WarpArray) -> list[Command]:
    levels, (*_, count, info) = kernels_of("levels"), arrays
    query = Command(_level_kernel(variant), _level_arguments(variant, arrays), len(count), levels.BLOCK)
    return [Command(levels.clear, [info], 2, 2), query]
