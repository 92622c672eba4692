"""Wrapped coordinates: translate particles into one cell of the lattice and bound the rounding errors that this causes.

No pair is decided on wrapped coordinates; wrapping only limits the number of periodic images to consider. `Wrapped.slack` bounds
the error of coordinates and `Wrapped.reach` includes that of cells. Pairs within these bounds of the cutoff are decided on the
given floats.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.batch import Batch
from jfrnn._geometry.images import LARGEST_TURN
from jfrnn._geometry.lattice import Lattice, add_rows, fractions_of, largest_component, product, translation

_TURN_BITS = 10
NOT_FINITE, TOO_FAR, _MOST_TURNS = 1 << _TURN_BITS, 2 << _TURN_BITS, (1 << _TURN_BITS) - 1


class Wrapped(NamedTuple):
    """Wrapped coordinates of particles, with bounds on their rounding errors; with a box per system, the bounds have an axis more.

    Attributes:
        sources: [n, d] wrapped coordinates, x - turns @ matrix up to rounding; NaN for particles out of range.
        queries: [m, d] likewise; the same array if the sources are the queries.
        turns: [n] int32, the lattice vectors that were subtracted, as `pack_turns` returns them.
        query_turns: [m] int32, likewise.
        slack: [] bound on the error of each component of a displacement of wrapped coordinates, for any shift within reach.
        reach: [d] the largest distance of a pair along each axis, in fractional coordinates (lengths along open axes).
        margin: [d] the part of `reach` that does not depend on the cutoff.
        enough: [] bool, whether no pair needs other images than those considered.
        met: [] int32, the bits `NOT_FINITE` and `TOO_FAR` if there are such particles; the lower bits are the most turns.
        rows: Rows of sources and of queries, if a kernel has brought them near.
    """

    sources: Array
    queries: Array
    turns: Array
    query_turns: Array
    slack: Array
    reach: Array
    margin: Array
    enough: Array
    met: Array
    rows: tuple[Array, Array] | None = None

    @property
    def most_turns(self) -> Array:
        """The largest number of turns along an axis, as a float."""
        return _most_turns(self.met, np.dtype(self.slack.dtype))


class NearRows(NamedTuple):
    """Particles that a kernel has brought near a box.

    Attributes:
        rows: [n, d + 1] their coordinates, and their packed turns, encoded as a float.
        points: [n, d] the coordinates.
        turns: [n] int32, the turns.
        met: [] int32, as in `Wrapped`.
    """

    rows: Array
    points: Array
    turns: Array
    met: Array


def pack_turns(points: Array, lattice: Lattice) -> Array:
    """Return `count_turns`, computed once, so that all users see the same value."""
    return lax.optimization_barrier(count_turns(points, lattice))


def count_turns(points: Array, lattice: Lattice) -> Array:
    """Count the lattice vectors between the cell and each point (0 along open axes): [n] int32, 10 bits per axis.

    The result is -1 for points that are not finite, and -2 for those farther away than `LARGEST_TURN`.
    """
    fractions = jnp.where(lattice.spread(lattice.periodic, 2), fractions_of(points, lattice), 0)
    turns = [jnp.floor(fractions[:, k]) for k in range(lattice.dim)]
    finite = functools.reduce(jnp.logical_and, (jnp.isfinite(points[:, k]) for k in range(lattice.dim)))
    near = functools.reduce(jnp.logical_and, (jnp.abs(x) <= LARGEST_TURN for x in turns), finite)
    parts = [(x.astype(jnp.int32) + (LARGEST_TURN + 1)) << (k * _TURN_BITS) for k, x in enumerate(turns)]
    return jnp.where(near, functools.reduce(jnp.bitwise_or, parts), jnp.where(finite, -2, -1))


def _met(packed: Array, dim: int) -> Array:
    """Return the most turns along an axis, and the bits for points out of range, [] int32.

    This is one reduction, which XLA supports across devices; it has no bitwise one for integers.
    """
    turns = jnp.max(jnp.abs(unpack_turns(packed, dim)), axis=1)
    parts = [turns, jnp.where(packed == -1, NOT_FINITE, 0), jnp.where(packed == -2, TOO_FAR, 0)]
    return functools.reduce(jnp.bitwise_or, jnp.max(jnp.stack([x.astype(jnp.int32) for x in parts]), axis=1, initial=0))


def _joined(met: list[Array]) -> Array:
    """Return what is met of all: the most turns, and the bits of each."""
    most = functools.reduce(jnp.maximum, (x & _MOST_TURNS for x in met))
    return functools.reduce(jnp.bitwise_or, (x & ~_MOST_TURNS for x in met), most)


def _most_turns(met: Array, dtype: np.dtype) -> Array:
    """Return the largest number of turns along an axis, as a float."""
    return (met & _MOST_TURNS).astype(dtype)


def unpack_turns(packed: Array, dim: int) -> Array:
    """Invert `pack_turns`: [..., d] int32, 0 for negative values."""
    places = np.arange(dim, dtype=np.int32) * _TURN_BITS
    parts = packed[..., None] >> places.reshape((1,) * packed.ndim + (dim,))
    return jnp.where(packed[..., None] < 0, 0, (parts & ((1 << _TURN_BITS) - 1)) - (LARGEST_TURN + 1))


def wrap(
    sources: Array,
    queries: Array | None,
    lattice: Lattice,
    radius: np.floating | Array,
    batch: Batch | None = None,
    brought: list[NearRows] | None = None,
) -> Wrapped:
    """Translate particles into one cell of the lattice and bound the rounding errors; `brought`: what kernels know of them.

    Let u be the computed fractional coordinates, R = matrix @ transform - 1 the residual of the transform (periodic columns). Then
    |u_j + S - u_i - (x_j - x_i + S·A) @ transform| is at most the rounding errors of u_i and u_j plus sum |S|·|R|, and |d @
    transform| <= |d|·|column of the transform|. `reach` is the sum of these terms, each rounded up generously.
    """
    dtype, images, dim = np.dtype(sources.dtype), lattice.images, lattice.dim
    periodic = lattice.spread(lattice.periodic, lattice.origin.ndim)
    clouds = [sources] if queries is None else [sources, queries]
    lattices = [lattice] * len(clouds) if batch is None else [lattice.of_rows(x) for x in (batch.sources, batch.of_queries)]
    if brought is None:
        packed = [pack_turns(points, each) for points, each in zip(clouds, lattices, strict=False)]
        found = [_met(turns, dim) for turns in packed]
    else:
        packed, found = [x.turns for x in brought], [x.met for x in brought]
    wrapped = []
    for points, turns, each in zip(clouds, packed, lattices, strict=False):
        off = unpack_turns(turns, dim).astype(dtype)
        moved = jnp.where((off == 0).all(axis=1, keepdims=True), points, points - translation(off, each))
        wrapped.append(jnp.where(turns[:, None] >= 0, moved, jnp.nan))
    met = _joined(found)
    most = _most_turns(met, dtype)

    largest = None
    if not (images.orthogonal or (lattice.flags is None and np.all(periodic))):
        largest = functools.reduce(jnp.maximum, _largest_finite(wrapped, batch, len(lattice.matrix)))
    bounds = bound_wrapping(most, lattice, radius, batch is not None, largest)
    rows = None if brought is None else (brought[0].rows, brought[-1].rows)
    return Wrapped(wrapped[0], wrapped[-1], packed[0], packed[-1], *bounds, met, rows)


class Bounds(NamedTuple):
    """The fields of `Wrapped` that follow from a lattice, a radius and the most turns."""

    slack: Array
    reach: Array
    margin: Array
    enough: Array


def bound_wrapping(
    most: Array, lattice: Lattice, radius: np.floating | Array, per_system: bool = False, largest: Array | None = None
) -> Bounds:
    """Bound the rounding errors of wrapping by at most `most` turns; `largest` coordinates, where lattices do not tell them."""
    dtype, images = np.dtype(lattice.matrix.dtype), lattice.images
    eps, periodic = jnp.finfo(dtype).eps, lattice.spread(lattice.periodic, lattice.origin.ndim)
    matrix, transform = jnp.abs(lattice.matrix), jnp.abs(lattice.transform)
    spans = add_rows(matrix)
    size = jnp.abs(lattice.origin) + (most + 1) * spans  # largest coordinate so many lattice vectors away
    size = size if largest is None else size + largest
    residual = lattice.residual + 8 * eps * product(matrix, transform)
    length = jnp.sqrt(add_rows((transform * radius) ** 2)) * (1 + 16 * eps)
    most_shifts = jnp.asarray(max(images.reach), dtype)
    if per_system:  # those of each system alone
        most_shifts = jnp.minimum(most_shifts, jnp.ceil(largest_component(length)[..., None]) + 1)
    shifts = most + most_shifts + 1
    rounding = 8 * eps * product(size[..., None, :], transform)[..., 0, :] + 2 * shifts * add_rows(residual)
    if images.orthogonal:
        rounding = jnp.where(periodic, rounding, 0)  # cells along open axes use the given coordinates
    margin = 2 * rounding + jnp.where(periodic, 8 * eps, 0)
    reach = length + margin
    most_images = lattice.spread(jnp.asarray(images.reach, dtype), periodic.ndim)
    limit = jnp.where(periodic, 0.5 if images.nearest else most_images, jnp.inf)
    enough = (reach < limit).all(axis=-1) if images.nearest else (reach <= limit).all(axis=-1)
    slack = _wrapping_error(most, most_shifts, lattice)
    return Bounds(slack, reach, margin, enough)


def _wrapping_error(most: Array, reach: Array, lattice: Lattice) -> Array:
    """Bound the error of a component of x_j - x_i from wrapping both by at most `most` turns and moving one to an image.

    Images lie up to `reach` cells away, [] or [systems, 1].

    With u = eps/2: a product t·A with a whole number t has an error of u|t·A|, or none for t = 0, 1, 2; with d such products, d
    times that. Adding a coordinate of the cell costs another u of it. Points that are not wrapped have no error.
    """
    dim, images = lattice.dim, lattice.images
    u = 0.525 * jnp.finfo(lattice.matrix.dtype).eps  # 5 % more than eps/2 covers second-order terms and the rounding of this sum
    spans = add_rows(jnp.abs(lattice.matrix))  # 0 for components to which no lattice vector contributes
    cell = jnp.where(spans > 0, jnp.abs(lattice.origin) + spans, 0)
    products = 1 if images.orthogonal else 2 * dim
    wrapping = jnp.where(most > 0, products * most * spans + cell, 0)
    exact = images.orthogonal & (reach <= 2)
    moving = jnp.where(exact, 0, products * reach) * spans + cell + reach * spans
    return u * largest_component(2 * wrapping + moving)


def _largest_finite(clouds: list[Array], batch: Batch | None, systems: int) -> list[Array]:
    """Return the largest coordinates [d], or [systems, d], of each array of points."""
    sizes = [jnp.where(jnp.isfinite(x), jnp.abs(x), 0) for x in clouds]
    if batch is None:
        return [jnp.max(x, axis=0, initial=0) for x in sizes]
    both = zip(sizes, (batch.sources, batch.of_queries), strict=False)
    return [jnp.zeros((systems, x.shape[1]), x.dtype).at[of].max(x, mode="clip") for x, of in both]
