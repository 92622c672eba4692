"""Particles that nobody wrapped, any number of boxes away: against the oracle, on all that a list and a sum tell."""

from fractions import Fraction
from itertools import product

import by_numpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import refuses, slots_as_set, slow, sparing
from test_boxes import oracle
from test_search_edges import edges_as_set

import jfrnn
from jfrnn._geometry.far import move_near
from jfrnn._geometry.images import LARGEST_TURN, images_of
from jfrnn._geometry.lattice import make_lattice
from jfrnn._geometry.wrapping import count_turns, unpack_turns

N, CUTOFF = 24, 1.0
CELLS = {
    "lengths": [10.0, 9.0, 7.0],
    "short": [1.1, 1.7, 0.9],
    "flat": [1.3, 2.1],
    "straight": [[3.0, 0, 0], [0, 2.7, 0], [0, 0, 3.3]],
    "fcc": [[0, 1.8, 1.8], [1.8, 0, 1.8], [1.8, 1.8, 0]],
}
# What each case of the default run tells, one program each; those by hand tell all.
ASKED = {("short", 5000, "warp", np.float64): ("count", "sums", "sums of the list"), ("fcc", 500, "warp", np.float32): ("edges",)}
ALL = ("count", "sums", "sums of the list", "edges", "edges of the list")


AWAY = [(cell, far) for cell in CELLS for far in ((200, 500) if cell == "fcc" else (200, 700, 5000, 400_000))]
KINDS = [(*away, *kind) for away, kind in product(AWAY, product(("warp", "jax", "brute"), (np.float32, np.float64)))]


def scene(cell, far, dtype, seed=0):
    matrix = np.asarray(CELLS[cell], dtype)
    matrix = np.diag(matrix) if matrix.ndim == 1 else matrix
    rng, dim = np.random.default_rng(seed), len(matrix)
    places = rng.random((N, dim)) + rng.integers(-far, far + 1, (N, dim))
    x = (places @ matrix.astype(float)).astype(dtype)
    x[1] = x[0] + np.eye(dim)[0].astype(dtype)  # a tie, up to rounding of the coordinates
    return x, matrix


@pytest.mark.parametrize(("cell", "far", "backend", "dtype"), sparing(KINDS, ASKED))
def test_pairs_shifts_and_sums(cell, far, backend, dtype):
    x, matrix = scene(cell, far, dtype)
    expected = reference.reference_images(x, CUTOFF, matrix=matrix, periodic=(True,) * len(matrix))
    count, asked = np.bincount([i for i, *_ in expected], minlength=N), ASKED.get((cell, far, backend, dtype), ALL)
    options = {"box": jfrnn.Box(np.asarray(CELLS[cell], dtype)), "backend": backend}
    one = lambda r, i, j: jnp.ones((), dtype)  # noqa: E731
    tell = {
        "count": lambda x, nbrs: jfrnn.count(x, CUTOFF, **options),
        "sums": lambda x, nbrs: jfrnn.pair_sum(one, x, CUTOFF, **options),
        "sums of the list": lambda x, nbrs: jfrnn.pair_sum(one, x, None, neighbors=nbrs),
        "edges": lambda x, nbrs: jfrnn.search_edges(x, CUTOFF, total=len(expected), **options).edges(x),
        "edges of the list": lambda x, nbrs: nbrs.edges(x, len(expected)),
    }

    @jax.jit
    def all_of(x):
        nbrs = jfrnn.search(x, CUTOFF, capacity=int(count.max()), **options)
        return nbrs, nbrs.vectors(x), nbrs.shifts(x), {name: tell[name](x, nbrs) for name in asked}

    nbrs, (vectors, mask), shifts, told = all_of(x)
    nbrs.check()
    assert slots_as_set(nbrs.idx, mask, shifts) == expected
    for name, found in told.items():
        if "edges" in name:
            assert edges_as_set(found) == expected
        else:
            np.testing.assert_array_equal(found, count)
    exact = [Fraction(v) for v in matrix.astype(float).reshape(-1).tolist()]
    dim, eps = len(matrix), float(np.finfo(dtype).eps)
    vectors, mask, shifts, idx = map(np.asarray, (vectors, mask, shifts, nbrs.idx))
    for (i, k), shift in zip(np.argwhere(mask)[:40].tolist(), shifts[mask][:40].tolist(), strict=True):
        j = int(idx[i, k])
        for c in range(dim):
            moved = sum(s * exact[dim * row + c] for row, s in enumerate(shift))
            known = Fraction(float(x[j, c])) - Fraction(float(x[i, c])) + moved
            size = 1000 * np.abs(matrix).max()  # of coordinates, and so of the rounding, wherever the particle is
            assert abs(float(known) - float(vectors[i, k, c])) <= size * eps


