"""Cells of many sizes, for cutoffs per particle: a few large cutoffs must not slow down all other particles.

Sources are sorted into top cells as wide as the largest cutoff (`jfrnn._geometry.cells`). Within a top cell they are sorted by
group, a range of cutoffs between two powers of two, and then along a Morton curve that halves the cell up to 17 times. So at each
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
from jfrnn._geometry.curves import Words, morton_words
from jfrnn._geometry.cutoffs import Cutoffs
from jfrnn._geometry.images import Images

HALVINGS = 17  # levels below a top cell, each halving its edges: cutoffs may differ by a factor of 100 000
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
        keys: In that order the group, then the Morton key within the top cell, in two words, the higher first: [n] uint32 each.
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
    keys: Words
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
    total = along.shape[1]
    finite = jnp.isfinite(along).all(axis=0)
    top, extent = grid_coordinates(along, axes.cells, finite, batch)
    place = jnp.stack([_place_in_cell(*axis) for axis in zip(along, axes.cells.edges, axes.cells.turns, strict=True)])
    place = jnp.where(finite, place, 0)
    widths = jnp.stack([edge if turn is None else 1 / turn for edge, turn in zip(axes.cells.edges, axes.cells.turns, strict=True)])

    group = jnp.zeros(n, jnp.uint32) if cutoffs.sources is None else groups_of(cutoffs.sources, cutoffs.largest, GROUPS)
    high, low = _key_of(group, list(place[:, :n].astype(jnp.uint32)))
    _, by_low = lax.sort((low, lax.iota(jnp.int32, n)), num_keys=1, is_stable=True)
    _, by_key = lax.sort((high[by_low], by_low), num_keys=1, is_stable=True)
    grid = build_grid(top[:, :n][:, by_key], finite[:n][by_key], extent, total)
    order = by_key[grid.order]
    keys = high[order], low[order]
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
        query_top, query_place = levels.query_top[:, places], levels.query_place[:, places]
        around = _cells_around(which, query_top, query_place, level, levels.grid.extent, images)
        start, stop = places_between(levels.grid, [around.top[0], *around.top])
        ends = _add_power(around.key, dim * (HALVINGS - level)[:, None])
        bounds = _lower_bound(keys, (jnp.stack([around.key[0], ends[0]]), jnp.stack([around.key[1], ends[1]])), start, stop)
        return bounds[0], jnp.where(around.there, bounds[1], bounds[0]), around.image

    return runs


def _place_in_cell(x: Array, edge: Array, turns: Array | None) -> Array:
    """Number the finest cells within each coordinate's top cell from 0, exactly: halves of a cell are cells themselves."""
    finest = 1 << HALVINGS
    if turns is not None:
        scaled = x * turns
        part = (scaled - jnp.clip(jnp.floor(scaled), 0, turns - 1)) * finest
    else:
        rest = cell_remainder(x, cell_coordinate(x, edge), edge)
        part = cell_coordinate(rest * 2**10, edge / (finest >> 10))  # neither overflows nor vanishes before squares do
        part = jnp.where(x < 0, finest - 1 - part, part)  # below 0, cells are mirrored
    return jnp.clip(jnp.floor(part), 0, finest - 1).astype(jnp.int32)


def groups_of(radii: Array, largest: Array, count: int) -> Array:
    """Return the group of each cutoff, [n] uint32: how far its binary exponent is below that of the largest, at most count - 1."""
    unsigned, nmant = (jnp.uint32, 23) if radii.dtype == jnp.float32 else (jnp.uint64, 52)

    def exponent(x: Array) -> Array:
        return (lax.bitcast_convert_type(x, unsigned) >> unsigned(nmant)).astype(jnp.int32)

    return jnp.clip(exponent(largest) - exponent(radii), 0, count - 1).astype(jnp.uint32)


def _key_of(group: Array, axes: list[Array]) -> Words:
    """Return the key of finest cells, given their number along each axis, for a group: both words."""
    high, low = morton_words(axes, HALVINGS)
    return high | group.astype(jnp.uint32) << np.uint32(HALVINGS * len(axes) - 32), low


def _add_power(key: Words, bit: Array) -> Words:
    """Return key + 2^bit, for any bit of both words."""
    (high, low), one = key, np.uint32(1)
    more = jnp.where(bit < 32, one << jnp.minimum(bit, 31).astype(jnp.uint32), 0)
    above = jnp.where(bit < 32, 0, one << jnp.maximum(bit - 32, 0).astype(jnp.uint32))
    return high + above + (low + more < low).astype(jnp.uint32), low + more


def _finest_level(reach: Array, widths: Array, axes: Axes) -> Array:
    """Return the finest level whose cells are wider than the cutoffs [b] along every axis: [b] int32; level 0 are the top cells."""
    along = reach[:, None] * axes.scale[None] + axes.margin[None]
    fits = [((widths * 2.0**-level)[None] > along).all(axis=1).astype(jnp.int32) for level in range(1, HALVINGS + 1)]
    return functools.reduce(jnp.add, fits)


class _Around(NamedTuple):
    """Cells around queries, [b, r] each: their top cells (one array per axis), first keys and image codes, and which ones exist."""

    top: list[Array]
    key: Words
    image: Array | None
    there: Array


def _cells_around(group: Array, top: Array, place: Array, level: Array, extent: Array, images: Images | None) -> _Around:
    """Return the cells of a group around queries [d, b] at their level [b]; in small boxes these span several periodic images."""
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
        finest = (fine & ((1 << level[:, None]) - 1)) << (HALVINGS - level)[:, None]
        within.append(finest.astype(jnp.uint32)[:, which[k]])
        code = code * (2 * reach[k] + 1) + (turn + reach[k])[:, which[k]]
        there = there & ~far[:, which[k]] & (jnp.abs(turn) <= max(reach[k], 1))[:, which[k]]
    cells += [jnp.broadcast_to(system[:, None], code.shape) for system in top[len(place) :]]
    return _Around(cells, _key_of(group, within), None if images is None else code, there)


def _lower_bound(keys: Words, target: Words, low: Array, high: Array) -> Array:
    """Return the first index in [low, high) whose key is not below the target, of indices [b, r] and targets [2, b, r] of words."""

    def halve(bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = low + (high - low) // 2
        upper, lower = (word.at[middle].get(mode="clip") for word in keys)
        right = ((upper < target[0]) | ((upper == target[0]) & (lower < target[1]))) & (low < high)
        return jnp.where(right, middle + 1, low), jnp.where(right, high, middle)

    shape = target[0].shape
    bounds = jnp.broadcast_to(low, shape), jnp.broadcast_to(jnp.maximum(low, high), shape)
    return lax.while_loop(lambda bounds: jnp.any(bounds[0] < bounds[1]), halve, bounds)[0]
