"""`search_triangles` against the oracle on every hard case, what it refuses, and what a list does in a time loop."""

import functools
from itertools import pairwise, product

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import assert_same, refuses

import jfrnn
from jfrnn._geometry.cutoffs import make_cutoff
from jfrnn._triangles import cells as _triangles_cells
from jfrnn._triangles import rows as _triangles_rows
from jfrnn._triangles import tree as _triangles_tree
from jfrnn._triangles import warp as _triangles_warp
from jfrnn.cases.triangles import TRIANGLE_CASES, TriangleInput, padded

BACKENDS = ("jax", "warp", "bvh")
EXTREME = ("tiny_cutoff", "huge_cutoff")
# Lengths are scaled: another program, which takes the array engine long; see `test_buckets_are_shared`.
SCALED = ("ties_small", *EXTREME)
IN_CELLS = ("jax", "warp")
CAPACITY = 40
KINDS = list(product((np.float32, np.float64), (2, 3)))
OFTEN = {  # each kind by one of the fast engines; the array engine compiles slowly
    "jax": [(np.float32, 3)],
    "warp": [(np.float32, 3), (np.float64, 2)],
    "bvh": [(np.float32, 2), (np.float64, 3)],
}


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch):
    """Candidates fill chunks of arrays, some of them several."""
    monkeypatch.setattr(_triangles_rows, "_CHUNK", 1 << 9)


def search_padded(name, dtype, dim, backend):
    given = padded(TRIANGLE_CASES[name].build(dtype, dim))
    return jfrnn.search_triangles(given.positions, given.vertices, given.faces, given.cutoff, capacity=CAPACITY, backend=backend)


def assert_exact(tri, expected):
    """Fail unless the list holds exactly these pairs."""
    assert not tri.overflow
    assert_same(set(reference.pairs_of(np.asarray(tri.idx), np.asarray(tri.count), len(tri.faces))), expected)


@functools.lru_cache(maxsize=2)
def expected_pairs(name, dtype, dim):
    given = TRIANGLE_CASES[name].build(dtype, dim)
    return reference.triangle_pairs(given.positions, given.vertices, given.faces, given.cutoff)


def each_case():
    for (dtype, dim), name, backend in product(KINDS, TRIANGLE_CASES, BACKENDS):
        rarely = (dtype, dim) not in OFTEN[backend] or (backend == "jax" and name in SCALED)
        kind = f"f{8 * dtype().itemsize}-{dim}d-{name}-{backend}"
        marks = [pytest.mark.slow] * rarely + [pytest.mark.kernels] * ((dtype, dim) == (np.float32, 3))
        yield pytest.param(name, dtype, dim, backend, id=kind, marks=marks)


@pytest.mark.parametrize(("name", "dtype", "dim", "backend"), list(each_case()))
def test_hard_case(name, dtype, dim, backend):
    tri = search_padded(name, dtype, dim, backend)
    assert_exact(tri, expected_pairs(name, dtype, dim))
    assert int(tri.required) == int(np.max(tri.count))


@pytest.mark.slow
@pytest.mark.parametrize("name", TRIANGLE_CASES)
def test_every_case_as_it_is(name, dtype, dim):
    """Eager, unpadded, capacity counted, other optimizations of the compiler: hundreds of programs."""
    given = TRIANGLE_CASES[name].build(dtype, dim)
    tri = jfrnn.search_triangles(given.positions, given.vertices, given.faces, given.cutoff)
    assert_exact(tri, expected_pairs(name, dtype, dim))


@pytest.mark.parametrize(("backend", "dtype"), [("jax", np.float32), ("warp", np.float64)])  # of which some take integers
def test_particles_at_the_cutoff_beside_each_side(backend, dtype):
    """They lie beyond one side alone, in its plane or at any angle to it: near the plane, but the side decides."""
    random, cutoff, eps = np.random.default_rng(11), 0.3, float(np.finfo(dtype).eps)
    corners = random.uniform(-3, 3, (16, 1, 3)) + random.uniform(-1, 1, (16, 3, 3))
    along = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(along[:, 0], along[:, 1])[:, None]
    across, up = (v / np.linalg.norm(v, axis=2, keepdims=True) for v in (np.cross(along, normal), normal))
    angle = random.uniform(-1.2, 1.2, (16, 3, 1)) * random.integers(0, 2, (16, 3, 1))
    away = cutoff * (1 + eps * random.integers(-2, 3, (16, 3, 1))) * (np.cos(angle) * across + np.sin(angle) * up)
    x = (corners + along * random.uniform(0.2, 0.8, (16, 3, 1)) + away).reshape(48, 3).astype(dtype)
    vertices, faces = corners.reshape(48, 3).astype(dtype), np.arange(48, dtype=np.int32).reshape(16, 3)
    wide = padded(TriangleInput(x, vertices, faces, cutoff))
    tri = jfrnn.search_triangles(wide.positions, wide.vertices, wide.faces, cutoff, capacity=CAPACITY, backend=backend)
    assert_exact(tri, reference.triangle_pairs(x, vertices, faces, cutoff))
    near = np.any(np.asarray(tri.idx) == np.repeat(np.arange(16), 3)[:, None], axis=1)
    assert 10 < near.sum() < 38


