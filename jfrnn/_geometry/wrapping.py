"""Wrapping: particles brought into one cell of the lattice, and bounds on what rounding does there.

No pair is decided on wrapped coordinates. Wrapping only brings particles into one cell, so that few images need be looked at.
`Wrapped.slack` bounds the rounding of coordinates and `Wrapped.reach` that of cells. Whatever lies within these bounds of the
cutoff is decided on the given floats.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.images import LARGEST_TURN
from jfrnn._geometry.lattice import Lattice, fractions_of, product, translation

_TURN_BITS = 10
NOT_FINITE, TOO_FAR = 1 << _TURN_BITS, 2 << _TURN_BITS


class Wrapped(NamedTuple):
    """Particles in one cell of the lattice, and what rounding may have done on the way.

    Attributes:
        sources: [n, d] wrapped, near enough: x - turns @ matrix but for rounding; NaN where they are out of range.
        queries: [m, d] likewise; the sources again where they are the queries.
        turns: [n] int32, see `pack_turns`.
        query_turns: [m] int32.
        slack: [] bound on the error of a component of a difference of wrapped coordinates, with a shift within reach.
        reach: [d] half the width of the stencil, in units of the transform: no pair is farther apart along an axis.
        margin: [d] of the reach, what does not depend on the radius.
        enough: [] bool: the images that are looked at are all that there can be.
        met: [] int32, the bits `NOT_FINITE` and `TOO_FAR` where there is such a particle; the lower bits are of turns.
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


def pack_turns(points: Array, lattice: Lattice) -> Array:
    """Count the lattice vectors between the cell and each point, 0 along open axes: [n] int32, 10 bits for each axis.

    -1 where a point is not finite, -2 where it is farther away than `LARGEST_TURN`.
    """
    fractions, periodic = fractions_of(points, lattice), lattice.images.periodic
    turns = [jnp.floor(fractions[:, k]) if p else jnp.zeros_like(fractions[:, k]) for k, p in enumerate(periodic)]
    finite = functools.reduce(jnp.logical_and, (jnp.isfinite(points[:, k]) for k in range(lattice.dim)))
    near = functools.reduce(jnp.logical_and, (jnp.abs(x) <= LARGEST_TURN for x in turns), finite)
    parts = [(x.astype(jnp.int32) + (LARGEST_TURN + 1)) << (k * _TURN_BITS) for k, x in enumerate(turns)]
    packed = jnp.where(near, functools.reduce(jnp.bitwise_or, parts), jnp.where(finite, -2, -1))
    return lax.optimization_barrier(packed)  # computed once, so that whoever asks gets the same


def _met(packed: Array, dim: int) -> Array:
    """Return the largest number of turns, and the bits of what is none, [] int32.

    Reductions that any number of devices can do together: XLA has no bitwise one of integers for that.
    """
    most = jnp.max(jnp.abs(unpack_turns(packed, dim)), initial=0)
    nowhere, far = jnp.any(packed == -1), jnp.any(packed == -2)
    return most | jnp.where(nowhere, NOT_FINITE, 0).astype(jnp.int32) | jnp.where(far, TOO_FAR, 0).astype(jnp.int32)


def unpack_turns(packed: Array, dim: int) -> Array:
    """Read what `pack_turns` wrote: [..., d] int32, 0 where it is negative."""
    places = np.arange(dim, dtype=np.int32) * _TURN_BITS
    parts = packed[..., None] >> places.reshape((1,) * packed.ndim + (dim,))
    return jnp.where(packed[..., None] < 0, 0, (parts & ((1 << _TURN_BITS) - 1)) - (LARGEST_TURN + 1))


