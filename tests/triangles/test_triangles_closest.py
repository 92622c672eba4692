"""Nearest points and signed distances against the oracle, finite differences, and shapes whose distance is known."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import launched
import numpy as np
import pytest
import reference
from checked import refuses, slow

import jfrnn
from jfrnn._geometry.cutoffs import make_cutoff
from jfrnn._search import norms
from jfrnn._triangles import rows as _triangles_rows
from jfrnn._triangles import warp as _triangles_warp
from jfrnn._triangles.closest import nearest_of
from jfrnn._triangles.tree import WIDTH, grow_tree, level_starts
from jfrnn._triangles.winding import cast_rays, is_closed, least_winding, ray_ways
from jfrnn.cases import meshes
from jfrnn.cases.triangles import TRIANGLE_CASES, padded
from jfrnn.kernels import _compile, triangles

KINDS = [pytest.param(np.float32, 3, id="f32-3d"), slow(np.float64, 2, id="f64-2d")]
PAIRS = 400


@jax.jit
def _nearest(points, corners):
    """Return nearest points, their vectors and distances: one program for all tests of pairs, `PAIRS` at a time."""
    vectors = nearest_of(points, corners)[0]
    return points + vectors, vectors, norms(vectors)


@pytest.mark.fully_compiled
@pytest.mark.parametrize(("dtype", "dim"), KINDS)
@pytest.mark.parametrize("name", TRIANGLE_CASES)
def test_distances_are_those_of_the_oracle(name, dtype, dim):
    given, eps = TRIANGLE_CASES[name].build(dtype, dim), float(np.finfo(dtype).eps)
    near = reference.triangle_pairs(given.positions, given.vertices, given.faces, given.cutoff)
    points, corners = np.zeros((PAIRS, dim), dtype), np.zeros((PAIRS, dim, dim), dtype)
    pairs = [sorted(near)[k] for k in sorted(np.random.default_rng(0).permutation(len(near))[:PAIRS])]
    points[: len(pairs)] = [given.positions[i] for i, _ in pairs]
    corners[: len(pairs)] = [given.vertices[given.faces[t]] for _, t in pairs]
    nearest, _, distance = map(np.asarray, _nearest(points, corners))
    for point, shape, here, far in zip(points[: len(pairs)], corners, nearest, distance):
        exact, size = reference.distance(point, shape)
        assert abs(far - exact) <= 4 * eps * size
        apart = np.linalg.norm((here.astype(float) - point) / given.cutoff) * given.cutoff
        assert abs(apart - exact) <= 4 * eps * (size + float(np.max(np.abs(point))))


@pytest.mark.parametrize(
    "name", ["random", "slivers", "degenerate", "repeated_vertices", "on_it", "copies", "not_finite", "faces_out_of_range"]
)
def test_nearest_points_of_rows_are_those_of_their_triangles(name):
    """Of the triangles in a row, and of no others; in masked slots the particle itself, at a distance of 0."""
    given = TRIANGLE_CASES[name].build(np.float32, 3)
    wide, eps = padded(given), float(np.finfo(np.float32).eps)
    tri = jfrnn.search_triangles(wide.positions, wide.vertices, wide.faces, 1.0, capacity=40)
    points, distance, mask = (np.asarray(x) for x in tri.closest(wide.positions))
    assert np.array_equal(mask, np.arange(40) < np.asarray(tri.count)[:, None])
    assert mask.any()
    idx, itself = np.asarray(tri.idx), np.broadcast_to(wide.positions[:, None], points.shape)
    assert np.array_equal(points[~mask], itself[~mask], equal_nan=True)
    assert not distance[~mask].any()
    for i, k in list(zip(*np.nonzero(mask), strict=True))[::3]:
        exact, size = reference.distance(wide.positions[i], wide.vertices[wide.faces[idx[i, k]]])
        apart = np.linalg.norm(points[i, k].astype(float) - wide.positions[i])
        assert abs(distance[i, k] - exact) <= 4 * eps * size
        assert abs(apart - exact) <= 4 * eps * (size + float(np.max(np.abs(wide.positions[i]))))


@pytest.mark.fully_compiled
def test_distances_to_slivers_do_not_depend_on_how_thin_they_are(dtype):
    rng, n, eps = np.random.default_rng(0), PAIRS, float(np.finfo(dtype).eps)
    along, across, up = np.moveaxis(np.linalg.qr(rng.normal(size=(n, 3, 3)))[0], 2, 0)
    start, length = rng.uniform(-1, 1, (n, 3)), 10 ** rng.uniform(-2, 0, (n, 1))
    width = length * 10 ** rng.uniform(np.log10(eps) - 1, 0, (n, 1))
    tip = start + rng.uniform(-0.2, 1.2, (n, 1)) * length * along + width * across
    corners = np.stack([start, start + length * along, tip], axis=1).astype(dtype)
    corners = np.array([rng.permutation(triangle) for triangle in corners])  # another side comes first
    height = 10 ** rng.uniform(np.log10(eps), 0, (n, 1)) * rng.integers(0, 4, (n, 1)).clip(max=1)
    points = (np.einsum("fk,fkd->fd", rng.dirichlet(np.ones(3), n), corners) + height * up).astype(dtype)
    vectors = np.asarray(_nearest(points, corners)[1])
    for point, triangle, vector in zip(points, corners, vectors, strict=True):
        exact, size = reference.distance(point, triangle)
        assert abs(np.linalg.norm(vector.astype(float)) - exact) <= 4 * eps * size


def test_needle_of_the_reference_figures():
    vertices, faces = joined((np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]]), np.array([[0, 1, 2]])))
    x = np.full((200, 3), np.nan)
    x[0] = [0.5, 1e-3, 1e-3]
    tri = jfrnn.search_triangles(x, vertices, faces, 1.0, capacity=48)
    distance = np.asarray(tri.closest(x)[1])[0]
    assert abs(distance[np.asarray(tri.idx)[0] == 0] - 0.00141414285346) < 1e-14


def test_a_list_that_lacks_triangles_raises_outside_jit():
    x = np.random.default_rng(0).uniform(-1.6, 1.6, (200, 3))
    whole = cube_list(x, np.float64)
    tri = dataclasses.replace(whole, status=whole.status | np.int32(jfrnn.Status.ROW_OVERFLOW), required=whole.required + 30)
    for ask in (jfrnn.TriangleList.closest, jfrnn.TriangleList.signed_distance):
        refuses(jfrnn.NeighborOverflowError, "capacity=48 is too small", ask, tri, x)
        jax.eval_shape(ask, tri, x)  # inside jit nobody knows


def cube_list(x, dtype, cutoff=1.0):
    vertices, faces = meshes.cube(2.0, 2)
    return jfrnn.search_triangles(x, vertices.astype(dtype), faces, cutoff, capacity=48)


def distance_to_cube(x):
    """Signed distance to a cube of edge 2 around the origin."""
    beyond = np.abs(x) - 1
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)


def test_signed_distance_to_a_cube():
    x = np.random.default_rng(0).uniform(-1.6, 1.6, (200, 3))
    x[:8] = np.array(
        [[1.2, 1.2, 1.2], [0.99, 0.99, 0.99], [1.2, 1.2, 0], [0.9, 0.9, 0], [1, 0, 0], [1, 1, 1], [1.0, 1, 0], [0, 0, 0]]
    )
    tri = cube_list(x, np.float64)
    signed = tri.signed_distance(x)
    assert signed.watertight
    expected = distance_to_cube(x)
    assert np.array_equal(signed.mask, np.abs(expected) < 1)
    assert np.allclose(np.where(signed.mask, expected, 0), signed.distance, atol=1e-14)
    clear, steps = np.asarray(signed.mask)[8:] & (np.abs(expected[8:]) > 1e-3), 1e-6 * np.eye(3)
    slopes = np.stack([distance_to_cube(x[8:] + step) - distance_to_cube(x[8:] - step) for step in steps], axis=1) / 2e-6
    assert np.allclose(np.asarray(signed.normal)[8:][clear], slopes[clear], atol=1e-5)
    assert min(np.sum(expected[8:][clear] < 0), np.sum(expected[8:][clear] > 0)) > 30


def test_at_a_corner_the_derivative_of_the_distance_is_the_normal():
    vertices, faces = meshes.cube(2.0, 1)
    x = jnp.asarray(vertices)
    tri = jfrnn.search_triangles(x, vertices, faces, 0.5)
    slope = jax.grad(lambda x: jnp.sum(tri.signed_distance(x).distance))(x)
    np.testing.assert_allclose(slope, np.sign(vertices) / np.sqrt(3), rtol=1e-12)
    np.testing.assert_allclose(tri.signed_distance(x).normal, slope, rtol=1e-12)


def test_where_normals_of_parts_cancel_that_of_the_nearest_face_counts():
    """Two cubes that touch in a face, all of whose sides they share: the middle of it is on a diagonal of both."""
    vertices, faces = meshes.cube(2.0, 1)
    both = np.concatenate([vertices, vertices + np.array([2.0, 0, 0])]), np.concatenate([faces, faces + len(vertices)])
    x = np.array([[1.0, 0, 0], [1.0, 0.3, 0.2], [1.0, 0.5, -0.5]])
    signed = jfrnn.search_triangles(x, *jfrnn.merge_vertices(*both), 0.2).signed_distance(x)
    np.testing.assert_allclose(np.abs(signed.normal), np.tile([1.0, 0, 0], (3, 1)), atol=1e-12)


def test_signed_distance_to_a_wall_that_has_moved():
    """Rows know the wall where it was, sides and distances are those of where it is."""
    x, by = np.random.default_rng(2).uniform(-1.6, 1.6, (200, 3)), np.array([0.3, -0.2, 0.1])
    tri = cube_list(x, np.float64)
    signed, expected = tri.signed_distance(x, vertices=tri.vertices + by), distance_to_cube(x - by)
    known = np.abs(expected) < 0.6  # nearer than what moves in from beyond the cutoff
    assert signed.watertight
    assert np.allclose(np.asarray(signed.distance)[known], expected[known], atol=1e-14)
    assert min(np.sum(expected[known] < 0), np.sum(expected[known] > 0)) > 30


def test_the_nearest_of_each_row_is_found_in_blocks_and_chunks(monkeypatch):
    x = np.random.default_rng(1).uniform(-1.6, 1.6, (200, 3))
    tri = cube_list(x, np.float64)
    _, distance, mask = (np.asarray(a) for a in tri.closest(x))
    assert int(tri.count.sum()) > 3 * len(x)  # several chunks
    monkeypatch.setattr(_triangles_rows, "_MOST_PAIRS", 200 + 20 * tri.capacity)  # and blocks of 20 rows
    given = x, np.asarray(tri.vertices)[np.asarray(tri.faces)], tri.idx, tri.count, np.ones(len(tri.faces), bool)
    cutoff = make_cutoff(tri.cutoff, np.dtype(np.float64), closed=False)
    slot, some = map(np.asarray, jax.jit(_triangles_rows.nearest_slots)(*given, cutoff))
    assert np.array_equal(some, mask.any(axis=1))
    assert np.array_equal(slot[some], np.where(mask, distance, np.inf).argmin(axis=1)[some])


@pytest.mark.parametrize("mesh", [meshes.circle(1.0, 8), meshes.cube(2.0, 2)], ids=["2d", "3d"])
@pytest.mark.parametrize("closed", [is_closed, jax.jit(is_closed)], ids=["known", "traced"])
def test_meshes_that_are_not_closed_are_told(mesh, closed):
    faces = mesh[1]
    assert closed(faces)
    turned, twice, lost, both = faces.copy(), faces.copy(), faces.copy(), faces.copy()
    turned[0], twice[0], lost[0], both[1] = faces[0, ::-1], faces[1], faces[0, 0], faces[0, ::-1]
    assert not closed(turned)
    assert not closed(twice)
    assert not closed(lost)  # collapsed: it bounds nothing
    assert not closed(both)
    assert closed(np.concatenate([faces, faces]))
    assert closed(np.concatenate([faces, faces[:3], faces[:3, ::-1]]))


def moved(mesh, by=0.0, size=1.0, turned_over=False):
    vertices, faces = mesh
    return vertices * size + np.asarray(by), faces[:, ::-1] if turned_over else faces


def joined(*parts):
    """Put meshes into one, padded with collapsed faces to the numbers of vertices and faces that other tests search among."""
    dim = parts[0][0].shape[1]
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([start + faces for start, (_, faces) in zip(starts, parts, strict=False)])
    most_vertices, most_faces = (26, 48) if dim == 3 else (64, 64)
    vertices = np.concatenate([vertices, np.repeat(vertices[:1], most_vertices - len(vertices), axis=0)])
    return vertices, np.concatenate([faces, np.zeros((most_faces - len(faces), dim), faces.dtype)])


def walls(dim):
    """Closed parts that meet: their names, and those parts."""
    part = meshes.cube(1.0, 1) if dim == 3 else meshes.circle(1.0, 4)
    beside, within = np.array([1.0, 0, 0][:dim]), np.array([0.6, 0.2, 0.1][:dim])
    if dim == 2:  # a square along the axes, so that parts may touch all along a side
        part = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]), part[1]
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(dim, dim)))[0]
    turn[:, 0] *= np.sign(np.linalg.det(turn))
    askew = part[0] @ turn.T, part[1]
    return {
        "one": [part],
        "apart": [part, moved(part, 3 * beside)],
        "overlapping": [part, moved(part, within)],
        "crossing": [part, moved(askew, 0.3 * within)],
        "touching": [part, moved(part, beside)],
        "touching in part": [part, moved(part, beside + 0.5 * (within - within[0]))],
        "at a vertex": [part, moved(part, np.ones(dim))],
        "nested": [part, moved(part, 0.05, 0.5), moved(part, 0.05, 0.3)],
        "doubled": [part, part],
        "hollow": [part, moved(part, 0.05, 0.5, turned_over=True)],
        "container": [moved(part, size=1.2, turned_over=True)],
        "full container": [moved(part, size=1.2, turned_over=True), moved(part, -0.1, 0.5), moved(part, -0.2, 0.4)],
        "undone": [part, moved(part, turned_over=True)],
    }


def around(dim, dtype):
    """Return points at random, and such that are level with faces, sides and vertices."""
    random = np.random.default_rng(1)
    random_points = random.uniform(-0.8, 1.6, (140, dim))
    level = random.choice([-0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25], (60, dim))
    level[np.arange(60), random.integers(0, dim, 60)] += random.choice([-1e-6, 1e-3, 1e-6], 60)
    return np.concatenate([random_points, level]).astype(dtype)


def test_sides_of_a_wall_that_is_open():
    """A spike without a bottom, one of whose three sides is a triangle and the others fans of many: angles are the weights."""
    corners = np.array([[np.cos(a), np.sin(a), 0] for a in (0, 2 * np.pi / 3, 4 * np.pi / 3)]) * 0.3
    share = np.arange(1, 6)[:, None] / 6
    ring = [corners[:2], *((1 - share) * a + share * b for a, b in zip(corners[1:], corners[[2, 0]], strict=True))]
    ring = np.concatenate([*ring[:2], corners[2:], ring[2]])
    named = np.arange(1, len(ring) + 1)
    wall = np.concatenate([[[0, 0, 1.0]], ring]), np.stack([np.zeros_like(named), named, np.roll(named, -1)], axis=1)
    outward = np.cross(corners - [0, 0, 1], np.roll(corners, -1, axis=0) - [0, 0, 1])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    random = np.random.default_rng(4)
    beyond = random.dirichlet(np.full(3, 0.3), 120) @ outward * random.uniform(0.01, 0.5, (120, 1))
    within = random.dirichlet(np.ones(3), 80) @ corners * 0.9
    height = random.uniform(0.5, 0.9, (80, 1))
    tip = np.array([0, 0, 1.0])
    x = np.concatenate([tip + beyond, within * (1 - height) + tip * height])
    vertices, faces = joined(wall)
    tri = jfrnn.search_triangles(x, vertices, faces, 1.0, capacity=48, backend="bvh")
    signed = tri.signed_distance(x)
    assert not signed.watertight
    assert np.all(signed.mask)
    assert np.allclose(signed.distance[:120], np.linalg.norm(beyond, axis=1), atol=1e-14)
    assert np.all(np.asarray(signed.distance[120:]) < 0)


@pytest.mark.parametrize("traced", [False, True])
def test_a_wall_is_as_watertight_without_particles(traced):
    vertices, faces = meshes.cube(2.0, 1)
    lost = vertices.copy()
    lost[0, 0] = np.nan

    def watertight(vertices, faces):
        none = jfrnn.search_triangles(np.zeros((0, 3)), vertices, faces, 0.5, capacity=1)
        return none.signed_distance(np.zeros((0, 3))).watertight

    told = jax.jit(watertight) if traced else watertight
    assert told(vertices, faces)
    assert told(vertices, faces[:0])
    assert not told(vertices, faces[1:])
    assert not told(lost, faces)


def test_lists_that_vmap_made_are_asked_one_at_a_time():
    vertices, faces = meshes.cube(2.0, 1)
    x = np.random.default_rng(0).uniform(0.8, 1.2, (2, 5, 3))
    both = jax.vmap(lambda x: jfrnn.search_triangles(x, vertices, faces, 0.5, capacity=12))(x)
    for positions, match in ((x, "positions must have shape"), (x[0], r"a list at a time is asked, got idx of shape \[2, 5, 12\]")):
        for asked in (both.closest, both.contacts, both.signed_distance, both.update, both.grow):
            with pytest.raises(ValueError, match=match):
                asked(positions)
    assert jax.vmap(lambda tri, x: tri.signed_distance(x).mask)(both, x).any()


def test_a_wall_with_a_lost_corner_is_not_watertight():
    """It has a hole there, through which rays go; the sides of the other faces are those of the cube."""
    vertices, faces = meshes.cube(2.0, 2)
    x = np.random.default_rng(5).uniform(-1.6, 1.6, (200, 3))
    at = int(np.argmax(vertices.sum(axis=1)))  # a corner of the cube
    vertices[at] = np.nan
    tri = jfrnn.search_triangles(x, vertices, faces, 1.0, capacity=48, backend="bvh")
    signed, expected = tri.signed_distance(x), distance_to_cube(x)
    assert tri.closed
    assert not signed.watertight
    clear = np.asarray(signed.mask) & (x.max(axis=1) < 0)
    assert np.allclose(np.asarray(signed.distance)[clear], expected[clear], atol=1e-14)
    assert clear.sum() > 10


WALLS = [(dim, name) for dim in (2, 3) for name in walls(dim)]
SOME = slice(None, None, 3)  # of points around walls, those whose sides the oracle is asked for
_known = {}


def expected_side(x, vertices, faces, name="one"):
    """Say which points are inside, and which are on a face, where there is no side. Asked again, the answer is there."""
    key = x.tobytes(), vertices.tobytes(), faces.tobytes()
    numbers = _known[key] = _known.get(key) or [reference.winding_number(point, vertices, faces) for point in x]
    least = 0 if "container" in name else 1
    return np.array([number is not None and number >= least for number in numbers]), np.array([x is None for x in numbers])


@pytest.mark.parametrize("backend", ["bvh", slow("warp"), slow("jax")])
@pytest.mark.parametrize("dtype", [np.float64, slow(np.float32)])
@pytest.mark.parametrize(("dim", "name"), WALLS)
def test_signs_are_those_of_the_union(dim, name, dtype, backend):
    vertices, faces = joined(*walls(dim)[name])
    vertices, x = vertices.astype(dtype), around(dim, dtype)
    cutoff, capacity = (1.0, 48) if dim == 3 else (0.5, 72)
    tri = jfrnn.search_triangles(x, vertices, faces, cutoff, capacity=capacity, backend=backend)
    tri.check()
    signed = tri.signed_distance(x)
    mask, distance = np.asarray(signed.mask), np.asarray(signed.distance)
    assert signed.watertight
    assert mask.sum() > 100
    away = np.asarray(signed.normal) * distance[:, None]
    off = mask & (distance != 0)
    assert np.allclose(np.linalg.norm(away[off], axis=1), np.abs(distance[off]), rtol=1e-5)
    _, apart, near = (np.asarray(part) for part in tri.closest(x))
    assert np.allclose(np.abs(distance[mask]), np.where(near, apart, np.inf).min(axis=1)[mask], rtol=1e-6)
    mask, distance = mask[SOME], distance[SOME]
    inside, on_face = expected_side(x[SOME], vertices, faces, name)
    assert np.all(np.abs(distance[on_face]) < np.finfo(dtype).eps)
    mask = mask & ~on_face
    clear = mask & (np.abs(distance) > 4 * np.finfo(dtype).eps)
    assert clear.sum() > max(mask.sum() - 8, 30)
    assert np.array_equal(distance[clear] < 0, inside[clear])
    assert inside[mask].any() == (name != "undone")


@jax.jit
def cast_both_ways(vertices, faces, x, asked=None):
    """Return what rays of arrays tell, and those of kernels: which points are inside, and which are left open."""
    corners, good, dtype = vertices[faces], jnp.ones(len(faces), bool), np.dtype(x.dtype)
    cutoff = make_cutoff(0.25, dtype, closed=False)
    tree, rays = grow_tree(corners, good, cutoff), ray_ways(x.shape[1], dtype)
    given = tree, corners, x, rays, jnp.ones(len(x), bool) if asked is None else asked, least_winding(corners, good), cutoff
    return cast_rays(*given), _triangles_warp.cast_rays(*given)


def test_rays_from_within_rounding_of_a_face(dtype):
    """They tell the right side, or none; those of kernels tell it wherever positions are float32."""
    random = np.random.default_rng(6)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    vertices, faces = joined((walls(2)["one"][0][0] @ turn.T, walls(2)["one"][0][1]))
    vertices, share = vertices.astype(dtype), random.uniform(0.1, 0.9, (200, 1))
    start, end = (vertices[faces[np.arange(200) % 4, k]].astype(float) for k in range(2))
    x = ((1 - share) * start + share * end).astype(dtype)
    expected, on_face = expected_side(x, vertices, faces)
    for k, (inside, unknown) in enumerate(cast_both_ways(vertices, faces, x)):
        sure = ~np.asarray(unknown) & ~on_face
        assert np.array_equal(np.asarray(inside)[sure], expected[sure])
        assert (sure | on_face).all() == (k == 1 and dtype == np.float32)
    assert 50 < expected.sum() < 150


@pytest.mark.parametrize("dim", [2, slow(3)])  # in 3D the next test does, with one wall
@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
def test_rays_without_warp(dim, dtype):
    """Rays of arrays tell the sides that those of kernels do, or leave them open."""
    for name, parts in walls(dim).items():
        vertices, faces = joined(*parts)
        vertices, x = vertices.astype(dtype), around(dim, dtype)
        (inside, unknown), (surely, still) = jax.tree.map(np.asarray, cast_both_ways(vertices, faces, x))
        apart = ~unknown & ~still
        assert np.array_equal(inside[apart], surely[apart])
        expected, on_face = expected_side(x[SOME], vertices, faces, name)
        level = np.arange(200)[SOME] >= 140
        for told, sure in ((inside[SOME], ~unknown[SOME]), (surely[SOME], ~still[SOME])):
            assert (sure | on_face | level).all()
            assert np.array_equal(told[sure & ~on_face], expected[sure & ~on_face])
        assert dtype == np.float64 or not np.any(still[SOME] & ~on_face)


def test_rays_through_a_tree_of_many_levels():
    """Gears of 6 000 and of 200 faces, one through the other, cast in chunks that do not hold all, as particles move."""
    vertices, faces = meshes.gear(12, 6000, 1.0, 2.0, 3.0)
    more, others = meshes.gear(6, 200, 1.0, 8.0, 2.0)
    both = np.concatenate([vertices, more + np.array([1.0, 0, 0])]).astype(np.float32)
    faces = np.concatenate([faces, others + len(vertices)])
    x = np.random.default_rng(0).uniform(both.min(axis=0), both.max(axis=0), (3000, 3)).astype(np.float32)
    tri = jfrnn.search_triangles(x, both, faces, 0.2, capacity=1, backend="bvh")
    asked = np.asarray(tri.count) > 0
    sides = [np.asarray(inside) & ~np.asarray(unknown) for inside, unknown in cast_both_ways(both, faces, x, asked)]
    assert np.array_equal(*sides)
    assert not sides[0][~asked].any()
    some = np.flatnonzero(asked)[:: asked.sum() // 8]
    expected, _ = expected_side(x[some], both, faces)
    assert np.array_equal(sides[0][some], expected)
    assert len(set(expected)) == 2


@pytest.mark.parametrize("dim", [slow(2), 3])
@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
def test_kernel_for_cuda(dim, dtype):
    """It compiles for a GPU, nothing contracted; its text for the CPU tells the sides, too."""
    double = dtype == np.float64
    program = _compile.find_binary(triangles.side_kernel(dim, double, WIDTH, cuda=True).program, arch=90).read_text()
    assert not re.search(r"\bfma\.|\b(mul|add|sub)\.f(32|64)", program)
    vertices, faces = joined(*walls(dim)["crossing"])
    vertices, x = vertices.astype(dtype), around(dim, dtype)
    tri = jfrnn.search_triangles(x, vertices, faces, 0.5, capacity=48, backend="bvh")
    given = {"positions": x, "corners": vertices[faces], "boxes": tri.cells.boxes, "cutoff": np.array([0.5], dtype)}
    given |= {"rays": ray_ways(dim, np.dtype(dtype)), "start": level_starts(len(faces)), "triangles": tri.cells.triangles}
    side = np.full(len(x), -7, np.int32)
    given |= {"asked": np.ones(len(x), np.int32), "least": np.ones(1, np.int32), "side": side, "info": np.zeros(1, np.int32)}
    arrays = {name: np.ascontiguousarray(array) for name, array in given.items()}
    sizes = {"n": len(x), "levels": len(arrays["start"]) - 1, "entries": tri.cells.boxes.shape[1]}
    launched.on_cpu(triangles.side_kernel(dim, double, WIDTH, cuda=False), **arrays, **sizes)
    inside, on_face = expected_side(x, vertices, faces)
    assert np.array_equal(side[~on_face], inside[~on_face])


SPHERE = meshes.sphere(1.0, 2)


@jax.jit
def energy_and_slopes(x, v, tri, weights):
    """Return a sum of terms, each times a weight, and its derivatives in particles and vertices; and distances: one program."""

    def energy(x, v):
        points, distance, mask = tri.closest(x, vertices=v)
        signed = tri.signed_distance(x, vertices=v)
        terms = jnp.where(mask, (0.4 - distance) ** 3, 0), points**3, signed.distance**2, distance, signed.distance
        return sum(weight * jnp.sum(term) for weight, term in zip(weights, terms)), distance

    return jax.value_and_grad(energy, (0, 1), has_aux=True)(x, v)


def test_gradients_are_those_of_finite_differences():
    vertices, faces = SPHERE
    x = np.random.default_rng(2).normal(size=(12, 3))
    x *= np.random.default_rng(3).uniform(0.8, 1.2, (12, 1)) / np.linalg.norm(x, axis=1, keepdims=True)
    tri, weights = jfrnn.search_triangles(x, vertices, faces, 0.4, capacity=32), np.array([1.0, 1, 1, 0, 0])
    gradients = energy_and_slopes(x, vertices, tri, weights)[1]
    random = np.random.default_rng(4)
    for _ in range(3):
        dx, dv = random.normal(size=x.shape), random.normal(size=vertices.shape)
        h = 1e-6
        ahead, behind = (float(energy_and_slopes(x + s * dx, vertices + s * dv, tri, weights)[0][0]) for s in (h, -h))
        slope = (ahead - behind) / (2 * h)
        assert np.isclose(np.vdot(gradients[0], dx) + np.vdot(gradients[1], dv), slope, rtol=1e-5)


@pytest.mark.slow
def test_second_derivatives_are_those_of_finite_differences():
    vertices, faces = meshes.sphere(1.0, 2)
    x = np.random.default_rng(5).normal(size=(4, 3))
    x *= 1.1 / np.linalg.norm(x, axis=1, keepdims=True)
    tri = jfrnn.search_triangles(x, vertices, faces, 0.4, capacity=32)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(tri.closest(x)[1] ** 3)))
    hessian = jax.jacfwd(gradient)(x).reshape(12, 12)
    steps = 1e-6 * np.eye(12).reshape(12, 4, 3)
    slopes = np.stack([np.ravel(gradient(x + h) - gradient(x - h)) / 2e-6 for h in steps])
    assert np.allclose(hessian, slopes, atol=1e-5)


@pytest.mark.parametrize("where", ["face", "side", "vertex", "degenerate"])
def test_gradients_are_finite_at_contact(where):
    """Particles and faces beyond the first are far away: they bring the scene to the shapes of the last but one test."""
    vertices, faces = np.full(SPHERE[0].shape, 9.0), np.full(SPHERE[1].shape, 4)
    vertices[:4] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 2, 2]]
    x = np.full((12, 3), -9.0)
    x[0] = {"face": [0.25, 0.25, 0], "side": [0.5, 0, 0], "vertex": [0, 0, 0], "degenerate": [2, 2, 2]}[where]
    faces[0] = [3, 3, 3] if where == "degenerate" else [0, 1, 2]
    tri = jfrnn.search_triangles(x, vertices, faces, 0.4, capacity=32)
    assert np.asarray(tri.count).tolist() == [1] + [0] * 11
    (_, distance), gap = energy_and_slopes(x, vertices, tri, np.array([0.0, 0, 0, 1, 0]))
    side = energy_and_slopes(x, vertices, tri, np.array([0.0, 0, 0, 0, 1]))[1]
    assert float(np.asarray(distance)[0, 0]) == 0
    assert all(np.all(np.isfinite(g)) for g in (*gap, *side))
    assert not np.any(gap[0])
    if where == "face":
        assert np.allclose(np.asarray(side[0])[0], [0, 0, 1])
