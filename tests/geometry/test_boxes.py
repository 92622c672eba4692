"""A box per system: every case of `jfrnn.cases.crystals` against the oracle, system by system, then what lists make of them."""

import functools
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from by_numpy import in_order
from checked import assert_same, padded, refuses, slow, sparing
from test_box import energy_and_slopes, image_pairs, masked_images

import jfrnn
from jfrnn.cases.crystals import CRYSTAL_CASES

CAPACITY = {2: 96, 3: 256}


def system_by_system(find, boxes, x, batch, periodic=None, queries=None, query_batch=None):
    """Return (i, j, S) of all pairs; `find` asks the oracle for those of the sources and queries of a system, by their numbers."""
    found = set()
    for system, box in enumerate(np.asarray(boxes, x.dtype)):
        flags = np.ones(x.shape[1], bool) if periodic is None else np.broadcast_to(np.asarray(periodic), boxes.shape[:2])[system]
        kind = {"matrix": np.diag(box) if box.ndim == 1 else box, "periodic": flags.tolist()}
        ends = np.flatnonzero(batch == system)
        starts = ends if queries is None else np.flatnonzero(query_batch == system)
        if len(ends) and len(starts):
            pairs = find(ends, starts, **kind, **({} if queries is None else {"queries": queries[starts]}))
            found |= {(int(starts[i]), int(ends[j]), shift) for i, j, shift in pairs}
    return found


def oracle(boxes, x, batch, cutoff, periodic=None, queries=None, query_batch=None, **options):
    """Return (i, j, S) of all pairs, system by system."""

    def find(ends, starts, **kind):
        return reference.reference_images(x[ends], cutoff, **kind, **options)

    return system_by_system(find, boxes, x, batch, periodic, queries, query_batch)


@functools.lru_cache(maxsize=32)
def expected_images(name, dtype, dim, closed=False, half=False):
    given = CRYSTAL_CASES[name].build(dtype, dim)
    of_queries = {"queries": given.queries, "query_batch": given.query_batch}
    options = {"closed": closed, **({"half": True} if half else {})}
    return oracle(given.boxes, given.positions, given.batch, given.cutoff, given.periodic, **of_queries, **options)


def box_of(given):
    return jfrnn.Box(given.boxes, given.periodic, per_system=True)


N, MOST, REACH = 268, 6, {2: (6, 5), 3: (4, 4, 6)}  # of the largest cases


def padded_box(given):
    """Return the boxes of a case, and more without particles, so that most cases share a program."""
    systems, dim = given.boxes.shape[:2]
    boxes = np.concatenate([given.boxes, np.stack([np.eye(dim, dtype=given.boxes.dtype)] * MOST)])[:MOST]
    flags = np.ones((MOST, dim), bool)
    flags[:systems] = given.periodic
    return jfrnn.Box(boxes, flags, per_system=True, images=REACH[dim])


def assert_case(name, dtype, dim, backend, closed=False, half=False, geometry=False, pad=True):
    given = CRYSTAL_CASES[name].build(dtype, dim)
    expected = expected_images(name, dtype, dim, closed, half)
    queries = {} if given.queries is None else {"queries": jnp.asarray(given.queries)}
    x, batch, box = given.positions, given.batch, padded_box(given) if pad else box_of(given)
    if pad:
        x, batch = padded(x, N), np.concatenate([batch, np.full(N - len(batch), -1, np.int32)])
    batch = batch if given.queries is None else (batch, given.query_batch)
    options = {"box": box, "batch": batch, "backend": backend, "closed": closed, "half": half}
    nbrs = jfrnn.search(jnp.asarray(x), given.cutoff, capacity=CAPACITY[dim], **queries, **options)
    nbrs.check()
    assert_same(masked_images(nbrs, x, **queries) if geometry else image_pairs(nbrs, x, **queries), expected)
    assert int(np.asarray(nbrs.count).sum()) == len(expected) > 0
    assert nbrs.backend == backend
    assert (box_of(given).numbers is None) == (name != "unreduced")
    assert (nbrs.images is None) == (name == "nearest")


EACH = list(product(CRYSTAL_CASES, (np.float32, np.float64), (2, 3), ("jax", "warp", "brute")))
# By default one kind on Warp, and a case on each engine that compiles slowly.
OFTEN = [("slabs", np.float32, 3, "jax"), ("absent", np.float64, 2, "brute"), *product(CRYSTAL_CASES, [np.float32], [3], ["warp"])]