def test_a_list_with_a_skin_follows_them_and_wrapping_is_no_motion():
    x, matrix = scene("lengths", 700, np.float64)
    box = jfrnn.Box(CELLS["lengths"])
    nbrs = jfrnn.search(x, CUTOFF, box=box, skin=0.3, slack=2.0)
    rng = np.random.default_rng(1)
    for step, moved in enumerate((x, x + 0.02 * rng.normal(size=x.shape), x % np.diag(matrix), x + 300 * np.diag(matrix))):
        nbrs = nbrs.update(moved)
        expected = reference.reference_images(moved, CUTOFF, matrix=matrix, periodic=(True,) * 3)
        assert slots_as_set(nbrs.idx, nbrs.distances(moved)[1], nbrs.shifts(moved)) == expected, step
    assert int(nbrs.rebuild_count) <= 1


def test_a_box_far_from_its_particles_and_particles_far_from_their_box():
    rng = np.random.default_rng(2)
    x = (rng.random((N, 3)) * [1.1, 1.7, 0.9]).astype(np.float32)
    expected = jfrnn.count(x, 0.5, box=jfrnn.Box([1.1, 1.7, 0.9]))
    for origin in (-1000.0, 300.0, [700.0, -250.0, 1e5]):
        np.testing.assert_array_equal(jfrnn.count(x, 0.5, box=jfrnn.Box([1.1, 1.7, 0.9], origin=origin)), expected)


def test_boxes_of_systems():
    (x, first), (y, second) = scene("lengths", 700, np.float32), scene("short", 3000, np.float32, seed=1)
    both, batch = np.concatenate([x, y]), np.repeat(np.int32([0, 1]), N)
    boxes = jfrnn.Box(np.stack([np.diag(first), np.diag(second)]), per_system=True)

    @jax.jit
    def all_of(x):
        nbrs = jfrnn.search(x, CUTOFF, capacity=72, box=boxes, batch=batch)
        return nbrs, nbrs.shifts(x), nbrs.distances(x)[1]

    nbrs, shifts, mask = all_of(both)
    nbrs.check()
    assert slots_as_set(nbrs.idx, mask, shifts) == oracle(np.stack([first, second]), both, batch, CUTOFF)


def test_derivatives_in_positions_and_box():
    """Of a list and of a sum, where all particles are far away."""
    x, matrix = scene("lengths", 700, np.float64)
    lengths = np.diag(matrix)
    nbrs = jfrnn.search(x, 3.0, box=jfrnn.Box(lengths), capacity=24)
    scaled = x / lengths

    def by_list(s, lengths):
        r, mask = nbrs.distances(s * lengths, jfrnn.Box(lengths))
        return jnp.where(mask, (3.0 - r) ** 3, 0).sum()

    def by_sum(s, lengths):
        box = jfrnn.Box(lengths, images=1)
        return jfrnn.pair_sum(lambda r, i, j: (3.0 - jnp.sqrt(r @ r)) ** 3, s * lengths, 3.0, box=box).sum()

    pairs = by_numpy.in_order(reference.reference_images(x, 3.0, matrix=matrix, periodic=(True,) * 3), 3)
    steps = scaled[pairs.j] - scaled[pairs.i] + pairs.shifts
    apart = np.linalg.norm(steps * lengths, axis=1)
    of_r = (-3 * (3.0 - apart) ** 2 / apart)[:, None] * steps * lengths
    value, of_lengths = ((3.0 - apart) ** 3).sum(), (of_r * steps).sum(0)
    of_s = by_numpy.pull(pairs, of_r, x) * lengths
    assert value > 0
    for energy in (by_list, by_sum):
        found = jax.jit(jax.value_and_grad(energy, (0, 1)))(scaled, lengths)
        expected = value, (of_s, of_lengths)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8), found, expected)


def test_graphs_have_the_positions_that_were_given():
    x, matrix = scene("lengths", 700, np.float64)
    graph = jfrnn.search(x, CUTOFF, box=jfrnn.Box(np.diag(matrix))).to_jraph(x)
    np.testing.assert_array_equal(graph.nodes["positions"][:N], x)
    i, j = np.asarray(graph.receivers), np.asarray(graph.senders)
    moved = x[j] - x[i] + np.asarray(graph.edges["shift"]) @ matrix
    np.testing.assert_allclose(graph.edges["displacement"], moved, atol=1e-8)


def test_what_lies_beyond_sets_a_bit():
    x, _ = scene("lengths", 0, np.float32)
    skewed = jfrnn.Box([[3.0, 0, 0], [0.7, 2.7, 0], [-0.3, 0.2, 3.3]])

    def status(far, box):
        moved = x.copy()
        moved[3, 1] = far
        return jfrnn.Status(int(jfrnn.search(moved, CUTOFF, box=box, capacity=24).status))

    assert status(x[3, 1], jfrnn.Box([10.0] * 3)) == jfrnn.Status.OK
    for far in (1e7, -1e20, 3e38):
        assert status(far, jfrnn.Box([10.0] * 3)) == jfrnn.Status.OUT_OF_RANGE
    assert status(2.7 * 400, skewed) == jfrnn.Status.OK


