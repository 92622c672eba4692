"""Sums over pairs by Warp's kernels: the term is part of the kernel that finds the pairs."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from jfrnn._engine.arrays import levels_of
from jfrnn._engine.cores import PLACES_PER_THREAD, on_every_core
from jfrnn._engine.cuda import Command, multiprocessors_of
from jfrnn._engine.launch import Kernel, kernel
from jfrnn._engine.levels_warp import level_sums
from jfrnn._engine.operands import pack_particles, periodic_kind, space_flags
from jfrnn._engine.problem import Filter, Search
from jfrnn._engine.serving import on_cpu, on_cuda, stand_in
from jfrnn._engine.start import WarpArray, WarpKernel, kernels_of, load_warp
from jfrnn._engine.sum_results import SumsOf, TermText
from jfrnn._engine.warp import CellKernels, cell_sizes, sort_on_cpu
from jfrnn._geometry import Cutoffs


class _SumVariant(NamedTuple):
    """All that is static about a pair sum, apart from shapes; `key` names the text."""

    dim: int
    double: bool
    scaled: bool
    own: bool
    closed: bool
    drop_self: bool
    periodic: int
    batched: bool
    compensated: bool
    extremes: bool
    key: str
    cuda: bool


def pair_sums(
    search: Search,
    keep: Filter,
    term: TermText,
    key: str,
    values: tuple[Array, Array, Array],
    compensated: bool,
    extremes: bool = False,
) -> tuple[Array, Array, Array]:
    """Sum a term (`jfrnn.kernels.pair_sum_cpu.TermText`, named by its key) with the columns that it reads.

    Returns:
        The sums of each query [m, width]; the sums over all pairs [totals]; and for `extremes`, where sums are the largest
        summands, their sources and the codes of their images, int32 [m, width, 2].
    """
    if isinstance(search.cutoff, Cutoffs):
        return level_sums(search, levels_of(search), keep, term, key, values, compensated, extremes)

    def on(cuda: bool) -> Callable[[Search, tuple[Array, Array, Array]], tuple[Array, Array, Array]]:
        def call(search: Search, values: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            sources, queries, cutoff, batch, torus, _ = search
            flags = (queries is None, cutoff.closed, keep.drop_self, periodic_kind(torus), batch is not None)
            double, kind = sources.dtype == jnp.float64, (compensated, extremes, key, cuda)
            variant = _SumVariant(sources.shape[1], double, cutoff.scaled, *flags, *kind)
            return _call_sums(variant, term, pack_particles(search), values)

        return call

    return lax.platform_dependent(search._replace(checks={}), values, cpu=on(False), cuda=on(True))


def _call_sums(
    variant: _SumVariant,
    term: TermText,
    particles: tuple[Array, Array, Array],
    values: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """Let XLA call the kernels."""
    n, m, engine = len(particles[0]), len(particles[1]), kernels_of(_module_of(variant))
    results = SumsOf(term, m, engine.slots(m), variant.compensated, variant.extremes)
    dims = results.dims()
    dims |= {"columns": max(engine.sorted_numbers(term, n, variant.dim, variant.double), 1)}
    cells = kernels_of(f"cells_{'cuda' if variant.cuda else 'cpu'}")
    of_search = {"info": 2, "scratch": cells.scratch_words(n, m, variant.dim, 2 if variant.double else 1, variant.own)}
    if variant.cuda:  # particles are sorted by a call of its own, which XLA makes once for a sum and its derivative
        values = (*values, *_sorting_callable(_sorting(variant))(*particles, output_dims=of_search))
    else:
        dims |= of_search
    sums, parts, rest, *_ = _sum_callable(variant, term)(*particles, *values, output_dims=dims)
    return results.unpacked(sums, parts, rest)


def _module_of(variant: _SumVariant) -> str:
    return f"pair_sum_{'cuda' if variant.cuda else 'cpu'}"


@kernel
def _sum_callable(variant: _SumVariant, term: TermText) -> Kernel:
    wp = load_warp()
    scalar = wp.float64 if variant.double else wp.float32
    rows, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    types = {"positions": rows, "queries": rows, "cutoff": reals, "shared_values": reals, "own_values": rows, "others": rows}
    of_search, results = {"info": ints, "scratch": ints}, {"sums": rows, "totals": reals, "errors": reals, "columns": reals}
    name = _name_of_sum(_module_of(variant), variant)
    if not variant.cuda:
        return on_cpu(name, functools.partial(_run_sums_on_cpu, variant, term), types | results | of_search, 6)
    if wp.is_cuda_available():
        _sum_kernels_on_cuda(variant, term).load(wp.get_cuda_device())
    return on_cuda(name, types | of_search | results, 4, functools.partial(_sum_commands, variant, term))


def _name_of_sum(name: str, variant: _SumVariant) -> str:
    flags = {"f64": variant.double, "f32": not variant.double, "scaled": variant.scaled, "own": variant.own}
    flags |= {"closed": variant.closed, "dropself": variant.drop_self, "batched": variant.batched}
    flags |= space_flags(variant.periodic)
    flags |= {"compensated": variant.compensated, "extremes": variant.extremes, variant.key: bool(variant.key)}
    return "_".join([f"jfrnn_{name}_{variant.dim}d", *(flag for flag, on in flags.items() if on)])


def _sorting(variant: _SumVariant) -> _SumVariant:
    """Return on what of a variant it depends how particles are sorted."""
    return variant._replace(closed=False, drop_self=False, compensated=False, extremes=False, key="")


@kernel
def _sorting_callable(variant: _SumVariant) -> Kernel:
    """Make a function that XLA calls to sort particles on CUDA: positions, queries and cutoff in; info and scratch out."""
    wp = load_warp()
    if wp.is_cuda_available():
        _stages_on_cuda(variant).load_stages(wp.get_cuda_device())
    scalar = wp.float64 if variant.double else wp.float32
    rows, ints = wp.array2d(dtype=scalar), wp.array(dtype=wp.int32)
    types = {"positions": rows, "queries": rows, "cutoff": wp.array(dtype=scalar), "info": ints, "scratch": ints}
    return on_cuda(_name_of_sum("sorting_cuda", variant), types, 2, functools.partial(_sorting_commands, variant))


def _stages_on_cuda(variant: _SumVariant) -> CellKernels:
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    return kernels_of("cells_cuda").cell_kernels(variant.dim, variant.double, variant.scaled, False, **kind)


def _sorting_commands(variant: _SumVariant, *arrays: WarpArray) -> list[Command]:
    positions, queries, cutoff, info, scratch = arrays
    n, m = positions.shape[0], queries.shape[0]
    # what sorts particles takes the arguments of a search that only counts
    sizes = cell_sizes(n, m, variant.own)
    arguments = [positions, queries, cutoff, stand_in(info, 1), info, info, scratch, *sizes, 0, 0, 0]
    stages = _stages_on_cuda(variant).stages(n, m, variant.own, multiprocessors_of(positions))
    return [Command(x.kernel, [*arguments, int(x.of_queries)], x.threads, x.block) for x in stages]


@functools.cache
def _sum_kernels_on_cpu(variant: _SumVariant, term: TermText) -> tuple[CellKernels, WarpKernel, WarpKernel]:
    """Return the kernels that sort particles, sort values, and sum."""
    sums = kernels_of("pair_sum_cpu")
    dim, double, scaled = variant[:3]
    kind = {"periodic": variant.periodic, "batched": variant.batched}
    cells = kernels_of("cells_cpu").cell_kernels(dim, double, scaled, False, **kind)
    query = sums.query_kernel(term, variant.key, dim, double, scaled, variant.compensated, **kind, extremes=variant.extremes)
    return cells, sums.sort_kernel(dim, double), query


def _run_sums_on_cpu(variant: _SumVariant, term: TermText, *arrays: WarpArray) -> None:
    cells, sort_values, query = _sum_kernels_on_cpu(variant, term)
    positions, queries, cutoff, shared, own, others, sums, totals, errors, columns, info, scratch = arrays
    n, m = positions.shape[0], queries.shape[0]
    sizes = cell_sizes(n, m, variant.own)
    sort_on_cpu(cells, positions, queries, cutoff, info, scratch, sizes)
    if term.source_columns:
        sorting = [others, cutoff, columns, scratch, *sizes]
        on_every_core(sort_values, sorting, -(-n // PLACES_PER_THREAD))
    arguments = [positions, queries, cutoff, shared, own, columns, sums, totals, errors, scratch, *sizes]
    arguments += [int(variant.closed), int(variant.drop_self)]
    on_every_core(query, arguments, -(-m // PLACES_PER_THREAD))


def _sum_kernels_on_cuda(variant: _SumVariant, term: TermText) -> CellKernels:
    dim, double, scaled = variant[:3]
    make = kernels_of("pair_sum_cuda").sum_kernels
    kind = {"periodic": variant.periodic, "batched": variant.batched, "extremes": variant.extremes}
    return make(term, variant.key, dim, double, scaled, variant.compensated, **kind)


def _sum_commands(variant: _SumVariant, term: TermText, *arrays: WarpArray) -> list[Command]:
    *given, info, scratch, sums, totals, errors, columns = arrays
    n, m = given[0].shape[0], given[1].shape[0]
    sizes = cell_sizes(n, m, variant.own)
    arguments = [*given, sums, totals, errors, columns, info, scratch, *sizes, int(variant.closed), int(variant.drop_self)]
    launches = _sum_kernels_on_cuda(variant, term).launches(n, m, multiprocessors_of(given[0]))
    return [Command(x.kernel, arguments, x.threads, x.block, x.beside) for x in launches]
