"""`memory_plan`: what it predicts against what the compiled programs, Warp and the operating system say; of pair sums, too."""

import dataclasses
import itertools
import os
import time

import jax
import numpy as np
import pytest
import warp as wp
from checked import refuses, slow, slowly
from places import ROOT, TESTS
from started import run_python

import jfrnn
import jfrnn._memory
from experiments import _measure
from jfrnn._engine import hashgrid, launch
from jfrnn.kernels import few_cuda

SIZES = [(1000, 40), (30_000, 256), (300_000, 40)]


def compiled_bytes(n, capacity, dim, dtype, backend, queries=None, **options):
    """Return what XLA says of a compiled search: bytes of the result and of temporary arrays."""

    def search(x, q):
        return jfrnn.search(x, 0.1, queries=q, capacity=capacity, backend=backend, **options)

    points = [None if size is None else jax.ShapeDtypeStruct((size, dim), dtype) for size in (n, queries)]
    memory = jax.jit(search).lower(*points).compile().memory_analysis()
    return memory.output_size_in_bytes, memory.temp_size_in_bytes


def assert_close(plan, measured):
    """Fail unless list, scratch and total are within 10 % of what was measured."""
    predicted = plan.list_bytes, plan.scratch_bytes, plan.total_bytes
    assert predicted == pytest.approx((*measured, sum(measured)), rel=0.1)


@pytest.mark.parametrize("queries", [None, 500, 400_000])
@pytest.mark.parametrize(("n", "capacity"), SIZES)
def test_warp_takes_what_was_planned(n, capacity, queries, dim, dtype):
    plan = jfrnn.memory_plan(n, 0.1, capacity, dim=dim, dtype=dtype, queries=queries, backend="warp")
    assert_close(plan, compiled_bytes(n, capacity, dim, dtype, "warp", queries))


@pytest.mark.parametrize("options", [{}, {"queries": 500}, {"skin": 0.01, "reverse": True}], ids=str)
def test_a_flat_list_takes_what_was_planned(options):
    """Scratch is a bound: counts may take turns in memory with what becomes of them."""
    n, total = 30_000, 90_000
    plan = jfrnn.memory_plan(n, 0.1, total=total, backend="warp", **options)
    given = dict(options)
    queries = jax.ShapeDtypeStruct((given.pop("queries"), 3), np.float32) if "queries" in given else None
    find = jax.jit(lambda x, q: jfrnn.search_edges(x, 0.1, total=total, queries=q, backend="warp", **given))
    memory = find.lower(jax.ShapeDtypeStruct((n, 3), np.float32), queries).compile().memory_analysis()
    assert plan.list_bytes == pytest.approx(memory.output_size_in_bytes, rel=0.01)
    assert memory.temp_size_in_bytes <= plan.scratch_bytes + 10_000
    assert "reverse" in options or plan.scratch_bytes <= 1.1 * memory.temp_size_in_bytes


@pytest.mark.parametrize("queries", [None, 500])
@pytest.mark.parametrize("reverse", [False, True])
def test_what_a_list_with_a_skin_keeps_is_planned(queries, reverse, dtype):
    options = {"skin": 0.01, "reverse": reverse, "backend": "warp"}
    plan = jfrnn.memory_plan(1000, 0.1, 8, dtype=dtype, queries=queries, **options)
    x = np.random.default_rng(0).random((1000, 3)).astype(dtype)
    nbrs = jfrnn.search(x, 0.1, capacity=8, queries=None if queries is None else x[:queries], **options)
    assert plan.list_bytes == sum(leaf.nbytes for leaf in jax.tree.leaves(nbrs))