@pytest.mark.parametrize("backend", ["warp", *(slow(name) for name in ("jax", "brute"))])
def test_in_skewed_cells_those_that_rounding_would_move_are_named(backend):
    """Beyond 511 vectors, points are taken whose move is exact; the others have no neighbors, and the error names one."""
    x, matrix = scene("fcc", 700, np.float32)
    nbrs = jfrnn.search(x, 2.0, box=jfrnn.Box(matrix), backend=backend)
    units, alone = np.abs(x @ np.linalg.inv(matrix)).max(axis=1), np.asarray(nbrs.count) == 0
    assert 0 < alone.sum() < (units > 511).sum() < N
    assert (units[alone] > 511).all()
    with pytest.raises(ValueError, match=rf"positions\[{int(units.argmax())}\] lies \d+"):
        jfrnn.count(x, 2.0, box=jfrnn.Box(matrix), backend=backend)
    refuses(ValueError, "farther away, a run has exploded", nbrs.check)
    expected = reference.reference_images(x, 2.0, matrix=matrix, periodic=(True,) * 3)
    found = [(i, j) for i, row in enumerate(np.asarray(nbrs.idx).tolist()) for j in row if j < N]
    assert sorted(found) == sorted((i, j) for i, j, _ in expected if not (alone[i] or alone[j]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nothing_is_rounded(dtype):
    """Lengths of all mantissas, and particles wherever they may be, at the edges where a step more is taken, too."""
    rng, most = np.random.default_rng(4), 2.0 ** (18 if dtype == np.float32 else 29)
    lengths = np.concatenate([rng.uniform(1, 2, 200), [1, np.nextafter(dtype(2), dtype(1)), 1.5]]).astype(dtype)
    drawn = rng.uniform(-1, 1, 400) * most ** rng.random(400)
    turns = np.concatenate([drawn, 192 * np.array([1, 1.0000001, 2, 4 / 3, -1, 3]), [most]])
    x = np.multiply.outer(turns, lengths).astype(dtype).reshape(-1, 1)
    matrix = np.broadcast_to(lengths, (len(turns), len(lengths))).reshape(-1, 1, 1).astype(dtype)

    both = jax.jit(lambda x, units, matrix: move_near(x, units, matrix, np.array([True]), True))
    near, steps = map(np.asarray, both(x, x / matrix[:, 0], matrix))
    assert (np.abs(near) < 193 * matrix[:, 0]).all()
    assert (steps != 0).mean() > 0.3
    for k in rng.choice(len(x), 4000, replace=False):
        exact = Fraction(float(x[k, 0])) - int(steps[k, 0]) * Fraction(float(matrix[k, 0, 0]))
        assert Fraction(float(near[k, 0])) == exact


def test_turns_that_do_not_fit_are_told():
    """Up to 511 on either side of the box are numbers; of those beyond, and of NaN, no axis has another's digits."""
    box, dtype = jfrnn.Box([1.0, 2.0, 4.0]), np.dtype(np.float32)
    kind = images_of(box, 0.1, dtype, 1)
    along = np.array([-LARGEST_TURN - 1, -LARGEST_TURN, -1, 0, LARGEST_TURN, LARGEST_TURN + 1])
    turns = np.stack(np.meshgrid(along, along, along), axis=-1).reshape(-1, 3)
    x = np.concatenate([(turns + 0.5) * [1, 2, 4], np.full((1, 3), np.nan)]).astype(dtype)

    @jax.jit
    def both(x):
        packed = count_turns(x, make_lattice(box, kind, dtype))
        return packed, unpack_turns(packed, 3)

    packed, unpacked = both(x)
    (*packed, nowhere), unpacked = np.asarray(packed), np.asarray(unpacked)[:-1]
    fit = (np.abs(turns) <= LARGEST_TURN).all(axis=1)
    assert 0 < fit.sum() < len(fit)
    np.testing.assert_array_equal(np.array(packed)[~fit], -2)
    np.testing.assert_array_equal(unpacked[fit], turns[fit])
    assert nowhere == -1


def test_boxes_of_systems_say_what_lies_beyond():
    """One particle of the second system; the pairs of the others stay."""
    x = np.random.default_rng(16).random((20, 3)).astype(np.float32)
    boxes, batch = jfrnn.Box(np.array([[1.0, 1.2, 0.9], [0.8, 1.1, 1.3]]), per_system=True), np.repeat(np.int32([0, 1]), 10)
    count = jax.jit(lambda x: jfrnn.search(x, 0.3, box=boxes, batch=batch, capacity=16))
    far = x.copy()
    far[13, 1] = 1e9
    near, beyond = count(x), count(far)
    assert jfrnn.Status(int(near.status)) == jfrnn.Status.OK
    assert jfrnn.Status(int(beyond.status)) == jfrnn.Status.OUT_OF_RANGE
    np.testing.assert_array_equal(np.asarray(beyond.count)[:10], np.asarray(near.count)[:10])
    assert np.asarray(beyond.count)[13] == 0
