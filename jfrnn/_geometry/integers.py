"""Fixed-point integers as wide as a float format: arithmetic without rounding for pairs that floats leave undecided.

A number is an array of limbs [..., count], the lowest first; limb k counts units of 2^(bits·k), with 11 bits in int32 for float32
and 26 bits in int64 for float64. Limbs are signed, and sums and products may exceed their bits until `carry_limbs` is called.
Numbers that are not carried have `GUARDS` zeros below the lowest limb, so that carrying needs no special case at the end.

There are no loops: each step is a few operations on whole arrays, which XLA fuses into one or two kernels. Compile time is roughly
proportional to the number of kernels.
"""

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

GUARDS = 3
_SHORT = 32  # XLA's CPU compiler splits a reduction over a longer axis into a chain of kernels


def limb_bits(dtype: np.dtype) -> int:
    """Return the bits per limb for this dtype of floats or limbs."""
    return 11 if dtype.itemsize == 4 else 26


def full_count(dtype: np.dtype) -> int:
    """Return the number of limbs that hold any float of this dtype, in units of the smallest denormal."""
    finfo = np.finfo(dtype)
    return -(-(finfo.maxexp - finfo.minexp + finfo.nmant + 1) // limb_bits(dtype))


def limb_type(dtype: np.dtype) -> np.dtype:
    """Return the integer dtype of limbs for floats of this dtype."""
    return np.dtype(np.int32 if dtype.itemsize == 4 else np.int64)


def fields_of(x: Array) -> tuple[Array, Array, Array]:
    """Split floats into sign (bool), position of the lowest mantissa bit (int32) and mantissa with its leading bit (unsigned).

    Positions count bits from that of the smallest denormal.
    """
    unsigned, nmant = (np.uint32, 23) if x.dtype == jnp.float32 else (np.uint64, 52)
    bits = lax.bitcast_convert_type(x, unsigned)
    magnitude = bits << unsigned(1) >> unsigned(1)
    exponent = magnitude >> unsigned(nmant)
    lead = jnp.minimum(exponent, unsigned(1)) << unsigned(nmant)
    mantissa = (magnitude & unsigned((1 << nmant) - 1)) | lead
    return bits != magnitude, jnp.maximum(exponent.astype(jnp.int32), 1) - 1, mantissa


def limbs_of(x: Array, count: int, origin: Array | None = None) -> Array:
    """Return finite floats [...] as limbs [..., GUARDS + count] below 2^bits; the unit is the bit at position `origin` [...], or 0.

    No set bit may lie below the origin.
    """
    dtype = np.dtype(x.dtype)
    bits, width, unsigned = limb_bits(dtype), 8 * dtype.itemsize, np.dtype(f"uint{8 * dtype.itemsize}").type
    sign, place, mantissa = fields_of(x)
    place = place if origin is None else place - origin
    shift = -place[..., None] + _along_limbs(np.arange(-GUARDS, count, dtype=np.int32) * bits, place.ndim + 1)

    def by(amount: Array) -> Array:  # the result of longer shifts would depend on the hardware
        return jnp.clip(amount, 0, width - 1).astype(unsigned)

    mantissa = mantissa[..., None]
    right = jnp.where(shift < width, mantissa >> by(shift), unsigned(0))
    left = jnp.where(shift > -bits, mantissa << by(-shift), unsigned(0))
    limbs = (jnp.where(shift < 0, left, right) & unsigned((1 << bits) - 1)).astype(limb_type(dtype))
    return jnp.where(sign[..., None], -limbs, limbs)


def carry_limbs(limbs: Array) -> Array:
    """Return the same numbers [..., count] with limbs of at most 1.26·2^bits; the top limb keeps the rest.

    Limbs [..., GUARDS + count] must be below 2^31 - 2^10 (float64: 2^62), top limbs below half of that. Each limb is split into
    three parts: the lower two lie within half of 2^bits, and the third is below 2^9 + 1 (2^10 + 1).
    """
    return _digits(*_windows(limbs)[:3], is_top=_is_top(limbs))


def limb_product(a: Array, b: Array) -> Array:
    """Multiply numbers [..., la] and [..., lb] with carried limbs: [..., GUARDS + la + lb], not carried. Leading axes broadcast.

    A limb of the product is a sum of min(la, lb) products. All shifted copies of b come from one reshape: la copies of b, padded
    with zeros to be one limb longer than a row, lie shifted by one limb each when read as rows.
    """
    la, lb = a.shape[-1], b.shape[-1]
    groups, length = -(-la // _SHORT), GUARDS + la + lb
    rows = groups * _SHORT if groups > 1 else la
    a = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, rows - la)])
    b = jnp.pad(b, [(0, 0)] * (b.ndim - 1) + [(GUARDS, rows + 1)])[..., : GUARDS + lb + rows + 1]
    lead, stride = b.shape[:-1], b.shape[-1]
    copies = jnp.broadcast_to(b[..., None, :], (*lead, rows, stride)).reshape(*lead, rows * stride)
    moved = copies[..., : rows * (stride - 1)].reshape(*lead, rows, stride - 1)[..., :length]
    return jnp.sum(_fold(a[..., None] * moved, groups, jnp.add, axis=-2), axis=-2, dtype=a.dtype)


