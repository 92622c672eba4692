"""Nearest points and signed distances against the oracle, finite differences, and shapes whose distance is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from jfrnn.cases import meshes
from jfrnn.cases.triangles import TRIANGLE_CASES, padded

import jfrnn
from jfrnn import _triangles_rows
from jfrnn._exact import make_cutoff
from jfrnn._triangles_closest import make_normals, nearest_of

# of cutoffs of their own, each a program anew, between the smallest and the largest
_IN_BETWEEN = {"ties_small", "ties_spacing", "ulps", "ulps_far", "ulps_large", "axis_ulps", "cell_edges"}

KINDS = [pytest.param(np.float32, 3, id="f32-3d"), pytest.param(np.float64, 2, id="f64-2d", marks=pytest.mark.slow)]


@pytest.mark.fully_compiled
@pytest.mark.parametrize(("dtype", "dim"), KINDS)
@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x in _IN_BETWEEN)) for x in TRIANGLE_CASES])
def test_distances_are_those_of_the_oracle(name, dtype, dim):
    given = TRIANGLE_CASES[name].build(dtype, dim)
    wide = padded(given)
    tri = jfrnn.search_triangles(wide.positions, wide.vertices, wide.faces, given.cutoff, capacity=40)
    points, distance, mask = (np.asarray(x) for x in tri.closest(wide.positions))
    assert np.array_equal(mask, np.arange(40) < np.asarray(tri.count)[:, None])
    eps = float(np.finfo(dtype).eps)
    for i, t, far, here in zip(*np.nonzero(mask), distance[mask], points[mask], strict=True):
        exact, size = reference.distance(given.positions[i], given.vertices[given.faces[int(tri.idx[i, t])]])
        scale = float(np.max(np.abs(given.positions[i])))
        assert abs(far - exact) <= 4 * eps * size
        apart = np.linalg.norm((here.astype(float) - given.positions[i]) / given.cutoff) * given.cutoff
        assert abs(apart - exact) <= 4 * eps * (size + scale)


@pytest.mark.fully_compiled
def test_distances_to_slivers_do_not_depend_on_how_thin_they_are(dtype):
    rng, n, eps = np.random.default_rng(0), 400, float(np.finfo(dtype).eps)
    along, across, up = np.moveaxis(np.linalg.qr(rng.normal(size=(n, 3, 3)))[0], 2, 0)
    start, length = rng.uniform(-1, 1, (n, 3)), 10 ** rng.uniform(-2, 0, (n, 1))
    width = length * 10 ** rng.uniform(np.log10(eps) - 1, 0, (n, 1))
    tip = start + rng.uniform(-0.2, 1.2, (n, 1)) * length * along + width * across
    corners = np.stack([start, start + length * along, tip], axis=1).astype(dtype)
    corners = np.array([rng.permutation(triangle) for triangle in corners])  # another side comes first
    height = 10 ** rng.uniform(np.log10(eps), 0, (n, 1)) * rng.integers(0, 4, (n, 1)).clip(max=1)
    points = (np.einsum("fk,fkd->fd", rng.dirichlet(np.ones(3), n), corners) + height * up).astype(dtype)
    vectors = np.asarray(jax.jit(nearest_of)(points, corners).vectors)
    for point, triangle, vector in zip(points, corners, vectors, strict=True):
        exact, size = reference.distance(point, triangle)
        assert abs(np.linalg.norm(vector.astype(float)) - exact) <= 4 * eps * size


def test_needle_of_the_reference_figures():
    vertices = jnp.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]], jnp.float64)
    x = jnp.array([[0.5, 1e-3, 1e-3]], jnp.float64)
    tri = jfrnn.search_triangles(x, vertices, jnp.array([[0, 1, 2]]), 0.0015, capacity=1)
    assert abs(float(tri.closest(x)[1][0, 0]) - 0.00141414285346) < 1e-14


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


def test_the_nearest_of_each_row_is_found_in_blocks_and_chunks(monkeypatch):
    x = np.random.default_rng(1).uniform(-1.6, 1.6, (97, 3))
    tri = cube_list(x, np.float64)
    _, distance, mask = (np.asarray(a) for a in tri.closest(x))
    assert int(tri.count.sum()) > 3 * len(x)  # several chunks
    monkeypatch.setattr(_triangles_rows, "_MOST_PAIRS", 97 + 20 * tri.capacity)  # and blocks of 20 rows
    given = jnp.asarray(x), tri.vertices[tri.faces], tri.idx, tri.count, jnp.ones(len(tri.faces), bool)
    slot, some = _triangles_rows.nearest_slots(*given, make_cutoff(tri.cutoff, np.dtype(np.float64), closed=False))
    assert np.array_equal(some, mask.any(axis=1))
    assert np.array_equal(np.asarray(slot)[some], np.where(mask, distance, np.inf).argmin(axis=1)[some])


def test_signed_distance_in_2d():
    vertices, faces = meshes.circle(1.0, 64)
    x = np.random.default_rng(1).uniform(-1.4, 1.4, (200, 2))
    tri = jfrnn.search_triangles(x, vertices, faces, 0.5, capacity=16)
    signed = tri.signed_distance(x)
    assert signed.watertight
    rough = np.linalg.norm(x, axis=1) - 1
    sure = np.asarray(signed.mask) & (np.abs(rough) > 2e-3)
    assert sure.sum() > 50
    assert np.array_equal(np.sign(signed.distance)[sure], np.sign(rough)[sure])


@pytest.mark.parametrize("mesh", [meshes.circle(1.0, 8), meshes.cube(2.0, 2)], ids=["2d", "3d"])
def test_meshes_that_are_not_closed_are_told(mesh):
    vertices, faces = mesh

    @jax.jit
    def watertight(faces, good):
        return make_normals(jnp.asarray(vertices), faces, jnp.asarray(vertices)[faces], good).watertight

    good = np.ones(len(faces), bool)
    assert watertight(faces, good)
    turned, twice = faces.copy(), faces.copy()
    turned[0], twice[0] = faces[0, ::-1], faces[1]
    assert not watertight(turned, good)
    assert not watertight(twice, good)
    assert not watertight(faces, np.arange(len(faces)) > 0)


def test_gradients_are_those_of_finite_differences():
    vertices, faces = meshes.sphere(1.0, 2)
    x = np.random.default_rng(2).normal(size=(12, 3))
    x *= np.random.default_rng(3).uniform(0.8, 1.2, (12, 1)) / np.linalg.norm(x, axis=1, keepdims=True)
    tri = jfrnn.search_triangles(x, vertices, faces, 0.4, capacity=32)

    def energy(x, v, tri):
        points, distance, mask = tri.closest(x, vertices=v)
        signed = tri.signed_distance(x, vertices=v)
        return jnp.sum(jnp.where(mask, (0.4 - distance) ** 3, 0)) + jnp.sum(points**3) + jnp.sum(signed.distance**2)

    both = jax.jit(jax.value_and_grad(energy, (0, 1)))  # one program
    _, gradients = both(x, vertices, tri)
    random = np.random.default_rng(4)
    for _ in range(3):
        dx, dv = random.normal(size=x.shape), random.normal(size=vertices.shape)
        h = 1e-6
        ahead, behind = (both(x + s * dx, vertices + s * dv, tri)[0] for s in (h, -h))
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


@jax.jit
def _distances_and_slopes(x, v, tri):
    gap = jax.grad(lambda x, v: tri.closest(x, vertices=v)[1].sum(), (0, 1))(x, v)
    side = jax.grad(lambda x, v: tri.signed_distance(x, vertices=v).distance.sum(), (0, 1))(x, v)
    return tri.closest(x, vertices=v)[1], gap, side


@pytest.mark.parametrize("where", ["face", "side", "vertex", "degenerate"])
def test_gradients_are_finite_at_contact(where):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 2, 2.0]], np.float32)
    x = {"face": [0.25, 0.25, 0], "side": [0.5, 0, 0], "vertex": [0, 0, 0], "degenerate": [2, 2, 2]}[where]
    faces = np.array([[3, 3, 3] if where == "degenerate" else [0, 1, 2]])
    point = np.array([x], np.float32)
    tri = jfrnn.search_triangles(point, vertices, faces, 0.5, capacity=1)
    assert int(tri.count[0]) == 1

    distance, gap, side = _distances_and_slopes(point, vertices, tri)
    assert float(distance[0, 0]) == 0
    assert all(np.all(np.isfinite(g)) for g in (*gap, *side))
    assert not np.any(gap[0])
    if where == "face":
        assert np.allclose(side[0], [[0, 0, 1]])
