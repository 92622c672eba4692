"""The Verlet skin: a list of all pairs within cutoff + skin stays complete until something has moved more than half the skin.

If no point has moved farther than skin/2 since the list was made, a pair that is now closer than the cutoff was then closer than
cutoff + skin (triangle inequality), so it is listed (Verlet 1967, doi:10.1103/PhysRev.159.98).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn import _geometry as geometry
from jfrnn._search.geometry import find_ends
from jfrnn._tracing import portable


@portable
@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Verlet:
    """What a list with a skin keeps of the time when it was last rebuilt.

    Attributes:
        positions: Sources at that time [length], shape [n, d]; inactive ones are infinite, and those that were far away from a
            periodic box have been moved near it (`bring_near`).
        queries: Queries at that time [length], shape [m, d], likewise, or None.
        box: The periodic box at that time, or None.
        radii: Cutoffs per particle at that time, or None with one cutoff.
        rebuild_count: How often `update` rebuilt the list, shape [], int32.
    """

    positions: Array
    queries: Array | None
    box: geometry.Box | None
    radii: geometry.Radii | None
    rebuild_count: Array


def has_moved_too_far(
    verlet: Verlet,
    positions: Array,
    queries: Array | None,
    box: geometry.Box | None,
    box_kind: geometry.Images | None,
    radii: geometry.Radii | None,
    skin: float,
    batch: geometry.Batch | None = None,
) -> Array:
    """Say whether any point is, or may be by rounding, skin/2 or more from where the list was made, [] bool.

    This takes one pass over the positions. A point that is not finite has no neighbors; it counts as moved when it becomes finite
    or ceases to be. Lattice translations do not count, since images stay where they are. A changed box has moved the images of a
    pair against each other, and larger cutoffs reach farther; both reduce the skin that is left for motion. By any rule, a pair's
    cutoff grows by no more than the two cutoffs from which it is made.
    """
    half = geometry.make_cutoff(skin / 2, np.dtype(positions.dtype), closed=False)
    used, grown, moved = jnp.zeros((), positions.dtype), jnp.zeros((), positions.dtype), jnp.zeros((), bool)
    clouds = [(verlet.positions, positions)]
    if queries is not None and verlet.queries is not None:
        clouds.append((verlet.queries, queries))
    old, news = None, [None] * len(clouds)
    if box is not None and verlet.box is not None and box_kind is not None:
        old, new = (geometry.make_lattice(x, box_kind, np.dtype(positions.dtype)) for x in (verlet.box, box))
        news = [new] * len(clouds)
        if box.per_system and batch is not None:
            news, old = [new.of_rows(x) for x in (batch.sources, batch.of_queries)], old.of_rows(batch.sources)
        clouds = [(before, geometry.bring_near(now, each).points) for (before, now), each in zip(clouds, news, strict=False)]
    found = (_find_extremes(*cloud, lattice, half) for cloud, lattice in zip(clouds, news, strict=False))
    extremes = functools.reduce(jnp.maximum, found)
    if old is not None and news[0] is not None:
        below, above = jnp.split(extremes[1:], 2)
        used = geometry.box_change(old, news[0], jnp.where(below + above >= 0, below + above, 0))
    if radii is not None and verlet.radii is not None:
        given = [(verlet.radii.sources, radii.sources), (verlet.radii.queries, radii.queries)]
        if verlet.radii.table is not None and radii.table is not None:  # species stay what they are
            given = [(verlet.radii.table, radii.table)]
            moved = moved | ((verlet.radii.table > 0) != (radii.table > 0)).any()
        for before, now in given:
            if before is not None and now is not None:
                was, stays = geometry.is_radius(before), geometry.is_radius(now)
                moved = moved | (was != stays).any()
                most = jnp.max(jnp.where(was & stays, now - before, 0), initial=0)
                grown = jnp.maximum(grown, most * (1 + 4 * jnp.finfo(most.dtype).eps))
    if box is not None or radii is not None:
        half = geometry.widen(half, (used + grown) / 4)
    return moved | ~(extremes[0] < half.inside)  # `inside` has a margin of 8 eps, so what is below is surely closer


def _find_extremes(before: Array, now: Array, lattice: geometry.Lattice | None, half_skin: geometry.Cutoff) -> Array:
    """Return the largest scaled square of a motion, infinite where rounding leaves it open, in one reduction.

    In a box, behind it come for each axis the largest numbers of lattice vectors that a point lies from the box, backward and
    forward, as `motion_of` counts them.
    """
    axes, sure, home = list((now - before).T), None, None
    if lattice is not None:
        axes, sure, home = geometry.motion_of(before, now, lattice)
    square = geometry.squared_distance(axes, half_skin)
    square = square if sure is None else jnp.where(sure, square, jnp.inf)
    there = jnp.isfinite(before).all(axis=1) | jnp.isfinite(now).all(axis=1)
    rows = [jnp.where(there, square, 0)]
    if home is not None:
        home = home.T.astype(square.dtype)
        rows += [*-home, *home]
    least = [np.array(-np.inf, square.dtype)] * len(rows)
    return jnp.stack(lax.reduce(rows, least, lambda a, b: [lax.max(x, y) for x, y in zip(a, b, strict=True)], (0,)))


def first_verlet(
    positions: Array,
    queries: Array | None,
    box: geometry.Box | None,
    kind: geometry.Images | None,
    radii: geometry.Radii | None,
    batch: geometry.Batch | None,
) -> Verlet:
    """Return the state of a list that was just made."""
    positions, queries, box, radii = lax.stop_gradient((positions, queries, box, radii))
    if box is not None and kind is not None:
        ends = find_ends(positions, positions if queries is None else queries, box, kind, batch, False)
        positions, queries = ends.sources.points, None if queries is None else ends.rows.points
    return Verlet(positions, queries, geometry.plain_box(box), radii, jnp.int32(0))