def wrap(sources: Array, queries: Array | None, lattice: Lattice, radius: np.floating | Array) -> Wrapped:
    """Bring particles into one cell of the lattice, and bound what rounding does.

    With u the computed units of the transform, u' the exact ones of the same transform, and R = matrix @ transform - 1 its
    residual (periodic columns), |u_j + S - u_i - (x_j - x_i + S·A) @ transform| is at most the rounding of u_i and u_j and
    sum |S|·|R|; and |d @ transform| <= |d|·|column of the transform|. `reach` adds these up, each rounded up generously.
    """
    dtype, images, dim = np.dtype(sources.dtype), lattice.images, lattice.dim
    eps, periodic = jnp.finfo(dtype).eps, np.array(images.periodic)
    clouds = [sources] if queries is None else [sources, queries]
    packed, wrapped = [pack_turns(points, lattice) for points in clouds], []
    for points, turns in zip(clouds, packed, strict=True):
        off = unpack_turns(turns, dim).astype(dtype)
        moved = jnp.where((off == 0).all(axis=1, keepdims=True), points, points - translation(off, lattice))
        wrapped.append(jnp.where(turns[:, None] >= 0, moved, jnp.nan))
    met = functools.reduce(jnp.bitwise_or, (_met(turns, dim) for turns in packed))
    most = (met & LARGEST_TURN).astype(dtype)  # at least as many as the largest number of turns, less than twice as many

    matrix, transform = jnp.abs(lattice.matrix), jnp.abs(lattice.transform)
    spans = matrix.sum(axis=0)
    size = jnp.abs(lattice.origin) + (most + 1) * spans  # of what lies so many lattice vectors away
    if not (images.orthogonal or periodic.all()):
        finite = [jnp.max(jnp.abs(x), axis=0, initial=0, where=jnp.isfinite(x)) for x in wrapped]
        size = size + functools.reduce(jnp.maximum, finite)
    residual = jnp.abs(product(lattice.matrix, lattice.transform) - jnp.diag(jnp.asarray(periodic, dtype)))
    residual = residual + 8 * eps * product(matrix, transform)
    shifts = most + max(images.reach) + 1
    rounding = 8 * eps * product(size[None], transform)[0] + 2 * shifts * residual.sum(axis=0)
    if images.orthogonal:
        rounding = jnp.where(periodic, rounding, 0)  # open axes are walked in raw coordinates
    length = jnp.sqrt(jnp.sum((transform * radius) ** 2, axis=0)) * (1 + 16 * eps)
    margin = 2 * rounding + jnp.where(periodic, 8 * eps, 0)
    reach = length + margin
    limit = jnp.where(periodic, 0.5 if images.nearest else jnp.asarray(images.reach, dtype), jnp.inf)
    enough = (reach < limit).all() if images.nearest else (reach <= limit).all()
    slack = _wrapping_error(most, lattice)
    return Wrapped(wrapped[0], wrapped[-1], packed[0], packed[-1], slack, reach, margin, enough, met)


def _wrapping_error(most: Array, lattice: Lattice) -> Array:
    """Bound the error of a component of x_j - x_i that wrapping both, by at most so many turns, and moving one to an image made.

    In units of u = eps/2: t·A of whole numbers takes u|t·A|, nothing for 0, 1, 2, and d times that where d such products add up;
    the sum with a coordinate of the cell takes u of it. What is not wrapped loses nothing.
    """
    dim, images = lattice.dim, lattice.images
    u = 0.525 * jnp.finfo(lattice.matrix.dtype).eps  # a twentieth more than half: for second orders, and for this sum
    spans = jnp.abs(lattice.matrix).sum(axis=0)  # 0 for components that no lattice vector has
    cell = jnp.where(spans > 0, jnp.abs(lattice.origin) + spans, 0)
    products = 1 if images.orthogonal else 2 * dim
    wrapping = jnp.where(most > 0, products * most * spans + cell, 0)
    reach = max(images.reach)
    moving = (0 if images.orthogonal and reach <= 2 else products * reach) * spans + cell + reach * spans
    return u * jnp.max(2 * wrapping + moving, initial=0)
