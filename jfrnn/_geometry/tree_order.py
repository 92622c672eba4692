"""The order of particles for a tree of boxes: those that are close to each other, and alike, follow each other."""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jfrnn._geometry.curves import hilbert_digits, spread

CLASSES = 31  # of cutoffs, or of species
_CLASS_BITS = 5


def order_for_tree(points: Array, classes: Array | None, systems: Array | None) -> Array:
    """Return the order of points, [n] int32: by system, then by class, then along a Hilbert curve; those not finite come last.

    The curve halves the box around all points 29 times along each axis. What follows each other on it lies in a compact region,
    while a Morton curve jumps. Its keys are words of 32 bits, by which XLA sorts one after the other, the lowest first: sorts of
    one word and an index are the fast ones on a GPU.

    Args:
        points: [n, d] coordinates, d = 2 or 3.
        classes: [n] uint32 below `CLASSES`, or None: all are of one class.
        systems: [n] uint32, the system of each point, or None: all are of one.
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