def limb_sign(limbs: Array) -> Array:
    """Return the signs of numbers [..., GUARDS + count] that satisfy the bounds of `carry_limbs`: [...] int32.

    After one more carry, each limb but the top one is below 2^bits - 1, so the lower limbs together are less than one unit of the
    next. The highest nonzero limb has the sign of the number.
    """
    bits, is_top = limb_bits(np.dtype(limbs.dtype)), _is_top(limbs)
    at, below, lower, lowest = _windows(limbs)
    here, under = _digits(at, below, lower, is_top), _digits(below, lower, lowest, np.zeros_like(is_top))
    digits = here - jnp.where(is_top, 0, _carry(here, bits) << bits) + _carry(under, bits)
    places = _along_limbs(2 * np.arange(at.shape[-1], dtype=np.int32), limbs.ndim)
    key = jnp.where(digits == 0, 0, jnp.where(digits > 0, places + 3, places + 2))
    groups = -(-at.shape[-1] // _SHORT)
    key = jnp.pad(key, [(0, 0)] * (limbs.ndim - 1) + [(0, groups * _SHORT - at.shape[-1] if groups > 1 else 0)])
    highest = jnp.max(_fold(key, groups, jnp.maximum, axis=-1), axis=-1)
    return jnp.where(highest == 0, 0, 2 * (highest & 1) - 1)


def _digits(at: Array, below: Array, lower: Array, is_top: np.ndarray) -> Array:
    """Return the carried limb, from the limb, the one below it and the one below that."""
    bits = limb_bits(np.dtype(at.dtype))
    once = _carry(below, bits)
    middle = once - jnp.where(is_top, 0, _carry(once, bits) << bits)
    return at - jnp.where(is_top, 0, _carry(at, bits) << bits) + middle + _carry(_carry(lower, bits), bits)


def _carry(limbs: Array, bits: int) -> Array:
    """Return the carry of a limb: what exceeds the part within half of 2^bits, in units of 2^bits."""
    return (limbs + (1 << (bits - 1))) >> bits


def _windows(limbs: Array) -> list[Array]:
    """Return the limbs without guards, then shifted by one, two and three positions."""
    count = limbs.shape[-1] - GUARDS
    return [limbs[..., GUARDS - by : GUARDS - by + count] for by in range(GUARDS + 1)]


def _is_top(limbs: Array) -> np.ndarray:
    count = limbs.shape[-1] - GUARDS
    return _along_limbs(np.arange(count) == count - 1, limbs.ndim)


def _along_limbs(x: np.ndarray, ndim: int) -> np.ndarray:
    return x.reshape((1,) * (ndim - 1) + x.shape)


def _fold(x: Array, groups: int, add: Callable[[Array, Array], Array], axis: int) -> Array:
    """Split an axis into parts and combine them, so that the axis is short enough for one kernel to reduce it."""
    return functools.reduce(add, jnp.split(x, groups, axis=axis))
