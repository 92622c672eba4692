"""Who pairs with whom: excluded pairs, and cutoffs of pairs of species: against the oracle, then what lists and sums make of it."""

import functools
from itertools import product

import by_numpy
import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import test_boxes
from checked import refuses, slow, slowly, sparing
from test_box import image_pairs

import jfrnn

SLOW = pytest.mark.slow
N, CAPACITY = 48, 64
TABLE = np.array([[3 / 8, 0, 0.21], [0, 0, 5 / 8], [0.21, 5 / 8, 1 / 8]])  # sites are multiples of 1/8: many ties
BOXES = {"open": None, "nearest": [1.5, 1.5, 1.5], "images": [1.0, 1.0, 1.0], "skewed": [[1.0, 0, 0], [0.25, 1, 0], [0, 0.5, 1]]}


@functools.cache
def scene(dtype, dim):
    """Points on a coarse grid, some of them on top of each other, some turned away from it; species; pairs, some of them twice."""
    random = np.random.default_rng(3)
    x = random.integers(0, 8, (N, dim)) / 8
    x[::5] += random.uniform(-0.02, 0.02, x[::5].shape)
    pairs = np.concatenate([random.integers(0, N, (60, 2)), [[4, 4], [7, -1], [-1, -1]]])
    return x.astype(dtype), random.integers(0, len(TABLE), N, np.int32), np.concatenate([pairs, pairs[:5, ::-1]])


def box_of(name, dim):
    return None if BOXES[name] is None else np.array(BOXES[name])[..., :dim][:dim]


def expected_pairs(who, x, species, pairs, box, cutoff=3 / 8, **options):
    """Return the oracle's pairs: with one cutoff, or those of species, without the excluded ones."""
    matrix, directed = np.ones(x.shape[1]) if box is None else box, "queries" in options
    options |= {"matrix": matrix, "periodic": (box is not None,) * x.shape[1]}
    if who == "exclude":
        found = reference.reference_images(x, cutoff, **options)
    else:
        own = {} if not directed else {"query_species": species[: len(options["queries"])]}
        found = reference.reference_species(x, TABLE.astype(x.dtype), species, **own, **options)
    return reference.without_excluded(found, pairs, directed=directed) if "exclude" in who else found


def asked(who, x, species, pairs):
    """Return the cutoff, and the arguments that say who pairs with whom."""
    exclude = {"exclude": pairs} if "exclude" in who else {}
    return (TABLE.astype(x.dtype), {"species": species} | exclude) if "table" in who else (3 / 8, exclude)


OFTEN = {("table, exclude", "images", "warp", 3, np.float32), ("table", "open", "warp", 2, np.float64)}
OFTEN |= {("exclude", "open", "warp", 3, np.float32)}
EACH = list(product(("exclude", "table", "table, exclude"), BOXES, ("warp", "jax", "brute"), (2, 3), (np.float32, np.float64)))


@pytest.mark.parametrize(("who", "box", "backend", "dim", "dtype"), sparing(EACH, OFTEN))
def test_case(who, box, backend, dim, dtype):
    x, species, pairs = scene(dtype, dim)
    cutoff, given = asked(who, x, species, pairs)
    lattice = box_of(box, dim)
    given |= {"backend": backend} | ({} if lattice is None else {"box": jfrnn.Box(lattice)})
    nbrs = jfrnn.search(x, cutoff, capacity=CAPACITY, **given)
    nbrs.check()
    expected = expected_pairs(who, x, species, pairs, lattice)
    assert image_pairs(nbrs, x) == expected
    if who != "exclude" and box != "images":
        np.testing.assert_array_equal(jfrnn.count(x, cutoff, **given), np.bincount([i for i, *_ in expected], minlength=N))


