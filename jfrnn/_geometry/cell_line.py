"""Cells numbered along one line: particles sorted by that number, and one table that finds the particles of any cell.

The number of the cell (x, y, z) is x + A·y + B·z modulo the length of the table, a power of two. In a domain that fits into the
table, A and B are the lengths of a row and of a plane of cells, and each cell has a number of its own. In any other domain A and B
are constants that strew the rows of cells over the table, so that the table follows the particles and never the domain. Cells that
then share a number are candidates of each other; the pair test refuses their particles.

Neighboring rows of cells differ by A or B wherever they are. So the rows around a query share no number, and no candidate is met
twice: `_constants` makes sure of that, and the lengths of rows and planes leave room for it.

A cell is a cube of edge `cell_edge(cutoff)`, a float slightly larger than the cutoff. Rows of cells are read along x. There a cell
is divided into `FINE` parts, so that a query reads fewer particles beyond its cutoff.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.images import Images

FINE = 4  # parts of a cell along x
_RUN = 2 * FINE + 1  # most parts that a run covers
_SMALLEST_TABLE = 4096
_LARGEST_TABLE = 1 << 30
_LONGEST_SPAN = 2.0**23  # of cells along an axis, if each is to have a number of its own: whole floats up to there are exact


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


class Cells(NamedTuple):
    """The cells of points, as uint32 with wrap-around: parts of cells along x, cells along the other axes, then systems.

    Attributes:
        along: [d, n], and a row more for the systems of a batch.
        number: [n] the number of the cell, or the length of the table for points that are not finite, which have no cell.
    """

    along: Array
    number: Array

    def of(self, points: Array) -> "Cells":
        """Return the cells of the points at these indices."""
        return Cells(self.along[:, points], self.number[points])


class Sorting(NamedTuple):
    """How particles are sorted and found; decides about time alone.

    Attributes:
        packed: Whether key and index are sorted as one word, in two passes where it is too short for both.
        least: Fewer keys of 32 bits are sorted together with padding.
        searched: The table of up to so many sources is searched for in the sorted keys instead of counted.
    """

    packed: bool = False
    least: int = 0
    searched: int = 0


PLAIN = Sorting()


class CellLine(NamedTuple):
    """Sources sorted by the number of their cell, and the table that finds them.

    Attributes:
        order: [n] int32, the source at each position; those without a cell come last.
        numbers: [n] uint32, the numbers of their cells, as `Cells.number`.
        inside: [] int32, how many sources have a cell.
        table: [size + 2·FINE + 2] int32, the position at which each number begins. After its last number the table starts again,
            with positions that go on from `inside`: runs may reach over the end.
        strides: Per axis but the first, then for systems: what a step along it adds to the number, uint32.
        turns: Per axis the number of cells, along x of parts, after which a periodic one starts again, int32; None for open ones.
    """

    order: Array
    numbers: Array
    inside: Array
    table: Array
    strides: list[Array]
    turns: list[Array | None]

    def twice(self, more: int = 0) -> Array:
        """Return the sources with a cell, twice in a row, as runs read them: [2·n + more] int32; those of queries come first."""
        place = lax.iota(jnp.int32, 2 * self.order.size + more)
        return self.order.at[jnp.where(place < self.inside, place, place - self.inside)].get(mode="clip")


def sort_along_line(
    points: Array, axes: CellAxes, sources: int, systems: Array | None, by: Sorting = PLAIN
) -> tuple[CellLine, Cells]:
    """Sort the first of the points [d, n + m], the `sources`, by cell; return also the cells of all points.

    Open axes begin where the sources do, with a margin; periodic ones, whose coordinates are fractions from 0 to 1, begin at 0.
    `systems` [n + m] uint32 are the systems of a batch.
    """
    there = functools.reduce(jnp.logical_and, (jnp.isfinite(x) for x in points))
    size = table_size(sources)
    is_open = [turn is None for turn in axes.turns]
    alike = all(edge is axes.edges[0] for edge in axes.edges)
    edges = axes.edges[0] if alike else jnp.stack(axes.edges)[:, None]
    whole = jnp.where(np.array(is_open)[:, None], cell_coordinate(points, edges), points) if any(is_open) else points
    among = jnp.where(there[:sources], whole[:, :sources], jnp.inf)
    ends = jnp.min(jnp.concatenate([among, jnp.where(there[:sources], -among, jnp.inf)]), axis=1, initial=jnp.inf)  # at once
    lowest, highest = ends[: len(whole)], -ends[len(whole) :]
    lowest = jnp.where(lowest <= highest, lowest, 0)
    opened = _whole_number(whole) - _whole_number(lowest)[:, None] + np.uint32(1) if any(is_open) else whole
    spans = jnp.maximum(highest - lowest, 0) + 1
    along, lengths = [], []
    for axis, turns in enumerate(axes.turns):
        parts = 1 if axis else FINE
        if turns is not None:
            fine = turns * parts
            along.append(jnp.clip(jnp.floor(points[axis] * fine), 0, fine - 1).astype(jnp.int32).astype(jnp.uint32))
            lengths.append(fine + 2 * parts)
            continue
        along.append(opened[0] * np.uint32(FINE) + _part_of(points[0], whole[0], axes.edges[0]) if axis == 0 else opened[axis])
        lengths.append(jnp.where(spans[axis] <= _LONGEST_SPAN, spans[axis] * parts + 2 * parts, jnp.inf))
    if systems is not None:
        along.append(systems)
        lengths.append(jnp.max(systems[:sources], initial=0).astype(points.dtype) + 1)
    strides = _strides(lengths, size)
    number = jnp.where(there, _number(along, strides) & np.uint32(size - 1), np.uint32(size))
    ascending, order = _sort(number[:sources], size, by)
    if sources <= by.searched:
        numbers = lax.iota(jnp.uint32, size + 1)
        begin = jnp.searchsorted(ascending, numbers, side="left", method="scan_unrolled").astype(jnp.int32)
    else:
        counts = jnp.zeros(size + 1, jnp.int32).at[ascending.astype(jnp.int32) + 1].add(1, mode="drop")
        begin = jnp.cumsum(counts, dtype=jnp.int32)
    inside = begin[size]
    table = jnp.concatenate([begin[:size], inside + begin[: _RUN + 1]])
    turns = [None if turn is None else turn.astype(jnp.int32) * (1 if k else FINE) for k, turn in enumerate(axes.turns)]
    return CellLine(order, ascending, inside, table, strides, turns), Cells(jnp.stack(along), number)


def sort_queries(cells: Cells, sources: int, by: Sorting) -> tuple[Array, Array]:
    """Return the numbers of the cells of queries, which follow those of the `sources`, and the queries in this order: [m] each."""
    return _sort(cells.number[sources:], table_size(sources), by)


def _sort(key: Array, size: int, by: Sorting) -> tuple[Array, Array]:
    """Sort keys [n] uint32 up to a size; return them and their indices. Half as many digits take a radix sort half the time."""
    n, place = key.size, lax.iota(jnp.int32, key.size)
    digits = 32 - max((n - 1).bit_length(), 1)  # that fit into a word beside an index
    if by.packed and size.bit_length() <= 2 * digits:
        mask, left = np.uint32((1 << (32 - digits)) - 1), np.uint32(32 - digits)
        places = lax.sort(key << left | place.astype(jnp.uint32))
        if size.bit_length() <= digits:
            return places >> left, (places & mask).astype(jnp.int32)
        first = places & mask
        part = key.at[first].get(mode="promise_in_bounds") >> np.uint32(digits) << left
        order = first.at[lax.sort(part | place.astype(jnp.uint32)) & mask].get(mode="promise_in_bounds")
        return key.at[order].get(mode="promise_in_bounds"), order.astype(jnp.int32)
    short = np.uint16 if size < 2**16 else np.uint32
    more = 0 if short is np.uint16 else max(by.least - n, 0)
    padded = jnp.pad(key.astype(short), (0, more), constant_values=short(np.iinfo(short).max))
    ascending, order = lax.sort((padded, lax.iota(jnp.int32, padded.size)), num_keys=1, is_stable=True)
    return ascending[:n].astype(jnp.uint32), order[:n]


def table_size(sources: int) -> int:
    """Return the length of the table for this number of sources, a power of two."""
    return min(max(_SMALLEST_TABLE, 1 << (2 * sources - 1).bit_length()), _LARGEST_TABLE)


def _part_of(x: Array, cell: Array, edge: Array) -> Array:
    """Return the part of its cell in which each open coordinate lies, uint32; below 0, cells are mirrored."""
    # from where its cell begins, exactly unless that is too far away to resolve
    from_start = _remainder(jnp.abs(x), jnp.where(x < 0, -1 - cell, cell), edge)
    part = cell_coordinate(from_start, edge / FINE)
    return jnp.clip(jnp.where(x < 0, FINE - 1 - part, part), 0, FINE - 1).astype(jnp.int32).astype(jnp.uint32)


def _whole_number(x: Array) -> Array:
    """Return whole floats modulo 2^32 as uint32.

    From 2^24 (float64: 2^53) on, pairs have equal coordinates: any function of them will do, and this one tells them apart.
    """
    if x.dtype == jnp.float32:
        exact = jnp.abs(x) < 2.0**24
        number = jnp.where(exact, x, 0).astype(jnp.int32).astype(jnp.uint32)
        bits = lax.bitcast_convert_type(x, jnp.uint32)
    else:
        exact = jnp.abs(x) < 2.0**53
        number = jnp.where(exact, x, 0).astype(jnp.int64).astype(jnp.uint32)
        wide = lax.bitcast_convert_type(x, jnp.uint64)
        bits = (wide >> np.uint64(32)).astype(jnp.uint32) ^ wide.astype(jnp.uint32)
    return jnp.where(exact, number, bits * np.uint32(0x9E3779B1))


def _strides(lengths: list[Array], size: int) -> list[Array]:
    """Return what a step along each axis but the first adds to the number of a cell."""
    total = functools.reduce(jnp.multiply, lengths) * (1 + 1e-5)  # rounded up
    fits = total <= size
    strides, stride = [], np.uint32(1)
    for length, constant in zip(lengths[:-1], _constants(len(lengths) - 1, size), strict=True):
        stride = stride * jnp.where(fits, length, 1).astype(jnp.uint32)
        strides.append(jnp.where(fits, stride, constant))
    return strides


@functools.cache
def _constants(count: int, size: int) -> list[np.uint32]:
    """Return odd strides that strew rows over a table evenly, as the multiples of powers of an irrational number are (R2 sequence).

    Rows up to two steps apart along each axis are at least a run apart.
    """
    ratio = 1.0
    for _ in range(64):  # the root of x^(count + 1) = x + 1
        ratio = (1 + ratio) ** (1 / (count + 1))
    strides = [int(size / ratio ** (k + 1)) | 1 for k in range(count)]
    for steps in itertools.product(range(-2, 3), repeat=count):
        apart = sum(step * stride for step, stride in zip(steps, strides, strict=True)) % size
        if any(steps) and min(apart, size - apart) < _RUN:
            raise AssertionError(f"rows of cells overlap in a table of {size}: strides {strides}.")
    return [np.uint32(stride) for stride in strides]


def _number(cells: Sequence[Array], strides: list[Array]) -> Array:
    return functools.reduce(jnp.add, (c * stride for c, stride in zip(cells[1:], strides, strict=True)), cells[0])


def line_runs(line: CellLine, cells: Cells, images: Images | None) -> tuple[Array, Array, Array | None]:
    """Find the sources in the cells around each query: starts, ends and image codes of their runs, [m, runs] int32.

    In open space each query has 3^(d-1) runs, one per row of cells. Along a periodic axis the cells beyond either end are those of
    a periodic image, and a row is split where it enters another image.
    """
    dim, size = len(line.turns), line.table.size - _RUN - 1
    reach = (0,) * dim if images is None else images.reach
    steps = [range(-max(k, 1), max(k, 1) + 1) for k in reach[1:]]
    rows = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, dim - 1).astype(np.int32)
    if images is None:
        ahead = _number(
            list(jnp.asarray(np.pad(rows, ((0, 0), (1, 0)), constant_values=-FINE).astype(np.uint32).T)), line.strides[: dim - 1]
        )
        begin = ((cells.number[:, None] + ahead[None]) & np.uint32(size - 1)).astype(jnp.int32)
        return *_ends(line, begin, jnp.where(cells.number < size, _RUN, 0)[:, None]), None
    parts = _parts_of_rows(cells.along[0].astype(jnp.int32)[:, None], line.turns[0], reach[0], images)
    first, last, turn = (jnp.repeat(x, len(rows), axis=1) for x in parts)  # [m, runs]: all rows of the first part come first
    number, turned = [first.astype(jnp.uint32)], [turn]
    for axis in range(1, dim):
        cell = cells.along[axis].astype(jnp.int32)[:, None] + np.tile(rows[:, axis - 1], parts[0].shape[1])[None]
        turns = line.turns[axis]
        turn = jnp.zeros_like(cell)
        if turns is not None and reach[axis] == 1:  # without a division
            turn = (cell >= turns).astype(jnp.int32) - (cell < 0).astype(jnp.int32)
        elif turns is not None:
            turn = cell // turns
        turned.append(turn)
        number.append((cell if turns is None else cell - turn * turns).astype(jnp.uint32))
    number += [system[:, None] for system in cells.along[dim:]]
    begin = (_number(number, line.strides) & np.uint32(size - 1)).astype(jnp.int32)
    length = jnp.where(cells.number[:, None] < size, jnp.maximum(last - first + 1, 0), 0)
    return *_ends(line, begin, length), images.code_of(turned)


def _ends(line: CellLine, begin: Array, length: Array) -> tuple[Array, Array]:
    """Return the positions at which runs begin and end that cover so many numbers from `begin` on."""
    start, stop = (line.table.at[at].get(mode="promise_in_bounds") for at in (begin, begin + length))
    return start, stop


def _parts_of_rows(x: Array, turns: Array | None, reach: int, images: Images) -> tuple[Array, Array, Array]:
    """Split the row of parts around x [m, 1] at the borders of images: [m, pieces] first and last part, and image of each."""
    if turns is None:
        return x - FINE, x + FINE, jnp.zeros_like(x)
    if images.nearest:  # The box has at least two cells, so a row enters only one other image.
        shifts = jnp.concatenate([jnp.zeros_like(x), jnp.where(x < FINE, -1, 1)], axis=1)
    else:
        shifts = jnp.broadcast_to(np.arange(-reach, reach + 1, dtype=np.int32)[None], (len(x), 2 * reach + 1))
    beyond, from_start = FINE * reach, x - shifts * turns
    return jnp.maximum(from_start - beyond, 0), jnp.minimum(from_start + beyond, turns - 1), shifts