@pytest.mark.parametrize(("name", "dtype", "dim", "backend"), sparing(EACH, OFTEN))
def test_case(name, dtype, dim, backend):
    geometry = backend == "warp" and name == "unreduced"  # where shifts of the list count other vectors than the given ones
    own_program = backend != "warp" or name in ("lengths", "nearest", "queries", "unreduced")
    assert_case(name, dtype, dim, backend, geometry=geometry, pad=not own_program)


@pytest.mark.parametrize("backend", ["warp", slow("jax"), slow("brute")])
def test_closed_and_half(backend):
    assert_case("ties", np.float64, 2, backend, closed=True)
    assert_case("ties", np.float64, 2, backend, half=True)
    assert_case("mixed", np.float64, 2, backend, half=True)


# --- what boxes per system add to lists ----------------------------------------------------------------------------------

PERIODIC = np.array([[True, True], [True, False], [False, False], [True, True]])


def crystals(dtype=np.float64, dim=2):
    given = CRYSTAL_CASES["mixed"].build(dtype, dim)
    return jnp.asarray(given.positions), given.batch, jnp.asarray(given.boxes)


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_skin_in_moving_boxes(backend):
    """Particles drift, boxes breathe and positions are wrapped: every step holds exactly the pairs of that step."""
    rng, (x, batch, boxes) = np.random.default_rng(0), [np.asarray(part) for part in crystals(np.float32)]
    batch = np.where(np.arange(len(batch)) % 7 == 0, -1, batch)
    nbrs = jfrnn.search(x, 0.5, box=jfrnn.Box(boxes), batch=batch, skin=0.08, capacity=64, backend=backend)
    update = jax.jit(lambda nbrs, x, boxes: nbrs.update(x, box=jfrnn.Box(boxes)))
    for step in range(8):
        x = x + rng.normal(scale=0.004, size=x.shape).astype(x.dtype)
        boxes = boxes * np.float32(1 + 0.001 * np.sin(step))
        if step == 3:
            own = boxes.astype(np.float64)[np.maximum(batch, 0)]
            turns = np.floor(np.einsum("nd,ndk->nk", x.astype(np.float64), np.linalg.inv(own)))
            x = x - np.einsum("nd,ndk->nk", turns, own).astype(x.dtype)
        nbrs = update(nbrs, x, boxes)
        assert masked_images(nbrs, x) == oracle(boxes, x, batch, 0.5)
    assert 0 < int(nbrs.rebuild_count) < 8
    nbrs.check()


