"""`backend="hashgrid"` where `wp.HashGrid` has its corners: shared buckets, cells beyond 32 bits, NaN, one program per cutoff."""

import ctypes
import re
from concurrent.futures import ThreadPoolExecutor

import checked
import jax
import jax.numpy as jnp
import launched
import numpy as np
import pytest

import jfrnn
from jfrnn._engine import auto
from jfrnn.kernels import _clang, hashgrid


@pytest.mark.parametrize(
    ("sources", "dim", "shape"),
    [
        (1, 2, (16, 16, 1)),
        (1, 3, (16, 16, 16)),
        (2048, 3, (16, 16, 16)),
        (2049, 3, (32, 16, 16)),
        (10**6, 3, (128, 128, 128)),
        (10**6, 2, (2048, 1024, 1)),
        (2**31 - 32, 2, (4096, 4096, 1)),
        (2**31 - 32, 3, (256, 256, 256)),
    ],
)
def test_grid_follows_the_particles(sources, dim, shape):
    assert hashgrid.grid_shape(sources, dim) == shape


def test_distant_cells_that_share_a_bucket(dtype, dim):
    """Blobs whole rounds of the grid apart, on both sides of the origin: every bucket holds particles of all of them."""
    rng = np.random.default_rng(0)
    rounds = rng.integers(-3, 4, (400, dim)) * 16 * 0.25
    points = (rng.random((400, dim)) + rounds).astype(dtype)
    checked.assert_exact(jfrnn.search(points, 0.25, backend="hashgrid"), points, 0.25)


@pytest.mark.parametrize("offset", [-(2**20) - 0.5, 2**20, -(2**31), 2**31, -(2**40), 2**40])
def test_cells_that_do_not_fit_a_grid(offset, dtype, dim):
    """In units of the cutoff: where Warp 1.18 clamped, and where cell numbers leave 32 bits."""
    cutoff = 2.0**-5
    points = ((np.random.default_rng(1).integers(-9, 9, (200, dim)) / 3 + offset) * cutoff).astype(dtype)
    checked.assert_exact(jfrnn.search(points, cutoff, backend="hashgrid"), points, cutoff)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_mostly_padding(value, dtype, dim):
    points = np.random.default_rng(2).random((500, dim)).astype(dtype)
    points[50:, 0] = value
    nbrs = jfrnn.search(points, 0.3, backend="hashgrid", include_self=True)
    checked.assert_exact(nbrs, points, 0.3, include_self=True)
    assert not nbrs.count[50:].any()
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE


def test_sizes_and_cutoffs_take_turns():
    """The grid of one shape serves all: nothing of the last search may be left in it."""
    for n, cutoff in [(900, 0.1), (3, 2.0), (1000, 0.05), (1, 1.0), (900, 0.2)]:
        points = np.random.default_rng(n).random((n, 3)).astype(np.float32)
        checked.assert_exact(jfrnn.search(points, cutoff, backend="hashgrid"), points, cutoff)


def test_threads_that_search_at_once_get_what_is_theirs():
    """They share one grid, and each builds its own points into it."""
    cases = [np.random.default_rng(n).random((n, 3)).astype(np.float32) for n in range(1500, 1508)]
    search = [jax.jit(lambda x, r=0.1 + 0.01 * k: jfrnn.search(x, r, capacity=400, backend="hashgrid").idx) for k in range(8)]
    expected = [np.asarray(work(x)) for work, x in zip(search, cases)]
    with ThreadPoolExecutor(4) as threads:
        found = [threads.submit(work, x) for _ in range(5) for work, x in zip(search, cases)]
        for k, each in enumerate(found):
            np.testing.assert_array_equal(each.result(), expected[k % 8])
    checked.assert_exact(jfrnn.search(cases[3], 0.13, backend="hashgrid"), cases[3], 0.13)


@pytest.mark.parametrize("others", [None, 9])
def test_on_cuda_warp_builds_on_the_stream_of_the_call(dtype, others):
    """Warp's functions are called as its own Python does, and go back to their stream, unless others set theirs meanwhile."""
    told, stream = [], [5]

    def update(grid, kind, width, points, groups):
        told.append((grid, kind, width, points[0], groups, stream[0]))
        stream[0] = others or stream[0]

    def set_stream(context, given, wait):
        assert (context, wait) == (11, 0)
        stream[0] = given

    word, number = ctypes.c_void_p, ctypes.c_int
    kinds = word, number, ctypes.c_double, ctypes.POINTER(word), word
    functions = {
        "update": ctypes.CFUNCTYPE(None, *kinds)(update),
        "get_stream": ctypes.CFUNCTYPE(word, word)(lambda context: stream[0]),
        "set_stream": ctypes.CFUNCTYPE(None, word, word, number)(set_stream),
    }
    given = {name: ctypes.cast(function, word).value for name, function in functions.items()}
    points, width = np.zeros(8), 0.1 + 2.0**-60
    given |= {"scratch": 3, "stream": 7, "grid": 13, "points": points, "context": 11}
    launched.on_cpu(hashgrid.build_kernel(dtype == np.float64), **given, **hashgrid.split_width(width))
    assert told == [(13, 2 if dtype == np.float64 else 1, width, 3, None, 7)]
    assert stream == [others or 5]


def test_two_cutoffs_in_one_program():
    points = np.random.default_rng(4).random((300, 2)).astype(np.float32)

    @jax.jit
    def both(x):
        return [jfrnn.search(x, cutoff, capacity=100, backend="hashgrid") for cutoff in (0.1, 0.2)]

    for nbrs, cutoff in zip(both(points), (0.1, 0.2)):
        checked.assert_exact(nbrs, points, cutoff)


def test_the_program_names_the_cutoff():
    """JAX's persistent compilation cache knows a kernel by what the program says of it alone."""
    x = jnp.zeros((5, 3), jnp.float32)
    names = set()
    for cutoff in (0.25, 4.0, 0.3, np.nextafter(np.float32(0.3), np.float32(1))):
        counted = jax.jit(lambda x, r=cutoff: jfrnn.count(x, r, backend="hashgrid"))
        text = counted.trace(x).lower(lowering_platforms=("cpu",)).as_text()
        names |= set(re.findall(r'kernel = "(jfrnn_hashgrid_cpu_3d_f32_own_dropself_0x[^"]+)@', text))
    assert len(names) == 4


def test_warp_1_18_is_refused(monkeypatch):
    monkeypatch.setattr(_clang, "warp_version", lambda: "1.18.0")
    monkeypatch.setattr(auto, "_what_is_missing", auto._what_is_missing.__wrapped__)
    assert jfrnn.count(np.zeros((3, 2), np.float32), 1.1875, backend="warp").tolist() == [2, 2, 2]
    with pytest.raises(RuntimeError, match=r"cannot run .*: the HashGrid of warp-lang 1\.18\.0 can list a pair twice: pip install"):
        jfrnn.count(np.zeros((3, 2), np.float32), 1.1875, backend="hashgrid")
