"""Fixed-point integers as wide as a float format, for what rounding leaves open: no rounding exists here.

A number is limbs [..., count], the lowest first, of which each counts units of 2^(bits·place): 11 bits in int32 for float32, 26
bits in int64 for float64. Limbs have any sign. Those of sums and products grow beyond their bits, until they are carried. What is
not has `GUARDS` zeros before its lowest limb, so that carrying reads limbs from below without a border.

Nothing loops: each step is a few operations on whole arrays, of which XLA makes one or two kernels, and the time to compile a
program is about proportional to the number of its kernels.
"""

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

GUARDS = 3
_SHORT = 32  # XLA's CPU compiler makes a chain of kernels of a reduction over a longer axis


def limb_bits(dtype: np.dtype) -> int:
    """Return the bits of a limb of floats or limbs of this dtype."""
    return 11 if dtype.itemsize == 4 else 26


def full_count(dtype: np.dtype) -> int:
    """Return how many limbs hold any float of this dtype, in units of the smallest denormal."""
    finfo = np.finfo(dtype)
    return -(-(finfo.maxexp - finfo.minexp + finfo.nmant + 1) // limb_bits(dtype))


def limb_type(dtype: np.dtype) -> np.dtype:
    """Return the dtype of the limbs of floats of this dtype."""
    return np.dtype(np.int32 if dtype.itemsize == 4 else np.int64)


def fields_of(x: Array) -> tuple[Array, Array, Array]:
    """Split floats into sign [...] bool, place of the lowest mantissa bit [...] int32, and mantissa with its leading bit, unsigned.

    Places count bits from that of the smallest denormal.
    """
    unsigned, nmant = (np.uint32, 23) if x.dtype == jnp.float32 else (np.uint64, 52)
    bits = lax.bitcast_convert_type(x, unsigned)
    magnitude = bits << unsigned(1) >> unsigned(1)
    exponent = magnitude >> unsigned(nmant)
    lead = jnp.minimum(exponent, unsigned(1)) << unsigned(nmant)
    mantissa = (magnitude & unsigned((1 << nmant) - 1)) | lead
    return bits != magnitude, jnp.maximum(exponent.astype(jnp.int32), 1) - 1, mantissa


def beside(columns: list[Array]) -> Array:
    """Return columns, [k] or scalars, as [k, columns]: `jnp.stack`, of which XLA's CPU compiler makes a loop for each column."""
    place = np.arange(len(columns), dtype=np.int32)[None]
    rows = [jnp.reshape(column, (-1, 1)) for column in columns]
    return functools.reduce(lambda left, k: jnp.where(place == k, rows[k], left), range(1, len(rows)), rows[0])


def limbs_of(x: Array, count: int, origin: Array | None = None) -> Array:
    """Write finite floats [...] as limbs [..., GUARDS + count] below 2^bits, in units of the bit at a place `origin` [...], or 0.

    No bit that is set may lie below the origin.
    """
    dtype = np.dtype(x.dtype)
    bits, width, unsigned = limb_bits(dtype), 8 * dtype.itemsize, np.dtype(f"uint{8 * dtype.itemsize}").type
    sign, place, mantissa = fields_of(x)
    place = place if origin is None else place - origin
    shift = -place[..., None] + _along_limbs(np.arange(-GUARDS, count, dtype=np.int32) * bits, place.ndim + 1)

    def by(amount: Array) -> Array:  # XLA leaves longer shifts to the hardware
        return jnp.clip(amount, 0, width - 1).astype(unsigned)

    mantissa = mantissa[..., None]
    right = jnp.where(shift < width, mantissa >> by(shift), unsigned(0))
    left = jnp.where(shift > -bits, mantissa << by(-shift), unsigned(0))
    limbs = (jnp.where(shift < 0, left, right) & unsigned((1 << bits) - 1)).astype(limb_type(dtype))
    return jnp.where(sign[..., None], -limbs, limbs)


def carry_limbs(limbs: Array) -> Array:
    """Return the same numbers, [..., count], in limbs of at most 1.26·2^bits; the top one keeps what is left.

    Limbs [..., GUARDS + count] are below 2^31 - 2^10 (float64: 2^62), the top ones below half of that. Each is written as
    three, of which the lower two lie within half of 2^bits, and the third is below 2^9 + 1 (2^10 + 1).
    """
    return _digits(*_windows(limbs)[:3], is_top=_is_top(limbs))


def limb_product(a: Array, b: Array) -> Array:
    """Multiply numbers [..., la] and [..., lb] with carried limbs: [..., GUARDS + la + lb], not carried. Leading axes broadcast.

    A limb is a sum of min(la, lb) products. b, between zeros, is written la times side by side, each time moved by a limb; that is
    a reshape of copies that are one limb longer than a row.
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
    """Return the signs of numbers [..., GUARDS + count], which are as `carry_limbs` takes them: [...] int32.

    Carried once more, each limb but the top one is below 2^bits - 1, so that all below a limb is less than one unit of it: the
    highest limb that is not 0 has the sign.
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
    """Return what carrying leaves in a place, of the limb there, that below it and the next lower one."""
    bits = limb_bits(np.dtype(at.dtype))
    once = _carry(below, bits)
    middle = once - jnp.where(is_top, 0, _carry(once, bits) << bits)
    return at - jnp.where(is_top, 0, _carry(at, bits) << bits) + middle + _carry(_carry(lower, bits), bits)


def _carry(limbs: Array, bits: int) -> Array:
    """Return what a limb within half of 2^bits leaves."""
    return (limbs + (1 << (bits - 1))) >> bits


def _windows(limbs: Array) -> list[Array]:
    """Return limbs without guards, and those one, two and three places below each."""
    count = limbs.shape[-1] - GUARDS
    return [limbs[..., GUARDS - by : GUARDS - by + count] for by in range(GUARDS + 1)]


def _is_top(limbs: Array) -> np.ndarray:
    count = limbs.shape[-1] - GUARDS
    return _along_limbs(np.arange(count) == count - 1, limbs.ndim)


def _along_limbs(x: np.ndarray, ndim: int) -> np.ndarray:
    return x.reshape((1,) * (ndim - 1) + x.shape)


def _fold(x: Array, groups: int, add: Callable[[Array, Array], Array], axis: int) -> Array:
    """Lay the parts of an axis above each other, so that it is short enough for one kernel to reduce it."""
    return functools.reduce(add, jnp.split(x, groups, axis=axis))
