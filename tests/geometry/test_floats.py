"""Quotients that are rounded once, from those of a device that divides with errors of a few units."""

import jax
import numpy as np
import pytest

from jfrnn._geometry.floats import rounded_quotient, settled_quotient


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_quotients_a_few_units_off_are_settled(dtype):
    rng = np.random.default_rng(3)
    y = rng.uniform(1, 4, 20_000).astype(dtype)
    whole = np.round(rng.uniform(1, 1000, y.size)).astype(dtype)
    near = rng.integers(-2, 3, y.size).astype(dtype)
    x = whole * y * (1 + near * np.finfo(dtype).eps)  # quotients at whole numbers, where a unit decides about the cell
    expected = x / y
    for units in (-2, -1, 0, 1, 2):
        given = expected
        for _ in range(abs(units)):
            given = np.nextafter(given, dtype(np.copysign(np.inf, units)))
        np.testing.assert_array_equal(jax.jit(settled_quotient)(x, y, given), expected)
        np.testing.assert_array_equal(jax.jit(settled_quotient)(-x, y, -given), -expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_quotients_of_any_size(dtype):
    info = np.finfo(dtype)
    x = np.array([0, 1, -1, 3, info.max, -info.max, info.tiny, 1e5, info.max / 3], dtype)
    for y in (1, 3, 0.1, info.tiny, info.max, info.max / 3, 1e-20):
        with np.errstate(over="ignore", under="ignore"):
            expected = x / dtype(y)
        actual = jax.jit(rounded_quotient)(x, np.full_like(x, y))
        within = (np.abs(expected) >= 0.5) & (np.abs(expected) < 2.0**60)
        np.testing.assert_array_equal(np.where(within, actual, 0), np.where(within, expected, 0), err_msg=f"{x} / {y}")
        np.testing.assert_allclose(actual, expected, rtol=4 * info.eps, atol=info.tiny)  # others are those of the device