@pytest.mark.parametrize(
    ("backend", "queries", "dim", "dtype"),
    [*itertools.product(["warp"], [None, 500], [2, 3], [np.float32, np.float64]), ("jax", 500, 3, np.float32)],
)
def test_counts_take_what_was_planned(backend, queries, dim, dtype):
    n = 30_000
    points = [None if size is None else jax.ShapeDtypeStruct((size, dim), dtype) for size in (n, queries)]
    count = jax.jit(lambda x, q: jfrnn.count(x, 0.1, queries=q, backend=backend))
    memory = count.lower(*points).compile().memory_analysis()
    plan = jfrnn.memory_plan(n, 0.1, dim=dim, dtype=dtype, queries=queries, backend=backend)
    assert plan.counts_bytes == memory.output_size_in_bytes == 4 * (queries or n)
    assert plan.scratch_bytes == pytest.approx(memory.temp_size_in_bytes, rel=0.01)
    assert plan.total_bytes == plan.counts_bytes + plan.scratch_bytes


def test_warp_takes_at_most_64_bytes_per_particle(dim, dtype):
    for (n, capacity), platform in itertools.product([(10, 1), *SIZES, (10**9, 64)], ["cpu", "gpu"]):
        plan = jfrnn.memory_plan(n, 0.1, capacity, dim=dim, dtype=dtype, backend="warp", platform=platform)
        order = 4 * n if platform == "gpu" and n > 4096 else 0  # of rows in space, which the list keeps
        assert plan.total_bytes - order <= 4 * n * capacity + 64 * n + 64_000
        assert plan.list_bytes == 4 * n * (capacity + 1) + 8 + order


def test_few_particles_take_no_scratch_on_a_gpu():
    """All of them meet in one kernel, unless the cutoff is so small that squares need a unit."""

    def scratch(n, cutoff=0.1, platform="gpu", **more):
        return jfrnn.memory_plan(n, cutoff, 8, backend="warp", platform=platform, **more).scratch_bytes

    assert scratch(few_cuda.MOST) == scratch(10, queries=few_cuda.MOST) == 0
    others = scratch(few_cuda.MOST + 1), scratch(10, queries=few_cuda.MOST + 1), scratch(10, 2.0**-90), scratch(10, platform="cpu")
    assert min(others) > 40


@pytest.mark.parametrize("backend", ["jax", slow("brute")])
@pytest.mark.parametrize(
    ("n", "capacity", "dim", "dtype", "queries"),
    [
        (300_000, 256, 2, np.float64, None),
        *slowly(
            (4_000_000, 64, 3, np.float32, None),
            (1000, 40, 3, np.float32, None),
            (1000, 40, 2, np.float32, 30_000),
            (20_000, 64, 2, np.float32, None),
        ),
        *slowly((20_000, 20_000, 2, np.float64, None), (4_000_000, 64, 3, np.float64, None)),
    ],
)
def test_compiled_engines_take_what_was_planned(n, capacity, dim, dtype, queries, backend):
    plan = jfrnn.memory_plan(n, 0.1, capacity, dim=dim, dtype=dtype, queries=queries, backend=backend)
    assert_close(plan, compiled_bytes(n, capacity, dim, dtype, backend, queries, closed=True))
    assert plan.scratch_bytes <= 64e6 + (100 if dtype == np.float32 else 125) * max(n, queries or 0)


@pytest.mark.parametrize(("n", "dim"), [(1000, 2), (30_000, 3), (70_000, 3)])
def test_hashgrid_takes_what_was_planned(n, dim, dtype):
    x = np.random.default_rng(0).random((n, dim)).astype(dtype)
    plan = jfrnn.memory_plan(n, 0.02, 8, dim=dim, dtype=dtype, backend="hashgrid")
    listed, given = compiled_bytes(n, 8, dim, dtype, "hashgrid")
    for key in list(launch._plans):  # a grid that is there would take nothing any more
        launch._open().drop(launch._plans.pop(key))
    hashgrid._hash_grid.cache_clear()
    with wp.ScopedMemoryTracker(print=False) as tracker:
        tracker.clear()
        jax.block_until_ready(jfrnn.search(x, 0.02, capacity=8, backend="hashgrid"))
        taken = wp._src.context.runtime.core.wp_alloc_tracker_get_peak_bytes()
    assert_close(plan, (listed, given + taken))
    assert plan.scratch_bytes <= 84 * n + 100_000


