"""No result shares memory with an argument or with itself, so that lists and positions may be donated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import slow

import jfrnn
from jfrnn.cases.meshes import cube

N, CUTOFF, SKIN = 40, 0.3, 0.05
X = np.random.default_rng(0).uniform(0, 1, (N, 3))
RADII = np.random.default_rng(1).uniform(0.1, 0.3, N)


def points(array=X):
    return jnp.array(array, jnp.float32)


def assert_own(result, *given):
    """Fail where arrays of a result share a buffer with each other, or with what was given."""
    jax.block_until_ready((result, given))  # an address is waited for with the GIL held, which kernels of the CPU need
    mine, theirs = ([x for x in jax.tree.leaves(tree) if isinstance(x, jax.Array) and x.size] for tree in (result, given))
    places = [x.unsafe_buffer_pointer() for x in mine]
    assert len(set(places)) == len(places)
    assert not set(places) & {x.unsafe_buffer_pointer() for x in theirs}


SCENES = {
    "skin": lambda: {"skin": SKIN},
    "images": lambda: {"skin": SKIN, "box": jfrnn.Box(jnp.array([0.5, 0.9, 1.0]))},
    "active": lambda: {"skin": SKIN, "active": jnp.arange(N) > 3, "box": jfrnn.Box(jnp.array([1.0, 0.9, 1.0]))},
    "queries": lambda: {"skin": SKIN, "queries": points(X[:9] + 0.01), "batch": (jnp.arange(N) % 2, jnp.arange(9) % 2)},
    "batch": lambda: {"batch": jnp.arange(N, dtype=jnp.int32) % 3, "box": jfrnn.Box(jnp.array([1.0, 0.9, 1.0], jnp.float32))},
    "radii": lambda: {"cutoff": jnp.array(RADII, jnp.float32), "skin": SKIN, "batch": jnp.arange(N, dtype=jnp.int32) % 3},
}


@pytest.mark.parametrize("scene", SCENES)
def test_lists_own_their_buffers(scene):
    x, options = points(), {"cutoff": CUTOFF} | SCENES[scene]()
    given = {name: options[name] for name in ("queries", "active") if name in options}
    nbrs = jfrnn.search(x, **options, slack=2.0)
    assert_own(nbrs, x, options)
    moved, far = x + 0.001, points(X[::-1])
    for y in (moved, far):
        assert_own(nbrs.update(y, **given), nbrs, y, options)
    assert_own(nbrs.grow(far, **given), nbrs, far, options)
    assert_own(jax.jit(lambda n, y: (y, n.update(y, **given)))(nbrs, moved), nbrs, moved, options)


@pytest.mark.parametrize("scene", ["images", "batch"])
def test_positions_and_list_are_donated_together(scene):
    x, options = points(), SCENES[scene]()
    start = points()
    nbrs = jfrnn.search(x, CUTOFF, **options, slack=2.0)
    step = jax.jit(lambda y, n: (y + 0.01, n.update(y + 0.01)), donate_argnums=(0, 1))
    y = x + 0
    for _ in range(3):
        y, nbrs = step(y, nbrs)
    np.testing.assert_array_equal(x, start)  # still there
    expected = jfrnn.search(y, CUTOFF, **options)
    found, right = (np.sort(each.distances(y)[1].sum(axis=1)) for each in (nbrs.update(y), expected))
    np.testing.assert_array_equal(found, right)
    for leaf in jax.tree.leaves(options):
        np.asarray(leaf)


def test_a_list_does_not_see_what_happens_to_the_arrays_it_was_made_of():
    x, lengths = np.array(X, np.float32), np.array([1.0, 0.9, 1.0], np.float32)
    box = jfrnn.Box(lengths)
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, box=box)
    jax.block_until_ready(nbrs)
    x += 0.2 * np.sin(np.arange(N, dtype=np.float32))[:, None]
    lengths *= 2
    assert box.vectors.tolist() == nbrs.box.vectors.tolist() == np.array([1.0, 0.9, 1.0], np.float32).tolist()
    assert int(nbrs.update(x).rebuild_count) == 1


@pytest.mark.parametrize("backend", ["bvh", slow("jax")])
def test_lists_of_triangles_own_their_buffers(backend):
    vertices, faces = cube()[:2]
    x, vertices, faces = points(), jnp.asarray(vertices, jnp.float32), jnp.asarray(faces, jnp.int32)
    tri = jfrnn.search_triangles(x, vertices, faces, CUTOFF, backend=backend, slack=2.0)
    assert_own(tri, x, vertices, faces)
    bent = vertices * 1.01
    for after in (tri.update(x), tri.update(x, vertices=bent), tri.grow(x), jax.jit(lambda t, x: t.update(x))(tri, x)):
        assert_own(after, tri, x, vertices, faces, bent)
    step = jax.jit(lambda x, t: (x + 0.01, t.update(x + 0.01)), donate_argnums=(0, 1))
    for _ in range(2):
        x, tri = step(x, tri)
    np.testing.assert_array_equal(tri.vertices, vertices)