@SLOW
@pytest.mark.parametrize("backend", ["warp", "jax", "brute"])
@pytest.mark.parametrize("who", ["exclude", "table", "table, exclude"])
def test_options(who, backend):
    """Half lists, closed ones, particles that are their own neighbors, and queries."""
    x, species, pairs = scene(np.float32, 3)
    cutoff, given = asked(who, x, species, pairs)
    box = np.ones(3)
    for options in ({"half": True}, {"closed": True}, {"include_self": True}, {"half": True, "include_self": True}):
        nbrs = jfrnn.search(x, cutoff, backend=backend, box=jfrnn.Box(box), **options, **given)
        assert image_pairs(nbrs, x) == expected_pairs(who, x, species, pairs, box, **options)
    batch = np.arange(N) % 2
    nbrs = jfrnn.search(x, cutoff, backend=backend, batch=batch, **given)
    assert image_pairs(nbrs, x) == {(i, j, s) for i, j, s in expected_pairs(who, x, species, pairs, None) if i % 2 == j % 2}
    queries = x[:20] + np.float32(1 / 8)
    given |= {"species": (species, species[:20])} if "table" in who else {}
    given |= {"exclude": pairs[pairs[:, 0] < 20]} if "exclude" in who else {}
    nbrs = jfrnn.search(x, cutoff, queries=queries, backend=backend, **given)
    assert image_pairs(nbrs, x, queries=queries) == expected_pairs(who, x, species, pairs, None, queries=queries)


@pytest.mark.parametrize("backend", ["warp", slow("jax")])
def test_a_box_per_system(backend):
    x, _, pairs = scene(np.float32, 3)
    box, batch = np.stack([np.ones(3), np.full(3, 1.25)]), np.arange(N) % 2
    given = {"box": jfrnn.Box(box, per_system=True), "batch": batch, "exclude": pairs, "backend": backend}
    counts = jfrnn.count(x, 3 / 8, **given)
    expected = [(i, j) for k in (0, 1) for i, j, _ in expected_pairs("exclude", x, None, pairs, box[k]) if i % 2 == j % 2 == k]
    np.testing.assert_array_equal(counts, np.bincount([i for i, _ in expected], minlength=N))
    if backend == "jax":
        np.testing.assert_array_equal(jfrnn.search(x, 3 / 8, **given).count, counts)


def slopes_of(pairs, x, q=None, box=None):
    """Return the sums of |r|^2 and the gradients of their total, by positions and by queries, in float64."""
    x, pairs = np.asarray(x, np.float64), by_numpy.in_order(pairs, 3)
    q = x if q is None else np.asarray(q, np.float64)
    r = by_numpy.vectors_of(pairs, x, q, None if box is None else np.diag(box))
    return by_numpy.add_up((r * r).sum(1), pairs.i, len(q)), *by_numpy.pull(pairs, 2 * r, x, q)


def square(r, i, j):
    return r @ r


def heavy(r, i, j):
    """The same by so many operations that kernels of the CPU look for what is near first."""
    zero = sum(jnp.sin(k * r[0]) ** 2 + jnp.cos(k * r[0]) ** 2 - 1 for k in range(1, 4))
    return r @ r + zero


SUMMED = [("exclude", "warp", "open", square)]
SUMMED += [slow("table, exclude", "warp", box, square) for box in ("open", "images")]
SUMMED += [slow("exclude", "warp", "images", square), slow("exclude", "warp", "open", heavy)]
SUMMED += [slow(*given, square) for given in product(("exclude", "table, exclude"), ("jax", "brute"), ("open", "images"))]


