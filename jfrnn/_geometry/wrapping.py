"""Wrapped coordinates: translate particles into one cell of the lattice and bound the rounding errors that this causes.

No pair is decided on wrapped coordinates; wrapping only limits the number of periodic images to consider. `Wrapped.slack` bounds
the error of coordinates and `Wrapped.reach` includes that of cells. Pairs within these bounds of the cutoff are decided on the
given floats.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.batch import Batch
from jfrnn._geometry.box import Box, round_box
from jfrnn._geometry.images import LARGEST_TURN, Images
from jfrnn._geometry.lattice import (
    KnownBox,
    Lattice,
    add_rows,
    fractions_of,
    is_valid,
    largest_component,
    make_lattice,
    pack_lattice,
    product,
    translation,
)
from jfrnn._tracing import Internal, at_once, compile_program, own_transfers, without_mesh

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
        enough: [] bool, whether no pair needs other images than those considered, in a lattice that is one.
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
    box: Box | None = None,
) -> Wrapped:
    """Translate particles into one cell of the lattice and bound the rounding errors.

    `brought` is what kernels know of the particles; `box` may know what lattice and radius tell of the errors.

    Let u be the computed fractional coordinates, R = matrix @ transform - 1 the residual of the transform (periodic columns). Then
    |u_j + S - u_i - (x_j - x_i + S·A) @ transform| is at most the rounding errors of u_i and u_j plus sum |S|·|R|, and |d @
    transform| <= |d|·|column of the transform|. `reach` is the sum of these terms, each rounded up generously.
    """
    dtype, dim = np.dtype(sources.dtype), lattice.dim
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

    known = None if box is None else _bounding_of(box)
    if not (lattice.images.orthogonal or (lattice.flags is None and all(lattice.images.periodic))):
        largest = functools.reduce(jnp.maximum, _largest_finite(wrapped, batch, len(lattice.matrix)))
        known = find_bounding(lattice, radius, batch is not None, largest)
    bounds = bound_wrapping(most, lattice, known or find_bounding(lattice, radius, batch is not None))
    rows = None if brought is None else (brought[0].rows, brought[-1].rows)
    return Wrapped(wrapped[0], wrapped[-1], packed[0], packed[-1], *bounds, met, rows)


class Bounding(NamedTuple):
    """What bounds the rounding errors of wrapping, but for how many turns there are: all that a lattice and a radius tell.

    Attributes:
        valid: [] bool, whether the lattice is finite, its vectors independent and its lengths positive.
        length: [d] the radius in fractional coordinates (lengths along open axes).
        rounding: [d] the error of fractional coordinates without a turn, in units of which `more` come for each turn.
        more: [d] likewise.
        cell: [d] the largest coordinate of the cell, 0 along components to which no lattice vector contributes.
        wrapping: [d] the error of a component from a turn, in units of eps/2.
        moving: [d] the error of a component from moving to an image, likewise.
    """

    valid: Array
    length: Array
    rounding: Array
    more: Array
    cell: Array
    wrapping: Array
    moving: Array


class Bounds(NamedTuple):
    """The fields of `Wrapped` that follow from a lattice, a radius and the most turns."""

    slack: Array
    reach: Array
    margin: Array
    enough: Array


def find_bounding(
    lattice: Lattice, radius: np.floating | Array, per_system: bool = False, largest: Array | None = None
) -> Bounding:
    """Return what bounds the rounding errors of wrapping; `largest` coordinates, where lattices do not tell them.

    With u = eps/2: a product t·A with a whole number t has an error of u|t·A|, or none for t = 0, 1, 2; with d such products, d
    times that. Adding a coordinate of the cell costs another u of it. Points that are not wrapped have no error.
    """
    dtype, images, dim = np.dtype(lattice.matrix.dtype), lattice.images, lattice.dim
    eps, periodic = jnp.finfo(dtype).eps, lattice.spread(lattice.periodic, lattice.origin.ndim)
    matrix, transform = jnp.abs(lattice.matrix), jnp.abs(lattice.transform)
    spans = add_rows(matrix)  # 0 for components to which no lattice vector contributes
    size = jnp.abs(lattice.origin) + spans  # of coordinates of the cell
    known = size if largest is None else size + largest
    residual = lattice.residual + 8 * eps * product(matrix, transform)
    length = jnp.sqrt(add_rows((transform * radius) ** 2)) * (1 + 16 * eps)
    reach = jnp.asarray(max(images.reach), dtype)
    if per_system:  # those of each system alone
        reach = jnp.minimum(reach, jnp.ceil(largest_component(length)[..., None]) + 1)
    doubled = 2 * add_rows(residual)
    more = 8 * eps * product(spans[..., None, :], transform)[..., 0, :] + doubled
    rounding = 8 * eps * product(known[..., None, :], transform)[..., 0, :] + (reach + 1) * doubled
    if images.orthogonal:
        rounding, more = (jnp.where(periodic, x, 0) for x in (rounding, more))  # cells along open axes use the given coordinates
    cell = jnp.where(spans > 0, size, 0)
    products = 1 if images.orthogonal else 2 * dim
    moving = jnp.where(images.orthogonal & (reach <= 2), 0, products * reach) * spans + cell + reach * spans
    return Bounding(is_valid(lattice), length, rounding, more, cell, products * spans, moving)


def bound_wrapping(most: Array, lattice: Lattice, known: Bounding) -> Bounds:
    """Bound the rounding errors of wrapping by at most `most` turns."""
    eps, images = jnp.finfo(lattice.matrix.dtype).eps, lattice.images
    periodic = lattice.spread(lattice.periodic, lattice.origin.ndim)
    margin = 2 * (known.rounding + most * known.more) + jnp.where(periodic, 8 * eps, 0)
    reach = known.length + margin
    most_images = lattice.spread(jnp.asarray(images.reach, lattice.matrix.dtype), periodic.ndim)
    limit = jnp.where(periodic, 0.5 if images.nearest else most_images, jnp.inf)
    enough = (reach < limit).all(axis=-1) if images.nearest else (reach <= limit).all(axis=-1)
    wrapping = jnp.where(most > 0, most * known.wrapping + known.cell, 0)
    # 5 % more than eps/2 covers second-order terms and the rounding of this sum
    slack = 0.525 * eps * largest_component(2 * wrapping + known.moving)
    return Bounds(slack, reach, margin, enough & known.valid)


def known_box(box: Box, images: Images, dtype: np.dtype, radius: np.floating | Array | None) -> Box:
    """Return a box, rounded to a dtype; where the host has its numbers, with what is known of it, which further calls take."""
    arrays, structure = jax.tree.flatten(box)
    if box.per_system or not all(isinstance(x, np.ndarray) for x in arrays):
        return round_box(box, dtype)
    known = tuple((np.asarray(x, dtype).tobytes(), x.shape) for x in arrays)
    with own_transfers(), without_mesh(), at_once():
        return _known_box(structure, known, images, np.dtype(dtype), radius if isinstance(radius, np.floating) else None)


@functools.lru_cache(maxsize=64)
def _known_box(structure: Internal, known: tuple, images: Images, dtype: np.dtype, radius: np.floating | None) -> KnownBox:
    box = jax.tree.unflatten(structure, [np.frombuffer(data, dtype).reshape(shape) for data, shape in known])
    return _find(box, images, radius)


def find_known(box: Box | None, images: Images | None, radius: np.floating | Array | None) -> Box | None:
    """Return a box with what is found of it, if that is not known yet; one per system, and none, as it is."""
    if box is None or images is None or box.per_system or isinstance(box, KnownBox):
        return box
    return _find(box, images, radius)


@functools.partial(compile_program, static_argnames="images")
def _find(box: Box, images: Images, radius: np.floating | Array | None) -> KnownBox:
    """Return a box of no system, with its lattice and, with a radius, what bounds the rounding errors of wrapping."""
    lattice = make_lattice(box, images, np.dtype(box.vectors.dtype))
    bounding = [] if radius is None else [x.astype(box.vectors.dtype).reshape(-1) for x in find_bounding(lattice, radius)]
    return KnownBox.of(box, jnp.concatenate([*pack_lattice(lattice), *bounding]))


def _bounding_of(box: Box) -> Bounding | None:
    """Return what a box that is known tells of rounding errors."""
    d = box.dim
    if not isinstance(box, KnownBox) or box.found.shape[-1] == 3 * d * d + d:
        return None
    valid, *others = jnp.split(box.found[3 * d * d + d :], [1 + k * d for k in range(6)])
    return Bounding(valid[0] != 0, *others)


def _largest_finite(clouds: list[Array], batch: Batch | None, systems: int) -> list[Array]:
    """Return the largest coordinates [d], or [systems, d], of each array of points."""
    sizes = [jnp.where(jnp.isfinite(x), jnp.abs(x), 0) for x in clouds]
    if batch is None:
        return [jnp.max(x, axis=0, initial=0) for x in sizes]
    both = zip(sizes, (batch.sources, batch.of_queries), strict=False)
    return [jnp.zeros((systems, x.shape[1]), x.dtype).at[of].max(x, mode="clip") for x, of in both]
