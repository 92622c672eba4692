"""What is static about a call of kernels that list, count or sum (`jfrnn.kernels.Kind`), and what follows: arrays, and numbers."""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.launch import Call, Shapes
from jfrnn._engine.operands import periodic_kind
from jfrnn._engine.plans import HugePages, Launch, Plan, ask_for_huge_pages, share
from jfrnn._engine.problem import Filter, Room, Rows, Search
from jfrnn._geometry import Cutoffs, Status
from jfrnn.kernels import Kind, cells_cpu, tree_cpu
from jfrnn.kernels._kind import OWN_BOXES, RULES
from jfrnn.kernels._native import EXCLUDED, ORDERS, TABLE, table_cells

SUMS = ("sums", "totals", "errors", "more")  # what kernels that sum write
_PARTICLES = ("positions", "queries", "cutoff")  # what kernels of cells are given


def kind_of_search(search: Search, keep: Filter, capacity: int | Room | None = None) -> Kind:
    """Return what is static about a search or, without a capacity, a count; sums add what is static about them alone."""
    cutoff, batched = search.cutoff, OWN_BOXES if search.per_system else int(search.batch is not None)
    return Kind(
        search.sources.shape[1],
        double=search.sources.dtype == jnp.float64,
        scaled=cutoff.scaled,
        own=search.queries is None,
        closed=cutoff.closed,
        drop_self=keep.drop_self,
        later=keep.later_only,
        lists=capacity is not None,
        flat=isinstance(capacity, Room),
        periodic=periodic_kind(search.lattice),
        batched=batched,
        excluding=search.excluding,
        rule=cutoff.rule if isinstance(cutoff, Cutoffs) else "",
    )


def scalar_of(kind: Kind) -> type:
    """Return the dtype of positions."""
    return np.float64 if kind.double else np.float32


def names_of_particles(rule: str) -> tuple[str, ...]:
    """Return the names of what `cutoffs_of_particles` returns."""
    return () if not rule else ("radii", "query_radii", *TABLE * (rule == RULES[-1]))


def names_of_tree(rule: str) -> tuple[str, ...]:
    """Return the names of what a tree on CUDA is given of cutoffs, and the orders of particles."""
    return (*names_of_particles(rule), *ORDERS)


def names_of_cutoffs(rule: str) -> tuple[str, ...]:
    """Return the names of the arrays that kernels are given by `cutoffs_of_pairs`."""
    return () if not rule else TABLE if rule == RULES[-1] else ("radii", "query_radii")


def describe_call(
    name: str,
    kind: Kind,
    plan: Callable[[Shapes, int], Plan],
    given: Sequence[str] = _PARTICLES,
    more: Sequence[str] = ("scratch",),
    cutoffs: Callable[[str], tuple[str, ...]] = names_of_cutoffs,
) -> Call:
    """Return what XLA calls for rows or counts: its name tells the kernels, and all that is static.

    It is `given` arrays of these names, then those of exclusions and of cutoffs that differ, by a function of the rule; it writes
    rows, counts, `info` and `more`.
    """
    results = [*["idx"] * kind.lists, *["receivers"] * kind.flat, "count", "info", *more]
    given = (*given, *EXCLUDED * bool(kind.excluding), *cutoffs(kind.rule), *["starts"] * kind.flat)
    return Call(f"jfrnn_{name}_{kind.name}", given, dict.fromkeys(results, np.int32), plan)


def describe_sums(
    name: str,
    kind: Kind,
    key: str,
    plan: Callable[[Shapes, int], Plan],
    given: Sequence[str],
    more: Mapping[str, type] = MappingProxyType({}),
    cutoffs: Callable[[str], tuple[str, ...]] = names_of_particles,
) -> Call:
    """Return what XLA calls for sums of a term, which a key tells from others; it writes sums and `more`."""
    given = (*given, *EXCLUDED * bool(kind.excluding), *cutoffs(kind.rule))
    return Call(f"jfrnn_{name}_{kind.name}_{key}", given, dict.fromkeys(SUMS, scalar_of(kind)) | dict(more), plan)


def plan_numbers(kind: Kind, shapes: Shapes) -> dict[str, int]:
    """Return the numbers that kernels of cells take, by name; of rows without a common length the capacity is 0."""
    capacity = shapes["idx"][1] if kind.lists and not kind.flat else 0
    flags = {"closed": kind.closed, "drop_self": kind.drop_self, "later_only": kind.later}
    return size_numbers(shapes, kind.own) | {"capacity": capacity, **flags}


def absent(kind: Kind) -> list[str]:
    """Return the names of arrays that kernels do not touch."""
    return [*["idx"] * (not kind.lists), *["starts", "receivers"] * (not kind.flat)]


def row_dims(m: int, capacity: int | Room | None) -> dict[str, int | tuple[int, int | None]]:
    """Return the shape of what is written of rows, by name; without rows there is none."""
    if isinstance(capacity, Room):
        return {"idx": capacity.total, "receivers": capacity.total}
    return {"idx": (m, capacity)}


def split_rows(written: Sequence[Array]) -> dict[str, Array | None]:
    """Return the fields of `Rows` that a kernel has written: none, rows, or those of a flat list."""
    return {"idx": None} | dict(zip(("idx", "receivers"), written, strict=False))


def found_rows(written: Sequence[Array], count: Array, longest: Array, capacity: int | Room | None) -> Rows:
    """Return what kernels have found whose status is that rows overflow, if anything."""
    overflow = isinstance(capacity, int) and longest > capacity
    status = jnp.where(overflow, Status.ROW_OVERFLOW.value, 0).astype(jnp.int32)
    return Rows(**split_rows(written), counts=count, required=longest, status=status)


def huge_pages(kind: Kind, shapes: Shapes) -> list[HugePages]:
    """Return the requests for what is written of rows, on the CPU."""
    names = [*["idx"] * kind.lists, *["receivers"] * kind.flat]
    return [step for name in names for step in ask_for_huge_pages(name, 4 * math.prod(shapes[name]))]


def sort_on_cpu(kind: Kind, n: int) -> list[Launch]:
    """Return what sorts sources and queries on the CPU; several threads put the coordinates of many sources in order."""
    build, gather = (tree_cpu if kind.rule else cells_cpu).sort_kernels(kind)
    return [Launch(build), *([share(gather, n)] if n >= cells_cpu.MANY else [])]


def size_numbers(shapes: Shapes, own: bool) -> dict[str, int]:
    """Return n, m, own and the cells of the table, as all kernels of cells take them."""
    n, m = shapes["positions"][0], shapes["queries"][0]
    kinds = shapes[TABLE[0]][0] if TABLE[0] in shapes else 0
    return {"n": n, "m": m, "own": int(own), "table": table_cells(n), "kinds": kinds}
