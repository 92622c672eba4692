"""`search` and `count`: options, capacity, jit, batches, and every input error."""

from itertools import product

import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import soon
from checked import refuses, slow, sparing
from started import run_python

import jfrnn


def random_points(n, dim, dtype, seed=0):
    return np.random.default_rng(seed).random((n, dim)).astype(dtype)


SLOW = pytest.mark.slow
BRUTE = slow("brute")  # its filters and rows are those of "jax", and it compiles as slowly
HALF, SELF, CLOSED = {"half": True}, {"include_self": True}, {"closed": True}
OPTIONS = [{}, HALF, SELF, CLOSED, HALF | SELF, HALF | CLOSED, HALF | SELF | CLOSED]


def each_option():
    """Yield options with every backend; by default both kinds for none and for two at once, of array engines what holds most."""
    for options, backend, kind in product(OPTIONS, ("jax", "brute", "warp", "hashgrid"), [(np.float32, 3), (np.float64, 2)]):
        first = kind == (np.float32, 3)
        often = {"jax": first and len(options) == 3, "brute": False, "warp": first is (len(options) < 3) or not options}
        often["hashgrid"] = first is (len(options) == 2) or not options
        name = f"{'+'.join(options) or 'plain'}-{backend}-{kind[1]}d"
        yield pytest.param(options, backend, *kind, id=name, marks=[] if often[backend] else [SLOW])


@pytest.mark.parametrize(("options", "backend", "dtype", "dim"), list(each_option()))
def test_options(options, backend, dtype, dim):
    points = np.concatenate([random_points(150, dim, dtype), random_points(20, dim, dtype)])  # 20 coincident pairs
    points[50:100] = np.round(8 * points[50:100]) / 8  # and pairs at exactly the cutoff
    cutoff = 0.125 if dim == 2 else 0.25
    nbrs = jfrnn.search(points, cutoff, backend=backend, capacity=40, **options)
    checked.assert_exact(nbrs, points, cutoff, **options)
    assert (nbrs.half, nbrs.include_self, nbrs.closed) == tuple(options.get(k, False) for k in ("half", "include_self", "closed"))
    assert nbrs.backend == backend
    if len(options) == 2 and dim == 3 and backend != "jax":
        np.testing.assert_array_equal(jfrnn.count(points, cutoff, backend=backend, **options), nbrs.count)


@pytest.mark.parametrize("backend", [slow("jax"), BRUTE, "warp", "hashgrid"])
@pytest.mark.parametrize(("m", "dtype", "dim"), [(1, np.float32, 2), (7, np.float64, 3), (300, np.float32, 3)])
def test_queries(m, backend, dtype, dim):
    points, queries = random_points(150, dim, dtype), 2 * random_points(m, dim, dtype, seed=1) - dtype(0.5)
    nbrs = jfrnn.search(points, 0.2, queries=queries, backend=backend)
    checked.assert_exact(nbrs, points, 0.2, queries=queries)
    np.testing.assert_array_equal(jfrnn.count(points, 0.2, queries=queries, backend=backend), nbrs.count)


@pytest.mark.parametrize("backend", [slow("jax"), "warp"])
def test_rows_longer_than_one_group_of_slots(backend):
    points = random_points(500, 3, np.float32)
    nbrs = jfrnn.search(points, 0.8, capacity=500, backend=backend)
    assert int(nbrs.required) > 300
    checked.assert_exact(nbrs, points, 0.8)


@pytest.mark.parametrize("backend", ["jax", "warp"])
def test_more_queries_than_one_block(backend):
    points = random_points(9000, 2, np.float32)
    checked.assert_exact(jfrnn.search(points, 0.02, capacity=40, backend=backend), points, 0.02)


@pytest.mark.parametrize("backend", [slow("jax"), BRUTE, "warp", "hashgrid"])
def test_same_input_gives_the_same_bits(backend):
    points = random_points(3000, 3, np.float32)
    first, second = (jfrnn.search(points, 0.1, capacity=32, backend=backend) for _ in range(2))
    np.testing.assert_array_equal(first.idx, second.idx)


# --- capacity ---------------------------------------------------------------------------------------------------------


def test_eager_search_cannot_overflow():
    points = np.zeros((300, 3), np.float32)  # everyone is everyone's neighbor
    nbrs = jfrnn.search(points, 1.0)
    assert int(nbrs.required) == 299
    assert nbrs.capacity == 300
    nbrs.check()


