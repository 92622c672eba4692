"""Sums over pairs by Warp's kernels: the term is part of the kernel that finds the pairs."""

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.boxes_warp import box_sums
from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import cutoffs_of_particles, excluded_rows, orders_for_tree, pack_particles, periodic_kind
from jfrnn._engine.plans import Launch, Plan, share
from jfrnn._engine.problem import Filter, Search
from jfrnn._engine.sum_results import FoundSums, SumsOf, TermText, beside_rows, numbers_of_values
from jfrnn._engine.variants import SumVariant, names_of_particles, names_of_tree, size_numbers
from jfrnn._engine.warp import QUERIES_PER_THREAD, are_few, by_cells_or_tree, fit_tree, place_launches, sort_on_cpu
from jfrnn._geometry import Cutoffs
from jfrnn._tracing import on_platform
from jfrnn.kernels import cells_cpu, cells_cuda, few_cuda, pair_sum_cpu, pair_sum_cuda, tree_cpu, tree_cuda
from jfrnn.kernels._native import EXCLUDED

_GIVEN = ("positions", "queries", "cutoff", "shared_values", "own_values", "others")  # what a call is given
_RESULTS = ("sums", "totals", "errors", "more")  # what kernels write
_SORTED = {False: "columns", True: "values"}  # what is known of sources, in the order of cells, on the CPU and on CUDA


def pair_sums(
    search: Search,
    keep: Filter,
    term: TermText,
    key: str,
    values: tuple[Array, Array, Array],
    compensated: bool,
    extremes: bool = False,
) -> FoundSums:
    """Sum a term (`jfrnn.kernels.pair_sum_cpu.TermText`, named by its key) with the columns that it reads.

    Returns:
        The sums of each query [m, width], or the first of them and the others in two arrays; the sums over all pairs [totals]; and
        for `extremes`, where sums are the largest summands, their sources and the codes of their images, int32 [m, width, 2].
    """
    term = term._replace(first=0) if extremes else term
    if search.per_system:
        return box_sums(search, keep, term, key, values, compensated, extremes)
    rule = search.cutoff.rule if isinstance(search.cutoff, Cutoffs) else ""
    term = term._replace(first=0) if rule else term

    def on(cuda: bool, tree: bool = False) -> Callable[[Search, tuple[Array, Array, Array]], FoundSums]:
        def call(search: Search, values: tuple[Array, Array, Array]) -> FoundSums:
            sources, queries, cutoff, batch, torus = search[:5]
            flags = (queries is None, cutoff.closed, keep.drop_self, periodic_kind(torus), batch is not None)
            kind = (compensated, extremes, key, cuda, cuda and not rule and are_few(search), search.excluding, rule, tree)
            variant = SumVariant(sources.shape[1], sources.dtype == jnp.float64, cutoff.scaled, *flags, *kind)
            of_particles = cutoffs_of_particles(cutoff) if isinstance(cutoff, Cutoffs) else {}
            values = values if cuda else beside_rows(term, values)
            more = [*excluded_rows(search), *of_particles.values()]
            orders = [*of_particles.values(), *orders_for_tree(search).values()] if tree else []
            return _call_sums(variant, term, pack_particles(search), values, more, orders)

        return call

    cuda = functools.partial(by_cells_or_tree, on(True), on(True, True)) if rule else on(True)
    return on_platform(search._replace(checks={}), values, late=bool(rule), cpu=on(False), cuda=cuda)


def _call_sums(
    variant: SumVariant,
    term: TermText,
    particles: tuple[Array, Array, Array],
    values: tuple[Array, Array, Array],
    more: list[Array],
    orders: list[Array],
) -> FoundSums:
    """Let XLA call the kernels; `more` are rows of exclusions, and cutoffs that differ, `orders` what a tree is fitted to."""
    n, m = len(particles[0]), len(particles[1])
    if variant.few:
        results = SumsOf(term, m, few_cuda.slots(m), variant.compensated, variant.extremes)
        return results.unpack(*_few_callable(variant, term)(*particles, *values, *more, output_dims=results.dims()))
    engine = pair_sum_cuda if variant.cuda else pair_sum_cpu
    results = SumsOf(term, m, engine.slots(m), variant.compensated, variant.extremes)
    dims = results.dims()
    dims |= {_SORTED[variant.cuda]: max(engine.sorted_numbers(term, n, variant.dim, variant.double), 1)}
    cells = (tree_cuda if variant.tree else cells_cuda) if variant.cuda else tree_cpu if variant.rule else cells_cpu
    of_search = {"info": 2, "scratch": cells.scratch_words(n, m, variant.dim, 2 if variant.double else 1, variant.own)}
    if variant.cuda:  # particles are sorted by a call of its own, which XLA makes once for a sum and its derivative
        values = (*values, *_sorting_callable(_sorting(variant))(*particles, *orders, output_dims=of_search))
    else:
        dims |= of_search
    return results.unpack(*_sum_callable(variant, term)(*particles, *values, *more, output_dims=dims)[: len(_RESULTS)])


