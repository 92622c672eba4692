"""Positions of the flags that are set in an array."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

_BITS = 32


class Packed(NamedTuple):
    """Flags as the bits of words, those behind the last one 0.

    Attributes:
        words: 32 flags in each, shape [words], uint32.
        size: How many flags there are.
        parts: In how many equal parts they were given; the flags that have the same place in their part stand side by side.
    """

    words: Array
    size: int
    parts: int

    def total(self) -> Array:
        """Return how many are set, [] int32."""
        return jnp.sum(lax.population_count(self.words).astype(jnp.int32), dtype=jnp.int32)


def set_places(flags: Array, most: int) -> Array:
    """Return the indices of the first flags [n] that are set, at most so many: [most] int32, ascending, padded with n."""
    n = len(flags)
    words = -(-n // _BITS)
    bits = jnp.pad(flags, (0, words * _BITS - n)).reshape(words, _BITS).astype(jnp.uint32)
    return packed_places(Packed(jnp.sum(bits << lax.iota(jnp.uint32, _BITS)[None], axis=1, dtype=jnp.uint32), n, 1), most)


def pack_parts(flags_of: Callable[[slice], Array], n: int) -> Packed:
    """Pack n flags, a multiple of 8, where `flags_of` says those of a slice.

    A GPU packs them without writing flags down first, if n is a multiple of 32; else it takes twice as long.
    """
    part = n // 8
    packed = functools.reduce(jnp.bitwise_or, [flags_of(slice(k * part, (k + 1) * part)).astype(jnp.uint8) << k for k in range(8)])
    if part % 4:
        packed = jnp.pad(packed, (0, -part % 4))
    return Packed(lax.bitcast_convert_type(packed.reshape(-1, 4), jnp.uint32), n, 8)


def packed_places(packed: Packed, most: int) -> Array:
    """Return the indices of so many flags that are set, [most] int32, padded with their number; of 1 part they ascend.

    Cost: each index is found in the cumulative counts of words, then in its word (Jacobson 1989, doi:10.1109/SFCS.1989.63533).
    `jax.numpy.nonzero` adds every flag to a histogram instead, which takes longer on CPU and GPU.
    """
    n, words = packed.size, len(packed.words)
    if not n:
        return jnp.zeros(most, jnp.int32)
    until = jnp.cumsum(lax.population_count(packed.words).astype(jnp.int32), dtype=jnp.int32)
    number = lax.iota(jnp.int32, most)
    found = jnp.searchsorted(until, number, side="right", method="scan_unrolled").astype(jnp.int32)
    word = jnp.minimum(found, words - 1)
    left, place = packed.words[word], word * _BITS
    before = number - (until[word] - lax.population_count(left).astype(jnp.int32))  # number of earlier flags in this word
    for width in (16, 8, 4, 2, 1):
        low = lax.population_count(left & np.uint32((1 << width) - 1)).astype(jnp.int32)
        beyond = before >= low
        before, place = jnp.where(beyond, before - low, before), jnp.where(beyond, place + width, place)
        left = jnp.where(beyond, left >> np.uint32(width), left)
    if packed.parts > 1:
        place = place % packed.parts * (n // packed.parts) + place // packed.parts
    return jnp.where(found < words, place, n)


def largest_of(x: Array) -> Array:
    """Return the largest of integers >= 0, of any shape: [].

    It is found twice at once, because XLA's CPU compiler splits a reduction of one array of integers into a chain of kernels, which
    dominate the time to compile.
    """
    x, zero = x.reshape(-1), np.zeros((), x.dtype)
    twice = lax.reduce((x, x), (zero, zero), lambda a, b: (lax.max(a[0], b[0]), lax.max(a[1], b[1])), (0,))
    return lax.max(*twice)


def first_set(flags: Array) -> Array:
    """Return the first index at which flags [n] are set, or n: [] int32."""
    there = jnp.concatenate([flags, jnp.ones(1, bool)])
    return lax.argmax(there, 0, jnp.int32)  # one kernel; a minimum of indices would be a chain of them