@pytest.mark.parametrize(("who", "backend", "box", "fn"), SUMMED)
def test_sums_and_their_gradients(who, backend, box, fn):
    x, species, pairs = scene(np.float32, 3)
    cutoff, given = asked(who, x, species, pairs)
    lattice = box_of(box, 3)
    given |= {"backend": backend} | ({} if lattice is None else {"box": jfrnn.Box(lattice)})

    def total(x):
        sums = jfrnn.pair_sum(fn, x, cutoff, **given)
        return sums.sum(), sums

    slopes, sums = jax.jit(jax.grad(total, has_aux=True))(x)
    expected = slopes_of(expected_pairs(who, x, species, pairs, lattice), x, box=lattice)
    np.testing.assert_allclose(sums, expected[0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(slopes, expected[1] + expected[2], atol=1e-4)


@pytest.mark.parametrize("backend", ["warp", slow("brute")])
def test_sums_for_queries(backend):
    """A derivative by the positions sums over the rows of the particles, which exclude the queries that exclude them."""
    x, _, pairs = scene(np.float32, 3)
    queries, pairs = x[:20] + np.float32(1 / 8), pairs[pairs[:, 0] < 20]

    def total(x, q):
        return jfrnn.pair_sum(square, x, 3 / 8, queries=q, exclude=pairs, backend=backend).sum()

    of_sources, of_queries = jax.jit(jax.grad(total, (0, 1)))(x, queries)
    _, *expected = slopes_of(expected_pairs("exclude", x, None, pairs, None, queries=queries), x, queries)
    np.testing.assert_allclose(of_sources, expected[0], atol=1e-4)
    np.testing.assert_allclose(of_queries, expected[1], atol=1e-4)


@SLOW
@pytest.mark.parametrize("backend", ["warp", "brute"])
@pytest.mark.parametrize("who", ["exclude", "table, exclude"])
def test_largest_summands(who, backend):
    x, species, pairs = scene(np.float32, 3)
    cutoff, given = asked(who, x, species, pairs)
    largest = jfrnn.pair_sum(square, x, cutoff, reduce="max", backend=backend, **given)
    expected = np.full(N, -np.inf)
    for i, j, _ in expected_pairs(who, x, species, pairs, None):
        expected[i] = max(expected[i], np.sum((np.float64(x[j]) - x[i]) ** 2))
    np.testing.assert_allclose(largest, expected, rtol=1e-6)


@pytest.mark.parametrize(("backend", "box"), [("warp", "open"), *slowly(("warp", "images"), ("warp", "skewed"), ("jax", "open"))])
def test_kept_lists(backend, box):
    """A list keeps who pairs with whom over updates, and its geometry and sums decide by species; cutoffs may change."""
    x, species, pairs = scene(np.float32, 3)
    table, lattice = TABLE.astype(np.float32), box_of(box, 3)
    given = {"species": species, "exclude": pairs, "skin": 0.05, "backend": backend}
    given |= {} if lattice is None else {"box": jfrnn.Box(lattice)}
    nbrs = jfrnn.search(x, table, capacity=CAPACITY, **given)

    @jax.jit
    def update(nbrs, x, table):
        nbrs = nbrs.update(x, cutoff=table)
        summed = jfrnn.pair_sum(lambda r, i, j: jnp.ones((), r.dtype), x, None, neighbors=nbrs)
        return nbrs, nbrs.distances(x), nbrs.shifts(x), summed

    on = table.copy()
    on[0, 1] = on[1, 0] = 0.3
    random = np.random.default_rng(0)
    for k, now in enumerate((table, 1.02 * table, on, table)):
        moved = (x + random.uniform(-0.01, 0.01, x.shape)).astype(np.float32)
        nbrs, away, shifts, summed = update(nbrs, moved, now)
        nbrs.check()
        assert int(nbrs.rebuild_count) == [0, 0, 1, 2][k]
        matrix = np.ones(3) if lattice is None else lattice
        near = reference.reference_species(moved, now, species, matrix=matrix, periodic=(lattice is not None,) * 3)
        expected = reference.without_excluded(near, pairs)
        assert checked.slots_as_set(nbrs.idx, away[1], shifts) == expected
        np.testing.assert_array_equal(summed, np.asarray(away[1]).sum(axis=1))


@SLOW
def test_grow_and_chunks():
    x, species, pairs = scene(np.float32, 3)
    nbrs = jfrnn.search(x, TABLE.astype(np.float32), species=species, exclude=pairs, skin=0.05, capacity=1)
    on = TABLE.astype(np.float32)
    on[1, 1] = 0.3
    chunk = jax.jit(lambda state, nbrs: (state, nbrs.update(state[0], cutoff=state[1])))
    _, grown = jfrnn.run_chunk(chunk, (x, on), nbrs, lambda state: state[0], cutoff=lambda state: state[1])
    near = reference.reference_species(x, on, species, matrix=np.ones(3), periodic=(False,) * 3)
    expected = {pair[:2] for pair in reference.without_excluded(near, pairs)}
    assert checked.as_set(*grown.pairs(positions=jnp.asarray(x))) == expected
    jfrnn.run_chunk(jax.jit(lambda x, n: (x, n.update(x))), jnp.asarray(x), nbrs, lambda x: x)[1].check()


def test_what_is_traced_sets_bits():
    x, species, pairs = scene(np.float32, 3)
    traces = []

    @jax.jit
    def search(x, table, species, pairs):
        traces.append(None)
        return jfrnn.search(x, table, species=species, exclude=pairs, capacity=CAPACITY)

    table = TABLE.astype(np.float32)
    nbrs = search(x, table, species, pairs)
    nbrs.check()
    assert image_pairs(nbrs, x) == expected_pairs("table, exclude", x, species, pairs, None)
    wrong = pairs.copy()
    wrong[3] = N, 0
    nbrs = search(x, table, species, wrong)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.EXCLUDED_OUT_OF_RANGE
    refuses(ValueError, "`exclude` names particles that do not exist", nbrs.check)
    lost, uneven = species.copy(), table.copy()
    lost[7], uneven[2, 1] = 3, 0.5
    nbrs = search(x, table, lost, pairs)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.INVALID_CUTOFF and nbrs.count[7] == 0
    nbrs = search(x, uneven, species, pairs)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.INVALID_CUTOFF
    assert not np.asarray(nbrs.count)[species > 0].any() and nbrs.count.any()
    assert len(traces) == 1


X, S, T = np.zeros((4, 3), np.float32), np.array([0, 1, 1, 0]), np.ones((2, 2), np.float32)
UNEVEN = np.array([[1.0, 0.5], [0.25, 1.0]], np.float32)


@pytest.mark.parametrize(
    ("error", "match", "make"),
    [
        (TypeError, "exclude must be an array of integers.*got float32", lambda: jfrnn.search(X, 1.0, exclude=T)),
        (ValueError, r"exclude must have shape \[e, 2\].*pairs_of_rows", lambda: jfrnn.search(X, 1.0, exclude=S)),
        (ValueError, r"below 4, or -1 in padding, got \[0, 4\] in row 1", lambda: jfrnn.search(X, 1.0, exclude=[[0, 1], [0, 4]])),
        (ValueError, r"got \[-2, 0\] in row 0", lambda: jfrnn.count(X, 1.0, exclude=np.array([[-2, 0]]))),
        (ValueError, "numbers of queries below 1, then", lambda: jfrnn.count(X, 1.0, queries=X[:1], exclude=np.array([[1, 0]]))),
        (ValueError, "'hashgrid' cannot exclude pairs: pass", lambda: jfrnn.count(X, 1.0, exclude=S[None, :2], backend="hashgrid")),
        (ValueError, "'hashgrid' takes one cutoff", lambda: jfrnn.search(X, T, species=S, backend="hashgrid")),
        (ValueError, "table of cutoffs of pairs of species: pass species=", lambda: jfrnn.search(X, T)),
        (TypeError, "cutoff must be an array of floats of shape", lambda: jfrnn.search(X, 1.0, species=S)),
        (ValueError, "cutoff must be symmetric.*got 0.5 for species 0 and 1, and 0.25", lambda: jfrnn.search(X, UNEVEN, species=S)),
        (ValueError, r"shape \[s, s\], a row and a column", lambda: jfrnn.search(X, T[:1], species=S)),
        (ValueError, "species must be numbers of species from 0 to 1.*got 2", lambda: jfrnn.search(X, T, species=S + 1)),
        (TypeError, "species must be an array of integers", lambda: jfrnn.search(X, T, species=X[:, 0])),
        (ValueError, "species must be a pair of arrays", lambda: jfrnn.search(X, T, species=S, queries=X)),
        (ValueError, "radius_rule is about cutoffs per particle", lambda: jfrnn.search(X, T, species=S, radius_rule="mean")),
        (TypeError, "rows must be signed integers", lambda: jfrnn.pairs_of_rows(S)),
    ],
)
def test_errors(error, match, make):
    refuses(error, match, make)


def test_nobody_is_excluded_by_no_pairs():
    assert jfrnn.search(X, 1.0, exclude=np.zeros((0, 2), int), capacity=4).exclude is None
    assert jfrnn.search(X, 1.0, exclude=[], capacity=4).exclude is None
    np.testing.assert_array_equal(jfrnn.count(X, 1.0, exclude=np.array([[-1, 2]])), [3] * 4)


def test_rows_of_partners_are_pairs():
    x = scene(np.float32, 3)[0][:20]
    rows = np.array([[i + 1, i + 2] if i < 18 else [-1, i - 3] for i in range(20)])
    bonded = [(i, j) for i in range(20) for j in rows[i] if j >= 0]
    nbrs = jfrnn.search(x, 3 / 8, exclude=jfrnn.pairs_of_rows(rows))
    assert image_pairs(nbrs, x) == expected_pairs("exclude", x, None, bonded, None)


def test_rows_of_partners_may_be_narrower_than_numbers_of_particles():
    rows = np.full((300, 1), -1, np.int8)
    rows[260] = 5
    for given in (rows, jnp.asarray(rows)):
        pairs = np.asarray(jfrnn.pairs_of_rows(given))
        assert pairs[(pairs >= 0).all(axis=1)].tolist() == [[260, 5]]


def test_one_excludes_very_many():
    """More than a kernel looks at one by one before it searches the row of them."""
    x = np.random.default_rng(1).random((100, 3)).astype(np.float32)
    pairs = np.array([(0, j) for j in range(1, 100) if j != 50])
    found = image_pairs(jfrnn.search(x, 1.8, capacity=100, exclude=pairs, backend="warp"), x)
    assert found == expected_pairs("exclude", x, None, pairs, None, cutoff=1.8)
    assert [pair[:2] for pair in found if 0 in pair[:2]] in ([(0, 50), (50, 0)], [(50, 0), (0, 50)])


# --- excluded images -------------------------------------------------------------------------------------------------------

LATTICES = {
    "open": None,
    "nearest": np.diag([2.0, 2.5, 3.0]),
    "images": np.diag([0.8, 1.1, 0.9]),
    "skewed": np.array([[1.0, 0, 0], [0.3, 1.1, 0], [-0.2, 0.25, 0.95]]),
    "short": np.array([[1.0, 0, 0], [30.3, 1.1, 0], [-17.2, 21.1, 0.9]]),
    "slab": np.diag([0.8, 1.1, 0.9]),
}
GIVEN = product(LATTICES, ("plain", "radii", "species", "batch", "half", "queries"), ("warp", "jax", "brute"))
IMAGES_OFTEN = [("images", "radii", "warp"), ("short", "half", "warp"), ("images", "plain", "jax")]  # queries: their derivatives


@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
@pytest.mark.parametrize(
    ("lattice", "kind", "backend", "summed"), [*((*each, False) for each in IMAGES_OFTEN), *(slow(*each, True) for each in GIVEN)]
)
def test_excluded_images(lattice, kind, backend, dtype, summed):
    """Pairs (i, j, S) are no neighbors, other images of them are, wherever particles lie; sums know nothing of them, either."""
    rng, given, cutoff = np.random.default_rng(6), LATTICES[lattice], 0.6
    matrix = (np.eye(3) if given is None else given).astype(dtype)
    axes = (True, True, False) if lattice == "slab" else (given is not None,) * 3
    x = rng.random((40, 3)) * (1 if given is None else 2) - 0.5
    if lattice in ("nearest", "images"):  # far away, too
        x += rng.integers(-600, 601, (40, 3)) @ matrix
    x = x.astype(dtype)
    options = {"matrix": matrix, "periodic": axes}
    all_pairs = sorted(reference.reference_images(x, cutoff, **options))
    picked = [all_pairs[k] for k in rng.choice(len(all_pairs), 60)] + [pair for pair in all_pairs if pair[0] == pair[1]][:1]
    picked += [(3, 4, (50, 0, 0)), (5, 6, (0, 0, 0))]
    exclude = np.array([[i, j, *shift] for i, j, shift in picked] + [[-1, 2, 0, 0, 0]])
    lengths = np.diag(matrix)
    more = {"backend": backend}
    if given is not None:
        more["box"] = jfrnn.Box(lengths if (matrix == np.diag(lengths)).all() else matrix, axes)
    radii, own, queries = cutoff, (lambda pair: True), {}
    if kind == "radii":
        radii = np.full(40, cutoff, dtype)
    elif kind == "species":
        radii, more["species"] = np.full((2, 2), cutoff, dtype), rng.integers(0, 2, 40)
    elif kind == "batch":
        systems = more["batch"] = rng.integers(0, 2, 40)
        own = lambda pair: systems[pair[0]] == systems[pair[1]]  # noqa: E731
    elif kind == "half":
        more["half"] = True
        own = lambda pair: pair[0] < pair[1] or (pair[0] == pair[1] and pair[2] > (0, 0, 0))  # noqa: E731
    gone = set(picked) | {(j, i, tuple(-s for s in shift)) for i, j, shift in picked}
    if kind == "queries":
        queries, gone, exclude = {"queries": x[:10]}, set(picked), exclude[exclude[:, 0] < 10]
        all_pairs = reference.reference_images(x, cutoff, **queries, **options)
    expected = {pair for pair in set(all_pairs) - gone if own(pair)}
    assert len(expected) < sum(map(own, all_pairs))
    nbrs = jfrnn.search(x, radii, exclude=exclude, capacity=96, **more, **queries)
    nbrs.check()
    assert checked.slots_as_set(nbrs.idx, np.asarray(nbrs.idx) < 40, nbrs.shifts(x, **queries)) == expected
    if kind == "half" or not summed:
        return
    sums = jax.jit(lambda x: jfrnn.pair_sum(lambda r, i, j: jnp.ones((), dtype), x, radii, exclude=exclude, **more, **queries))(x)
    np.testing.assert_array_equal(sums, np.bincount([i for i, *_ in expected], minlength=len(nbrs.idx)))


@pytest.mark.parametrize("apart", [slow(False), True])
def test_derivatives_leave_excluded_images_out(apart):
    """A square of sums, whose derivative runs over the pairs the other way round, too; of queries, these are other rows."""
    rng, lengths = np.random.default_rng(7), np.array([0.8, 1.1, 0.9])
    x = rng.random((20, 3))
    queries = {"queries": x[:7]} if apart else {}
    pairs = sorted(reference.reference_images(x, 0.5, matrix=np.diag(lengths), periodic=(True,) * 3, **queries))
    exclude = np.array([[i, j, *shift] for i, j, shift in pairs[::3]])
    gone = set(pairs[::3]) | (set() if apart else {(j, i, tuple(-s for s in shift)) for i, j, shift in pairs[::3]})
    left = [pair for pair in pairs if pair not in gone]

    @jax.jit
    @jax.grad
    def slopes(x):
        given = {"queries": x[:7]} if apart else {}
        return (jfrnn.pair_sum(square, x, 0.5, exclude=exclude, box=jfrnn.Box(lengths), **given) ** 2).sum()

    left = by_numpy.in_order(left, 3)
    r = by_numpy.vectors_of(left, x, x, np.diag(lengths))
    of_r = (4 * np.bincount(left.i, (r * r).sum(1))[left.i])[:, None] * r
    np.testing.assert_allclose(slopes(x), by_numpy.pull(left, of_r, x), rtol=1e-9, atol=1e-12)


def test_excluded_images_traced_and_in_systems_of_their_own():
    rng, cells = np.random.default_rng(8), np.array([[0.8, 1.1, 0.9], [2.0, 2.5, 3.0]])
    x, batch = rng.random((40, 3)), np.repeat([0, 1], 20)
    found = test_boxes.oracle(cells, x, batch, 0.6)
    picked = sorted(found)[::4]
    gone = set(picked) | {(j, i, tuple(-s for s in shift)) for i, j, shift in picked}
    box = jfrnn.Box(cells, per_system=True, images=1)

    @jax.jit
    def search(exclude):
        return jfrnn.search(x, 0.6, box=box, batch=batch, exclude=exclude, capacity=96)

    exclude = np.array([[i, j, *shift] for i, j, shift in picked])
    nbrs = search(exclude)
    nbrs.check()
    assert int(np.sum(nbrs.count)) == len(found - gone)
    refuses(ValueError, "exclude", search(exclude + 100).check)
    with pytest.raises(ValueError, match=r"shape \[e, 2\], a pair in each row, or \[e, 5\] with the lattice shift"):
        jfrnn.search(x, 0.6, exclude=exclude[:, :4])
    assert jax.make_jaxpr(lambda: jfrnn.count(x, 0.6, exclude=exclude[:, :2]))  # as before
