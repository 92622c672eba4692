"""Meshes of walls are closed, turned outwards, and as large as they say; corners that coincide become one."""

import math
from collections import Counter

import jax
import numpy as np
import pytest
from checked import refuses

import jfrnn
from jfrnn.cases import meshes

CLOSED = {
    "cube": meshes.cube(2.0, 3),
    "sphere": meshes.sphere(1.5, 8),
    "pipe": meshes.pipe(0.5, 1.0, 3.0, 24, 5),
    "gear": meshes.gear(17, 3000),
    "gear_many_teeth": meshes.gear(60, 8000, module=0.5),
    "gear_few_teeth": meshes.gear(9, 500, bore=2.0),
    "gear_pair": meshes.gear_pair((11, 23), 4000, bore=3.0)[1],
}


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.sum(a * np.cross(b, c)) / 6


@pytest.mark.parametrize("name", CLOSED)
def test_each_side_runs_both_ways_once(name):
    vertices, faces = CLOSED[name]
    sides = Counter((int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3))
    assert set(sides.values()) == {1}
    assert all((b, a) in sides for a, b in sides)
    assert sorted(set(faces.reshape(-1).tolist())) == list(range(len(vertices)))
    assert len(vertices) - len(sides) // 2 + len(faces) == (2 if name in ("cube", "sphere") else 0)  # Euler: sphere or torus
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 0  # areas


def test_volumes():
    assert math.isclose(volume(*meshes.cube(2.0, 3)), 8)
    assert math.isclose(volume(*meshes.sphere(1.0, 32)), 4 / 3 * math.pi, rel_tol=5e-3)
    assert math.isclose(volume(*meshes.pipe(0.5, 1.0, 3.0, 400, 2)), 3 * 0.75 * math.pi, rel_tol=1e-3)
    assert math.isclose(volume(*meshes.gear(20, 12_000)), 10 * math.pi * (10**2 - 2.5**2), rel_tol=0.05)


def test_caps_of_a_gear_are_flat_and_simple():
    """Seen from above, faces of the upper end are all turned up: the outline and the bore do not fold over each other."""
    vertices, faces = meshes.gear(17, 3000)
    top = faces[np.all(vertices[faces][:, :, 2] == 5.0, axis=1)]
    a, b, c = (vertices[top[:, k]] for k in range(3))
    assert len(top) == 2 * np.sum(vertices[:, 2] == 5.0) // 2
    assert np.cross(b - a, c - a)[:, 2].min() > 0


@pytest.mark.parametrize("faces", [2000, 12_000, 100_000])
def test_gears_have_about_as_many_faces(faces):
    assert abs(len(meshes.gear(20, faces)[1]) / faces - 1) < 0.05


def test_flanks_are_involutes():
    """The normal of an involute touches the base circle."""
    line, _ = meshes.gear_outline(20, 1.0, 203)
    flank = line[2:102]
    normal = np.stack([np.gradient(flank[:, 1]), -np.gradient(flank[:, 0])], axis=1)[1:-1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    reach = np.abs(flank[1:-1, 0] * normal[:, 1] - flank[1:-1, 1] * normal[:, 0])
    assert np.allclose(reach[5:], 10 * math.cos(math.radians(20)), rtol=1e-3)


def inside(points, line):
    """Count crossings of a ray along x with a closed line: odd inside."""
    a, b = line, np.roll(line, -1, axis=0)
    x, y = points[:, None, 0], points[:, None, 1]
    across = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return np.sum(across & (x < at), axis=1) % 2 == 1


def test_gears_in_mesh_touch_but_do_not_overlap():
    lines = [v[v[:, 2] == 5.0][:, :2] for v, _ in meshes.gear_pair((20, 30), 4000)]
    first, second = (line[: len(line) // 2] for line in lines)  # the outline, then the bore
    assert np.allclose(second.mean(axis=0), [25, 0], atol=0.1)
    assert not np.any(inside(first, second))
    assert not np.any(inside(second, first))
    assert np.linalg.norm(first[:, None] - second, axis=-1).min() < 0.1
    assert np.any(inside(first, second - [0.2, 0]))


def test_the_sharpest_tip_is_not_pointed():
    line, _ = meshes.gear_outline(5, 1.0, 8, pressure_angle=30.0)
    angle = np.unwrap(np.arctan2(line[:, 1], line[:, 0]))
    assert np.all(np.diff(angle) > 0)


def test_lines_in_2d():
    for vertices, faces in (meshes.circle(2.0, 100), meshes.gear_outline(12, 1.0, 10)):
        a, b = vertices[faces[:, 0]], vertices[faces[:, 1]]
        assert np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 0
        assert np.array_equal(np.sort(faces.reshape(-1)), np.repeat(np.arange(len(vertices)), 2))
    assert np.allclose(np.linalg.norm(meshes.circle(2.0, 100)[0], axis=1), 2)


def test_a_plate_is_a_sheet():
    vertices, faces = meshes.plate((2.0, 4.0), (2, 3))
    assert (vertices.shape, faces.shape) == ((12, 3), (12, 3))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert np.allclose(np.cross(b - a, c - a), [0, 0, 4 / 3])


def test_what_is_refused():
    refuses(ValueError, "inner must be below outer", meshes.pipe, 1.0, 1.0)
    refuses(ValueError, "bore must be below", meshes.gear, 20, 1000, bore=18.0)
    refuses(ValueError, "pressure_angle must lie", meshes.gear_outline, 20, pressure_angle=45.0)
    refuses(ValueError, "teeth must lie", meshes.gear, 4)


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
    refuses(error, match, jfrnn.merge_vertices, vertices, faces)


def test_vertices_that_would_be_rounded_are_refused():
    with jax.enable_x64(False):
        refuses(
            TypeError,
            "vertices are float64, but JAX's 64-bit mode is off",
            jfrnn.merge_vertices,
            np.zeros((1, 3)),
            np.zeros((1, 3), int),
        )


def test_it_does_not_run_while_tracing():
    with pytest.raises(TypeError, match=r"cannot run inside jax\.jit: call it before"):
        jax.jit(jfrnn.merge_vertices)(np.zeros((2, 3)), np.zeros((1, 3), int))
