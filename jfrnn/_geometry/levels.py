"""Cells of many sizes, for cutoffs that differ from particle to particle: a large one must not make all others pay.

Sources stand in cells as wide as the largest cutoff (`jfrnn._geometry.cells`). Within such a top cell they are sorted by group,
those whose cutoffs lie between the same powers of two, and then along a Morton curve, which halves the cell up to 7 times: at each
level, the sources of a group in a cell are one contiguous run. A query looks, for each group, at the 3^d cells around it at the
finest level whose cells are wider than what the rule lets the group reach. Its candidates are thereby, up to a constant, as many as
there are particles within that reach, whatever the cutoffs of others: no (largest/smallest)^d.
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

HALVINGS = 7  # of a top cell, along each axis
GROUPS = 8  # of cutoffs, by powers of two below the largest; the last one holds all that are smaller still


class Axes(NamedTuple):
    """How top cells are cut, and how far a cutoff r reaches along each axis: `scale`·r + `margin`, [d] each."""

    cells: CellAxes
    scale: Array
    margin: Array


class Levels(NamedTuple):
    """Sources and queries in the order in which they are walked, and what is needed to find the sources of a group in a cell.

    Attributes:
        order: [n] int32, the source at each place.
        query_order: [m] int32, likewise; the same where the sources are the queries.
        grid: The top cells of the sources.
        keys: [n] uint32 in order: group, then the place within the top cell along the Morton curve.
        query_top: [d, m] int32, the top cell of each query; [d + 1, m] where systems are told apart.
        query_place: [d, m] int32, the finest cell within it, counted from 0 along each axis.
        largest: [GROUPS] the largest cutoff of each group, -1 where there is none; None: the rule asks for no cutoffs of sources,
            and all are one group.
        passes: [] int32, groups that are in use; None likewise.
        widths: [d] of top cells.
        axes: What a cutoff reaches, in the units of the widths.
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
    """Sort n sources, and the queries unless the sources are `own` queries, whose coordinates along the axes are [d, n + m].

    `batch` [n + m] uint32 are the systems to which they belong.
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
    """Return what finds the runs of candidates of queries at some places in one group, as `jfrnn._engine.runs.Runs`."""
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
    """Number the finest cells within the top cell of each coordinate from 0 on, exactly: halves of a cell are cells themselves."""
    finest = 1 << HALVINGS
    if turns is not None:
        scaled = x * turns
        part = (scaled - jnp.clip(jnp.floor(scaled), 0, turns - 1)) * finest
    else:
        part = cell_coordinate(cell_remainder(x, edge), edge / finest)
        part = jnp.where(x < 0, finest - 1 - part, part)  # below 0, cells are mirrored
    return jnp.clip(jnp.floor(part), 0, finest - 1).astype(jnp.int32)


def _groups(radii: Array, largest: Array) -> Array:
    """Return how many powers of two lie between each cutoff and the largest one, [n] uint32, at most GROUPS - 1."""
    unsigned, nmant = (jnp.uint32, 23) if radii.dtype == jnp.float32 else (jnp.uint64, 52)

    def exponent(x: Array) -> Array:
        return (lax.bitcast_convert_type(x, unsigned) >> unsigned(nmant)).astype(jnp.int32)

    return jnp.clip(exponent(largest) - exponent(radii), 0, GROUPS - 1).astype(jnp.uint32)


def _morton(axes: list[Array]) -> Array:
    return functools.reduce(jnp.bitwise_or, (spread(c, len(axes)) << np.uint32(k) for k, c in enumerate(axes)))


def _finest_level(reach: Array, widths: Array, axes: Axes) -> Array:
    """Return the finest level whose cells are wider than a reach [b], along every axis: [b] int32; 0 are the top cells."""
    along = reach[:, None] * axes.scale[None] + axes.margin[None]
    fits = [((widths * 2.0**-level)[None] > along).all(axis=1).astype(jnp.int32) for level in range(1, HALVINGS + 1)]
    return functools.reduce(jnp.add, fits)


class _Around(NamedTuple):
    """Cells around queries, [b, r] each: the top cells that hold them (one array per axis), their first keys, their images."""

    top: list[Array]
    key: Array
    image: Array | None
    there: Array


def _cells_around(top: Array, place: Array, level: Array, extent: Array, images: Images | None) -> _Around:
    """Return the cells around queries [d, b] at their level [b]; many steps of top cells where images lie so close."""
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
    """Return the first place in [low, high) whose key is not below the target, for places [b, r] and targets [2, b, r]."""

    def halve(bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = low + (high - low) // 2
        right = (keys.at[middle].get(mode="clip") < target) & (low < high)
        return jnp.where(right, middle + 1, low), jnp.where(right, high, middle)

    bounds = jnp.broadcast_to(low, target.shape), jnp.broadcast_to(jnp.maximum(low, high), target.shape)
    return lax.while_loop(lambda bounds: jnp.any(bounds[0] < bounds[1]), halve, bounds)[0]