BLOBS = """
import sys
import jax, jfrnn
from jfrnn.cases import scene
from experiments._measure import PeakMemory

backend, n, separation = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
blobs = scene("two-blobs", n=n, separation=separation)
x, search = jax.numpy.asarray(blobs.positions), jax.jit(lambda x: jfrnn.search(x, blobs.cutoff, capacity=8, backend=backend))
jax.block_until_ready(search(x[: 1 << 15]))  # so many that kernels are compiled which sort many
compiled = search.lower(x).compile()
memory = PeakMemory()
found = jax.block_until_ready(compiled(x))
print(memory.source, memory.peak() - memory.start, blobs.cutoff, int(found.required))
"""


@pytest.mark.parametrize("backend", ["warp", slow("hashgrid")])
def test_two_blobs_cost_the_same_however_far_apart(backend):
    """Both take what was planned, whatever the box; the nearer ones leave some pages of it untouched.

    Each search runs in a process of its own, which no earlier search has given memory to use again.
    """
    n, taken = 200_000, []
    for separation in ("10", "1e6"):
        source, size, cutoff, required = run_python("-c", BLOBS, backend, n, separation).stdout.split()
        if source != "VmHWM":
            pytest.skip("this system cannot reset the peak of a process")
        assert int(required) > 50
        taken.append(int(size))
    plan = jfrnn.memory_plan(n, float(cutoff), 8, backend=backend)
    assert plan == jfrnn.memory_plan(n, 1e6 * float(cutoff), 8, backend=backend)
    assert plan.list_bytes < min(taken) <= max(taken) < 1.1 * plan.total_bytes
    assert abs(taken[1] - taken[0]) < 20 * n  # the cell table: 16 B per particle


# --- pair sums ---------------------------------------------------------------------------------------------------------------


def density(r, i, j):
    return j["m"] * jax.numpy.maximum(1 - r @ r / 0.01, 0) ** 3


def several(r, i, j):
    """Read two numbers of j besides coordinates, one more of i, and sum three."""
    return j["m"] * r[:2] + i["v"], j["m"] * j["u"]


def numbers_of(n, dtype, *names):
    return {name: jax.ShapeDtypeStruct((n,), dtype) for name in names}


@pytest.mark.parametrize(
    ("fn", "names", "gradient", "bytes_"),
    [
        (density, "m", False, 36 + 4 + 2 * 4),  # the array of a single number is not packed; rows without a sum are marked apart
        (density, "m", True, 36 + 3 * 4 + 2 * 8 + 4 + 12),
        (several, "muv", False, 36 + 2 * 8 + 4 + 2 * 12),  # what is summed, and the arrays that fn returns
    ],
)
def test_sums_take_what_is_stated(fn, names, gradient, bytes_):
    """At most, in bytes per particle (float32): scratch of the search, packed and sorted numbers, sums and results."""
    n = 30_000
    plan = jfrnn.memory_plan(n, 0.1, fn=fn, values=numbers_of(n, np.float32, *names), gradient=gradient)
    assert (plan.backend, plan.list_bytes) == ("warp", 0)
    assert 0.8 * bytes_ * n < plan.total_bytes < bytes_ * n + 4000


SUMS = """
import sys
import jax, jfrnn
import numpy as np
from experiments._measure import PeakMemory
from test_memory import density

n, gradient = int(sys.argv[1]), sys.argv[2] == "True"
random = np.random.default_rng(0)


def run(x, m):
    return jfrnn.pair_sum(density, x, 0.03, {"m": m}, backend="warp")


def with_gradient(x, m):
    return jax.grad(lambda x: ((rho := run(x, m)) @ rho, rho), has_aux=True)(x)


x, m = jax.numpy.asarray(random.random((n, 3)), "float32"), jax.numpy.ones(n, "float32")
program = jax.jit(with_gradient if gradient else run)
jax.block_until_ready(program(x[: 1 << 15], m[: 1 << 15]))  # as above
compiled = program.lower(x, m).compile()
memory = PeakMemory()
jax.block_until_ready(compiled(x, m))
print(memory.source, memory.peak() - memory.start)
"""


