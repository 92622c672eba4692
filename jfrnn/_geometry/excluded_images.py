"""Excluded images: which code the image of an excluded pair has in a search, that counts lattice vectors from wrapped positions."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn._geometry.exclusions import ExcludedRows
from jfrnn._geometry.lattice import Lattice
from jfrnn._geometry.wrapping import Wrapped, unpack_turns


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
    rows: ExcludedRows, lattice: Lattice, wrapped: Wrapped, moved: tuple[Array, Array], systems: Array | None
) -> ExcludedCodes:
    """Return rows in a lattice, or where each system [m] of the queries has one.

    `moved` are the lattice vectors by which sources [n, d] and queries [m, d] were brought near, whole floats. A shift S between
    points as they are given is S - (those of i) + (those of j) between near points, and this, in short vectors if these are
    searched, less the turns of i and more those of j, between wrapped ones.

    Raises:
        ValueError: names of images are more than int32 can number.
    """
    if rows.shifts is None:
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
        inverse = _inverse(numbers)
        shifts = functools.reduce(jnp.add, (shifts[:, k, None] * inverse[..., k, :] for k in range(dim)))
    shifts = shifts - unpack_turns(wrapped.query_turns, dim)[row] + unpack_turns(wrapped.turns, dim)[rows.others]
    reach = np.array(images.reach, np.int32)
    there = (jnp.abs(shifts) <= jnp.where(periodic, reach, 0)).all(axis=1)
    code = jnp.zeros_like(row)
    for k in range(dim):
        code = code * (2 * reach[k] + 1) + shifts[:, k] + reach[k]
    return _sorted(rows, jnp.where(there, code, -1))


def _sorted(rows: ExcludedRows, codes: Array) -> ExcludedCodes:
    """Return rows with their codes, those out of reach at the end of each row, in the order of names."""
    late = jnp.where(codes < 0, np.iinfo(np.int32).max, codes)
    order = jnp.lexsort((rows.others, late, rows.row_of_each))
    return ExcludedCodes(rows.starts, rows.others[order], codes[order])


def _inverse(numbers: Array) -> Array:
    """Invert whole numbers [..., d, d] of determinant 1 or -1 by cofactors."""
    rows = [numbers[..., k, :] for k in range(numbers.shape[-1])]
    if len(rows) == 2:
        (a, b), (c, d) = ((row[..., 0], row[..., 1]) for row in rows)
        return jnp.stack([jnp.stack([d, -b], -1), jnp.stack([-c, a], -1)], -2) * (a * d - b * c)[..., None, None]
    columns = [jnp.cross(rows[k - 2], rows[k - 1]) for k in range(3)]
    determinant = functools.reduce(jnp.add, (rows[0][..., k] * columns[0][..., k] for k in range(3)))
    return jnp.stack(columns, axis=-1) * determinant[..., None, None]
