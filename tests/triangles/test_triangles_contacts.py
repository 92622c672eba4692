"""Contacts: one per wall, whose triangles share sides and corners; and which pairs of particles have a triangle between them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slow, slowly
from jax.extend.core import jaxprs_in_params

import jfrnn
from jfrnn._triangles import triangle_list as _triangles_list
from jfrnn._triangles.closest import nearest_of
from jfrnn.cases import meshes

CAPACITY = 40


def asked(x, vertices, faces, dtype=np.float64, cutoff=0.35):
    """Return the list of points, and its contacts: points, distances, mask."""
    tri = jfrnn.search_triangles(x.astype(dtype), vertices.astype(dtype), faces, cutoff, capacity=CAPACITY)
    tri.check()
    return tri, *(np.asarray(part) for part in tri.contacts(x.astype(dtype)))


def turned(rng, *arrays):
    """Turn and move all arrays as one, so that nothing lies on an axis."""
    turn, move = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
    return [array @ turn.T + move for array in arrays]


def plate_and_points():
    """Return a plate of 128 triangles, and 150 points over it: over a vertex, over a side, elsewhere."""
    vertices, faces = meshes.plate((2.0, 2.0), (8, 8))
    x = np.random.default_rng(3).uniform(-0.9, 0.9, (150, 3)) * np.array([1, 1, 0.3])
    x[:2] = [[0.25, 0.5, 0.125], [0.25, 0.625, 0.125]]
    return x, vertices, faces


def in_a_large_scene(x, vertices, faces):
    """Add particles and a face far away, so that a plate takes the program of the box: 2000 particles, 98 corners, 192 faces."""
    far, corners = np.full((2000 - len(x), 3), -99.0), np.full((98 - len(vertices), 3), 99.0)
    named = np.full((192 - len(faces), 3), 97)
    return np.concatenate([x, far]), np.concatenate([vertices, corners]), np.concatenate([faces, named])


def on_triangles(rng, vertices, faces, n):
    """Return points over faces, sides and corners, or beside them by all magnitudes."""
    weights = rng.dirichlet(np.ones(faces.shape[1]), n)
    kind = rng.integers(0, 3, n)
    weights[kind == 1, 0] = 0
    weights[kind == 2, :-1] = 0
    points = np.einsum("nk,nkd->nd", weights / weights.sum(axis=1, keepdims=True), vertices[faces[rng.integers(0, len(faces), n)]])
    return points + rng.normal(size=points.shape) * 10 ** rng.uniform(-9, -1, (n, 1)) * rng.integers(0, 2, (n, 1))


@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
def test_a_flat_wall_of_many_triangles_is_one_contact(dtype):
    rng, (_, vertices, faces) = np.random.default_rng(0), plate_and_points()
    faces, n = rng.permutation(faces), 2000
    x = np.clip(on_triangles(rng, vertices, faces, n), -1, 1)
    x[:, 2] = rng.choice([0, 1e-6, 0.01, 0.1, 0.29], n) * rng.choice([-1, 1], n)
    for points, corners in ([x, vertices], turned(rng, x, vertices)):
        tri, _, distance, mask = asked(points, corners, faces, dtype)
        assert np.mean(tri.count) > 10
        assert np.array_equal(mask.sum(axis=1), np.ones(n))
        assert np.allclose(distance[mask], np.abs(x[:, 2]), atol=1e-6)


def test_a_box_has_one_contact_outside_and_one_per_wall_inside():
    rng = np.random.default_rng(1)
    vertices, faces = meshes.cube(2.0, 4)
    faces, n = rng.permutation(faces), 2000
    x = np.concatenate([on_triangles(rng, vertices, faces, n // 2), rng.uniform(-1, 1, (n // 2, 3))])
    x[:4] = [[1.1, 1.1, 1.1], [1.1, 1.1, 0.2], [0.9, 0.8, 0.9], [0.9, 0.8, 0.2]]
    tri, _, _, mask = asked(*turned(rng, x, vertices), faces)
    count, walls = mask.sum(axis=1), np.sum(1 - np.abs(x) < 0.35, axis=1)
    assert list(count[:4]) == [1, 1, 3, 2]
    outside, inside = np.abs(x).max(axis=1) > 1 + 1e-3, np.abs(x).max(axis=1) < 1 - 1e-3
    assert np.array_equal(count[outside & (tri.count > 0)], np.ones(np.sum(outside & (tri.count > 0))))
    assert np.array_equal(count[inside], walls[inside])
    assert outside.sum() > 50
    assert list(np.bincount(walls[inside])) > [100, 100, 100, 10]


def test_a_polygon_has_one_contact_outside_and_two_in_a_corner():
    along = np.linspace(-1, 1, 9)[:-1]
    side = np.stack([along, np.full(8, -1.0)], axis=1)
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    vertices = np.concatenate([side @ np.linalg.matrix_power(quarter, k).T for k in range(4)])
    faces = np.stack([np.arange(32), (np.arange(32) + 1) % 32], axis=1)
    x = np.array([[0.1, -1.1], [0.25, -1.1], [-1.1, -1.2], [-0.9, -0.8], [0.25, -0.9], [0.3, -0.9], [0.0, 0.0], [0.9, -0.9]])
    _, points, distance, mask = asked(x, vertices, faces)
    assert list(mask.sum(axis=1)) == [1, 1, 1, 2, 1, 1, 0, 2]
    assert np.allclose(np.sort(distance[3][mask[3]]), [0.1, 0.2])
    assert np.array_equal(points[~mask], np.repeat(x, CAPACITY, axis=0).reshape(*mask.shape, 2)[~mask])
    assert not distance[~mask].any()


def described(x, corners, mask, points, distance):
    """Return the contacts of a particle as points [m, d]: nearest points that no nearer triangle of its row contains.

    Args:
        x: The particle.
        corners: Triangles of its row, shape [k, corner, d].
        mask, points, distance: What `closest` says of them.
    """
    at, shapes = np.broadcast_arrays(points[:, None, :, None].swapaxes(2, 3), corners[None])
    gap = np.linalg.norm(_nearest(jnp.asarray(at[..., 0, :]), jnp.asarray(shapes)), axis=-1)
    nearer = mask[None] & (gap < 1e-12) & (distance[None] < distance[:, None] - 1e-12)
    return np.unique(np.round(points[mask & ~nearer.any(axis=1)] - x, 9), axis=0)


@jax.jit
def _nearest(points, corners):
    return nearest_of(points, corners)[0]


@pytest.mark.parametrize("mesh", [pytest.param(meshes.cube(2.0, 4), id="3d"), slow(meshes.circle(1.0, 64), id="2d")])
def test_contacts_are_those_of_the_description(mesh):
    rng, (vertices, faces) = np.random.default_rng(2), mesh
    vertices = vertices + rng.uniform(-0.03, 0.03, vertices.shape)  # edges of all angles, convex and concave
    x = rng.uniform(-1.3, 1.3, (2000, vertices.shape[1]))
    tri, points, _, mask = asked(x, vertices, rng.permutation(faces))
    nearest, distance, near = (np.asarray(part) for part in tri.closest(x))
    several = 0
    for i in np.flatnonzero(near.any(axis=1))[:150]:
        corners = vertices[np.asarray(tri.faces)[np.where(near[i], np.asarray(tri.idx)[i], 0)]]
        expected = described(x[i], corners, near[i], nearest[i], distance[i])
        found = np.round(points[i][mask[i]] - x[i], 9)
        assert len(found) == len(expected)
        assert np.allclose(np.unique(found, axis=0), expected, atol=2e-9)
        several += len(expected) > 1
    assert several > 10


def test_of_equal_triangles_the_first_remains():
    x, vertices, faces = plate_and_points()
    sparse, half = meshes.plate((2.0, 2.0), (8, 4))
    both_ways = np.concatenate([half, half[:, ::-1]])
    for corners, order in ((vertices, faces), (vertices, faces[::-1]), (np.resize(sparse, vertices.shape), both_ways)):
        wide, *wall = in_a_large_scene(x, corners, order)
        tri, *parts = asked(wide, *wall)
        (_, distance, mask), (_, away, near) = ([np.asarray(part)[:150] for part in all] for all in (parts, tri.closest(wide)))
        least = np.where(near, away, np.inf).min(axis=1, keepdims=True)
        assert np.array_equal(mask.sum(axis=1), np.ones(150))
        assert np.array_equal(distance[mask], least[:, 0])
        idx = np.asarray(tri.idx)[:150]
        assert np.array_equal(idx[mask][:2], np.where(near & (away == least), idx, 192).min(axis=1)[:2])


@pytest.mark.slow
def test_derivatives_are_those_of_closest():
    x, vertices, faces = plate_and_points()
    tri = jfrnn.search_triangles(x, vertices, faces, 0.35, capacity=CAPACITY)  # as many as near nothing
    slopes = jax.jit(jax.grad(lambda x: tri.contacts(x)[1].sum()))(x)
    assert np.allclose(slopes, np.sign(x) * np.array([0, 0, 1]), atol=1e-12)


def test_memory_is_that_of_rows():
    n, capacity = 7, 1000
    vertices, faces = meshes.cube(2.0, 1)
    tri = jfrnn.search_triangles(np.zeros((n, 3)), vertices, faces, 0.5, capacity=capacity)
    of = jax.ShapeDtypeStruct
    rows = of((n, capacity, 3), np.float64), of((n, capacity), np.int32), of((n, capacity), bool)
    inner = jax.make_jaxpr(_triangles_list._contacts_in_rows)(tri, tri.vertices[:n], tri.vertices, *rows)
    assert 0 < max(sizes(inner.jaxpr)) <= 9 * n * capacity


def sizes(jaxpr):
    """Return how many numbers each array of a program holds."""
    for equation in jaxpr.eqns:
        yield from (variable.aval.size for variable in equation.outvars)
        for inner in jaxprs_in_params(equation.params):
            yield from sizes(inner)


def test_nothing_near_nothing_there():
    x, vertices, faces = plate_and_points()
    x = x + 9
    for given in (faces, faces[:0]):
        _, points, distance, mask = asked(x, vertices, given)
        assert not mask.any()
        assert not distance.any()
        assert np.array_equal(points, np.broadcast_to(x[:, None], points.shape))


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


@pytest.mark.parametrize("dtype", [np.int8, np.uint32, np.int64, *map(slow, (np.uint8, np.int16, np.int32))])
def test_every_integer_type_names_the_same_particles(dtype):
    """The last number of int8 is that of a particle, too, where there are more."""
    x = np.ones((200, 3), np.float32)
    x[127], x[5] = [0.2, 0.2, 0.1], [0.2, 0.2, -0.1]
    corners = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    tri = jfrnn.search_triangles(x, corners, np.array([[0, 1, 2]]), 9.0, capacity=1)
    assert tri.between(x, np.array([[127, 5], [5, 127], [127, 6]], dtype)).tolist() == [True, True, False]


def test_errors():
    x = np.zeros((2, 3), np.float32)
    tri = jfrnn.search_triangles(x, np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), 1.0, capacity=1)
    refuses(TypeError, r"pairs must be integers of shape \[e, 2\].*got float64 of shape \[2\]", tri.between, x, np.zeros(2))
    assert tri.between(x, np.zeros((0, 2), int)).shape == (0,)