@kernel
def _sum_callable(variant: SumVariant, term: TermText) -> Call:
    scalar, words = np.float64 if variant.double else np.float32, {"info": np.int32, "scratch": np.int32}
    results, of_search = dict.fromkeys((*_RESULTS, _SORTED[variant.cuda]), scalar), tuple(words)
    more = (*EXCLUDED * bool(variant.excluding), *names_of_particles(variant.rule))
    name = variant.name(f"pair_sum_{'cuda' if variant.cuda else 'cpu'}")
    if variant.cuda:  # particles are sorted
        return Call(name, (*_GIVEN, *of_search, *more), results, functools.partial(_plan_on_cuda, variant, term))
    return Call(name, (*_GIVEN, *more), results | words, functools.partial(_plan_on_cpu, variant, term))


@kernel
def _few_callable(variant: SumVariant, term: TermText) -> Call:
    scalar, plan = np.float64 if variant.double else np.float32, functools.partial(_plan_few, variant, term)
    return Call(
        variant.name("pair_sum_few_cuda"), (*_GIVEN, *EXCLUDED * bool(variant.excluding)), dict.fromkeys(_RESULTS, scalar), plan
    )


def _plan_few(variant: SumVariant, term: TermText, shapes: Shapes, _: int) -> Plan:
    kind = variant.compensated, variant.batched, variant.extremes, variant.periodic == 1, variant.excluding
    numbers = _numbers(variant, term, shapes)
    query = few_cuda.sum_kernel(few_cuda.warps(numbers["m"]), term, variant.key, variant.dim, variant.double, *kind)
    numbers["drop_self"] &= variant.own
    return Plan([Launch(query, few_cuda.threads(numbers["m"]))], numbers)


def _sorting(variant: SumVariant) -> SumVariant:
    """Return on what of a variant it depends how particles are sorted."""
    rule = variant.rule if variant.tree else ""
    return variant._replace(closed=False, drop_self=False, compensated=False, extremes=False, key="", excluding=0, rule=rule)


@kernel
def _sorting_callable(variant: SumVariant) -> Call:
    """Make a function that XLA calls to sort particles on CUDA."""
    words = {"info": np.int32, "scratch": np.int32}
    given = (*_GIVEN[:3], *names_of_tree(variant.rule) * variant.tree)
    return Call(variant.name("sorting_cuda"), given, words, functools.partial(_plan_sorting, variant))


def _space(variant: SumVariant) -> dict[str, int]:
    return {"periodic": variant.periodic, "batched": variant.batched}


def _plan_sorting(variant: SumVariant, shapes: Shapes, multiprocessors: int) -> Plan:
    if variant.tree:
        numbers = size_numbers(shapes, variant.own)
        return Plan(fit_tree(tree_cuda.fit_kernel(variant.dim, variant.double, variant.rule, **_space(variant)), numbers), numbers)
    kernels = cells_cuda.cell_kernels(variant.dim, variant.double, variant.scaled, False, **_space(variant))
    numbers = size_numbers(shapes, variant.own)
    # what sorts particles takes the arguments of a search that only counts
    more = dict.fromkeys(("capacity", "closed", "drop_self"), 0)
    stages = place_launches(kernels.stages(numbers["n"], numbers["m"], variant.own, multiprocessors))
    return Plan(stages, numbers | more, ["idx", "count", "starts", "receivers"])


def _numbers(variant: SumVariant, term: TermText, shapes: Shapes) -> dict[str, int]:
    flags = {"closed": variant.closed, "drop_self": variant.drop_self, "width": term.source_columns}
    return size_numbers(shapes, variant.own) | flags


def _plan_on_cpu(variant: SumVariant, term: TermText, shapes: Shapes, multiprocessors: int) -> Plan:
    dim, double, scaled = variant[:3]
    space = _space(variant)
    more = space | {"extremes": variant.extremes, "excluding": variant.excluding, "rule": variant.rule}
    query = pair_sum_cpu.query_kernel(term, variant.key, dim, double, scaled, variant.compensated, **more)
    numbers = _numbers(variant, term, shapes) | numbers_of_values(term, shapes)
    values = [share(pair_sum_cpu.sort_kernel(dim, double), numbers["n"])] if term.source_columns else []
    if variant.rule:
        sort = sort_on_cpu(tree_cpu.sort_kernels(dim, double, variant.rule, **space), numbers["n"])
    else:
        sort = sort_on_cpu(cells_cpu.sort_kernels(dim, double, scaled, **space), numbers["n"])
    return Plan([*sort, *values, share(query, numbers["m"], QUERIES_PER_THREAD)], numbers)


def _plan_on_cuda(variant: SumVariant, term: TermText, shapes: Shapes, multiprocessors: int) -> Plan:
    dim, double, scaled = variant[:3]
    more = _space(variant) | {"extremes": variant.extremes, "excluding": variant.excluding, "rule": variant.rule}
    more["tree"] = variant.tree
    kernels = pair_sum_cuda.sum_kernels(term, variant.key, dim, double, scaled, variant.compensated, **more)
    numbers = _numbers(variant, term, shapes)
    launches = kernels.launches(numbers["n"], numbers["m"], multiprocessors)
    return Plan([Launch(x.kernel, x.threads, beside=x.beside) for x in launches], numbers)
