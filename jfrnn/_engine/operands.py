"""What is static about a call of kernels that list, count or sum (`jfrnn.kernels.Kind`), and what such kernels are given."""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.launch import Call, Shapes
from jfrnn._engine.plans import HugePages, Launch, Plan, ask_for_huge_pages, share
from jfrnn._engine.problem import Filter, Room, Rows, Search, largest_radius
from jfrnn._geometry import CLASSES, Cutoffs, Lattice, Status, octaves_of, order_for_tree
from jfrnn.kernels import Kind, cells_cpu, tree_cpu
from jfrnn.kernels._native import EXCLUDED, ORDERS, OWN_BOXES, RULES, TABLE, table_cells

SUMS = ("sums", "totals", "errors", "more")  # what kernels that sum write
_PARTICLES = ("positions", "queries", "cutoff")  # what kernels of cells are given
MOST_IN_BOX = 1 << 27  # most positions in a box, where ids share their bits with image codes


def periodic_kind(lattice: Lattice | None) -> int:
    """Return `periodic` of `jfrnn.kernels.Kind`."""
    if lattice is None:
        return 0
    images = lattice.images
    return (1 if images.nearest else 2) + (0 if images.orthogonal else 2)


def particle_rows(points: Array, turns: Array | None, systems: Array | None) -> Array:
    """Return rows of particles as kernels read them: coordinates, packed turns, system number."""
    return side_by_side(points, [as_float(x, points.dtype) for x in (turns, systems) if x is not None])


def side_by_side(first: Array, columns: list[Array], length: int | None = None) -> Array:
    """Return an array [n, k] with columns [n] behind its own, then zeros up to a length.

    XLA's concatenation takes at least twice as long.
    """
    rows = jnp.pad(first, ((0, 0), (0, len(columns) if length is None else length - first.shape[1])))
    for k, column in enumerate(columns, first.shape[1]):
        rows = jnp.where(np.arange(rows.shape[1]) == k, column[:, None], rows)
    return rows


def as_float(x: Array, dtype: np.dtype) -> Array:
    """Encode values as floats: integers of the same width by their bits, smaller types by value."""
    if x.dtype == dtype:
        return x
    same_width = jnp.issubdtype(x.dtype, jnp.integer) and x.dtype.itemsize == dtype.itemsize
    return lax.bitcast_convert_type(x, dtype) if same_width else x.astype(dtype)


def as_integer(x: Array) -> Array:
    """Decode int32 that `as_float` encoded."""
    return lax.bitcast_convert_type(x, jnp.int32) if x.dtype == jnp.float32 else x.astype(jnp.int32)


def lattice_numbers(lattice: Lattice, reach: Array, slack: Array, turns: Array, flags: Array | None = None) -> Array:
    """Return the numbers of a lattice that kernels read, in the order that `jfrnn.kernels._native` specifies.

    Along axes that are not periodic by `flags`, images have numbers below 0.
    """
    more = 3 - lattice.dim
    square, line = ((0, more), (0, more)), (0, more)
    images = jnp.asarray(lattice.images.reach).astype(lattice.matrix.dtype)
    images = images if flags is None else jnp.where(flags, images, -images)
    parts = [jnp.pad(lattice.matrix, square), jnp.pad(lattice.transform, square), jnp.pad(lattice.origin, line)]
    parts += [jnp.pad(reach, line, constant_values=1), jnp.pad(images, line), slack, turns]
    if not lattice.images.orthogonal:
        dim = lattice.dim
        numbers = lattice.given[dim:] if lattice.images.short else lattice.images.numbers.astype(images.dtype)
        parts += [jnp.pad(lattice.given[:dim], square), jnp.pad(numbers, square)]
    return jnp.concatenate([part.reshape(-1) for part in parts])


def excluded_rows(search: Search) -> list[Array]:
    """Return the rows of sources that queries exclude, as kernels read them (`native/decide/excluded.h`), if there are any."""
    return [] if search.exclude is None else [search.exclude.starts, search.exclude.names(search.sizes[0])]


def cutoffs_of_particles(cutoffs: Cutoffs) -> dict[str, Array]:
    """Return the cutoffs of sources and queries by the names that kernels on the CPU have for them; a table and species, too."""
    names = dict(zip(("radii", "query_radii"), (cutoffs.sources, cutoffs.queries), strict=True))
    named = {name: jnp.zeros(1, cutoffs.largest.dtype) if x is None else x for name, x in names.items()}
    return named if cutoffs.kinds is None else named | dict(zip(TABLE, cutoffs.kinds, strict=True))


