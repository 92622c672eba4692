"""Places of flags that are set, and largest numbers, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jfrnn._tracing.flags import largest_of, pack_parts, packed_places, set_places

MOST = (1, 40, 1100)


@jax.jit
def places_of(flags):
    return [set_places(flags, most) for most in MOST]


@pytest.mark.parametrize("n", [0, 1, 31, 32, 33, 1000])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 1.0])
def test_places_are_those_of_numpy(n, share):
    flags = np.random.default_rng(n).random(n) < share
    for most, got in zip(MOST, places_of(flags), strict=True):
        expected = np.full(most, n)
        found = np.flatnonzero(flags)[:most]
        expected[: len(found)] = found
        assert got.dtype == jnp.int32
        np.testing.assert_array_equal(got, expected)


def test_the_last_and_the_first_flag_of_each_word_are_found():
    for k in (0, 31, 32, 63, 64, 95):
        first, most, _ = places_of(np.arange(96) == k)
        assert first.tolist() == [k]
        assert most.tolist() == [k, *[96] * 39]


@pytest.mark.parametrize("n", [8, 32, 88, 1024])
@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 1.0])
def test_flags_that_are_packed_by_parts(n, share):
    flags = np.random.default_rng(n).random(n) < share
    packed = pack_parts(lambda rows: jnp.asarray(flags)[rows], n)
    assert int(packed.total()) == flags.sum()
    for most in MOST:
        places = np.asarray(packed_places(packed, most))
        found = places[places < n]
        assert places.tolist() == [*found, *[n] * (most - len(found))]  # what is unused stands behind
        assert len(set(found)) == len(found) == min(flags.sum(), most)
        assert flags[found].all()


@pytest.mark.parametrize("dtype", [np.int8, np.int32, np.uint32])
@pytest.mark.parametrize("shape", [(1,), (33,), (40, 3)])
def test_the_largest_number(dtype, shape):
    x = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    found = jax.jit(largest_of)(x)
    assert found.dtype == dtype
    assert found == x.max()