@pytest.mark.parametrize(("slack", "capacity"), [(1.0, 8), (1.5, 8), (2.0, 16)])
def test_slack_multiplies_the_longest_row(slack, capacity):
    points = np.arange(100, dtype=np.float32)[:, None] * np.ones((1, 2), np.float32)
    nbrs = jfrnn.search(points, 3.0 * 1.5, slack=slack)  # 3 neighbors on either side
    assert int(nbrs.required) == 6 - 0
    assert nbrs.capacity == -(-int(6 * slack) // 8) * 8 >= capacity


SHORT = [*product((1, 3, 200), ("warp", "hashgrid")), (3, "jax")]


@pytest.mark.parametrize(("capacity", "backend"), sparing(product((1, 3, 200), ("warp", "hashgrid", "jax", "brute")), SHORT))
def test_overflow_sets_the_bit_and_keeps_true_counts(capacity, backend):
    points = random_points(300, 2, np.float32)
    full = jfrnn.search(points, 0.3)
    nbrs = jax.jit(lambda x: jfrnn.search(x, 0.3, capacity=capacity, backend=backend))(points)
    required = int(full.required)
    assert bool(nbrs.overflow) == (required > capacity)
    assert int(nbrs.required) == required
    np.testing.assert_array_equal(nbrs.count, full.count)
    if required > capacity:
        with pytest.raises(jfrnn.NeighborOverflowError, match=f"capacity={required} or more") as error:
            nbrs.check()
        assert (error.value.required, error.value.capacity) == (required, capacity)
        refuses(jfrnn.NeighborOverflowError, "too small", nbrs.pairs)
        refuses(jfrnn.NeighborOverflowError, "too small", nbrs.csr)
    kept = [set(row[: min(c, capacity)].tolist()) for row, c in zip(np.asarray(nbrs.idx), np.asarray(nbrs.count), strict=True)]
    true = [set(row[:c].tolist()) for row, c in zip(np.asarray(full.idx), np.asarray(full.count), strict=True)]
    assert all(k <= t and len(k) == min(len(t), capacity) for k, t in zip(kept, true, strict=True))


@pytest.mark.parametrize("backend", ["warp", "hashgrid"])
def test_one_neighbor_too_many_sets_the_bit(backend):
    points = random_points(300, 2, np.float32)
    required = int(jfrnn.count(points, 0.3).max())
    for capacity in (required - 1, required):
        nbrs = jax.jit(lambda x, capacity=capacity: jfrnn.search(x, 0.3, capacity=capacity, backend=backend))(points)
        assert jfrnn.Status(int(nbrs.status)) == (jfrnn.Status.ROW_OVERFLOW if capacity < required else jfrnn.Status(0))
        assert int(nbrs.required) == required


# --- data that no shape can reveal ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("backend", "dtype", "dim"),
    [
        *((backend, *kind) for backend in ("warp", "hashgrid") for kind in [(np.float32, 3), (np.float64, 2)]),
        ("jax", np.float32, 3),
        slow("jax", np.float64, 2),
        slow("brute", np.float32, 3),
    ],
)
def test_non_finite_positions_set_a_bit_and_spare_the_others(value, backend, dtype, dim):
    points = random_points(100, dim, dtype)
    points[17, dim - 1] = value
    nbrs = jfrnn.search(points, 0.3, backend=backend, include_self=True, capacity=100)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE
    checked.assert_exact(nbrs, points, 0.3, include_self=True)
    assert nbrs.count[17] == 0
    refuses(ValueError, "non-finite coordinates", nbrs.check)


@pytest.mark.parametrize("backend", ["warp", "hashgrid", "jax"])
def test_non_finite_queries_set_the_bit(backend):
    points, queries = random_points(10, 2, np.float32), np.array([[0.5, np.nan], [0.5, 0.5]], np.float32)
    nbrs = jfrnn.search(points, 0.3, queries=queries, capacity=16, backend=backend)
    checked.assert_exact(nbrs, points, 0.3, queries=queries)
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE
    refuses(ValueError, "queries", nbrs.check)


def test_counts_that_are_not_known_raise_or_are_no_numbers():
    points = random_points(100, 3, np.float32)
    points[17, 2] = np.nan
    refuses(ValueError, r"positions\[17\] is", jfrnn.count, points, 0.3)
    assert np.flatnonzero(np.asarray(jax.jit(lambda x: jfrnn.count(x, 0.3))(points)) < 0).tolist() == [17]


def test_all_positions_non_finite(dim):
    nbrs = jfrnn.search(np.full((40, dim), np.nan, np.float32), 1.0)
    assert not nbrs.count.any()
    assert jfrnn.Status(int(nbrs.status)) == jfrnn.Status.NONFINITE


# --- transformations --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["jax", "warp"])
def test_one_program_serves_every_cutoff(backend):
    from jfrnn._search.problem import find_fields

    points = random_points(77, 2, np.float32)
    jfrnn.search(points, 0.1, capacity=76, backend=backend)
    before = find_fields.cache_size()
    for cutoff in (0.2, 0.5, 3.0):
        first, second = (jfrnn.search(points, cutoff, capacity=76, backend=backend) for _ in range(2))
        checked.assert_exact(first, points, cutoff)
        np.testing.assert_array_equal(first.idx, second.idx)  # the same bits
    assert find_fields.cache_size() == before


