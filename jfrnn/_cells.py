"""Cells: which cell a particle is in, in which order the cells stand, and where the particles of a cell lie.

A cell is a cube of edge `cell_edge(cutoff)`, a float slightly above the cutoff. Cells along x are adjacent in the order, so that
the stencil of a particle is one contiguous run of sorted particles per row of cells: 3 runs in 2D, 9 in 3D.
"""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_CELLS_PER_PARTICLE = 4  # a dense table holds at most this many cells per particle: 16 B per particle
_SMALLEST_TABLE = 4096
_FAR = np.int32(2**31 - 1)


class Grid(NamedTuple):
    """Sources in cell order, and what is needed to find a cell among them.

    Attributes:
        order: [n] int32, the particle at each place of the cell order; non-finite ones last.
        coords: [d, n] int32 in that order, the cell of each particle (x, y[, z]).
        extent: [d] int32, cells per axis, with a margin of one empty cell on either side.
        dense: [] bool, whether the box is small enough for `table`.
        table: [cells + 1] int32, the first place of each cell in row-major order (zeros where not dense).
    """

    order: Array
    coords: Array
    extent: Array
    dense: Array
    table: Array


def cell_edge(radius: np.floating | Array) -> Array:
    """Return the smallest float with half a mantissa (12 or 26 bits) above the cutoff."""
    radius = jnp.asarray(radius)
    unsigned, dropped = (jnp.uint32, 12) if radius.dtype == jnp.float32 else (jnp.uint64, 27)
    bits = lax.bitcast_convert_type(radius, unsigned)
    return lax.bitcast_convert_type(((bits >> unsigned(dropped)) + unsigned(1)) << unsigned(dropped), radius.dtype)


def cell_coordinate(x: Array, edge: Array) -> Array:
    """Return the index of the cell that holds each coordinate, as a whole float: the exact floor of |x|/edge, mirrored below 0.

    Why no pair leaves the stencil: cells are intervals of width `edge` (x >= 0: [k·edge, (k+1)·edge) is cell k; x < 0: the mirror
    image is cell -1-k), and `edge` exceeds the cutoff, so that two coordinates with a whole cell between them are further apart
    than the cutoff. The quotient's rounding is undone: with half a mantissa in `edge` and in either half of q, the products
    q_high·edge and q_low·edge are exact, and so is |x| - q_high·edge; the sign of the remainder is therefore right. From
    q = 2^24 (2^53) on, neighboring floats are further apart than the cutoff, so that only equal coordinates, which share a cell,
    can belong to a pair.
    """
    magnitude = jnp.abs(x)
    quotient = jnp.floor(magnitude / edge)
    quotient = jnp.where(_remainder(magnitude, quotient, edge) < 0, quotient - 1, quotient)
    quotient = jnp.where(_remainder(magnitude, quotient + 1, edge) >= 0, quotient + 1, quotient)
    return jnp.where(x < 0, -1 - quotient, quotient)


def _remainder(magnitude: Array, quotient: Array, edge: Array) -> Array:
    half = 2.0 ** (12 if edge.dtype == np.float32 else 26)
    high = jnp.floor(quotient / half) * half
    return (magnitude - high * edge) - (quotient - high) * edge


def grid_coordinates(positions: Array, edge: Array, finite: Array) -> tuple[Array, Array]:
    """Number the cells of [d, n] coordinates from 1 on along each axis: [d, n] int32, and the [d] extents with their margins.

    A small bounding box keeps its empty cells. In a large one, runs of empty planes shrink to a single one, axis by axis: cells
    that touch still touch, cells that do not still do not, and no axis is longer than 2n + 1, however far apart the particles are.
    """
    some = jnp.any(finite)
    cells = cell_coordinate(positions, edge)
    lowest = jnp.where(some, jnp.min(cells, axis=1, initial=jnp.inf, where=finite), 0)[:, None]
    highest = jnp.where(some, jnp.max(cells, axis=1, initial=-jnp.inf, where=finite), 0)[:, None]
    cells = jnp.where(finite, cells, lowest)
    small = jnp.prod(highest - lowest + 3) <= _table_size(finite.size)
    coords = lax.cond(
        small,
        lambda cells: (cells - lowest).astype(jnp.int32) + 1,
        lambda cells: lax.map(_squeeze_gaps, cells) + 1,
        cells,
    )
    return coords, jnp.max(coords, axis=1) + 2


