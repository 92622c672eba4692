"""Cells of many sizes, for cutoffs per particle: a few large cutoffs must not slow down all other particles.

Sources are sorted into top cells as wide as the largest cutoff (`jfrnn._geometry.cells`). Within a top cell they are sorted by
group, a range of cutoffs between two powers of two, and then along a Morton curve that halves the cell up to 7 times. So at each
level, the sources of a group in a cell form one contiguous run. For each group, a query visits the 3^d cells around it at the
finest level whose cells are wider than the cutoff of such pairs. The number of candidates is thereby proportional to the number of
particles within that cutoff, whatever the cutoffs of other particles; no factor (largest / smallest)^d arises.
"""

import functools
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.cells import (
    CellAxes,
    Grid,
    build_grid,
    cell_coordinate,
    cell_order,
    cell_remainder,
    grid_coordinates,
    places_between,
)
from jfrnn._geometry.curves import spread
from jfrnn._geometry.cutoffs import Cutoffs
from jfrnn._geometry.images import Images

HALVINGS = 7  # levels below a top cell, each halving its edges
GROUPS = 8  # ranges of cutoffs, by powers of two below the largest; the last one holds all smaller ones


class Axes(NamedTuple):
    """How axes are divided into top cells, and how far a cutoff r reaches along each of them: `scale`·r + `margin`, [d] each."""

    cells: CellAxes
    scale: Array
    margin: Array


class Levels(NamedTuple):
    """Sources and queries in the order in which they are visited, and the tables that find the sources of a group in a cell.

    Attributes:
        order: [n] int32, the source at each position of the order.
        query_order: [m] int32, likewise for queries; the same array if the sources are the queries.
        grid: The top cells of the sources.
        keys: [n] uint32 in that order: the group, then the Morton key within the top cell.
        query_top: [d, m] int32, the top cell of each query; [d + 1, m] with a batch.
        query_place: [d, m] int32, the finest cell of each query within its top cell, counted from 0 along each axis.
        largest: [GROUPS] largest cutoff of each group, -1 if empty; None if the rule does not use cutoffs of sources, which then
            form one group.
        passes: [] int32, the number of groups to visit; None likewise.
        widths: [d] widths of the top cells.
        axes: How axes are divided, in the units of the widths.
    """

    order: Array
    query_order: Array
    grid: Grid
    keys: Array
    query_top: Array
    query_place: Array
    largest: Array | None
    passes: Array | None
    widths: Array
    axes: Axes


def sort_by_levels(along: Array, axes: Axes, cutoffs: Cutoffs, n: int, own: bool, batch: Array | None = None) -> Levels:
    """Sort n sources, and separate queries if not `own`; coordinates of all of them along the axes are [d, n + m].

    `batch` [n + m] uint32 holds their system numbers.
    """
    dim, total = along.shape
    finite = jnp.isfinite(along).all(axis=0)
    top, extent = grid_coordinates(along, axes.cells, finite, batch)
    place = jnp.stack([_place_in_cell(*axis) for axis in zip(along, axes.cells.edges, axes.cells.turns, strict=True)])
    place = jnp.where(finite, place, 0)
    widths = jnp.stack([edge if turn is None else 1 / turn for edge, turn in zip(axes.cells.edges, axes.cells.turns, strict=True)])

    group = jnp.zeros(n, jnp.uint32) if cutoffs.sources is None else _groups(cutoffs.sources, cutoffs.largest)
    key = (group << np.uint32(HALVINGS * dim)) | _morton(list(place[:, :n].astype(jnp.uint32)))
    _, by_key = lax.sort((key, lax.iota(jnp.int32, n)), num_keys=1, is_stable=True)
    grid = build_grid(top[:, :n][:, by_key], finite[:n][by_key], extent, total)
    order = by_key[grid.order]
    keys = key[order]
    query_order = order if own else cell_order(top[:, n:], finite[n:], extent, grid.dense)
    at = query_order if own else n + query_order
    largest, passes = None, None
    if cutoffs.sources is not None:
        radii = jnp.where(finite[:n], cutoffs.sources, -1)
        largest = jnp.full(GROUPS, -1, radii.dtype).at[group].max(radii)
        passes = jnp.max(jnp.where(finite[:n], group.astype(jnp.int32) + 1, 0), initial=0)

    return Levels(order, query_order, grid, keys, top[:, at], place[:, at], largest, passes, widths, axes)


def level_runs(
    levels: Levels, cutoffs: Cutoffs, images: Images | None
) -> Callable[[Array, Array], tuple[Array, Array, Array | None]]:
    """Return a function that finds the candidate runs of queries in one group, as `jfrnn._engine.candidates.Runs`."""
    dim, keys, largest = len(levels.widths), levels.keys, levels.largest
    query_radii = None if cutoffs.queries is None else cutoffs.queries[levels.query_order]

    def runs(places: Array, which: Array) -> tuple[Array, Array, Array | None]:
        of_query = None if query_radii is None else query_radii.at[places].get(mode="promise_in_bounds")
        of_group = None if largest is None else jnp.broadcast_to(jnp.maximum(largest[which], 0), places.shape)
        radii = cutoffs.of_pairs(of_query, of_group)
        reach = functools.reduce(jnp.add, radii) / len(radii) * (1 + 4 * jnp.finfo(radii[0].dtype).eps)
        level = _finest_level(reach, levels.widths, levels.axes)
        first = which.astype(jnp.uint32) << np.uint32(HALVINGS * dim)
        around = _cells_around(levels.query_top[:, places], levels.query_place[:, places], level, levels.grid.extent, images)
        start, stop = places_between(levels.grid, [around.top[0], *around.top])
        size = (np.uint32(1) << (dim * (HALVINGS - level)).astype(jnp.uint32))[:, None]
        lowest = first | around.key
        bounds = _lower_bound(keys, jnp.stack([lowest, lowest + size]), start, stop)
        return bounds[0], jnp.where(around.there, bounds[1], bounds[0]), around.image

    return runs


