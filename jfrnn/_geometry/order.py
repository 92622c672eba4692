"""Orders of particles: permutations that place particles which are close in space close together in memory."""

import functools
from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.core import Tracer

from jfrnn._geometry.curves import Words, hilbert_digits, hilbert_words, morton_words, spread
from jfrnn._geometry.floats import rounded_quotient
from jfrnn._geometry.inputs import check_positions, is_real
from jfrnn._tracing import Given, Number, Points, compile_program, on_device, own_transfers

CLASSES = 31  # of cutoffs, or of species
_CLASS_BITS = 5
_SORT_BITS = 21  # bits per axis, fewer than the 24 up to which float32 holds cell numbers exactly
_LAYOUT = {np.dtype(np.float32): (np.int32, 23, 127), np.dtype(np.float64): (np.int64, 52, 1023)}  # type, mantissa bits, bias
_NO_CELL = np.uint32(2**32 - 1)  # sorts last, as no key has such a high word
_DISTINCT = 100  # from 2^100 cells on, neighboring floats are more than 2^21 cells apart, in float64 too


def sort_order(positions: Points, cell_size: Number, *, curve: Literal["hilbert", "morton", "row"] = "hilbert") -> Array:
    """Order particles by their cells along a curve, so that `positions[order]` has neighbors in space close in memory.

    The cell of a particle is floor(x / cell_size), with the quotient as the dtype rounds it; cells are counted from the lowest
    occupied one on each axis. If an axis needs more than 2^21 cells, the cells of all axes are merged by the smallest sufficient
    power of two, so a single particle extremely far away costs locality. Particles of one cell keep their order; those with a
    non-finite coordinate come last, in their order. Cost: one 32-bit sort if all keys fit into 32 bits (1024 cells per axis in 3D,
    65 536 in 2D; "row": 2^31 cells in all), else two; under vmap always two.

    Args:
        positions: Particle positions [length], shape [n, 2] or [n, 3], float32 or float64. n = 0 is allowed.
        cell_size: Edge of a cell [length], a static number > 0; the cutoff is a good choice.
        curve: "hilbert" (by `hilbert_encode` with 21 bits), "morton" (by `morton_encode`), or "row" (by z, then y, then x).

    Returns:
        The permutation, int32, shape [n]: position k of the order holds particle order[k].

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, shape or range.

    Differentiable: no (integers). Jit: yes, cell_size and curve static. vmap: yes. Source: see the encoders.

    >>> import jax.numpy as jnp, jfrnn
    >>> jfrnn.sort_order(jnp.array([[0.9, 0.0], [0.1, 0.0], [0.5, 0.0]]), 0.1).tolist()
    [1, 2, 0]
    """
    positions = check_positions("positions", positions)
    size = _check_cell_size(cell_size, np.dtype(positions.dtype))
    if not isinstance(curve, str) or curve not in _CURVES:
        raise ValueError(f"curve must be one of {', '.join(map(repr, _CURVES))}, got {curve!r}.")
    with own_transfers():
        return _sort_order(positions, on_device(size), _CURVES[curve])


def hilbert_order(positions: Array, size: Array) -> Array:
    """Order particles as `sort_order` does, with a cell edge that is an array (normal and finite)."""
    return _sort_order(positions, size, hilbert_words)


@functools.partial(compile_program, static_argnames="curve")
def _sort_order(positions: Array, size: Array, curve: Callable[[list[Array], int], Words]) -> Array:
    finite = jnp.all(jnp.isfinite(positions), axis=1)
    high, low = curve(_cells_from_lowest(positions.T, size, finite), _SORT_BITS)
    one_word = jnp.all(~finite | ((high == 0) & (low != _NO_CELL)))
    high, low = (jnp.where(finite, word, _NO_CELL) for word in (high, low))

    def sort_by(word: Array, order: Array) -> Array:  # a uint32 key with an int32 payload, which XLA sorts fast
        return lax.sort((word, order), num_keys=1, is_stable=True)[1]

    order = sort_by(low, lax.iota(jnp.int32, len(positions)))
    return lax.cond(one_word, lambda order: order, lambda order: sort_by(high[order], order), order)


def _cells_from_lowest(x: Array, size: Array, finite: Array) -> list[Array]:
    """Number the cells of coordinates [d, n] along each axis from the lowest occupied one: d arrays [n] uint32, below 2^21.

    Quotients that could overflow are first taken in cells of edge size * 2^ahead, axis by axis. So far out, the particles of an
    axis either share one coordinate or span so many cells that these are merged by more than 2^ahead anyhow. `cells - lowest` is
    exact up to 2^24 cells; beyond that, its error is at most 1/16 of a merged cell.
    """
    x = jnp.where(finite, x, 0)
    largest = jnp.max(jnp.abs(x), axis=1, initial=0)
    ahead = jnp.maximum(_exponent(largest) - _exponent(size) - _DISTINCT, 0)
    edge = jnp.broadcast_to(_times_power_of_two(size, ahead)[:, None], x.shape)
    cells = jnp.floor(rounded_quotient(x, edge))
    cells = jnp.where(x < 0, jnp.minimum(cells, -1), cells)  # otherwise a quotient that underflows would be in cell 0
    lowest = jnp.min(cells, axis=1, initial=jnp.inf, where=finite)
    span = jnp.max(cells, axis=1, initial=-jnp.inf, where=finite) - lowest  # -inf if there is no particle
    excess = jnp.where(span > 0, _exponent(span) + 1 - _SORT_BITS + ahead, 0)
    merged = jnp.maximum(jnp.max(excess), 0)  # merging cells by 2^merged suffices, as span < 2^(1 + exponent)
    scale = _times_power_of_two(jnp.ones((), x.dtype), jnp.clip(ahead - merged, -120, 0))
    index = jnp.floor((cells - lowest[:, None]) * scale[:, None])
    return list(jnp.where(finite, index, 0).astype(jnp.uint32))