@pytest.mark.parametrize("gradient", [slow(False), True])
def test_sums_take_what_was_planned(gradient):
    """In a process of its own, as a search above."""
    n, path = 300_000, os.pathsep.join(map(str, (ROOT, TESTS, TESTS / "release" / "whole")))
    source, size = run_python("-c", SUMS, n, gradient, PYTHONPATH=path).stdout.split()[-2:]
    if source != "VmHWM":
        pytest.skip("this system cannot reset the peak of a process")
    plan = jfrnn.memory_plan(n, 0.03, fn=density, values=numbers_of(n, np.float32, "m"), gradient=gradient)
    assert plan.total_bytes - 20 * n < int(size) < 1.1 * plan.total_bytes + 1e6  # some of the cell table stays untouched


def test_a_sum_without_translation_is_planned_with_the_array_engine():
    def sorts(r, i, j):
        return jax.numpy.sort(r)

    plan = jfrnn.memory_plan(100, 0.1, fn=sorts, dim=2)
    assert (plan.backend, plan.sums_bytes) == ("jax", 800)
    refuses(NotImplementedError, "no translation", jfrnn.memory_plan, 100, 0.1, fn=sorts, dim=2, backend="warp")


# --- for all -----------------------------------------------------------------------------------------------------------------


def test_a_plan_allocates_nothing():
    memory, begin = _measure.PeakMemory(), time.perf_counter()
    assert jfrnn.memory_plan(2_000_000_000, 0.1, 64, backend="warp").total_bytes > 560e9
    assert jfrnn.memory_plan(300_000_000, 0.1, 64, backend="brute").total_bytes > 80e9
    assert memory.peak() - memory.start < 1e9
    assert time.perf_counter() - begin < 60


@pytest.mark.parametrize(("n", "queries"), [(0, None), (0, 5), (5, 0)])
@pytest.mark.parametrize("backend", ["warp", "hashgrid", "jax"])
def test_nothing_to_search(n, queries, backend):
    plan = jfrnn.memory_plan(n, 0.1, 7, queries=queries, backend=backend)
    assert plan.list_bytes == 32 * (n if queries is None else queries) + 8
    assert plan.scratch_bytes < 1000


def test_auto_plans_the_engine_that_would_run():
    plan = jfrnn.memory_plan(1000, 0.1, 40)
    assert plan.backend == jfrnn.search(np.zeros((1000, 3), np.float32), 0.1, capacity=40).backend
    assert plan == jfrnn.memory_plan(1000, 0.1, 40, backend=plan.backend, platform="cpu")
    assert plan != jfrnn.memory_plan(1000, 0.1, 40, queries=1000)


def test_the_plan_reads_well():
    plan = jfrnn.MemoryPlan(list_bytes=12_345_678, scratch_bytes=1_000_000, backend="jax")
    scratch, total = "  scratch       1.00 MB", "  total        13.35 MB"
    head = "one search with backend='jax', beside the positions:"
    assert str(plan).splitlines() == [head, "  list         12.35 MB", scratch, total]
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan.backend = "warp"
    plan = jfrnn.MemoryPlan(list_bytes=0, scratch_bytes=1_000_000, backend="warp", counts_bytes=400_000)
    head = "one count with backend='warp', beside the positions:"
    assert str(plan).splitlines() == [head, "  counts        0.40 MB", scratch, "  total         1.40 MB"]
    assert str(jfrnn.memory_plan(0, 0.1, backend="warp")).startswith("one count")
    plan = jfrnn.MemoryPlan(list_bytes=0, scratch_bytes=1_000_000, backend="warp", sums_bytes=12_345_678)
    head = "one pair sum with backend='warp', beside the positions and values:"
    assert str(plan).splitlines() == [head, "  sums         12.35 MB", scratch, total]


