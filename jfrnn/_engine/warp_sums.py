"""Sums over pairs by Warp's kernels: the term is part of the kernel that finds the pairs."""

import functools
from collections.abc import Callable, Sequence

import numpy as np
from jax import Array

from jfrnn._engine.boxes_warp import box_sums
from jfrnn._engine.launch import Call, Shapes, kernel
from jfrnn._engine.operands import (
    SUMS,
    cutoffs_of_particles,
    describe_sums,
    excluded_rows,
    kind_of_search,
    names_of_particles,
    names_of_tree,
    orders_for_tree,
    pack_particles,
    scalar_of,
    size_numbers,
    sort_on_cpu,
)
from jfrnn._engine.plans import Launch, Plan, share
from jfrnn._engine.problem import Filter, Search
from jfrnn._engine.sum_results import FoundSums, Summed, SumsOf, TermText, Values, numbers_of_values
from jfrnn._engine.warp import QUERIES_PER_THREAD, are_few, by_cells_or_tree, fit_tree, place_launches
from jfrnn._geometry import Cutoffs
from jfrnn._tracing import on_platform
from jfrnn.kernels import Kind, cells_cpu, cells_cuda, few_cuda, pair_sum_cpu, pair_sum_cuda, tree_cpu, tree_cuda

_GIVEN = ("positions", "queries", "cutoff", "shared_values", "own_values", "others")  # what a call is given
_WORDS = {"bits": np.int32, "scratch": np.int32}  # what is written where particles are sorted


def pair_sums(search: Search, keep: Filter, summed: Summed, values: Values) -> FoundSums:
    """Sum a term over the pairs of a search, with the columns that it reads.

    Returns:
        The sums of each query [m, width], or the first of them and the others in two arrays; the sums over all pairs [totals]; and
        for extremes, where sums are the largest summands, their sources and the codes of their images, int32 [m, width, 2].
    """
    term, key, kind = summed.term, summed.key, summed.of(kind_of_search(search, keep))
    term = term._replace(first=0) if kind.extremes or (kind.rule and not search.per_system) else term
    if search.per_system:
        return box_sums(search, keep, summed._replace(term=term), values)

    def on(cuda: bool, tree: bool = False) -> Callable[[Search, Values], FoundSums]:
        def call(search: Search, values: Values) -> FoundSums:
            of_particles = cutoffs_of_particles(search.cutoff) if isinstance(search.cutoff, Cutoffs) else {}
            particles, more = pack_particles(search), [*excluded_rows(search), *of_particles.values()]
            n, m, width, double = len(particles[0]), len(particles[1]), 2 if kind.double else 1, kind.double
            if not cuda:
                results = SumsOf(term, kind, m, pair_sum_cpu.slots(m))
                words = (tree_cpu if kind.rule else cells_cpu).scratch_words(n, m, kind.dim, width, kind.own)
                dims = {"columns": max(pair_sum_cpu.sorted_numbers(term, n, kind.dim, double), 1), "bits": (), "scratch": words}
                make, given = _cpu_callable(kind, term, key), [*values.beside_rows, *more]
            elif not kind.rule and are_few(search):
                results, dims = SumsOf(term, kind, m, few_cuda.slots(m)), {}
                make, given = _few_callable(kind, term, key), [*values.whole, *more]
            else:
                results, one = SumsOf(term, kind, m, pair_sum_cuda.slots(m)), kind._replace(tree=tree)
                orders = list(of_particles.values()) if tree or one.long else []
                orders += orders_for_tree(search).values() if tree else []
                dims = {"values": max(pair_sum_cuda.sorted_numbers(term, n, kind.dim, double), 1)}
                sorted_ones = sort_particles(one, particles, orders)
                make, given = _cuda_callable(one, term, key), [*values.beside_rows, *sorted_ones, *more]
            return results.unpack(*make(*particles, *given, output_dims=results.dims() | dims)[: len(SUMS)])

        return call

    cuda = functools.partial(by_cells_or_tree, on(True), on(True, True)) if kind.rule else on(True)
    return on_platform(search._replace(checks={}), values, late=bool(kind.rule), cpu=on(False), cuda=cuda)


