"""Corners that coincide become one, and nothing else moves."""

import jax
import numpy as np
import pytest

import jfrnn
from jfrnn.cases import meshes


def test_triangles_written_apart_hang_together_again(dtype):
    vertices, faces = meshes.sphere(1.0, 2)
    vertices = vertices.astype(dtype)
    apart = vertices[faces].reshape(-1, 3)
    merged, named = (np.asarray(a) for a in jfrnn.merge_vertices(apart, np.arange(len(apart)).reshape(-1, 3)))
    assert merged.shape == vertices.shape
    assert merged.dtype == dtype
    assert np.array_equal(merged[named], vertices[faces])
    # in the order in which they came first
    assert np.all(np.diff(np.unique(named, return_index=True)[1]) > 0)


def test_exactly_equal_corners_alone_are_one():
    up = np.nextafter(1.0, 2.0)
    vertices = np.array([[0.0, 1], [-0.0, 1], [0, up], [np.nan, 0], [np.nan, 0], [0, 1], [np.inf, 0], [np.inf, 0]])
    faces = np.arange(8).reshape(4, 2)
    merged, named = jfrnn.merge_vertices(vertices, faces)
    assert named.tolist() == [[0, 0], [1, 2], [3, 0], [4, 4]]
    assert np.array_equal(np.asarray(merged)[named], vertices[faces], equal_nan=True)
    empty, none = jfrnn.merge_vertices(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert (empty.shape, none.shape) == ((0, 3), (0, 3))


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "match"),
    [
        (np.zeros((2, 3), int), np.zeros((1, 3), int), TypeError, "vertices must be float32 or float64, got int64"),
        (np.zeros(3), np.zeros((1, 3), int), ValueError, r"vertices must have shape \[v, 3\] or \[v, 2\], got \[3\]"),
        (np.zeros((2, 3)), np.zeros((1, 3)), TypeError, "faces must be integers"),
        (np.zeros((2, 3)), np.zeros(3, int), ValueError, r"faces must have shape \[f, 3\], got \[3\]"),
        (np.zeros((2, 3)), np.array([[0, 1, 0], [0, 1, 2]]), ValueError, r"from 0 to 1: face 1 is \[0, 1, 2\]"),
    ],
)
def test_what_is_no_mesh_is_refused(vertices, faces, error, match):
    with pytest.raises(error, match=match):
        jfrnn.merge_vertices(vertices, faces)


def test_it_does_not_run_while_tracing():
    with pytest.raises(TypeError, match=r"cannot run inside jax\.jit: call it before"):
        jax.jit(jfrnn.merge_vertices)(np.zeros((2, 3)), np.zeros((1, 3), int))
