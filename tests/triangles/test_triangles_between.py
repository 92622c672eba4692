"""Which pairs of particles have a triangle between them, beside exact rational arithmetic."""

import jax
import numpy as np
import pytest
import reference
from checked import slowly

import jfrnn

N, FACES, CORNERS = 64, 3, 9
PAIRS = np.random.default_rng(0).integers(0, N, (400, 2))
PAIRS[:N] = np.arange(N)[:, None] ^ [0, 1]  # particles 2k and 2k + 1, and padding
PAIRS[-3:] = [[-1, 2], [N, N], [3, N]]


def points(kind, rng, dim, dtype):
    """Return particles and corners: on few sites, so that much meets sides and corners; through those within rounding; anywhere."""
    if kind == "sites":
        return (rng.integers(0, 5, (size, dim)).astype(dtype) / dtype(3) for size in (N, CORNERS))
    if kind == "of all sizes":  # too far apart for usual integers
        sizes = (rng.integers(-2, 3, (size, dim)) * 10.0 ** rng.integers(-9, 0, (size, dim)) for size in (N, CORNERS))
        return (size.astype(dtype) for size in sizes)
    corners, x = rng.random((CORNERS, dim)).astype(dtype), rng.random((N, dim))
    if kind == "through sides":
        shares = rng.dirichlet(np.ones(dim), N // 2) * (rng.random((N // 2, dim)) < 0.7)
        met = np.einsum("kc,kcd->kd", shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-9), corners[faces_of(N // 2, dim)])
        way = rng.normal(size=met.shape) / 3
        x[0::2], x[1::2] = met - way, met + way
    return x.astype(dtype), corners


def faces_of(count, dim):
    """Return the corners of so many triangles, in turns."""
    return np.resize(np.arange(FACES * dim).reshape(FACES, dim), (count, dim))


@pytest.mark.parametrize(("dim", "dtype"), [(3, np.float32), *slowly((3, np.float64), (2, np.float32), (2, np.float64))])
def test_who_is_parted(dim, dtype):
    rng, faces = np.random.default_rng(2), faces_of(FACES, dim)
    between = jax.jit(lambda tri, x: tri.between(x, PAIRS))
    for kind in ("sites", "of all sizes", "through sides", "anywhere"):
        x, corners = points(kind, rng, dim, dtype)
        tri = jfrnn.search_triangles(x, corners, faces, 100.0, capacity=FACES)
        found = np.asarray(between(tri, x))
        expected = [any(reference.is_parted(x[i], x[j], corners[face]) for face in faces) for i, j in PAIRS[:-3]]
        assert 20 < sum(expected) < 380, kind
        np.testing.assert_array_equal(found, [*expected, False, False, False], err_msg=kind)


def test_every_integer_type_names_the_same_particles():
    """The last number of int8 is that of a particle, too, where there are more."""
    x = np.ones((200, 3), np.float32)
    x[127], x[5] = [0.2, 0.2, 0.1], [0.2, 0.2, -0.1]
    corners = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    tri = jfrnn.search_triangles(x, corners, np.array([[0, 1, 2]]), 9.0, capacity=1)
    for dtype in (np.int8, np.uint8, np.int16, np.uint32, np.int32, np.int64):
        assert tri.between(x, np.array([[127, 5], [5, 127], [127, 6]], dtype)).tolist() == [True, True, False], dtype


def test_errors():
    x = np.zeros((2, 3), np.float32)
    tri = jfrnn.search_triangles(x, np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), 1.0, capacity=1)
    with pytest.raises(TypeError, match=r"pairs must be integers of shape \[e, 2\].*got float64 of shape \[2\]"):
        tri.between(x, np.zeros(2))
    assert tri.between(x, np.zeros((0, 2), int)).shape == (0,)
