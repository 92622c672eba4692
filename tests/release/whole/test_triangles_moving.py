"""Walls that are deformed or turn, inside compiled programs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import assert_same, slow

import jfrnn
from jfrnn.cases import meshes

BACKENDS = [slow("jax"), "warp", "bvh"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wall_that_is_deformed(backend):
    """In a scan, searched for in each step from traced corners, and by updates of a list: all that exact arithmetic finds."""
    vertices, faces = meshes.cube(2.0, 1)
    vertices = vertices.astype(np.float32)
    random = np.random.default_rng(0)
    x, bump = (random.uniform(-1.5, 1.5, size).astype(np.float32) for size in ((24, 3), vertices.shape))
    first = jfrnn.search_triangles(x, vertices, faces, 0.5, capacity=12, backend=backend)

    @jax.jit
    def steps(x, vertices, tri):
        def step(carry, _):
            corners, tri = carry
            corners = corners + 0.2 * bump
            tri = tri.update(x, vertices=corners)
            fresh = jfrnn.search_triangles(x, corners, tri.faces, 0.5, capacity=12, backend=backend)
            return (corners, tri), (corners, tri.idx, tri.count, fresh.idx, fresh.count)

        return jax.lax.scan(step, (vertices, tri), None, length=3)[1]

    for corners, idx, count, fresh_idx, fresh_count in zip(*(np.asarray(a) for a in steps(x, vertices, first))):
        expected = reference.triangle_pairs(x, corners, faces, 0.5)
        assert expected
        assert_same(set(reference.pairs_of(idx, count, len(faces))), expected)
        assert np.array_equal(idx, fresh_idx)
        assert np.array_equal(count, fresh_count)


def test_particles_in_the_frame_of_a_wall_that_turns():
    """A quarter turn is exact; another angle moves distances by rounding alone."""
    vertices, faces = meshes.gear(6, 200, 1.0, 2.0, 3.0)
    x = np.random.default_rng(1).uniform(-4, 4, (150, 3))

    @jax.jit
    def both(x, turn, corners):
        moved = jfrnn.search_triangles(x, corners @ turn.T, jnp.asarray(faces), 0.6, capacity=96)
        still = jfrnn.search_triangles(x @ turn, corners, jnp.asarray(faces), 0.6, capacity=96)
        return moved, still, moved.signed_distance(x), still.signed_distance(x @ turn)

    for angle in (np.pi / 2, 0.7):
        c, s = (0.0, 1.0) if angle == np.pi / 2 else (np.cos(angle), np.sin(angle))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        moved, still, there, here = both(x, turn, vertices)
        assert not moved.overflow
        assert int(moved.count.sum()) > 100
        if c == 0:
            assert np.array_equal(np.sort(moved.idx, axis=1), np.sort(still.idx, axis=1))
        assert np.array_equal(moved.count, still.count)
        np.testing.assert_allclose(there.distance, here.distance, atol=1e-14)
        clear = np.asarray(there.mask) & (np.abs(there.distance) > 1e-3)
        np.testing.assert_allclose(np.asarray(there.normal)[clear], np.asarray(here.normal @ turn.T)[clear], atol=1e-10)