@pytest.mark.parametrize("backend", ["warp", "bvh"])
def test_where_floats_are_farther_apart_than_the_cutoff(backend):
    """A box, widened by the cutoff, is as large as before: the particles on its border are in it."""
    random = np.random.default_rng(12)
    vertices = (2.0**27 + 16 * random.integers(-3, 4, (48, 3))).astype(np.float32)
    x, faces = vertices[random.permutation(48)], np.arange(48, dtype=np.int32).reshape(16, 3)
    wide = padded(TriangleInput(x, vertices, faces, 1.0))
    tri = jfrnn.search_triangles(wide.positions, wide.vertices, wide.faces, 1.0, capacity=CAPACITY, backend=backend)
    assert_exact(tri, reference.triangle_pairs(x, vertices, faces, 1.0))
    assert int(tri.count.sum()) >= 48


def wall(dtype=np.float32, origin=0.0):
    """A square of two triangles in the plane z = 0."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype) + np.array([0, 0, origin], dtype)
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("dtype", "dim"), [(np.float32, 2), (np.float64, 3)])
def test_nothing_is_near_nothing(dtype, dim):
    empty, faces = np.zeros((0, dim), dtype), np.zeros((0, dim), np.int64)
    points, corners = np.zeros((2, dim), dtype), np.eye(dim, dtype=dtype)
    search = functools.partial(jfrnn.search_triangles, cutoff=1.0)
    without = ((empty, empty, faces), (points, empty, faces), (points, corners, faces))
    for x, v, f in (*without, (empty, corners, np.arange(dim)[None])):
        tri = search(x, v, f)
        tri.check()
        assert tri.idx.shape == (len(x), 8)
        assert np.all(np.asarray(tri.idx) == len(f))
        assert not np.any(tri.count)
        if 0 in (len(x), len(f)):
            nearest, distance, mask = tri.closest(x)
            assert (nearest.shape, distance.shape) == ((len(x), 8, dim), (len(x), 8))
            assert not np.any(mask)
            assert tri.signed_distance(x).distance.shape == (len(x),)


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"positions": "here"}, TypeError, r"positions must be a JAX or NumPy array"),
        ({"vertices": np.zeros((4, 2), np.float32)}, ValueError, r"vertices must match positions \(float32, 3 columns\)"),
        ({"vertices": np.zeros((4, 3))}, ValueError, r"vertices must match positions"),
        ({"faces": np.zeros((2, 3))}, TypeError, r"faces must be an array of integers of shape \[f, 3\], .* got float64"),
        ({"faces": {0, 1, 2}}, TypeError, r"faces must be an array of integers .* got set"),
        ({"faces": np.zeros((2, 4), int)}, ValueError, r"faces must have shape \[f, 3\], the vertices of triangles in 3D"),
        ({"cutoff": 0.0}, ValueError, r"cutoff must be positive and finite"),
        ({"cutoff": 1e-40}, ValueError, r"cutoff=.* is outside"),
        ({"capacity": 0}, ValueError, r"capacity must be at least 1"),
        ({"slack": 0.5}, ValueError, r"slack must be finite and at least 1"),
        ({"backend": "hashgrid"}, ValueError, r"backend must be one of 'auto', 'jax', 'warp', 'bvh'"),
    ],
)
def test_what_is_refused(change, error, match):
    vertices, faces = wall()
    given = {"positions": np.zeros((1, 3), np.float32), "vertices": vertices, "faces": faces, "cutoff": 1.0} | change
    refuses(error, match, jfrnn.search_triangles, **given)


def test_capacity_is_asked_for_under_jit():
    vertices, faces = wall()
    with pytest.raises(ValueError, match="capacity must be given where positions, vertices or faces are traced"):
        jax.jit(lambda x: jfrnn.search_triangles(x, vertices, faces, 1.0).idx)(np.zeros((1, 3), np.float32))


def test_status_tells_of_the_data():
    vertices, faces = wall()
    points = np.full((4, 3), 0.25, np.float32)
    broken = vertices.copy()
    broken[3] = np.nan
    search = functools.partial(jfrnn.search_triangles, cutoff=0.5, capacity=1)
    cases = [
        (points, vertices, faces, jfrnn.Status.ROW_OVERFLOW, r"capacity=1 is too small: one row has 2 neighbors"),
        (points * np.nan, vertices, faces, jfrnn.Status.NONFINITE, r"`positions` .* hold non-finite"),
        (points, broken, faces, jfrnn.Status.NONFINITE_VERTEX, r"`vertices` that faces name hold non-finite"),
        (points, vertices, np.array([[0, 1, 2], [0, 2, 4]]), jfrnn.Status.FACE_OUT_OF_RANGE, r"name vertices that do not exist"),
        (points, vertices, np.array([[0, 1, 2], [0, 2, -(2**40)]]), jfrnn.Status.FACE_OUT_OF_RANGE, r"`faces` name vertices"),
    ]
    for x, v, f, bit, match in cases:
        tri = search(x, v, f)
        assert jfrnn.Status(int(tri.status)) == bit
        refuses((ValueError, jfrnn.NeighborOverflowError), match, tri.check)


def test_a_loop_with_a_wall_that_moves():
    """Updates keep what was sticky, reuse the cells of a wall that stays, and sort one that does not; grow makes room."""
    vertices, faces = wall()
    x = np.random.default_rng(0).uniform([-0.5, -0.5, 0.6], [1.5, 1.5, 1.4], (4, 3)).astype(np.float32)
    tri = jfrnn.search_triangles(x, vertices, faces, 0.5, capacity=1)
    assert int(tri.required) <= 1 or tri.overflow

    @jax.jit
    def fall(x, tri):
        def step(_, carry):
            x, tri = carry
            x = x - jnp.array([0.0, 0.0, 0.25], jnp.float32)
            return x, tri.update(x)

        return jax.lax.fori_loop(0, 4, step, (x, tri))

    after, seen = fall(x, tri)
    assert seen.overflow
    assert int(seen.required) == 2
    _, past = fall(after, seen)
    assert not np.any(past.count)
    assert past.overflow
    assert int(past.required) == 2
    grown = seen.grow(after)
    grown.check()
    assert grown.capacity == 8
    assert_exact(grown, reference.triangle_pairs(np.asarray(after), vertices, faces, 0.5))
    lifted = wall(origin=0.75)[0]
    moved = jax.jit(lambda x, v, tri: tri.update(x, vertices=v))(after, lifted, grown)
    assert_exact(moved, reference.triangle_pairs(np.asarray(after), lifted, faces, 0.5))
    assert np.array_equal(moved.vertices, lifted)
    refuses(TypeError, r"grow\(\) changes the shape", jax.jit(lambda x, tri: tri.grow(x).idx), after, grown)
    refuses(ValueError, "positions hold 3 particles, but the list was made for 4", grown.update, after[:3])
    refuses(ValueError, "vertices hold 3 corners, but the list was made for 4", grown.update, after, vertices=lifted[:3])
    said = " must be float32 with 3 columns, for which the list was made, got "
    for ask in (grown.update, grown.grow, grown.closest, grown.signed_distance):
        refuses(ValueError, f"positions{said}float64 with 3", ask, after.astype(np.float64))
        refuses(ValueError, f"vertices{said}float32 with 2", ask, after, vertices=lifted[:, :2])


@pytest.mark.parametrize("backend", IN_CELLS)
def test_buckets_are_shared_without_harm(monkeypatch, backend):
    """All cells hashed into two buckets: candidates are many, pairs the same, and squares of lengths are no floats."""
    for module in (_triangles_cells, _triangles_warp):
        monkeypatch.setattr(module, "bucket_count", lambda faces: 2)
    for name in EXTREME:
        wide = padded(TRIANGLE_CASES[name].build(np.float64, 2))
        faces = np.pad(wide.faces, ((0, 1), (0, 0)), constant_values=-1)  # a shape of its own: what was traced is kept
        tri = jfrnn.search_triangles(wide.positions, wide.vertices, faces, wide.cutoff, capacity=CAPACITY, backend=backend)
        assert tri.cells.start.shape == (3,)
        assert_exact(tri, expected_pairs(name, np.float64, 2))


@pytest.mark.kernels
@pytest.mark.parametrize("backend", IN_CELLS)
def test_cells_hold_what_they_say(backend):
    """Each bucket holds a triangle once at most, in the order of triangles; levels in use come first, the smallest cells before."""
    tri = search_padded("sizes", np.float32, 3, backend)
    start, held, levels = (np.asarray(x) for x in (tri.cells.start, tri.cells.triangles, tri.cells.levels))
    count = int(tri.cells.level_count)
    assert start[0] == 0
    for low, high in pairwise(start):
        inside = held[low:high][held[low:high] < 32]
        assert np.all(np.diff(inside) > 0)
    assert np.all(np.diff(levels[:count]) < 0)
    assert not np.any(levels[count:])
    assert set(levels[:count]) == set(np.asarray(tri.cells.level_of)[:24])


@pytest.mark.kernels
def test_engines_make_the_same_cells():
    one, two = (search_padded("random", np.float32, 3, backend) for backend in IN_CELLS)
    assert np.array_equal(one.cells.level_of, two.cells.level_of)
    assert np.array_equal(one.idx, two.idx)


def test_engines_make_the_same_cells_for_any_cutoff():
    sort = jax.jit(_triangles_cells.sort_triangles)
    for name in EXTREME:
        wide = padded(TRIANGLE_CASES[name].build(np.float64, 2))
        there = np.all(wide.faces >= 0, axis=1)
        corners = np.where(there[:, None, None], wide.vertices[wide.faces], 0)
        made = sort(corners, there, make_cutoff(wide.cutoff, np.dtype(np.float64), closed=False))
        kernel = search_padded(name, np.float64, 2, "warp").cells
        assert int(made.level_count) == int(kernel.level_count)
        assert np.array_equal(made.level_of[:16], kernel.level_of[:16])
        assert np.array_equal(made.start, kernel.start)
        assert np.array_equal(made.triangles, kernel.triangles)


@pytest.mark.parametrize(("faces", "starts"), [(1, [0, 16]), (16, [0, 16]), (17, [0, 32, 48]), (257, [0, 272, 304, 320])])
def test_levels_of_a_tree(faces, starts):
    assert _triangles_tree.level_starts(faces).tolist() == starts


@jax.jit
def grown(corners, good, cutoff):
    return _triangles_tree.grow_tree(corners, good, cutoff)


@pytest.mark.parametrize("spread", [0.0, 1e-30, 1.0, 1e30])
@pytest.mark.parametrize(("dtype", "dim"), [(np.float32, 3), (np.float64, 2)])
def test_a_tree_holds_what_it_says(dtype, dim, spread):
    """Every sound triangle is a leaf, once; a box holds those of its children, and a leaf's what is within the cutoff."""
    corners = np.random.default_rng(2).normal(size=(300, dim, dim)).astype(dtype) * dtype(spread)
    good = np.arange(300) % 7 != 3
    tree = grown(corners, good, make_cutoff(0.25, np.dtype(dtype), closed=False))
    triangles, boxes = np.asarray(tree.triangles), np.asarray(tree.boxes)
    starts = _triangles_tree.level_starts(300)
    assert sorted(triangles) == [*range(300), *[300] * 4]
    assert boxes.shape == (2 * dim, starts[-1])
    low, high = boxes[:dim], boxes[dim:]
    empty = low[0] == np.inf
    assert np.all((low == np.inf) == (high == -np.inf))
    assert np.array_equal(empty[:304], [t == 300 or not good[t] for t in triangles])
    held = triangles[~empty[:304]]
    assert np.all(low[:, :304][:, ~empty[:304]] <= corners[held].min(axis=1).T - dtype(0.25))
    assert np.all(high[:, :304][:, ~empty[:304]] >= corners[held].max(axis=1).T + dtype(0.25))
    for (begin, end), after in zip(pairwise(starts[:-1]), starts[1:-1], strict=True):
        nodes = (end - begin) // 16
        assert np.array_equal(low[:, after : after + nodes], low[:, begin:end].reshape(dim, nodes, 16).min(axis=2))
        assert np.array_equal(high[:, after : after + nodes], high[:, begin:end].reshape(dim, nodes, 16).max(axis=2))


