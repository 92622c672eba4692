"""Pairs that are no neighbors, whatever their distance: as users give them, and as a search looks them up.

The image of an excluded pair has a code in a search, which counts lattice vectors from wrapped positions.
"""

import contextlib
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jfrnn._geometry.lattice import Lattice, adjugate
from jfrnn._geometry.wrapping import Wrapped, unpack_turns
from jfrnn._tracing import Given, IndexRows, as_array, gather, on_device, own_transfers, portable

_ArrayModule = Any  # numpy or jax.numpy


@portable
class Exclusions(NamedTuple):
    """The sources that each row of a search excludes, in all of their periodic images or in one. A pytree.

    Attributes:
        rows: The excluded sources of each query.
        turned: The same with queries and sources exchanged; None if the sources are the queries: rows are then their own mirror
            image.
        valid: Whether all pairs name particles that there are, [] bool; None if they are known to.
    """

    rows: "ExcludedRows"
    turned: "ExcludedRows | None"
    valid: Array | None

    def reverse(self) -> "Exclusions":
        """Return the same pairs with queries and sources exchanged."""
        return self if self.turned is None else self._replace(rows=self.turned, turned=self.rows)


@portable
class ExcludedRows(NamedTuple):
    """Rows of excluded sources, one for each query. A pytree.

    Attributes:
        starts: [m + 1] int32, where the row of a query begins in `others`, and at the end where the last one ends.
        others: [k] int32, excluded sources, ascending in each row; behind the last row stands what excludes nothing.
        shifts: [k, d] int32, the lattice shift of the image that is excluded; None: all images are.
    """

    starts: Array
    others: Array
    shifts: Array | None = None

    @property
    def row_of_each(self) -> Array:
        """The row of each of `others`, [k] int32; behind the last row the number of rows."""
        place = jnp.arange(self.others.shape[0], dtype=jnp.int32)
        return jnp.searchsorted(self.starts, place, side="right").astype(jnp.int32) - 1


def check_exclusions(exclude: Given, positions: Array, asking: Array | None) -> Exclusions | None:
    """Return pairs [e, 2], or images [e, 2 + d], as rows, or None if there are none; those that hold a -1 count as padding."""
    sources, queries = positions.shape[0], None if asking is None else asking.shape[0]
    dim = positions.shape[1]
    if isinstance(exclude, list | tuple) and not exclude:  # NumPy would make floats of it
        return None
    exclude = as_array("exclude", exclude)
    if not hasattr(exclude, "dtype") or not np.issubdtype(exclude.dtype, np.integer):
        told = np.dtype(exclude.dtype) if hasattr(exclude, "dtype") else type(exclude).__name__
        raise TypeError(f"exclude must be an array of integers, the numbers of two particles in each row, got {told}.")
    if len(exclude.shape) != 2 or exclude.shape[1] not in (2, 2 + dim):
        raise ValueError(
            f"exclude must have shape [e, 2], a pair in each row, or [e, {2 + dim}] with the lattice shift of an image behind it, "
            f"got shape {list(exclude.shape)}: write rows of partners, one for each particle, as pairs with jfrnn.pairs_of_rows."
        )
    if exclude.shape[0] > 2**30 - 1:
        raise ValueError(f"exclude holds {exclude.shape[0]} pairs, but rows are numbered in int32: at most {2**30 - 1}.")
    if 0 in (exclude.shape[0], sources, queries):
        return None
    if isinstance(exclude, Tracer):
        return _make_rows(jnp, gather(exclude), sources, queries)
    with own_transfers() if isinstance(exclude, Array) else contextlib.nullcontext():
        known = np.asarray(jax.device_get(exclude) if isinstance(exclude, Array) else exclude)
        made = _make_rows(np, known, sources, queries)
        if not made.valid:
            rows = sources if queries is None else queries
            wrong = int(np.argmax(~_exist(known, rows, sources) & ~_pad(known)))
            first = "numbers of particles" if queries is None else f"numbers of queries below {rows}, then of particles"
            raise ValueError(
                f"exclude must hold {first} below {sources}, or -1 in padding, got {known[wrong].tolist()} in row {wrong}."
            )
        return jax.tree.map(on_device, made._replace(valid=None))


