"""Cells: the cell of each particle, and the top cells of `jfrnn._geometry.levels`: their order and where their particles start.

A cell is a cube of edge `cell_edge(cutoff)`, a float slightly larger than the cutoff.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_CELLS_PER_PARTICLE = 4  # the largest dense table, in cells per particle: 16 B per particle
_SMALLEST_TABLE = 4096
_FAR = np.int32(2**31 - 1)


class Grid(NamedTuple):
    """Sources sorted by cell, and the tables that find the sources of a cell.

    Attributes:
        order: [n] int32, the source at each position of the cell order; non-finite ones come last.
        coords: [d, n] int32, the cell (x, y[, z]) of each source in that order; [d + 1, n] with a batch, the system being the last
            row.
        extent: [d] or [d + 1] int32, number of cells per axis. Open axes have an empty cell at either end.
        dense: [] bool, whether the bounding box is small enough for `table`.
        table: [cells + 1] int32, where each cell starts in the order, cells in row-major order; zeros if not dense.
    """

    order: Array
    coords: Array
    extent: Array
    dense: Array
    table: Array


def cell_edge(radius: np.floating | Array) -> Array:
    """Return the smallest float above the cutoff that has half a mantissa (12 or 26 bits)."""
    radius = jnp.asarray(radius)
    unsigned, dropped = (jnp.uint32, 12) if radius.dtype == jnp.float32 else (jnp.uint64, 27)
    bits = lax.bitcast_convert_type(radius, unsigned)
    return lax.bitcast_convert_type(((bits >> unsigned(dropped)) + unsigned(1)) << unsigned(dropped), radius.dtype)


def cell_coordinate(x: Array, edge: Array) -> Array:
    """Return the cell index of each coordinate as a whole float: floor(|x| / edge) exactly, mirrored for x < 0.

    No pair leaves the 3^d cells around a particle. Cell k >= 0 is the interval [k·edge, (k+1)·edge), and cell -1-k is its mirror
    image. Since `edge` exceeds the cutoff, two coordinates with a whole cell between them are farther apart than the cutoff. The
    rounding of the quotient is corrected: `edge` and both halves of the quotient q have half a mantissa, so q_high·edge, q_low·edge
    and |x| - q_high·edge are exact, and the sign of the remainder is right. From q = 2^24 (2^53) on, neighboring floats are farther
    apart than the cutoff; only equal coordinates, which share a cell, can then form a pair.
    """
    magnitude = jnp.abs(x)
    quotient = jnp.floor(magnitude / edge)
    quotient = jnp.where(_remainder(magnitude, quotient, edge) < 0, quotient - 1, quotient)
    quotient = jnp.where(_remainder(magnitude, quotient + 1, edge) >= 0, quotient + 1, quotient)
    return jnp.where(x < 0, -1 - quotient, quotient)


def cell_remainder(x: Array, cell: Array, edge: Array) -> Array:
    """Return the distance of |x| from the start of its cell, exactly; in [0, edge) unless cells are too far away to resolve."""
    return _remainder(jnp.abs(x), jnp.where(x < 0, -1 - cell, cell), edge)


def _remainder(magnitude: Array, quotient: Array, edge: Array) -> Array:
    half = 2.0 ** (12 if edge.dtype == np.float32 else 26)
    high = jnp.floor(quotient / half) * half
    return (magnitude - high * edge) - (quotient - high) * edge


class CellAxes(NamedTuple):
    """How each axis is divided into cells: the edge, and for periodic axes `turns` [], the whole number of cells in the box."""

    edges: list[Array]
    turns: list[Array | None]


def open_axes(edge: Array, dim: int) -> CellAxes:
    """Divide all axes of an open space into cells of one edge."""
    return CellAxes([edge] * dim, [None] * dim)


def grid_coordinates(positions: Array, axes: CellAxes, finite: Array, batch: Array | None = None) -> tuple[Array, Array]:
    """Number the cells of coordinates [d, n] along each axis: return [d, n] int32 and the extents [d]. A batch adds an axis.

    Open axes count from 1, with a margin of one empty cell. If the bounding box is small, empty cells are kept. If it is large,
    each run of empty planes shrinks to one, axis by axis: adjacent cells stay adjacent, others do not become so, and no axis is
    longer than 2n + 1 cells. Periodic axes, whose coordinates are fractions from 0 to 1, count from 0.
    `batch` [n] uint32 holds system numbers; they are renumbered from 0 with small gaps, and distinct systems stay distinct.
    """
    some = jnp.any(finite)
    is_open = [turn is None for turn in axes.turns]
    numbered = [
        cell_coordinate(x, edge) if turn is None else jnp.clip(jnp.floor(x * turn), 0, turn - 1)
        for x, edge, turn in zip(positions, axes.edges, axes.turns, strict=True)
    ]
    cells = jnp.stack(numbered)
    lowest = jnp.where(some, jnp.min(cells, axis=1, initial=jnp.inf, where=finite), 0)[:, None]
    highest = jnp.where(some, jnp.max(cells, axis=1, initial=-jnp.inf, where=finite), 0)[:, None]
    cells = jnp.where(finite, cells, lowest)
    extents = [
        high - low + 3 if turn is None else turn for low, high, turn in zip(lowest[:, 0], highest[:, 0], axes.turns, strict=True)
    ]
    systems = 1 if batch is None else jnp.max(batch, initial=0).astype(cells.dtype) + 1
    small = jnp.prod(jnp.stack(extents)) * systems <= _table_size(finite.size)
    coords = lax.cond(
        small,
        lambda cells: jnp.stack(
            [
                (c - low).astype(jnp.int32) + 1 if free else c.astype(jnp.int32)
                for c, low, free in zip(cells, lowest, is_open, strict=True)
            ]
        ),
        lambda cells: jnp.stack(
            [_squeeze_gaps(c) + 1 if free else c.astype(jnp.int32) for c, free in zip(cells, is_open, strict=True)]
        ),
        cells,
    )
    margins = [jnp.max(c) + 2 if turn is None else turn.astype(jnp.int32) for c, turn in zip(coords, axes.turns, strict=True)]
    if batch is None:
        return coords, jnp.stack(margins)
    system = lax.cond(small, lambda batch: batch.astype(jnp.int32), _squeeze_gaps, batch)
    return jnp.concatenate([coords, system[None]]), jnp.stack([*margins, jnp.max(system) + 1])


def _squeeze_gaps(cells: Array) -> Array:
    """Renumber whole floats or uint32 [n] from 0, keeping their order, so that consecutive values differ by at most 2."""
    _, order = _sort_by(cells if cells.dtype == jnp.uint32 else ordered_bits(cells), _iota(cells.size))
    ascending = cells[order]
    before, after = ascending[:-1], ascending[1:]
    step = jnp.where(after == before, 0, jnp.where(after - before == 1, 1, 2)).astype(jnp.int32)
    place = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(step, dtype=jnp.int32)])
    return jnp.zeros(cells.size, jnp.int32).at[order].set(place, unique_indices=True)


def ordered_bits(x: Array) -> Array:
    """Map floats to unsigned integers so that the order is kept."""
    unsigned = jnp.uint32 if x.dtype == jnp.float32 else jnp.uint64
    top = unsigned(1 << (32 if x.dtype == jnp.float32 else 64) - 1)
    bits = lax.bitcast_convert_type(x, unsigned)
    return jnp.where(bits >= top, ~bits, bits | top)


def _sort_by(key: Array, payload: Array) -> tuple[Array, Array]:
    # With two operands, XLA uses its fast sort on every device.
    ascending, carried = lax.sort((key, payload), num_keys=1, is_stable=True)
    return ascending, carried


def _iota(n: int) -> Array:
    return lax.iota(jnp.int32, n)


def _table_size(n: int) -> int:
    return min(max(_SMALLEST_TABLE, _CELLS_PER_PARTICLE * n), 2**30)


def build_grid(coords: Array, finite: Array, extent: Array, capacity: int) -> Grid:
    """Sort n >= 1 sources by cell; `capacity`, the number of sources and queries, bounds the size of a dense table."""
    cells = jnp.prod(extent.astype(jnp.float32)) * np.float32(1 + 1e-6)  # rounded up, so that the table is never too small
    size = _table_size(capacity)
    dense = cells <= size
    order = cell_order(coords, finite, extent, dense)
    coords = jnp.where(finite, coords, _FAR)[:, order]

    def count_cells(coords: Array) -> Array:
        cell = jnp.where(coords[0] == _FAR, size, _row_major(coords, extent))
        return jnp.cumsum(jnp.zeros(size + 1, jnp.int32).at[cell + 1].add(1, mode="drop"), dtype=jnp.int32)

    table = lax.cond(dense, count_cells, lambda _: jnp.zeros(size + 1, jnp.int32), coords)
    return Grid(order, coords, extent, dense, table)


def cell_order(coords: Array, finite: Array, extent: Array, dense: Array) -> Array:
    """Return particles sorted by cell (x fastest), [n] int32; ties are sorted by index, non-finite particles come last."""

    def by_row_major_key(coords: Array) -> Array:
        key = jnp.where(finite, _row_major(coords, extent), _FAR)
        return _sort_by(key.astype(jnp.uint32), _iota(finite.size))[1]

    def axis_by_axis(coords: Array) -> Array:
        keys = jnp.where(finite, coords, _FAR).astype(jnp.uint32)
        return lax.fori_loop(0, len(keys), lambda axis, order: _sort_by(keys[axis, order], order)[1], _iota(finite.size))

    return lax.cond(dense, by_row_major_key, axis_by_axis, coords)


def _row_major(coords: Sequence[Array] | Array, extent: Array) -> Array:
    index = coords[-1]
    for axis in range(len(coords) - 2, -1, -1):
        index = index * extent[axis] + coords[axis]
    return index


def places_between(grid: Grid, cells: list[Array]) -> tuple[Array, Array]:
    """Return start and end [m, r] of rows of cells, given by their first and last cell along x and by y[, z]."""

    def from_table(cells: list[Array]) -> tuple[Array, Array]:
        first, last, *rest = cells
        row = _row_major([jnp.zeros_like(first), *rest], grid.extent)
        return grid.table.at[row + first].get(mode="clip"), grid.table.at[row + last + 1].get(mode="clip")

    def by_binary_search(cells: list[Array]) -> tuple[Array, Array]:
        first, last, *rest = cells
        bounds = _lower_bound(grid.coords, [jnp.stack([first, last + 1]), *(jnp.stack([c, c]) for c in rest)])
        return bounds[0], bounds[1]

    return lax.cond(grid.dense, from_table, by_binary_search, cells)


def _lower_bound(cells: Array, target: list[Array]) -> Array:
    """Return the first index among sorted cells [d, n] that is not below the target; the last axis is compared first."""

    def is_below(place: Array) -> Array:
        below = jnp.zeros(place.shape, bool)
        for c, t in zip(cells, target, strict=True):  # x first: later axes take precedence
            here = c.at[place].get(mode="clip")
            below = (here < t) | ((here == t) & below)
        return below

    def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bounds
        middle = low + (high - low) // 2
        right = is_below(middle) & (low < high)
        return jnp.where(right, middle + 1, low), jnp.where(right, high, middle)

    low = jnp.zeros(target[0].shape, jnp.int32)
    n = cells.shape[1]
    return lax.fori_loop(0, n.bit_length(), halve, (low, jnp.full_like(low, n)))[0]