@pytest.mark.parametrize("backend", ["jax", BRUTE, "warp", "hashgrid"])
def test_vmap_equals_a_loop(backend):
    batch = np.stack([random_points(60, 2, np.float32, seed) * 10.0**seed for seed in range(3)]).astype(np.float32)
    nbrs = jax.jit(jax.vmap(lambda x: jfrnn.search(x, 0.3, capacity=60, backend=backend)))(batch)
    counts = None if backend == "jax" else np.asarray(jax.jit(jax.vmap(lambda x: jfrnn.count(x, 0.3, backend=backend)))(batch))
    for k, points in enumerate(batch):
        one = jax.tree.map(lambda leaf, k=k: jnp.asarray(np.asarray(leaf)[k]), nbrs)
        checked.assert_exact(one, points, 0.3)
        if backend != "jax":  # of which another test counts in a loop
            np.testing.assert_array_equal(counts[k], one.count)


@pytest.mark.parametrize("backend", [slow("jax"), "warp"])
def test_scan_and_cond(backend):
    start = random_points(60, 2, np.float32)

    def step(x, t):
        count = jax.lax.cond(
            t > 1, lambda: jfrnn.search(x, 0.2, capacity=60, backend=backend).count, lambda: jfrnn.count(x, 0.1, backend=backend)
        )
        return x * 1.5, count

    _, counts = jax.jit(lambda x: jax.lax.scan(step, x, jnp.arange(4)))(start)
    x = start
    for t in range(4):
        pairs = reference.reference_pairs(x, 0.2 if t > 1 else 0.1)
        np.testing.assert_array_equal(np.asarray(counts)[t], np.bincount([i for i, _ in pairs], minlength=60))
        x = x * np.float32(1.5)


# --- memory -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", [slow("jax"), "warp"])
def test_memory_does_not_know_the_box(backend):
    programs = [
        jax.jit(lambda x, r=r: jfrnn.search(x, r, capacity=8, backend=backend))
        .lower(jax.ShapeDtypeStruct((1000, 3), jnp.float32))
        .compile()
        for r in (1e-9, 1e9)
    ]
    assert len({p.memory_analysis().temp_size_in_bytes for p in programs}) == 1


# --- errors -----------------------------------------------------------------------------------------------------------

X = np.zeros((4, 3), np.float32)


@pytest.mark.parametrize(
    ("error", "match", "arguments"),
    [
        (TypeError, r"positions must be a JAX or NumPy array.*got set", {"positions": {0.0}}),
        (TypeError, r"positions must be float32 or float64, got int64", {"positions": np.zeros((4, 3), np.int64)}),
        (TypeError, r"positions must be float32 or float64, got float16", {"positions": np.zeros((4, 3), np.float16)}),
        (ValueError, r"positions must have shape \[n, 2\] or \[n, 3\].*got shape \[3\]", {"positions": X[0]}),
        (ValueError, r"got shape \[4, 1\]", {"positions": X[:, :1]}),
        (ValueError, r"got shape \[3, 4\]: pass positions.T", {"positions": X.T}),
        (ValueError, r"got shape \[1, 4, 3\]", {"positions": X[None]}),
        (ValueError, r"cutoff must be positive and finite, got 0", {"cutoff": 0.0}),
        (ValueError, r"cutoff must be positive and finite, got -1", {"cutoff": -1}),
        (ValueError, r"cutoff must be positive and finite, got nan", {"cutoff": float("nan")}),
        (ValueError, r"cutoff must be positive and finite, got inf", {"cutoff": float("inf")}),
        (ValueError, r"cutoff=1e-40 is outside", {"cutoff": 1e-40}),
        (ValueError, r"cutoff=3e\+38 is outside", {"cutoff": 3e38}),
        (TypeError, r"cutoff must be a number, got bool", {"cutoff": True}),
        (TypeError, r"cutoff must be a number, got bool", {"cutoff": np.bool_(True)}),
        (TypeError, r"cutoff must be a number, got complex64", {"cutoff": np.complex64(1)}),
        (TypeError, r"cutoff must be a number, got <U1", {"cutoff": np.str_("1")}),
        (TypeError, r"skin must be a number .* got complex64", {"skin": np.complex64(1)}),
        (ValueError, r"queries must match positions \(float32, 3 columns\), got float64", {"queries": X.astype(np.float64)}),
        (ValueError, r"queries must match positions .* with 2 columns", {"queries": X[:, :2]}),
        (ValueError, r"half=True .* cannot be used with queries", {"queries": X, "half": True}),
        (ValueError, r"include_self=True .* cannot be used with queries", {"queries": X, "include_self": True}),
        (TypeError, r"half must be True or False, known while tracing, got int 1", {"half": 1}),
        (TypeError, r"include_self must be True or False", {"include_self": None}),
        (TypeError, r"closed must be True or False", {"closed": "yes"}),
        (TypeError, r"capacity must be a static int .* got float 8.0", {"capacity": 8.0}),
        (ValueError, r"capacity must be at least 1, got 0", {"capacity": 0}),
        (ValueError, r"capacity must be at most 2147483647, .* got 2147483648", {"capacity": 2**31}),
        (ValueError, r"slack must be finite and at least 1 .* got 0.5", {"slack": 0.5}),
        (TypeError, r"slack must be a number", {"slack": "a lot"}),
        (TypeError, r"slack must be a number", {"slack": np.complex64(2)}),
        (ValueError, r"backend must be one of 'auto', 'jax', 'warp', 'hashgrid', 'brute', got 'cuda'", {"backend": "cuda"}),
    ],
)
def test_input_errors(error, match, arguments):
    arguments = {"positions": X, "cutoff": 1.0} | arguments
    refuses(error, match, jfrnn.search, arguments.pop("positions"), arguments.pop("cutoff"), **arguments)