@pytest.mark.parametrize(("dtype", "dim"), [pytest.param(np.float32, 3, id="f32-3d"), pytest.param(np.float64, 2, id="f64-2d")])
def test_a_tree_finds_what_cells_find(dtype, dim):
    """More triangles than two levels hold, of sizes from a thousandth of the cutoff to a hundredfold."""
    random = np.random.default_rng(3)
    sizes = 10.0 ** random.uniform(-3, 2, (700, 1, 1))
    corners = random.uniform(-20, 20, (700, 1, dim)) + sizes * random.normal(size=(700, dim, dim))
    x, faces = random.uniform(-20, 20, (900, dim)).astype(dtype), np.arange(700 * dim).reshape(700, dim)
    search = functools.partial(jfrnn.search_triangles, x, corners.reshape(-1, dim).astype(dtype), faces, 1.0, capacity=128)
    lists = [search(backend=backend) for backend in ("bvh", "warp")]
    assert not lists[0].overflow
    found = [reference.pairs_of(np.asarray(tri.idx), np.asarray(tri.count), 700) for tri in lists]
    assert sorted(found[0]) == sorted(found[1])
    assert len(found[0]) > 700  # more than one per triangle
    again = lists[0].update(x)
    assert np.array_equal(again.idx, lists[0].idx)


