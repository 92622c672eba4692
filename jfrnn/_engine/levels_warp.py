"""CUDA inside JAX where cutoffs differ widely from particle to particle: lists, counts and sums over cells of many sizes."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.arrays import levels_of
from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import excluded_rows, lattice_numbers, particle_rows, periodic_kind, space_flags
from jfrnn._engine.plans import Clear, Launch, Plan
from jfrnn._engine.problem import Filter, Room, Rows, Search
from jfrnn._engine.sum_results import FoundSums, SumsOf, TermText
from jfrnn._engine.variants import absent, excluding_flags, found_rows, row_dims
from jfrnn._geometry import GROUPS, HALVINGS, Cutoffs, Levels
from jfrnn.kernels import levels as level_kernels
from jfrnn.kernels import pair_sum_levels
from jfrnn.kernels._native import EXCLUDED, RULES, TABLE


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
    excluding: int
    flat: bool = False


def level_neighbors(search: Search, keep: Filter, capacity: int | Room | None) -> Rows:
    """Search with a cutoff per particle on CUDA, among sources that XLA sorts; capacity=None only counts."""
    levels = levels_of(search)
    lists, (_, m) = capacity is not None, search.sizes
    starts = [capacity.starts] if isinstance(capacity, Room) else []
    variant = _variant_of(search, keep, lists)._replace(flat=bool(starts))
    dims = {**row_dims(m, capacity), "count": m, "info": 2}
    *written, count, info = _level_callable(variant)(*_operands(search, levels), *starts, output_dims=dims)
    return found_rows(written, count, info[0], capacity)


def level_sums(
    search: Search, keep: Filter, term: TermText, key: str, values: tuple[Array, Array, Array], compensated: bool, extremes: bool
) -> FoundSums:
    """Sum a term as `jfrnn._engine.warp_sums.pair_sums` does, on CUDA, among sources that XLA sorts."""
    (shared, own, others), (_, m), levels = values, search.sizes, levels_of(search)
    results = SumsOf(term, m, pair_sum_levels.slots(m), compensated, extremes)
    call_sums = _sum_callable(_variant_of(search, keep, False), results, key)
    columns = jnp.zeros(1, others.dtype) if term.source_columns == 0 else others[levels.order].T.reshape(-1)
    operands = _operands(search, levels)
    return results.unpack(*call_sums(*operands, shared, own, columns, output_dims=results.dims() | {"info": 2})[:3])


def _variant_of(search: Search, keep: Filter, lists: bool) -> _LevelVariant:
    sources, cutoffs = search.sources, search.cutoffs
    kind = (search.queries is None, cutoffs.closed, keep, cutoffs.rule, periodic_kind(search.torus), search.batch is not None)
    kind = (*kind, search.excluding)
    return _LevelVariant(sources.shape[1], sources.dtype == jnp.float64, lists, *kind)


def _operands(search: Search, levels: Levels) -> list[Array]:
    """Return what the kernels read, in the order of `_GIVEN`."""
    sources, queries, cutoffs, torus = search.sources, search.queries, search.cutoffs, search.torus
    given, dim, padding = sources if queries is None else queries, sources.shape[1], level_kernels.PADDING

    def put_in_order(x: Array | None, order: Array, more: int) -> Array:
        return jnp.zeros(1, sources.dtype) if x is None else jnp.pad(x[order], (0, more)).reshape(-1)

    raw = [jnp.zeros((1, 1), sources.dtype)] * 2
    points, rows = sources, given
    if torus is not None:
        points, rows = torus[1].sources, torus[1].queries
        raw = [particle_rows(sources, torus[1].turns, None), particle_rows(given, torus[1].query_turns, None)]
    line = (0, 3 - dim)
    largest = jnp.zeros(GROUPS, sources.dtype) if levels.largest is None else levels.largest
    numbers = [] if torus is None else [lattice_numbers(torus[0], torus[1].reach, torus[1].slack)]
    numbers += [largest, *(jnp.pad(x, line) for x in (levels.widths, levels.axes.scale, levels.axes.margin))]
    passes = jnp.int32(1) if levels.passes is None else levels.passes
    extent = levels.grid.extent
    header = [jnp.pad(extent, (0, 4 - extent.size)), levels.grid.dense.astype(jnp.int32)[None], passes[None]]
    return [
        *raw,
        jnp.pad(points[levels.order].T, ((0, 0), (0, padding))).reshape(-1),
        put_in_order(cutoffs.sources, levels.order, padding),
        levels.order,
        lax.bitcast_convert_type(jnp.stack(levels.keys[::-1], axis=1), jnp.int32).reshape(-1),  # words of 64 bits
        levels.grid.coords.reshape(-1),
        levels.grid.table,
        jnp.concatenate(header),
        jnp.concatenate([cutoffs.largest[None], *numbers]),
        rows[levels.query_order].T.reshape(-1),
        put_in_order(cutoffs.queries, levels.query_order, 0),
        levels.query_order,
        levels.query_top.reshape(-1),
        levels.query_place.reshape(-1),
        *excluded_rows(search),
        *_operands_of_kinds(cutoffs, levels),
    ]


def _operands_of_kinds(cutoffs: Cutoffs, levels: Levels) -> list[Array]:
    """Return a table of cutoffs, and whose species is which in the order of visits, in the order of `TABLE`."""
    if cutoffs.kinds is None:
        return []
    table, of_sources, of_queries = cutoffs.kinds
    sorted_kinds = jnp.pad(of_sources[levels.order], (0, level_kernels.PADDING))
    return [table, sorted_kinds, of_queries[levels.query_order]]


_GIVEN = ("positions", "queries", "axes", "radii", "ids", "keys", "top", "table", "header", "cutoff")
_GIVEN += ("query_axes", "query_radii", "query_ids", "query_top", "places")


def _given(variant: _LevelVariant) -> tuple[str, ...]:
    return (*_GIVEN, *EXCLUDED * bool(variant.excluding), *TABLE * (variant.rule == RULES[-1]))


def _name(name: str, variant: _LevelVariant, **more: bool) -> str:
    flags = {"f64": variant.double, "f32": not variant.double, "list": variant.lists, "flat": variant.flat, "own": variant.own}
    flags |= {"closed": variant.closed, "dropself": variant.keep.drop_self, "later": variant.keep.later_only, variant.rule: True}
    flags |= {**space_flags(variant.periodic), "batched": variant.batched, **excluding_flags(variant.excluding)}
    return "_".join([f"jfrnn_{name}_{variant.dim}d", *(flag for flag, on in {**flags, **more}.items() if on)])


@kernel
def _level_callable(variant: _LevelVariant) -> Call:
    results = dict.fromkeys([*["idx"] * variant.lists, *["receivers"] * variant.flat, "count", "info"], np.int32)
    name = _name("levels_cuda", variant)
    given = (*_given(variant), *["starts"] * variant.flat)
    return Call(name, given, results, functools.partial(_plan_rows, variant))


@kernel
def _sum_callable(variant: _LevelVariant, results: SumsOf, key: str) -> Call:
    kind = {"compensated": results.compensated, "extremes": results.extremes}
    name = _name("pair_sum_levels_cuda", variant, **kind, **{key: True})
    dtypes = dict.fromkeys(("sums", "totals", "errors"), np.float64 if variant.double else np.float32) | {"info": np.int32}
    plan = functools.partial(_plan_sums, variant, results, key)
    return Call(name, (*_given(variant), "shared_values", "own_values", "columns"), dtypes, plan)


def _plan_sums(variant: _LevelVariant, results: SumsOf, key: str, shapes: Shapes, multiprocessors: int) -> Plan:
    of_search = variant.dim, variant.double, variant.rule, GROUPS, HALVINGS, results.compensated, variant.periodic, variant.batched
    query = pair_sum_levels.query_kernel(results.term, key, *of_search, results.extremes, variant.excluding)
    numbers = _numbers(variant, shapes)
    return Plan([Launch(query, numbers["m"])], numbers)


def _numbers(variant: _LevelVariant, shapes: Shapes) -> dict[str, int]:
    flags = {"own_queries": variant.own, "closed": variant.closed}
    flags |= {"drop_self": variant.keep.drop_self, "later_only": variant.keep.later_only}
    kinds = shapes[TABLE[0]][0] if TABLE[0] in shapes else 0
    return {"n": shapes["ids"][0], "m": shapes["query_ids"][0], "kinds": kinds, **flags}


def _plan_rows(variant: _LevelVariant, shapes: Shapes, multiprocessors: int) -> Plan:
    kind = (variant.dim, variant.double, variant.lists, variant.rule, GROUPS, HALVINGS, variant.periodic, variant.batched)
    query = level_kernels.query_kernel(*kind, variant.excluding, variant.flat)
    numbers = _numbers(variant, shapes) | {"capacity": shapes["idx"][1] if variant.lists and not variant.flat else 0}
    return Plan([Clear("info", 8), Launch(query, numbers["m"])], numbers, absent(variant.lists, variant.flat))