@pytest.mark.parametrize(
    ("error", "match", "function"),
    [
        (ValueError, "capacity must be given where positions are traced", lambda x: jfrnn.search(x, 1.0).count),
        (TypeError, "cutoff must be a static .*traced.*or pass an array", lambda x: jfrnn.search(x, x[0, 0], capacity=4).count),
        (
            TypeError,
            "cutoff must be a static .*traced.*or make the list with an array",
            lambda x: jfrnn.pair_sum(lambda r, i, j: r @ r, x, x[0, 0], neighbors=jfrnn.search(x, 1.0, capacity=4)),
        ),
        (TypeError, "capacity must be a static int .* got a traced", lambda x: jfrnn.search(x, 1.0, capacity=x.astype(int)[0, 0])),
        (TypeError, "half must be True or False, known while tracing.*traced", lambda x: jfrnn.count(x, 1.0, half=x[0, 0] > 0)),
    ],
)
def test_errors_under_jit(error, match, function):
    refuses(error, match, jax.jit(function), X)


def test_float64_without_x64_is_refused():
    with jax.enable_x64(False), pytest.raises(TypeError, match="64-bit mode is off and would round them to float32 in silence"):
        jfrnn.search(X.astype(np.float64), 1.0)


@pytest.mark.parametrize(("backend", "dim"), [("warp", 2), ("warp", 3), ("jax", 3), slow("jax", 2)])
def test_float32_works_without_x64(dim, backend):
    points = random_points(200, dim, np.float32)
    points[:50] = np.round(points[:50] * 16) / 16  # ties
    with jax.enable_x64(False):
        nbrs = jfrnn.search(points, 0.25, capacity=200, backend=backend)
        checked.assert_exact(nbrs, points, 0.25)


def test_a_program_may_end_before_its_results():
    """Native code computes them while the interpreter ends: it needs neither Python nor what Python gives back."""
    program = soon.PROGRAM + (
        "import jax, jfrnn, numpy as np\n"
        "x = np.random.default_rng(0).random((50_000, 3)).astype(np.float32)\n"
        "def search(backend): return jax.jit(lambda x: jfrnn.search(x, 0.045, capacity=64, backend=backend).idx)\n"
        "both = [search(backend).lower(x).compile() for backend in ('warp', 'hashgrid')]\n"
        "found = [each(x) for each in both]\n"  # what is compiled returns at once, and the interpreter exits
    )
    run_python("-c", program, timeout=300)


def test_atoms_are_told_where_their_positions_are():
    class Atoms:
        positions = np.zeros((2, 3))

    refuses(TypeError, r"got Atoms, which has one: pass atoms\.positions, with a cell box=jfrnn\.Box", jfrnn.search, Atoms(), 1.0)


def test_near_ties_among_more_particles_than_meet_at_once():
    """A GPU multiplies coordinates of so many in halves, and decides what the rounding of these leaves open."""
    rng, half = np.random.default_rng(0), 4000
    direction = rng.normal(size=(half, 3))
    first = rng.uniform(0, 8, (half, 3))
    second = first + 0.3 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    x = np.concatenate([first, second]).astype(np.float32)
    nbrs = jfrnn.search(x, 0.3, backend="warp", capacity=32)
    expected = reference.reference_pairs(x, 0.3)
    apart = [(i, i + half) in expected for i in range(half)]
    assert 0.3 < np.mean(apart) < 0.7
    checked.assert_pairs(nbrs, expected)