def _place_in_cell(x: Array, edge: Array, turns: Array | None) -> Array:
    """Number the finest cells within each coordinate's top cell from 0, exactly: halves of a cell are cells themselves."""
    finest = 1 << HALVINGS
    if turns is not None:
        scaled = x * turns
        part = (scaled - jnp.clip(jnp.floor(scaled), 0, turns - 1)) * finest
    else:
        part = cell_coordinate(cell_remainder(x, cell_coordinate(x, edge), edge), edge / finest)
        part = jnp.where(x < 0, finest - 1 - part, part)  # below 0, cells are mirrored
    return jnp.clip(jnp.floor(part), 0, finest - 1).astype(jnp.int32)


def _groups(radii: Array, largest: Array) -> Array:
    """Return the group of each cutoff, [n] uint32: its binary exponent below that of the largest, at most GROUPS - 1."""
    unsigned, nmant = (jnp.uint32, 23) if radii.dtype == jnp.float32 else (jnp.uint64, 52)

    def exponent(x: Array) -> Array:
        return (lax.bitcast_convert_type(x, unsigned) >> unsigned(nmant)).astype(jnp.int32)

    return jnp.clip(exponent(largest) - exponent(radii), 0, GROUPS - 1).astype(jnp.uint32)


def _morton(axes: list[Array]) -> Array:
    return functools.reduce(jnp.bitwise_or, (spread(c, len(axes)) << np.uint32(k) for k, c in enumerate(axes)))


def _finest_level(reach: Array, widths: Array, axes: Axes) -> Array:
    """Return the finest level whose cells are wider than the cutoffs [b] along every axis: [b] int32; level 0 are the top cells."""
    along = reach[:, None] * axes.scale[None] + axes.margin[None]
    fits = [((widths * 2.0**-level)[None] > along).all(axis=1).astype(jnp.int32) for level in range(1, HALVINGS + 1)]
    return functools.reduce(jnp.add, fits)


class _Around(NamedTuple):
    """Cells around queries, [b, r] each: their top cells (one array per axis), first keys and image codes, and which ones exist."""

    top: list[Array]
    key: Array
    image: Array | None
    there: Array


def _cells_around(top: Array, place: Array, level: Array, extent: Array, images: Images | None) -> _Around:
    """Return the cells around queries [d, b] at their level [b]; in small boxes these span several periodic images."""
    reach = (0,) * len(place) if images is None else images.reach
    steps = [np.arange(-max(k, 1), max(k, 1) + 1, dtype=np.int32) for k in reach]
    which = np.array(list(product(*(range(len(axis)) for axis in steps)))).T  # [d, r]
    cells, within, code, there = [], [], jnp.zeros((level.size, which.shape[1]), jnp.int32), jnp.ones((), bool)
    for k, step in enumerate(steps):
        fine = (place[k] >> (HALVINGS - level))[:, None] + step[None]
        cell = top[k][:, None] + (fine >> level[:, None])
        turn = jnp.zeros_like(cell) if reach[k] == 0 else cell // extent[k]
        far = (np.abs(step) > 1)[None] & (level[:, None] > 0)
        cells.append((cell - turn * extent[k])[:, which[k]])
        within.append((fine & ((1 << level[:, None]) - 1)).astype(jnp.uint32)[:, which[k]])
        code = code * (2 * reach[k] + 1) + (turn + reach[k])[:, which[k]]
        there = there & ~far[:, which[k]] & (jnp.abs(turn) <= max(reach[k], 1))[:, which[k]]
    cells += [jnp.broadcast_to(system[:, None], code.shape) for system in top[len(place) :]]
    key = _morton(within) << (len(place) * (HALVINGS - level)).astype(jnp.uint32)[:, None]
    return _Around(cells, key, None if images is None else code, there)


def _lower_bound(keys: Array, target: Array, low: Array, high: Array) -> Array:
    """Return the first index in [low, high) whose key is not below the target, for indices [b, r] and targets [2, b, r]."""

    def halve(bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = low + (high - low) // 2
        right = (keys.at[middle].get(mode="clip") < target) & (low < high)
        return jnp.where(right, middle + 1, low), jnp.where(right, high, middle)

    bounds = jnp.broadcast_to(low, target.shape), jnp.broadcast_to(jnp.maximum(low, high), target.shape)
    return lax.while_loop(lambda bounds: jnp.any(bounds[0] < bounds[1]), halve, bounds)[0]