@pytest.mark.parametrize(
    ("dtype", "dim", "faces", "backend"),
    [(np.float32, 3, 0, "warp"), (np.float64, 2, 500, "warp"), (np.float64, 3, 500, "auto"), (np.float32, 2, 0, "auto")],
)
def test_memory_is_planned(dtype, dim, faces, backend):
    """What the list takes, its wall included, is known beforehand, and follows particles and faces alone."""
    plan = jfrnn.memory_plan(1000, 0.1, 16, dim=dim, dtype=dtype, faces=faces, backend=backend)
    count = faces // 2 + 2  # of a closed wall, which the plan takes for granted
    vertices = np.random.default_rng(0).normal(size=(count, dim)).astype(dtype)
    named = np.random.default_rng(1).integers(0, count, (faces, dim))
    tri = jfrnn.search_triangles(np.zeros((1000, dim), dtype), vertices, named, 0.1, capacity=16, backend=backend)
    made = jax.tree.leaves(tri)
    assert 0 <= plan.list_bytes - sum(leaf.nbytes for leaf in made) <= 16 * len(made)  # a table of results
    assert plan.scratch_bytes < 1000 * (64 + faces)
    assert plan.backend == tri.backend == {"auto": "bvh"}.get(backend, backend)


def test_plans_that_make_no_sense_are_refused():
    refuses(ValueError, "faces belong to a search for triangles", jfrnn.memory_plan, 10, 0.1, 8, faces=10, queries=10)
    refuses(ValueError, "with faces, got", jfrnn.memory_plan, 10, 0.1, 8, faces=10, backend="brute")


