"""The arrays that all Warp kernels read: rows of particles, and the numbers of a cutoff and of a lattice."""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._engine.problem import Search, largest_radius
from jfrnn._geometry import CLASSES, Cutoffs, Lattice, octaves_of, order_for_tree
from jfrnn.kernels._native import ORDERS, TABLE

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


def side_by_side(first: Array, columns: list[Array]) -> Array:
    """Return an array [n, k] with columns [n] behind its own; XLA's concatenation takes at least twice as long."""
    rows = jnp.pad(first, ((0, 0), (0, len(columns))))
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


def lattice_numbers(lattice: Lattice, reach: Array, slack: Array, flags: Array | None = None) -> Array:
    """Return the numbers of a lattice that kernels read, in the order that `jfrnn.kernels._native` specifies.

    Along axes that are not periodic by `flags`, images have numbers below 0.
    """
    more = 3 - lattice.dim
    square, line = ((0, more), (0, more)), (0, more)
    images = jnp.asarray(lattice.images.reach).astype(lattice.matrix.dtype)
    images = images if flags is None else jnp.where(flags, images, -images)
    parts = [jnp.pad(lattice.matrix, square), jnp.pad(lattice.transform, square), jnp.pad(lattice.origin, line)]
    parts += [jnp.pad(reach, line, constant_values=1), jnp.pad(images, line), slack]
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
    if torus is not None:
        turns, query_turns = torus[1].turns, torus[1].query_turns
        numbers.append(lattice_numbers(torus[0], torus[1].reach, torus[1].slack))
    if isinstance(cutoff, Cutoffs) and cutoff.longer is not None:
        numbers.append(cutoff.longer.astype(sources.dtype)[None])
    if batch is not None:
        numbers.append(as_float(jnp.max(batch.of_all)[None], sources.dtype))
    sources = particle_rows(sources, turns, None if batch is None else batch.sources)
    rows = sources if queries is None else particle_rows(queries, query_turns, None if batch is None else batch.queries)
    return sources, rows, jnp.concatenate(numbers)