@pytest.mark.parametrize(
    ("error", "match", "arguments"),
    [
        (TypeError, r"n must be an int, the number of points, got float 1000\.0", {"n": 1e3}),
        (TypeError, r"n must be an int, the number of points, got float64 of shape \[9, 3\]", {"n": np.zeros((9, 3))}),
        (ValueError, r"n must be a number of points from 0 to 2147483616, got -1", {"n": -1}),
        (ValueError, r"queries must be a number of points from 0 to 2147483616, got 2147483648", {"queries": 2**31}),
        (TypeError, r"queries must be an int, the number of points, got bool True", {"queries": True}),
        (ValueError, r"cutoff must be positive and finite, got 0", {"cutoff": 0.0}),
        (ValueError, r"capacity must be at least 1, got 0", {"capacity": 0}),
        (TypeError, r"capacity must be a static int", {"capacity": 8.0}),
        (ValueError, r"capacity is that of a list.*got 8", {"fn": density}),
        (ValueError, r"values and gradient belong to a pair sum", {"gradient": True}),
        (ValueError, r"skin and reverse are those of a list", {"capacity": None, "skin": 0.1}),
        (ValueError, r"skin and reverse are those of a list", {"faces": 4, "reverse": True}),
        (ValueError, r"dim must be 2 or 3, got int 4", {"dim": 4}),
        (TypeError, r"dtype must be float32 or float64, got int64", {"dtype": np.int64}),
        (ValueError, r"backend must be one of 'auto', 'jax', 'warp', 'hashgrid', 'brute', got 'cuda'", {"backend": "cuda"}),
        (RuntimeError, r"platform='abacus' is none that JAX has here.*name backend='warp'", {"platform": "abacus"}),
        (RuntimeError, r"platform='abacus' is none that JAX has here", {"platform": "abacus", "backend": "jax"}),
        (RuntimeError, r"backend='warp' runs on .*'cpu', 'gpu', 'cuda', got 'abacus'", {"platform": "abacus", "backend": "warp"}),
    ],
)
def test_input_errors(error, match, arguments):
    arguments = {"n": 10, "cutoff": 0.1, "capacity": 8} | arguments
    refuses(error, match, jfrnn.memory_plan, arguments.pop("n"), arguments.pop("cutoff"), arguments.pop("capacity"), **arguments)


def test_float64_without_x64_is_refused():
    with jax.enable_x64(False), pytest.raises(TypeError, match="dtype is float64, but JAX's 64-bit mode is off"):
        jfrnn.memory_plan(10, 0.1, 8, dtype=np.float64)


@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
def test_options_of_warp_take_what_is_stated(dtype):
    """A box or a batch copies the positions, and cutoffs per particle are prepared by XLA: bytes per particle, the list apart."""
    n = 20_000
    x, radii = jax.ShapeDtypeStruct((n, 3), dtype), jax.ShapeDtypeStruct((n,), dtype)
    systems, box = jax.ShapeDtypeStruct((n,), np.int32), jfrnn.Box([1.0] * 3, images=1)
    common = {"capacity": 8, "backend": "warp"}
    programs = [
        (64 + 20, lambda x, radii, systems: jfrnn.search(x, 0.01, box=box, batch=systems, **common)),
        (140, lambda x, radii, systems: jfrnn.search(x, radii, radius_rule="mean", box=box, **common)),
    ]
    bounds = [bound if dtype == np.float32 else wide for (bound, _), wide in zip(programs, (64 + 40, 180), strict=True)]
    for bound, (_, program) in zip(bounds, programs, strict=True):
        analysis = jax.jit(program).lower(x, radii, systems).compile().memory_analysis()
        assert analysis.temp_size_in_bytes <= bound * n + 64_000
