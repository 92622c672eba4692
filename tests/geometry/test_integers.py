"""Integers in limbs against Python's own, at the sizes up to which they promise to be exact."""

import math

import jax
import numpy as np
import pytest

from jfrnn._geometry.integers import GUARDS, carry_limbs, full_count, limb_bits, limb_product, limb_sign, limb_type, limbs_of


def number(limbs, bits):
    return sum(int(x) << bits * place for place, x in enumerate(limbs))


def raw_limbs(rng, whole, count, most):
    """Numbers of limbs up to `most`, before which guards stand: random, largest, and almost nothing."""
    bits = limb_bits(whole)
    rows = [rng.integers(-most, most, count) for _ in range(6)] + [np.full(count, most), np.full(count, -most)]
    rows = [np.where(np.arange(count) == count - 1, row // 2, row) for row in rows]  # room for what is left
    unit = np.zeros(count, whole)
    unit[-1] = 1
    unit[:-1] = 1 - (1 << bits)  # 2^(bits·(count - 1)) less all below: 2^bits - 1 too little, so 1
    unit[0] -= 1
    rows += [unit, -unit, unit + np.eye(count, dtype=whole)[0], unit - np.eye(count, dtype=whole)[0], 0 * unit]
    return np.pad(np.array(rows, whole), ((0, 0), (GUARDS, 0)))


def test_floats_are_what_they_are(dtype):
    finfo = np.finfo(dtype)
    least = finfo.smallest_subnormal
    x = np.array([0.0, 1.0, -1.5, finfo.max, -finfo.max, finfo.tiny, least, -3 * least], dtype)
    x = np.concatenate([x, np.random.default_rng(0).normal(size=20).astype(dtype)])
    limbs = np.asarray(jax.jit(limbs_of, static_argnums=1)(x, full_count(np.dtype(dtype))))
    assert not limbs[:, :GUARDS].any()
    unit = -int(math.log2(least))
    for value, row in zip(x, limbs, strict=True):
        above, below = float(value).as_integer_ratio()
        assert number(row[GUARDS:], limb_bits(np.dtype(dtype))) == above * 2**unit // below


@pytest.mark.parametrize("count", [6, 54])
def test_carrying_keeps_numbers_and_signs(dtype, count):
    whole, narrow = limb_type(np.dtype(dtype)), np.dtype(dtype).itemsize == 4
    bits, most = limb_bits(whole), 2**31 - 2**10 - 1 if narrow else 2**62
    rows = raw_limbs(np.random.default_rng(1), whole, count, most)
    limbs, signs = (np.asarray(jax.jit(f)(rows)) for f in (carry_limbs, limb_sign))
    assert np.abs(limbs[:, :-1]).max() <= 1.26 * 2**bits
    for row, carried, sign in zip(rows[:, GUARDS:], limbs, signs, strict=True):
        value = number(row, bits)
        assert number(carried, bits) == value
        assert sign == (value > 0) - (value < 0)


@pytest.mark.parametrize("counts", [(6, 12), (54, 54), (3, 40)])
def test_products_are_exact(dtype, counts):
    whole = limb_type(np.dtype(dtype))
    bits, rng = limb_bits(whole), np.random.default_rng(2)
    most = int(1.26 * 2**bits)
    a, b = (raw_limbs(rng, whole, count, most)[:8, GUARDS:] for count in counts)
    found = np.asarray(jax.jit(limb_product)(a, b))
    assert not found[:, :GUARDS].any()
    for x, y, xy in zip(a, b, found, strict=True):
        assert number(xy[GUARDS:], bits) == number(x, bits) * number(y, bits)