@pytest.mark.parametrize("ways", [("distances", "list"), slow(("edges", "sum"))], ids="-".join)
def test_derivatives_in_positions_and_boxes(ways):
    """Sums over the pairs of the oracle, and their derivatives."""
    x, batch, boxes = crystals()
    pairs = in_order(expected_images("mixed", np.float64, 2), 2)
    total, capacity = len(pairs[0]), CAPACITY[2]
    nbrs = jfrnn.search(x, 0.75, box=jfrnn.Box(boxes), batch=batch, backend="warp", capacity=capacity)

    def energy(way, x, boxes):
        def of_pair(r, i, j):
            del i, j
            return (0.75 - jnp.sqrt(r @ r)) ** 3

        box = jfrnn.Box(boxes, images=nbrs.box_kind.reach)
        if way == "sum":
            return jfrnn.pair_sum(of_pair, x, 0.75, box=box, batch=batch).sum()
        if way == "list":
            return jfrnn.pair_sum(of_pair, x, None, neighbors=nbrs, box=box).sum()
        if way == "edges":
            edges = nbrs.edges(x, total + 3, box=box)
            r = jnp.sqrt(jnp.where(edges.mask, (edges.displacement**2).sum(axis=1), 1))
            return jnp.where(edges.mask, (0.75 - r) ** 3, 0).sum()
        r, mask = nbrs.distances(x, box=box)
        return jnp.where(mask, (0.75 - r) ** 3, 0).sum()

    @jax.jit
    def everything(x, boxes):
        return [jax.value_and_grad(functools.partial(energy, way), argnums=(0, 1))(x, boxes) for way in ways]

    right, of_x, of_boxes = energy_and_slopes(np.asarray(x), np.asarray(boxes), pairs, batch, 0.75)
    for value, gradient in everything(x, boxes):
        np.testing.assert_allclose(value, right, rtol=1e-12)
        np.testing.assert_allclose(gradient[0], of_x, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(gradient[1], of_boxes, rtol=1e-10, atol=1e-12)
    assert not of_boxes[1].any()  # no particle is in that system


@pytest.mark.parametrize("backend", ["warp", slow("jax"), slow("brute")])
def test_known_numbers_of_neighbors_at_long_cutoffs(backend):
    """Diamond, 2 atoms in its primitive cell, at 95 bohr; and single particles in cubic cells, whose neighbors integers count."""
    edge, cutoff = 3.567, 95 * 0.529177210903
    diamond = edge / 2 * np.array([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
    boxes = np.stack([diamond, 3.0 * np.eye(3), diamond, 60.0 * np.eye(3)])
    atoms = edge / 4 * np.array([[0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5], [0, 0, 0], [1, 1, 1], [0, 0, 0]])
    away = np.arange(-17, 18) ** 2
    cubic = int((9 * (away[:, None, None] + away[:, None] + away) < cutoff**2).sum()) - 1
    given = {"box": jfrnn.Box(boxes), "batch": np.array([0, 0, 1, 2, 2, 3]), "backend": backend}
    if backend != "warp":
        assert jfrnn.count(atoms, cutoff, **given).tolist() == [94004, 94004, cubic, 94004, 94004, 0]
        return
    nbrs = jfrnn.search(atoms, cutoff, capacity=94008, **given)
    nbrs.check()
    counts, shifts = np.asarray(nbrs.count).tolist(), np.asarray(nbrs.shifts(atoms))
    assert counts == [94004, 94004, cubic, 94004, 94004, 0]
    for i, count in enumerate(counts):  # no particle has another one twice in the same image
        listed = np.column_stack([np.asarray(nbrs.idx)[i], shifts[i]])[:count]
        assert len(np.unique(listed @ 1000 ** np.arange(4))) == count


def test_one_program_serves_other_boxes_and_flags():
    x, batch, traces = np.random.default_rng(2).uniform(-2, 2, (30, 2)), np.arange(30, dtype=np.int32) % 4, []

    @jax.jit
    def search(x, boxes, periodic, batch):
        traces.append(None)
        box = jfrnn.Box(boxes, periodic, per_system=True, images=2)
        return jfrnn.search(x, 0.5, box=box, batch=batch, capacity=64, backend="warp")

    for lengths in ([[1.0, 2.0], [0.5, 1.5], [1.0, 1.0], [3.0, 0.4]], [[0.6, 0.7], [2.0, 1.5], [1.0, 1.0], [3.0, 3.0]]):
        for periodic in (PERIODIC, ~PERIODIC):
            boxes = np.array(lengths)
            found = search(x, boxes, periodic, batch)
            found.check()
            assert image_pairs(found, x) == oracle(boxes, np.asarray(x), batch, 0.5, periodic)
    assert jfrnn.Status.BOX_TOO_SMALL in jfrnn.Status(int(search(x, np.full((4, 2), 0.1), PERIODIC, batch).status))
    empty = boxes * [[1.0], [1.0], [1.0], [0.0]]  # of a system without particles, whatever its box is
    search(np.where(batch[:, None] == 3, np.nan, x), empty, PERIODIC, np.where(batch == 3, -1, batch)).check()
    assert len(traces) == 1


def test_grow_in_boxes_that_shrink():
    x, batch = jnp.asarray(np.random.default_rng(3).uniform(-2, 2, (20, 2))), np.arange(20, dtype=np.int32) % 2
    box = jfrnn.Box(np.array([[2.0, 3.0], [4.0, 2.0], [9.0, 9.0]]), per_system=True)
    nbrs = jfrnn.search(x, 0.5, box=box, batch=batch, capacity=8)
    assert nbrs.images is None
    boxes = np.array([[0.4, 0.9], [1.5, 0.7], [9.0, 9.0]])
    small = jfrnn.Box(boxes, per_system=True)
    assert image_pairs(nbrs.grow(x, box=small), x) == oracle(boxes, np.asarray(x), batch, 0.5)


def test_numbers_without_a_box_are_told():
    x = jnp.zeros((3, 2))
    nbrs = jfrnn.search(x, 0.5, box=jfrnn.Box(np.ones((2, 2, 2)) + np.eye(2)), batch=np.array([0, 2, -1]), capacity=8)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.SYSTEM_WITHOUT_BOX
    refuses(ValueError, "names systems for which `box` holds no box", nbrs.check)


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_numbers_mean_the_same_where_no_axis_is_periodic(backend):
    """Said for all systems or for each: particles of -1 are nowhere, and numbers without a box are told."""
    x, cells = np.random.default_rng(0).uniform(size=(6, 3)), np.stack([np.eye(3)] * 2)
    for periodic in (False, np.zeros((2, 3), bool)):
        given = {"box": jfrnn.Box(cells, periodic), "backend": backend}
        np.testing.assert_array_equal(jfrnn.count(x, 2.0, batch=np.array([0, -1, -1, 1, 1, 1]), **given), [0, 0, 0, 2, 2, 2])
        unknown = functools.partial(jfrnn.count, x, 2.0, batch=np.array([0, 5, 5, 1, 1, 1]), **given)
        refuses(ValueError, "names systems for which", unknown)


X, SYSTEMS, CELLS = np.zeros((4, 3)), np.zeros(4, np.int32), np.stack([np.eye(3)] * 2)


@pytest.mark.parametrize(
    ("error", "match", "call"),
    [
        (ValueError, r"got shape \[5, 3\]", lambda: jfrnn.Box(np.ones((5, 3)))),
        (ValueError, r"with per_system=True \[systems, d\], got shape \[3\]", lambda: jfrnn.Box(np.ones(3), per_system=True)),
        (TypeError, "per_system must be True, False or None", lambda: jfrnn.Box(CELLS, per_system=1)),
        (ValueError, r"got shape \[2, 3, 3\]", lambda: jfrnn.Box(CELLS, per_system=False)),
        (ValueError, r"of shape \[2, 3\], got bool of shape \[3, 3\]", lambda: jfrnn.Box(CELLS, np.ones((3, 3), bool))),
        (ValueError, r"origin must be a number or have shape \[3\] or \[2, 3\]", lambda: jfrnn.Box(CELLS, origin=np.zeros((3, 3)))),
        (ValueError, r"independent, got the rows .* in system 1", lambda: jfrnn.Box(CELLS * [[[1.0]], [[0.0]]])),
        (ValueError, r"must be finite, got .* in system 0", lambda: jfrnn.Box(CELLS * [[[np.nan]], [[1.0]]])),
        (ValueError, r"must be positive, got \[-1.0, 1.0\] in system 1", lambda: jfrnn.Box([[1.0, 1], [-1, 1]], per_system=True)),
        (ValueError, "a box per system: pass batch=", lambda: jfrnn.search(X, 1.0, box=jfrnn.Box(CELLS))),
        (
            ValueError,
            r"kind with which the list was made \(.*for each of 2 systems\), got .*for each of 1 systems",
            lambda: jfrnn.search(X, 0.1, box=jfrnn.Box(CELLS), batch=SYSTEMS, capacity=8).update(X, box=jfrnn.Box(CELLS[:1])),
        ),
        (ValueError, "hashgrid.*one system", lambda: jfrnn.count(X, 1.0, box=jfrnn.Box(CELLS), batch=SYSTEMS, backend="hashgrid")),
    ],
)
def test_errors(error, match, call):
    refuses(error, match, call)


def test_near_ties_of_particles_a_hundred_cells_away():
    """Where boxes differ, too, no pair is decided by wrapped coordinates, which lost to rounding what tells these pairs apart."""
    rng, boxes = np.random.default_rng(5), np.array([[3.1, 2.7, 3.3], [2.9, 3.7, 2.3]], np.float32)
    batch = np.repeat([0, 1], 60)
    lengths = boxes[batch].astype(float)
    start = (rng.random((120, 3)) + rng.integers(-100, 101, (120, 3))) * lengths
    way = rng.normal(size=(60, 3))
    way *= 0.5 / np.linalg.norm(way, axis=1, keepdims=True)
    x = start.astype(np.float32)
    x[1::2] = (x[::2].astype(float) + way + rng.integers(-50, 51, (60, 3)) * lengths[::2]).astype(np.float32)
    expected = oracle(boxes, x, batch, 0.5)
    nbrs = jfrnn.search(jnp.asarray(x), 0.5, box=jfrnn.Box(boxes, per_system=True), batch=batch, capacity=16, backend="warp")
    nbrs.check()
    assert image_pairs(nbrs, jnp.asarray(x)) == expected
    near = {pair[:2] for pair in expected}
    assert 10 < sum((k, k + 1) in near for k in range(0, 120, 2)) < 50


def test_systems_of_a_few_particles_in_wide_boxes():
    rng = np.random.default_rng(5)
    lengths, batch = rng.uniform(3, 9, 60), np.sort(rng.integers(0, 60, 240)).astype(np.int32)
    x = rng.random((240, 3)) * lengths[batch, None]
    boxes = jfrnn.Box(np.eye(3) * lengths[:, None, None], images=1)
    apart = x[:, None] - x
    apart -= np.rint(apart / lengths[batch, None, None]) * lengths[batch, None, None]
    near = (np.linalg.norm(apart, axis=-1) < 1.2) & (batch[:, None] == batch) & ~np.eye(240, dtype=bool)
    found = jfrnn.count(x, 1.2, box=boxes, batch=batch, backend="warp")
    np.testing.assert_array_equal(found, near.sum(axis=1))
