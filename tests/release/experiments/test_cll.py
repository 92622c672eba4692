import numpy as np
import pytest
import warp as wp

from experiments import _oracle
from experiments.methods import cll as adapter
from jfrnn import cases


@pytest.fixture(scope="module", autouse=True)
def _warm_kernels():
    """Compile the kernels once, for both precisions together, without what takes Clang long."""
    kernels = adapter._cll_kernels
    wp.set_module_options({"optimization_level": 0}, module=kernels)
    for real, vector in ((wp.float32, wp.vec3f), (wp.float64, wp.vec3d)):
        kinds = {"positions": wp.array(dtype=vector), "origin": vector, "inverse_edge": real}
        wp.overload(kernels.link_particles_kernel, kinds)
        wp.overload(kernels.append_pairs_kernel, {**kinds, "cutoff_squared": real})
    yield
    wp.set_module_options({"optimization_level": None}, module=kernels)


def search(positions, cutoff):
    """Return the pairs as the method gives them, shape [m, 2]."""
    rounded = _oracle.round_cutoff(cutoff, positions.dtype)
    found = adapter.read(adapter.prepare(positions, rounded)())
    assert not found.directed
    assert found.list_bytes == 8 * len(found.pairs[0])
    return np.stack(found.pairs, axis=1)


def keys(pairs, size):
    """Return sorted keys of unordered pairs; fail on one that stands there twice, or on a particle with itself."""
    low, high = pairs.min(axis=1).astype(np.int64), pairs.max(axis=1)
    assert (low < high).all()
    found = np.sort(low * size + high)
    assert len(np.unique(found)) == len(found)
    return found


def assert_exact(positions, cutoff):
    expected = _oracle.find_pairs(positions, cutoff)
    assert len(expected) > 0
    np.testing.assert_array_equal(keys(search(positions, cutoff), len(positions)), expected)


@pytest.mark.parametrize("offset", [0.0, -2.5, 1e4])
def test_exact_where_no_pair_is_near_the_cutoff(dim, offset):
    positions = np.random.default_rng(1).uniform(-1, 1, (700, dim)) + offset
    for cutoff in (0.05, 0.2, 5.0):
        assert_exact(positions, cutoff)


def test_exact_on_integers_where_ties_are_computed_exactly(dtype, dim):
    positions = np.argwhere(np.ones((7, 6, 5)[:dim])).astype(dtype)
    for cutoff in (2.0, 3.0, 5.0):
        assert_exact(positions, cutoff)


def test_a_tie_on_the_lattice_of_the_thesis_falls_as_rounding_wants(dtype):
    scene = cases.scene("full", spacing=5e-4, dtype=dtype)
    found = keys(search(scene.positions, scene.cutoff), scene.n)
    exact = _oracle.find_pairs(scene.positions, scene.cutoff)
    wrong = np.setxor1d(found, exact)
    assert len(wrong) > 0  # the method is inexact, and the sweep must be able to show it
    i, j = np.divmod(wrong, scene.n)
    points = scene.positions.astype(np.float64)
    distance = np.linalg.norm(points[j] - points[i], axis=1) / _oracle.round_cutoff(scene.cutoff, dtype)
    assert np.abs(distance - 1).max() < 4 * np.finfo(dtype).eps


def test_particles_on_cell_edges_and_far_from_all_others(dtype):
    cutoff = 0.25
    line = np.arange(0.0, 3.0, cutoff)
    positions = np.zeros((3 * len(line) + 2, 3), dtype)
    positions[:-2, 0] = np.stack([np.nextafter(line, -1), line, np.nextafter(line, 9)]).ravel()
    positions[-2:] = [[500, 20, 0], [500, 20, 0.125]]
    found, exact = set(keys(search(positions, cutoff), len(positions))), set(_oracle.find_pairs(positions, cutoff))
    assert found ^ exact <= near_ties(positions, cutoff)
    assert max(found) == (len(positions) - 2) * len(positions) + len(positions) - 1


def near_ties(positions, cutoff):
    """Return the keys of the pairs that working precision may decide either way."""
    points = positions.astype(np.float64)
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    i, j = np.nonzero(np.abs(distance - cutoff) < 8 * np.finfo(positions.dtype).eps * cutoff)
    return {int(a * len(points) + b) for a, b in zip(i, j, strict=True) if a < b}


def test_coincident_particles_are_pairs_and_one_alone_has_none(dtype):
    assert_exact(np.zeros((5, 3), dtype), 0.1)
    assert search(np.ones((1, 3), dtype), 1.0).shape == (0, 2)


def test_the_same_input_gives_the_same_list():
    positions = np.random.default_rng(2).uniform(0, 1, (400, 3)).astype(np.float32)
    run = adapter.prepare(positions, 0.25)
    first = run().numpy()
    assert len(first) > 400
    np.testing.assert_array_equal(run().numpy(), first)


def test_cells_cover_the_box_and_are_wider_than_the_cutoff():
    edge, shape = adapter._cll_kernels.size_grid([0.0, -1.0, 2.0], [5.0, 9.0, 2.0], 0.5, 2.0**-23)
    assert 0.5 < edge < 0.5 * (1 + 1e-4)
    assert shape == [10, 20, 1]
    assert all(count * edge > length for count, length in zip(shape, (5.0, 10.0, 0.0), strict=True))


def test_a_box_that_needs_too_many_cells_is_refused():
    positions = wp.array(np.array([[0, 0, 0], [1e4, 1e4, 1e4]], np.float32), dtype=wp.vec3f, device="cpu")
    with pytest.raises(ValueError, match=r"one entry per cell of the box: \d+ cells, at most 268435456 allowed"):
        adapter._cll_kernels.search_pairs(positions, [0.0] * 3, [1e4] * 3, 1.0)