def _exponent(x: Array) -> Array:
    """Return floor(log2(x)) of normal x > 0, int32; for 0 a value below all others."""
    signed, mantissa, bias = _LAYOUT[x.dtype]
    return (lax.bitcast_convert_type(x, signed) >> mantissa).astype(jnp.int32) - bias


def _times_power_of_two(x: Array, power: Array) -> Array:
    """Return x * 2^power for normal x > 0 and a normal result, even if 2^power itself is out of range."""
    signed, mantissa, _ = _LAYOUT[x.dtype]
    return lax.bitcast_convert_type(lax.bitcast_convert_type(x, signed) + (power.astype(signed) << mantissa), x.dtype)


def _row_words(axes: list[Array], bits: int) -> Words:
    """Return the row-major index if there are at most 2^31 cells, else the concatenated coordinates, which sort alike."""
    x, y, *z = axes
    low, high = x | y << bits, y >> 32 - bits
    for c in z:
        high = high | c << 2 * bits - 32
    index, cells = jnp.zeros_like(x), np.float32(1)
    for c in reversed(axes):
        extent = jnp.max(c, initial=np.uint32(0)) + 1
        index = index * extent + c
        cells = cells * extent.astype(jnp.float32)
    small = cells <= 2.0**31
    return jnp.where(small, 0, high), jnp.where(small, index, low)


_CURVES = {"row": _row_words, "morton": morton_words, "hilbert": hilbert_words}


def _check_cell_size(cell_size: Given, dtype: np.dtype) -> np.floating:
    """Return the edge of a cell, rounded to the dtype of the positions."""
    if isinstance(cell_size, Tracer):
        raise TypeError("cell_size must be a static number, got a traced value: pass a Python float, or make it a static argument.")
    shape = list(np.shape(cell_size))
    if shape or not is_real(cell_size):
        raise TypeError(f"cell_size must be one number, got {type(cell_size).__name__} of shape {shape}.")
    value, low, high = float(cell_size), float(np.finfo(dtype).tiny), float(np.finfo(dtype).max)
    if not low <= value <= high:
        raise ValueError(f"cell_size must be positive, finite and a normal {dtype} [{low:.1e}, {high:.1e}], got {value}.")
    return dtype.type(value)


def order_for_tree(points: Array, classes: Array | None, systems: Array | None) -> Array:
    """Return the order of points, [n] int32: by system, then by class, then along a Hilbert curve; those not finite come last.

    The curve halves the box around all points 29 times along each axis. What follows each other on it lies in a compact region,
    while a Morton curve jumps. Its keys are words of 32 bits, by which XLA sorts one after the other, the lowest first: sorts of
    one word and an index are the fast ones on a GPU. Classes, below `CLASSES`, and systems are [n] uint32; None: all are of one.
    """
    n, dim = points.shape
    finite = jnp.isfinite(points).all(axis=1)
    halves = jnp.where(finite[:, None], points, 0) / 2  # so that no difference overflows
    low = jnp.min(halves, axis=0, initial=jnp.inf, where=finite[:, None])
    high = jnp.max(halves, axis=0, initial=-jnp.inf, where=finite[:, None])
    parts = (halves - low) / jnp.where(high > low, high - low, 1)
    widths = [(32 - _CLASS_BITS) // dim, *[32 // dim] * (dim - 1)]  # binary digits along each axis in each word
    fine = jnp.minimum((parts * 2.0 ** sum(widths)).astype(jnp.uint32), np.uint32(2 ** sum(widths) - 1))
    digits_along = hilbert_digits(list(fine.T), sum(widths), unroll=7)
    words, below = [], sum(widths)
    for width in widths:
        below -= width
        digits = [(each >> np.uint32(below)) & np.uint32(2**width - 1) for each in digits_along]
        words.append(functools.reduce(jnp.bitwise_or, [spread(each, dim) << np.uint32(axis) for axis, each in enumerate(digits)]))
    if classes is not None:
        words[0] |= classes << np.uint32(dim * widths[0])
    words[0] = jnp.where(finite, words[0], np.uint32(2**32 - 1))  # no class is so high
    if systems is not None:  # a system may have any number
        words = [(~finite).astype(jnp.uint32), systems, *words]
    order = lax.iota(jnp.int32, n)
    for word in reversed(words):
        _, order = lax.sort((word[order], order), num_keys=1, is_stable=True)
    return order
