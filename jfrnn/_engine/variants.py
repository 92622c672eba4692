"""What is static about a call of kernels that list, count or sum, and what follows from that: its name, and its numbers."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._engine.launch import Call, Shapes
from jfrnn._engine.operands import space_flags
from jfrnn._engine.plans import HugePages, Plan, ask_for_huge_pages
from jfrnn._engine.problem import Filter, Room, Rows
from jfrnn._geometry import Status
from jfrnn.kernels._native import EXCLUDED, ORDERS, RULES, TABLE, table_cells

_PARTICLES = ("positions", "queries", "cutoff")  # what kernels of cells are given


class Variant(NamedTuple):
    """All that is static about an engine call, apart from shapes."""

    dim: int
    double: bool
    scaled: bool
    lists: bool
    own: bool
    closed: bool
    keep: Filter
    periodic: int = 0  # 1: nearest images, 2: images are told apart; two more where the lattice is skewed
    batched: bool = False
    excluding: int = 0  # as `Search.excluding`
    flat: bool = False  # a list whose rows follow each other without gaps
    rule: str = ""  # by which the cutoff of a pair follows from both, if they differ


def excluding_flags(excluding: int) -> dict[str, bool]:
    """Return the words of a name that tell what queries exclude."""
    return {"excluding": excluding == 1, "excludingimages": excluding == 2}


class SumVariant(NamedTuple):
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
    few: bool  # all of them meet
    excluding: int
    rule: str = ""
    tree: bool = False  # on CUDA

    def name(self, of: str) -> str:
        """Return the name of a call, which tells it from all others."""
        flags = {"f64": self.double, "f32": not self.double, "scaled": self.scaled, "own": self.own}
        flags |= {"closed": self.closed, "dropself": self.drop_self, "batched": self.batched, **space_flags(self.periodic)}
        flags |= {"compensated": self.compensated, "extremes": self.extremes, **excluding_flags(self.excluding)}
        flags |= {self.rule: bool(self.rule), "tree": self.tree, self.key: bool(self.key)}
        return "_".join([f"jfrnn_{of}_{self.dim}d", *(flag for flag, on in flags.items() if on)])


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
    variant: Variant,
    plan: Callable[[Shapes, int], Plan],
    given: Sequence[str] = _PARTICLES,
    more: Sequence[str] = ("scratch",),
    cutoffs: Callable[[str], tuple[str, ...]] = names_of_cutoffs,
) -> Call:
    """Return what XLA calls for rows or counts: its name tells the kernels, and all that is static.

    It is `given` arrays of these names, then those of exclusions and of cutoffs that differ, by a function of the rule; it writes
    rows, counts, `info` and `more`.
    """
    flags = {"f64": variant.double, "f32": not variant.double, "scaled": variant.scaled, "list": variant.lists}
    flags |= {"flat": variant.flat, **space_flags(variant.periodic), "batched": variant.batched}
    flags |= {"own": variant.own, "closed": variant.closed, "dropself": variant.keep.drop_self, "later": variant.keep.later_only}
    flags |= {**excluding_flags(variant.excluding), variant.rule: bool(variant.rule)}
    whole = "_".join(["jfrnn", name, f"{variant.dim}d", *(flag for flag, on in flags.items() if on)])
    results = [*["idx"] * variant.lists, *["receivers"] * variant.flat, "count", "info", *more]
    given = (*given, *EXCLUDED * bool(variant.excluding), *cutoffs(variant.rule), *["starts"] * variant.flat)
    return Call(whole, given, dict.fromkeys(results, np.int32), plan)


def plan_numbers(variant: Variant, shapes: Shapes) -> dict[str, int]:
    """Return the numbers that kernels of cells take, by name; of rows without a common length the capacity is 0."""
    flags = {"closed": variant.closed, "drop_self": variant.keep.drop_self, "later_only": variant.keep.later_only}
    capacity = shapes["idx"][1] if variant.lists and not variant.flat else 0
    return size_numbers(shapes, variant.own) | {"capacity": capacity, **flags}


def absent(lists: bool, flat: bool) -> list[str]:
    """Return the names of arrays that kernels do not touch."""
    return [*["idx"] * (not lists), *["starts", "receivers"] * (not flat)]


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


def huge_pages(variant: Variant, shapes: Shapes) -> list[HugePages]:
    """Return the requests for what is written of rows, on the CPU."""
    names = [*["idx"] * variant.lists, *["receivers"] * variant.flat]
    return [step for name in names for step in ask_for_huge_pages(name, 4 * math.prod(shapes[name]))]


def size_numbers(shapes: Shapes, own: bool) -> dict[str, int]:
    """Return n, m, own and the cells of the table, as all kernels of cells take them."""
    n, m = shapes["positions"][0], shapes["queries"][0]
    kinds = shapes[TABLE[0]][0] if TABLE[0] in shapes else 0
    return {"n": n, "m": m, "own": int(own), "table": table_cells(n), "kinds": kinds}
