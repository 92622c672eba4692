"""Cells: in which one a coordinate lies, exactly.

A cell is a cube of edge `cell_edge(cutoff)`, a float slightly larger than the cutoff.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax


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


def ordered_bits(x: Array) -> Array:
    """Map floats to unsigned integers so that the order is kept."""
    unsigned = jnp.uint32 if x.dtype == jnp.float32 else jnp.uint64
    top = unsigned(1 << (32 if x.dtype == jnp.float32 else 64) - 1)
    bits = lax.bitcast_convert_type(x, unsigned)
    return jnp.where(bits >= top, ~bits, bits | top)