def _squeeze_gaps(cells: Array) -> Array:
    """Renumber whole floats [n] from 0 on, in order, with steps of at most 2."""
    _, order = _sort_by(_ordered_bits(cells), _iota(cells.size))
    ascending = cells[order]
    before, after = ascending[:-1], ascending[1:]
    step = jnp.where(after == before, 0, jnp.where(after - before == 1, 1, 2)).astype(jnp.int32)
    place = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(step, dtype=jnp.int32)])
    return jnp.zeros(cells.size, jnp.int32).at[order].set(place, unique_indices=True)


def _ordered_bits(x: Array) -> Array:
    """Map floats to unsigned integers of the same order."""
    unsigned = jnp.uint32 if x.dtype == jnp.float32 else jnp.uint64
    top = unsigned(1 << (32 if x.dtype == jnp.float32 else 64) - 1)
    bits = lax.bitcast_convert_type(x, unsigned)
    return jnp.where(bits >= top, ~bits, bits | top)


def _sort_by(key: Array, payload: Array) -> tuple[Array, Array]:
    # two operands: XLA's fast sort on every device
    ascending, carried = lax.sort((key, payload), num_keys=1, is_stable=True)
    return ascending, carried


def _iota(n: int) -> Array:
    return lax.iota(jnp.int32, n)


def _table_size(n: int) -> int:
    return min(max(_SMALLEST_TABLE, _CELLS_PER_PARTICLE * n), 2**30)


def build_grid(coords: Array, finite: Array, extent: Array, capacity: int) -> Grid:
    """Sort n >= 1 sources by cell; `capacity` particles (sources and queries) bound the size of a dense table."""
    cells = jnp.prod(extent.astype(jnp.float32)) * np.float32(1 + 1e-6)  # rounded up: a table is never too small
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
    """Return the [n] int32 order of particles by cell (x fastest), ties by index, non-finite ones last."""

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


def stencil_runs(grid: Grid, coords: Array) -> tuple[Array, Array]:
    """Find the sources in the 3^d cells around each query cell [d, m]: [m, 3^(d-1)] int32 first places and ends of the runs.

    Dense: two loads from the table per run. Otherwise: two binary searches per run among the sorted cells of the sources.
    """

    def from_table(coords: Array) -> tuple[Array, Array]:
        first = _row_major(_stencil_rows(coords), grid.extent) - 1
        return grid.table.at[first].get(mode="clip"), grid.table.at[first + 3].get(mode="clip")

    def by_binary_search(coords: Array) -> tuple[Array, Array]:
        x, *rest = _stencil_rows(coords)
        bounds = _lower_bound(grid.coords, [jnp.stack([x - 1, x + 2]), *(jnp.stack([c, c]) for c in rest)])
        return bounds[0], bounds[1]

    return lax.cond(grid.dense, from_table, by_binary_search, coords)


def _stencil_rows(coords: Array) -> list[Array]:
    """Return the middle cell of each row of the stencil: d arrays [m, 3^(d-1)]."""
    offsets = np.array(list(product((0,), *[(-1, 0, 1)] * (len(coords) - 1))), np.int32)
    return [c[:, None] + offsets[:, axis] for axis, c in enumerate(coords)]


def _lower_bound(cells: Array, target: list[Array]) -> Array:
    """Return the first place among sorted cells [d, n] that is not below the target, the last axis compared first."""

    def is_below(place: Array) -> Array:
        below = jnp.zeros(place.shape, bool)
        for c, t in zip(cells, target, strict=True):  # x first: a later axis overrules an earlier one
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
