"""Error-free transformations: float operations that return their result together with its exact rounding error.

Sources: Dekker (1971); Ogita, Rump & Oishi (2005), doi:10.1137/030601818.
"""

import functools

import jax
import jax.numpy as jnp
from jax import Array, lax

WHOLE_BITS = 12  # whole numbers of so many bits have exact products with half mantissas


def two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """Return fl(a + b) and its rounding error (Knuth 1969)."""
    total = a + b
    b_virtual = total - a
    a_virtual = total - b_virtual
    return total, (a - a_virtual) + (b - b_virtual)


def compensated_sum(a: tuple[Array, ...], b: tuple[Array, ...]) -> tuple[Array, Array]:
    """Add two compensated sums (value, error): nearly as accurate as twice the working precision."""
    total, rounding = two_sum(a[0], b[0])
    return total, a[1] + b[1] + rounding


def rounded_sum(value: Array, error: Array) -> Array:
    """Return value + error of a compensated sum, or the value if it is not finite, since its error then means nothing."""
    return jnp.where(jnp.isfinite(value), value + error, value)


def half_mantissa(x: Array) -> Array:
    """Round x to half its mantissa (12 of 24 bits, 26 of 53) by integer operations."""
    unsigned, dropped = (jnp.uint32, 12) if x.dtype == jnp.float32 else (jnp.uint64, 27)
    bits = lax.bitcast_convert_type(x, unsigned)
    rounded = (bits + unsigned(1 << (dropped - 1))) >> unsigned(dropped) << unsigned(dropped)
    return lax.bitcast_convert_type(rounded, x.dtype)


def distill(terms: list[Array]) -> list[Array]:
    """Replace terms by others with the same exact sum, most of it in the last one (VecSum of Ogita, Rump & Oishi)."""
    result = []
    total = terms[0]
    for term in terms[1:]:
        total, error = two_sum(total, term)
        result.append(error)
    return [*result, total]


def unit_scale(x: Array) -> Array:
    """Return the power of two, a normal float, that scales positive floats into [1, 4)."""
    unsigned, nmant, bias = (jnp.uint32, 23, 127) if x.dtype == jnp.float32 else (jnp.uint64, 52, 1023)
    exponent = lax.bitcast_convert_type(x, unsigned) >> unsigned(nmant)  # biased; 2·bias - e is the exponent of the inverse
    return lax.bitcast_convert_type(jnp.maximum(unsigned(2 * bias) - exponent, unsigned(1)) << unsigned(nmant), x.dtype)


def rounded_quotient(x: Array, y: Array) -> Array:
    """Return x / y, y normal and positive, as IEEE 754 rounds it; GPUs divide float32 with errors of up to two units.

    Quotients below 1/2 or beyond 2^60 are those of the device.
    """
    scale = unit_scale(y)
    return settled_quotient(x * scale, y * scale, (x * scale) / lax.optimization_barrier(y * scale))


def settled_quotient(x: Array, y: Array, quotient: Array) -> Array:
    """Return x / y, y in [1, 4), rounded to nearest, from a quotient that is a few units off.

    What remains of x tells the quotient to within a unit. The remainders of this float and of its neighbor are then floats
    themselves (Markstein 1990, doi:10.1147/rd.341.0111), and the nearer one has the smaller remainder.
    """
    within = (jnp.abs(quotient) >= 0.5) & (jnp.abs(quotient) < 2.0**60)
    near = jnp.where(within, quotient, 1)  # so that no other quotient makes a remainder that overflows
    x = jnp.where(within, x, y)
    near = near + _remainder(x, y, near) / y
    left = _remainder(x, y, near)
    beside = jnp.nextafter(near, jnp.where(left < 0, -jnp.inf, jnp.inf).astype(near.dtype))
    near = jnp.where(jnp.abs(_remainder(x, y, beside)) < jnp.abs(left), beside, near)
    return jnp.where(within, near, quotient)


def _remainder(x: Array, y: Array, quotient: Array) -> Array:
    """Return x - quotient * y with one rounding or so: products of half mantissas are exact."""
    *errors, total = distill([x, *(-q * part for q in _halves(quotient) for part in _halves(y))])
    return rounded_sum(total, functools.reduce(jnp.add, errors))


@jax.custom_jvp
def rounded_scaled(points: Array, sizes: Array) -> Array:
    """Return points * sizes, [n, d], with one rounding, which all that use it see: no product is contracted with a sum."""
    return lax.optimization_barrier(points * sizes)


@jax.custom_jvp
def rounded_product(points: Array, matrix: Array) -> Array:
    """Return points @ matrix of [n, d] and one matrix, or one per point, in twice the precision and rounded once.

    Products of half mantissas are exact, so that no device can contract them with sums to another result.
    """
    parts = [(x, y) for k in range(points.shape[1]) for x in _halves(points[:, k, None]) for y in _halves(matrix[..., k, :])]
    *errors, total = distill([x * y for x, y in parts])
    return lax.optimization_barrier(rounded_sum(total, functools.reduce(jnp.add, errors)))


def _halves(x: Array) -> tuple[Array, Array]:
    high = half_mantissa(x)
    return high, x - high


@rounded_scaled.defjvp
def _rounded_scaled_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (points, sizes), (of_points, of_sizes) = primals, tangents
    return rounded_scaled(points, sizes), of_points * sizes + points * of_sizes


@rounded_product.defjvp
def _rounded_product_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (points, matrix), (of_points, of_matrix) = primals, tangents
    return rounded_product(points, matrix), _plain_product(of_points, matrix) + _plain_product(points, of_matrix)


def _plain_product(points: Array, matrix: Array) -> Array:
    """Return points @ matrix, without a matmul, which GPUs may compute in fewer bits."""
    return functools.reduce(jnp.add, (points[:, k, None] * matrix[..., k, :] for k in range(points.shape[1])))


def ordered_bits(x: Array) -> Array:
    """Map floats to unsigned integers so that the order is kept."""
    unsigned = jnp.uint32 if x.dtype == jnp.float32 else jnp.uint64
    top = unsigned(1 << (32 if x.dtype == jnp.float32 else 64) - 1)
    bits = lax.bitcast_convert_type(x, unsigned)
    return jnp.where(bits >= top, ~bits, bits | top)