def test_a_triangle_far_away_leaves_others_in_order():
    """Boxes of nodes stay small: a curve whose cells were a thousandth of the extent would put all but one into one cell."""
    corners = np.random.default_rng(4).random((512, 1, 3)) + 0.01 * np.random.default_rng(5).random((512, 3, 3))
    far = np.concatenate([corners, corners[:1] + np.array([4096.0, 0, 0])]).astype(np.float32)
    cutoff = make_cutoff(0.01, np.dtype(np.float32), closed=False)

    def node_volume(corners):
        boxes = np.asarray(grown(corners, np.ones(len(corners), bool), cutoff).boxes)
        first, last = _triangles_tree.level_starts(len(corners))[1:3]
        return np.median(np.prod(boxes[3:, first:last] - boxes[:3, first:last], axis=0)[np.isfinite(boxes[0, first:last])])

    assert node_volume(far) < 2 * node_volume(corners.astype(np.float32)) < 0.2


def test_a_list_may_be_an_argument_of_what_is_differentiated():
    vertices, faces = wall()
    x = np.random.default_rng(6).uniform(0.1, 0.9, (5, 3)).astype(np.float32) * np.array([1, 1, 0.2], np.float32)

    def total(tri, x):
        return tri.update(x).closest(x)[1].sum()

    tri = jfrnn.search_triangles(x, vertices, faces, 0.5, capacity=2, backend="bvh")  # its boxes are floats

    @jax.jit
    def both_ways(tri, x):
        value, pull = jax.vjp(total, tri, x)
        return value, pull(jnp.ones_like(value))[1], jax.grad(lambda x: total(tri, x))(x)

    value, pulled, slopes = both_ways(tri, x)
    assert value > 0
    assert np.array_equal(pulled, slopes)