def sort_particles(kind: Kind, particles: tuple[Array, Array, Array], given: list[Array]) -> Sequence[Array]:
    """Sort particles on CUDA by a call of its own, which XLA makes once for a sum and its derivative; return what it wrote.

    `given` are cutoffs that differ, and the orders that a tree is fitted to.
    """
    n, m = len(particles[0]), len(particles[1])
    words = (tree_cuda if kind.tree else cells_cuda).scratch_words(n, m, kind.dim, 2 if kind.double else 1, kind.own)
    more = ("rule", "tree") if kind.tree or kind.long else ()
    kind = kind.only("scaled", "own", "periodic", "batched", *more)
    return _sorting_callable(kind)(*particles, *given, output_dims={"bits": (), "scratch": words})


@kernel
def _cpu_callable(kind: Kind, term: TermText, key: str) -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        numbers = _numbers(kind, term, shapes) | numbers_of_values(term, shapes)
        values = [share(pair_sum_cpu.sort_kernel(kind.dim, kind.double), numbers["n"])] if term.source_columns else []
        query = share(pair_sum_cpu.query_kernel(kind, term, key), numbers["m"], QUERIES_PER_THREAD)
        return Plan([*sort_on_cpu(kind, shapes, numbers), *values, query], numbers)

    return describe_sums("pair_sum_cpu", kind, key, plan, _GIVEN, more={"columns": scalar_of(kind), **_WORDS})


@kernel
def _cuda_callable(kind: Kind, term: TermText, key: str) -> Call:
    def plan(shapes: Shapes, multiprocessors: int) -> Plan:
        numbers = _numbers(kind, term, shapes)
        m = numbers["m"]
        kernels = pair_sum_cuda.sum_kernels(kind, term, key, cells_cuda.lanes_of_query(m), cells_cuda.has_parts(m, kind.own))
        launches = kernels.launches(numbers["n"], m, kind.own, multiprocessors)
        return Plan([Launch(x.kernel, x.threads, beside=x.beside) for x in launches], numbers)

    return describe_sums("pair_sum_cuda", kind, key, plan, (*_GIVEN, *_WORDS), more={"values": scalar_of(kind)})


@kernel
def _few_callable(kind: Kind, term: TermText, key: str) -> Call:
    def plan(shapes: Shapes, _: int) -> Plan:
        numbers = _numbers(kind, term, shapes)
        query = few_cuda.sum_kernel(kind, few_cuda.warps(numbers["m"]), term, key)
        numbers["drop_self"] &= kind.own
        return Plan([Launch(query, few_cuda.threads(numbers["m"]))], numbers)

    return describe_sums("pair_sum_few_cuda", kind, key, plan, _GIVEN)


@kernel
def _sorting_callable(kind: Kind) -> Call:
    """Make a function that XLA calls to sort particles on CUDA."""

    def plan(shapes: Shapes, multiprocessors: int) -> Plan:
        numbers = size_numbers(shapes, kind.own)
        if kind.tree:
            return Plan(fit_tree(tree_cuda.fit_kernel(kind), numbers), numbers)
        # what sorts particles takes the arguments of a search that only counts
        more = dict.fromkeys(("capacity", "closed", "drop_self"), 0)
        stages = cells_cuda.cell_kernels(kind).stages(numbers["n"], numbers["m"], kind.own, multiprocessors)
        return Plan(place_launches(stages), numbers | more, ["idx", "count", "starts", "receivers"])

    cutoffs = () if not kind.rule else names_of_tree(kind.rule) if kind.tree else names_of_particles(kind.rule)
    return Call(f"jfrnn_sorting_cuda_{kind.name}", (*_GIVEN[:3], *cutoffs), _WORDS, plan)


def _numbers(kind: Kind, term: TermText, shapes: Shapes) -> dict[str, int]:
    flags = {"closed": kind.closed, "drop_self": kind.drop_self, "width": term.source_columns}
    return size_numbers(shapes, kind.own) | flags