def orders_for_tree(search: Search) -> dict[str, Array]:
    """Return the orders in which sources and queries follow each other in a tree on CUDA, by the names of `ORDERS`."""
    cutoffs, torus, batch = search.cutoffs, search.torus, search.batch

    def order(points: Array, radii: Array | None, species: Array | None, systems: Array | None) -> Array:
        if species is not None:
            classes = jnp.minimum(species.astype(jnp.uint32), CLASSES - 1)
        else:
            classes = None if radii is None else octaves_of(radii, cutoffs.largest, CLASSES).astype(jnp.uint32)
        return order_for_tree(points, classes, systems)

    _, *species = (None, None, None) if cutoffs.kinds is None else cutoffs.kinds
    systems = [None, None] if batch is None else [batch.sources, batch.queries]
    given = search.sources if search.queries is None else search.queries
    points = (search.sources, given) if torus is None else (torus[1].sources, torus[1].queries)
    own = search.queries is None
    radii = cutoffs.queries if own and cutoffs.sources is None else cutoffs.sources
    sources = order(points[0], radii, species[0], systems[0])
    queries = sources if own else order(points[1], cutoffs.queries, species[1], systems[1])
    return dict(zip(ORDERS, (sources, queries), strict=True))


def pack_particles(search: Search) -> tuple[Array, Array, Array]:
    """Return rows of sources and of queries, and the shared numbers, as the cell kernels read them."""
    sources, queries, cutoff, batch, torus = search[:5]
    numbers = [jnp.reshape(jnp.asarray(largest_radius(cutoff)), 1)]
    turns = query_turns = None
    rows = None
    if torus is not None:
        rows = None if batch is not None else torus[1].rows
        turns, query_turns = torus[1].turns, torus[1].query_turns
        numbers.append(lattice_numbers(torus[0], torus[1].reach, torus[1].slack, torus[1].most_turns))
    if isinstance(cutoff, Cutoffs) and cutoff.longer is not None:
        numbers.append(cutoff.longer.astype(sources.dtype)[None])
    if batch is not None:
        numbers.append(as_float(jnp.max(batch.of_all)[None], sources.dtype))
    if rows is None:
        first = particle_rows(sources, turns, None if batch is None else batch.sources)
        rows = first, first if queries is None else particle_rows(queries, query_turns, None if batch is None else batch.queries)
    return rows[0], rows[1], jnp.concatenate(numbers)


# --- calls --------------------------------------------------------------------------------------------------------------


def kind_of_search(search: Search, keep: Filter, capacity: int | Room | None = None) -> Kind:
    """Return what is static about a search or, without a capacity, a count; sums add what is static about them alone."""
    cutoff, batched = search.cutoff, OWN_BOXES if search.per_system else int(search.batch is not None)
    exclude = search.exclude
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
        excluding=0 if exclude is None else 1 if exclude.codes is None else 2,
        rule=cutoff.rule if isinstance(cutoff, Cutoffs) else "",
    )


def scalar_of(kind: Kind) -> type:
    """Return the dtype of positions."""
    return np.float64 if kind.double else np.float32


def names_of_particles(rule: str) -> tuple[str, ...]:
    """Return the names of what `cutoffs_of_particles` returns, by a rule of cutoffs that differ."""
    return ("radii", "query_radii", *TABLE * (rule == RULES[-1]))


def names_of_tree(rule: str) -> tuple[str, ...]:
    """Return the names of what a tree on CUDA is given of cutoffs, and the orders of particles."""
    return (*names_of_particles(rule), *ORDERS)


def names_of_cutoffs(rule: str) -> tuple[str, ...]:
    """Return the names of the arrays that kernels are given by `cutoffs_of_pairs`."""
    return TABLE if rule == RULES[-1] else ("radii", "query_radii")


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
    rows, counts, the length of the longest row, bits of the status and `more`.
    """
    results = [*["idx"] * kind.lists, *["receivers"] * kind.flat, "count", "longest", "bits", *more]
    of_cutoffs = cutoffs(kind.rule) if kind.rule else ()
    given = (*given, *EXCLUDED * bool(kind.excluding), *of_cutoffs, *["starts"] * kind.flat)
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
    given = (*given, *EXCLUDED * bool(kind.excluding), *(cutoffs(kind.rule) if kind.rule else ()))
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


def sort_on_cpu(kind: Kind, shapes: Shapes, numbers: Mapping[str, int]) -> list[HugePages | Launch]:
    """Return what sorts sources and queries on the CPU, of numbers of a plan; several threads sort many."""
    n, m, sort = numbers["n"], numbers["m"], (tree_cpu if kind.rule else cells_cpu).sort_kernels(kind)
    build = [*ask_for_huge_pages("scratch", 4 * math.prod(shapes["scratch"])), Launch(sort.build)]
    if max(n, m) < cells_cpu.MANY:
        return build
    of_queries = [] if numbers["own"] else [share(step, m)._replace(numbers={"of_queries": 1}) for step in sort.steps]
    more = [share(step, n) if shared else Launch(step) for step, shared in sort.more]
    return [*build, *(share(step, n) for step in sort.steps), *of_queries, *more]


def size_numbers(shapes: Shapes, own: bool) -> dict[str, int]:
    """Return n, m, own and the cells of the table, as all kernels of cells take them (of sources, unless told otherwise)."""
    n, m = shapes["positions"][0], shapes["queries"][0]
    kinds = shapes[TABLE[0]][0] if TABLE[0] in shapes else 0
    return {"n": n, "m": m, "own": int(own), "of_queries": 0, "table": table_cells(n), "kinds": kinds}
