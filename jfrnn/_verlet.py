"""The Verlet skin: a list of all pairs within cutoff + skin stays complete until something has moved more than half the skin.

If no point moved farther than skin/2 since the list was made, a pair that is closer than the cutoff now was closer than
cutoff + skin then (triangle inequality), so it stands in the list (Verlet 1967, doi:10.1103/PhysRev.159.98).
"""

import dataclasses
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._box import Box, Images, box_change
from jfrnn._exact import Cutoff, make_cutoff, squared_distance, widened


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Verlet:
    """What a list with a skin remembers: where it was made, and how often it was made anew.

    Attributes:
        positions: Sources when the list was last made [length], shape [n, d]; inactive ones are NaN.
        queries: Queries then [length], shape [m, d], or None.
        box: The periodic box then, or None.
        rebuild_count: How often `update` made the list anew, shape [], int32.
    """

    positions: Array
    queries: Array | None
    box: Box | None
    rebuild_count: Array


def list_radius(cutoff: float, skin: float, dtype: np.dtype) -> float:
    """Return cutoff + skin, both of this dtype, rounded up to it: no pair within the exact sum is lost."""
    exact = Fraction(cutoff) + Fraction(skin)
    radius = dtype.type(cutoff) + dtype.type(skin)
    while math.isfinite(radius) and Fraction(float(radius)) < exact:
        radius = np.nextafter(radius, dtype.type(np.inf))
    return float(radius)


def moved_too_far(
    verlet: Verlet, positions: Array, queries: Array | None, box: Box | None, box_kind: Images | None, skin: float
) -> Array:
    """Say whether any point is, or may be by rounding, skin/2 or more from where the list was made, [] bool.

    One pass over the positions. A point that is not finite has no neighbors: it counts as moved when it becomes so or ceases to be.
    A box that changed has moved the images of a pair against each other: that much less of the skin is left for the points.
    """
    half = make_cutoff(skin / 2, np.dtype(positions.dtype), closed=False)
    if box is not None and verlet.box is not None and box_kind is not None:
        points = positions if queries is None else jnp.concatenate([positions, queries])
        half = widened(half, box_change(verlet.box, box, points, box_kind, np.dtype(positions.dtype)) / 4)
    moved = _any_beyond(verlet.positions, positions, half)
    return moved if queries is None or verlet.queries is None else moved | _any_beyond(verlet.queries, queries, half)


def _any_beyond(before: Array, now: Array, half_skin: Cutoff) -> Array:
    near = squared_distance(list((now - before).T), half_skin) < half_skin.inside  # 8 eps inside: surely closer
    there = jnp.isfinite(before).all(axis=1) | jnp.isfinite(now).all(axis=1)
    return jnp.any(there & ~near)


def first_verlet(positions: Array, queries: Array | None, box: Box | None) -> Verlet:
    """Return what a list remembers that was just made."""
    positions, queries, box = lax.stop_gradient((positions, queries, box))
    return Verlet(positions, queries, box, jnp.int32(0))
