"""Particles far from a periodic box: moved near it by whole numbers of lattice vectors, without rounding.

Coordinates that are never wrapped, as those of a long molecular run, lie any number of boxes away. Kernels number the lattice
vectors between a particle and its box by few bits, and the errors of wrapped coordinates grow with that number. So a particle that
is at least `FAR` vectors away is first moved by a multiple of `FAR_STEP` of them, to coordinates that are floats again.

Why nothing is rounded where vectors lie along the axes: let A be a length in [1, 2), p the exponent of x, and s·256·A what is
subtracted, with s = round(x / 256 A). A is the sum of two halves of its mantissa, so that both products are exact. In float32,
the first product is a multiple of 2^-3, and x is one of 2^(p - 23). Their difference is below 2^8 + 2^(p - 11), which is less
than 2^24 such units for 192 <= x < 2^20, so it is a float. If x is 384 A or more, the second product and the difference are
multiples of 2^-15, and the result is below 2^9, as it is at most 128 A plus the rounding of s. For smaller x, s is 1, and the
result is a multiple of 2^-16 and at most 128 A < 2^8. In both cases it is a float, too. In float64, halves have 26 bits, and s up
to 22.

Where several vectors contribute to a component, sums are checked: points that rounding would change are not moved.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.floats import half_mantissa, two_sum

FAR_STEP, FAR = 256, 192
FAR_BITS = {4: 11, 8: 22}  # of how many steps a particle is moved, by the size of a float [B]


def is_far(units: Array) -> Array:
    """Say along which lattice vectors points are far, of their coordinates [n, d] along these."""
    return jnp.abs(units) >= FAR


def move_near(
    points: Array, units: Array, matrix: Array, periodic: Array | np.ndarray, orthogonal: bool, rarely: bool = False
) -> tuple[Array, Array]:
    """Return points - turns @ matrix, [n, d], exactly, and turns, [n, d] whole floats: multiples of 256, 0 along open axes.

    `units` [n, d] are the coordinates of the points along the vectors, `matrix` [d, d] the vectors of all or [n, d, d] those of
    each. Points that lie too far away, or that would be rounded, are not moved. Differentiable in points and matrix. What is done
    `rarely` is a loop: XLA compiles its body once.
    """
    steps = jnp.round(units / FAR_STEP)
    far = is_far(units) & (jnp.abs(steps) <= 2.0 ** FAR_BITS[points.dtype.itemsize]) & periodic
    return _subtract(points, jnp.where(far, steps * FAR_STEP, 0), matrix, orthogonal, rarely)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _subtract(points: Array, turns: Array, matrix: Array, orthogonal: bool, rarely: bool) -> tuple[Array, Array]:
    """Return x - turns @ matrix, [n, d], of one matrix or one per row, and the turns; those of rows that would be rounded are 0."""
    if not orthogonal:
        moved, exact = _subtract_checked(points, turns, matrix, rarely)
        turns = jnp.where(exact[:, None], turns, 0)
        return jnp.where((turns != 0).any(axis=1, keepdims=True), moved, points), turns
    lengths = jnp.stack([matrix[..., k, k] for k in range(points.shape[1])], axis=-1)
    high = half_mantissa(lengths)
    high, low = (x if x.ndim == 2 else x[None] for x in (high, lengths - high))
    return jnp.where(turns == 0, points, (points - turns * high) - turns * low), turns


@_subtract.defjvp
def _subtract_jvp(
    orthogonal: bool, rarely: bool, primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    (points, turns, matrix), (moved, _, stretched) = primals, tangents
    near, turns = _subtract(points, turns, matrix, orthogonal, rarely)
    rows = (turns[:, k, None] * stretched[..., k, :] for k in range(points.shape[1]))
    return (near, turns), (moved - functools.reduce(jnp.add, rows), jnp.zeros_like(turns))


def _subtract_checked(points: Array, turns: Array, matrix: Array, rarely: bool) -> tuple[Array, Array]:
    """Return x - turns @ matrix, [n, d], and for which rows nothing was rounded."""
    high, dim = half_mantissa(matrix), points.shape[1]
    factors = jnp.concatenate([turns, turns], axis=1)
    rows = jnp.concatenate([high, matrix - high], axis=-2)

    def subtract(k: int | Array, sums: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        total, rest, lost = sums
        factor, row = factors[:, k, None], rows[..., k, :]
        total, error = two_sum(total, -factor * row)
        rest, more = two_sum(rest, error)
        return total, rest, lost + jnp.abs(more)

    sums = points, 0 * points, 0 * points
    total, rest, lost = lax.fori_loop(0, 2 * dim, subtract, sums, unroll=not rarely)
    total, error = two_sum(total, rest)
    return total, ((lost == 0) & (error == 0)).all(axis=1)
