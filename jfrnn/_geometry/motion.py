"""Motion: how far particles have moved since a list was made, and how far a change of the box moved periodic images."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.lattice import Lattice, nearest_shifts, translation, units_of
from jfrnn._geometry.wrapping import count_turns, unpack_turns


def motion_of(before: Array, now: Array, lattice: Lattice) -> tuple[list[Array], Array, Array]:
    """Measure the motion of points [n, d] modulo the lattice: a point that was wrapped into the box has not moved.

    Return the magnitude of each component, rounded up, d arrays [n]; whether rounding cannot have changed the translations that
    were subtracted, and S·A is exact for them, [n] bool; and how many lattice vectors each point would lie from the box without
    those translations, [n, d] int32.
    """
    eps = jnp.finfo(now.dtype).eps
    difference, matrix, transform = now - before, jnp.abs(lattice.matrix), jnp.abs(lattice.transform)
    units, turns = units_of(difference, lattice), turns_between(before, now, lattice)
    size, taken = jnp.abs(difference), jnp.abs(turns)
    rounding = 4 * eps * (size + translation(taken, dataclasses.replace(lattice, matrix=matrix)))
    was_turned = (turns != 0).any(axis=1)
    left = jnp.abs(difference - translation(turns, lattice)) + jnp.where(was_turned[:, None], rounding, 0)
    residual = lattice.spread(lattice.residual.sum(axis=-2), 2)
    most = jnp.max(taken, axis=1, keepdims=True, initial=0) + 1
    unsure = 8 * eps * units_of(size, dataclasses.replace(lattice, transform=transform)) + 2 * most * residual
    sure = jnp.where(lattice.spread(lattice.periodic, 2), jnp.abs(units - turns) + unsure < 0.5, True).all(axis=1)
    packed = count_turns(now, lattice)
    home = unpack_turns(packed, lattice.dim) - jnp.clip(turns, -(2.0**20), 2.0**20).astype(jnp.int32)
    return list(left.T), sure & ((packed >= 0) | ~was_turned), home


def turns_between(before: Array, now: Array, lattice: Lattice) -> Array:
    """Count the lattice vectors by which points [n, d] were translated, as by wrapping: whole floats, 0 along open axes."""
    before, now, fixed = lax.stop_gradient((before, now, lattice))
    moved = jnp.where(jnp.isfinite(now - before).all(axis=1, keepdims=True), now - before, 0)
    turns = -nearest_shifts(moved, fixed)
    return turns if lattice.images.orthogonal else _least_motion(moved, (turns, _nearest_planes(moved, fixed), 0 * turns), fixed)


def _least_motion(moved: Array, among: tuple[Array, ...], lattice: Lattice) -> Array:
    """Return the translations that leave the shortest motion; those that come first, where others are no better.

    In a box that is far from reduced, the fractional coordinates of a short motion are long.
    """
    rests = [jnp.sum((moved - translation(turns, lattice)) ** 2, axis=1, keepdims=True) for turns in among]
    best, least = among[0], rests[0]
    for turns, rest in zip(among[1:], rests[1:], strict=True):
        best, least = jnp.where(rest < least, turns, best), jnp.minimum(rest, least)
    return best


def _nearest_planes(moved: Array, lattice: Lattice) -> Array:
    """Return lattice vectors near points [n, d], whole floats: plane by plane, from the last vector on (Babai 1986)."""
    rows = [jnp.asarray(lattice.spread(lattice.matrix[..., k, :], 2)) for k in range(lattice.dim)]
    across: list[Array] = []  # what is orthogonal to the vectors before
    for row in rows:
        across.append(functools.reduce(lambda x, other: x - _along(x, other) * other, across, row))
    turns, rest = [], moved
    for row, normal in zip(reversed(rows), reversed(across), strict=True):
        turns.append(jnp.round(_along(rest, normal)))
        rest = rest - turns[-1] * row
    return jnp.concatenate(turns[::-1], axis=1)


def _along(points: Array, normal: Array) -> Array:
    """Return how often a vector fits into points along it, [n, 1]; 0 for a vector of length 0."""
    square = jnp.sum(normal**2, axis=-1, keepdims=True)
    return jnp.sum(points * normal, axis=-1, keepdims=True) / jnp.where(square > 0, square, 1)


def box_change(before: Lattice, now: Lattice, spans: Array) -> Array:
    """Bound the change in displacement that a changed box, or the one of any row, causes for any pair within reach.

    `spans` [d] tells how many lattice vectors lie between the cells of two points at most, as `motion_of` counts them.
    """
    dtype = now.matrix.dtype
    eps = jnp.finfo(dtype).eps
    moved = jnp.sqrt(jnp.sum((now.matrix - before.matrix) ** 2, axis=-1)) * (1 + 16 * eps)
    if now.images.counts_short:  # short vectors carry a rounding error
        moved = jnp.where(moved > 0, moved + 4 * eps * jnp.sum(jnp.abs(now.matrix), axis=-1), moved)
    cells = spans + np.array(now.images.reach, dtype)
    return jnp.max(jnp.sum(now.spread(cells, moved.ndim) * moved, axis=-1))