def _exist(pairs: Given, rows: int, sources: int) -> Given:
    """Say which pairs [e, 2] name particles that there are."""
    return (pairs[:, 0] >= 0) & (pairs[:, 0] < rows) & (pairs[:, 1] >= 0) & (pairs[:, 1] < sources)


def _pad(pairs: Given) -> Given:
    """Say which pairs [e, 2] are padding."""
    unsigned = np.issubdtype(pairs.dtype, np.unsignedinteger)
    return pairs[:, 0] < 0 if unsigned else (pairs[:, 0] == -1) | (pairs[:, 1] == -1)


def _make_rows(xp: _ArrayModule, pairs: Given, sources: int, queries: int | None) -> Exclusions:
    rows = sources if queries is None else queries
    used = _exist(pairs, rows, sources)
    valid = (used | _pad(pairs)).all()
    first, second = (xp.where(used, x, 0).astype(np.int32) for x in (pairs[:, 0], pairs[:, 1]))
    shifts, kind = None, pairs.dtype
    if pairs.shape[1] > 2:  # a shift that does not fit into int32 belongs to an image too far away to be a neighbor
        most = min(np.iinfo(np.int32).max // 4, np.iinfo(kind).max)
        shifts = xp.clip(pairs[:, 2:], 0 if kind.kind == "u" else -most, most).astype(np.int32)
    if queries is None:
        used, first, second = (xp.concatenate(x) for x in ((used, used), (first, second), (second, first)))
        both = None if shifts is None else xp.concatenate([shifts, -shifts])
        return Exclusions(_sort_rows(xp, used, first, second, both, rows), None, valid)
    turned = _sort_rows(xp, used, second, first, None if shifts is None else -shifts, sources)
    return Exclusions(_sort_rows(xp, used, first, second, shifts, rows), turned, valid)


def _sort_rows(xp: _ArrayModule, used: Given, rows: Given, others: Given, shifts: Given, count: int) -> ExcludedRows:
    key = xp.where(used, rows, np.int32(count))
    order = xp.lexsort((others, key))
    starts = xp.searchsorted(key[order], xp.arange(count + 1, dtype=np.int32)).astype(np.int32)
    return ExcludedRows(starts, others[order], None if shifts is None else shifts[order])


def pairs_of_rows(rows: IndexRows) -> Array:
    """Write rows of partners, one for each particle, as pairs, as `exclude` of `jfrnn.search` takes them.

    Args:
        rows: Numbers of particles, shape [n, k], integers; unused places hold -1. A pair may stand in the rows of both or of one.

    Returns:
        Pairs (i, rows[i, ...]), shape [n·k, 2], of the dtype of the rows, or int32 if that cannot number n. Those of
        unused places hold a -1, and exclude nothing.

    Raises:
        TypeError, ValueError: rows are no integers, or have another shape.

    Differentiable: no (integers). Jit: yes. vmap: yes.

    >>> import numpy as np, jfrnn
    >>> jfrnn.pairs_of_rows(np.array([[1, 2], [-1, -1], [-1, -1]])).tolist()
    [[0, 1], [0, 2], [1, -1], [1, -1], [2, -1], [2, -1]]
    """
    given: Given = as_array("rows", rows)
    if not hasattr(given, "dtype") or not np.issubdtype(given.dtype, np.signedinteger) or len(given.shape) != 2:
        told = f"{given.dtype} of shape {list(given.shape)}" if hasattr(given, "dtype") else type(given).__name__
        raise TypeError(f"rows must be signed integers of shape [n, k], got {told}.")
    xp: Any = jnp if isinstance(given, Array) else np
    if given.shape[0] > np.iinfo(given.dtype).max:
        given = given.astype(np.int32)
    own = xp.broadcast_to(xp.arange(given.shape[0], dtype=given.dtype)[:, None], given.shape)
    return xp.stack([own, given], axis=-1).reshape(-1, 2)


class ExcludedCodes(NamedTuple):
    """Rows of sources that queries exclude, as a search looks them up.

    Attributes:
        starts: [m + 1] int32, where the row of a query begins, and at the end where the last one ends.
        others: [k] int32, excluded sources.
        codes: [k] int32, the code of the excluded image, -1 for one that is out of reach; None: all images are excluded.
    """

    starts: Array
    others: Array
    codes: Array | None

    def names(self, sources: int) -> Array:
        """Return `source + sources * code`, or the source, ascending in each row, [k] int32."""
        if self.codes is None:
            return self.others
        return jnp.where(self.codes < 0, np.iinfo(np.int32).max, self.others + sources * self.codes)


def exclude_in_space(rows: ExcludedRows) -> ExcludedCodes:
    """Return rows in open space, where only what is not shifted is there."""
    if rows.shifts is None:
        return ExcludedCodes(rows.starts, rows.others, None)
    return _sorted(rows, jnp.where((rows.shifts == 0).all(axis=1), 0, -1))


def exclude_in_lattice(
    rows: ExcludedRows, lattice: Lattice, wrapped: Wrapped, moved: tuple[Array, Array] | None, systems: Array | None
) -> ExcludedCodes:
    """Return rows in a lattice, or where each system [m] of the queries has one.

    `moved` are the lattice vectors by which sources [n, d] and queries [m, d] were brought near, whole floats; None: rows have no
    shifts. A shift S between
    points as they are given is S - (those of i) + (those of j) between near points, and this, in short vectors if these are
    searched, less the turns of i and more those of j, between wrapped ones. Refused are more names of images than int32 has.
    """
    if rows.shifts is None or moved is None:
        return ExcludedCodes(rows.starts, rows.others, None)
    images, dim, n = lattice.images, lattice.dim, len(wrapped.sources)
    if n * images.total >= 2**31:
        raise ValueError(
            f"exclude with lattice shifts numbers images by int32, and {n} positions have {images.total} each: exclude pairs."
        )
    m = len(rows.starts) - 1
    row = jnp.minimum(rows.row_of_each, m - 1)
    of_sources, of_queries = (x.astype(jnp.int32) for x in moved)
    shifts = rows.shifts - of_queries[row] + of_sources[rows.others]
    periodic = jnp.asarray(lattice.periodic)
    if images.per_system and systems is not None:
        periodic = periodic[systems[row]] if periodic.ndim == 2 else periodic
        numbers = lattice.given[systems[row], dim:].astype(jnp.int32) if images.short else None
    else:
        numbers = None if images.basis is None else jnp.asarray(images.numbers, jnp.int32)
    if numbers is not None:
        cofactors = adjugate(numbers)
        determinant = functools.reduce(jnp.add, (numbers[..., 0, k] * cofactors[..., k, 0] for k in range(dim)))  # 1 or -1
        inverse = cofactors * determinant[..., None, None]
        shifts = functools.reduce(jnp.add, (shifts[:, k, None] * inverse[..., k, :] for k in range(dim)))
    shifts = shifts - unpack_turns(wrapped.query_turns, dim)[row] + unpack_turns(wrapped.turns, dim)[rows.others]
    reach = np.array(images.reach, np.int32)
    there = (jnp.abs(shifts) <= jnp.where(periodic, reach, 0)).all(axis=1)
    return _sorted(rows, jnp.where(there, images.code_of(shifts.T), -1))


def _sorted(rows: ExcludedRows, codes: Array) -> ExcludedCodes:
    """Return rows with their codes, those out of reach at the end of each row, in the order of names."""
    late = jnp.where(codes < 0, np.iinfo(np.int32).max, codes)
    order = jnp.lexsort((rows.others, late, rows.row_of_each))
    return ExcludedCodes(rows.starts, rows.others[order], codes[order])
