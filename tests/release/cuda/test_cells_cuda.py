"""The CUDA kernels as far as a machine without a GPU can tell: they compile for one, and their memory is what is promised.

What they answer is decided on a GPU: python -m experiments gpu experiments/configs/h200.toml --out DIR.
"""

import itertools

import jax
import jax.numpy as jnp
import launched
import numpy as np
import pytest
from checked import sparing

import jfrnn
from jfrnn._engine import warp
from jfrnn._engine.near_warp import constants_of_far
from jfrnn.kernels import Kind, _compile, cells_cpu, cells_cuda, declare, few_cuda, hashgrid, near, tree_cuda
from jfrnn.kernels._native import program

VARIANTS = [(dim, double, False, lists, False) for dim, double, lists in itertools.product((2, 3), (False, True), (False, True))]
VARIANTS += [
    (3, False, scaled, lists, later) for scaled, lists, later in ((True, True, False), (False, True, True), (True, False, True))
]


# Rows of a table in which any two columns hold each pair of 0 and 1: variants of what two options may be.
FEW = [(2, False, False, False, False), (3, True, False, False, False), (2, True, False, True, False)]
FEW += [(3, False, True, True, False), (3, False, False, True, True)]
PAIRWISE = ["11111", "10001", "11000", "01100", "00110", "00011"]


def pairwise(columns):
    """Return variants of a dimension and options, fewer than all: any two of them are tried in all ways."""
    return [(2 + int(row[0]), *(mark == "1" for mark in row[1:columns])) for row in PAIRWISE]


def compiles(*kernels):
    """Compile programs for a GPU that need not be there; return how many there are."""
    programs = {kernel.program for kernel in kernels if kernel is not None}
    for program_ in programs:
        text = _compile.find_binary(program_, arch=90).read_text()
        assert all(f".entry {kernel.name}(" in text for kernel in kernels if kernel is not None and kernel.program == program_)
    return len(programs)


@pytest.mark.parametrize(("dim", "double", "scaled", "lists", "later"), sparing(VARIANTS, FEW))
def test_variants_compile(dim, double, scaled, lists, later):
    assert compiles(*cells_cuda.cell_kernels(Kind(dim, double, scaled=scaled, lists=lists, later=later))) == 2


@pytest.mark.parametrize(
    ("dim", "double", "scaled", "lists"), sparing(itertools.product((2, 3), *3 * [(False, True)]), pairwise(4))
)
def test_hashgrid_compiles(dim, double, scaled, lists):
    assert compiles(*hashgrid.search_kernels(Kind(dim, double, scaled=scaled, lists=lists), cuda=True)) == 1


@pytest.mark.parametrize("skewed", [False, True])
def test_rows_of_particles_in_a_box_compile(skewed):
    for dim, double in ((2, True), (3, False)):
        assert compiles(near.near_kernel(dim, double, skewed, tuple(constants_of_far(double).items()), cuda=True)) == 1


def test_boxes_batches_and_cutoffs_per_particle_compile():
    assert compiles(*cells_cuda.cell_kernels(Kind(3, False, lists=True, periodic=2, batched=1), parted=True)) == 3
    for rule, periodic in (("mean", 2), ("gather", 0)):
        kind = Kind(3, False, scaled=True, lists=True, periodic=periodic, rule=rule)
        batched = kind._replace(batched=1)
        assert compiles(tree_cuda.fit_kernel(batched), tree_cuda.query_kernel(batched)) == 2
        assert compiles(*cells_cuda.cell_kernels(kind)) == 3
    for rule, double in (("table", False), ("either", False), ("table", True)):
        assert compiles(*cells_cuda.cell_kernels(Kind(2, double, scaled=True, rule=rule))) == 2


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of a CPU answer in place of those of a GPU")
def test_cells_serve_where_cutoffs_are_alike_near_most_particles(monkeypatch):
    """A core of many whose cutoffs are tiny beside a few others is for a tree; what is spread evenly never is."""
    random, n, found = np.random.default_rng(0), 20_000, []
    x, r = random.random((n, 3)).astype(np.float32), np.float32((28 / 4.19 / n) ** (1 / 3))

    def chosen(x, cutoff, **options):
        def by(search, **more):
            found.append(warp.cutoffs_are_alike(search))
            return more["cpu"](search)

        monkeypatch.setattr(warp.lax, "platform_dependent", by)
        with jax.disable_jit():
            jfrnn.count(x, cutoff, backend="warp", **options)
        return bool(found.pop())

    for rule in ("gather", "scatter", "either"):
        assert chosen(x, np.full(n, r), radius_rule=rule)
        assert chosen(x, (r * random.uniform(2 / 3, 4 / 3, n)).astype(np.float32), radius_rule=rule)
        core, cutoffs = (
            np.where(np.arange(n)[:, None] < 19_000, 0.5 + 0.005 * x, x),
            np.where(np.arange(n) < 19_000, 0.005 * r, 5 * r),
        )
        assert not chosen(core, cutoffs, radius_rule=rule)
    assert chosen(x, np.array([[r, r / 2], [r / 2, r]]), species=np.arange(n, dtype=np.int32) % 2)
    assert chosen(x, np.full(n, 10 * r), batch=np.arange(n, dtype=np.int32) // 200)
    assert chosen(x, np.full(n, 2 * r), queries=x[:5], radius_rule="scatter")


@pytest.mark.parametrize(
    ("dim", "double", "lists", "batched", "boxed"), sparing(itertools.product((2, 3), *4 * [(False, True)]), pairwise(5))
)
def test_kernels_of_few_particles_compile(dim, double, lists, batched, boxed):
    kind = Kind(dim, double, lists=lists, periodic=int(boxed), batched=int(batched))
    assert compiles(few_cuda.rows_kernel(kind, 32 if lists else 16)) == 1


@pytest.mark.parametrize("module", [cells_cpu, cells_cuda], ids=["cpu", "cuda"])
@pytest.mark.parametrize("n", [10_000, 1_000_000, 100_000_000])
def test_scratch_is_at_most_64_bytes_per_particle(module, n, dim):
    for width in (1, 2):
        fixed = 64 * 1024  # headers and bounds of blocks
        assert 4 * module.scratch_words(n, n, dim, width, True) <= 64 * n + fixed
        assert 4 * module.scratch_words(n, n, dim, width, False) <= 64 * (n + n) + fixed


def test_queries_that_reach_out_of_a_box_have_a_kernel_of_their_own():
    kernels = cells_cuda.cell_kernels(Kind(3, False, lists=True, periodic=1))
    for own, marks in ((True, 0), (False, 1)):
        launches = kernels.launches(1000, 500, own, 132)
        assert [launch.kernel for launch in launches[-2:]] == [kernels.crossing, kernels.query]
        assert [launch.beside for launch in launches] == [False] * (len(launches) - 1) + [True]
        assert [(launch.kernel, launch.of_queries) for launch in launches].count((kernels.gather, True)) == marks
        assert all(launch.threads % launch.kernel.block == 0 for launch in launches)


def test_queries_of_their_own_are_sorted_too():
    kernels = cells_cuda.cell_kernels(Kind(3, False, lists=True))
    own, others = (kernels.launches(1000, 500, own, 132) for own in (True, False))
    assert [launch.of_queries for launch in own] == [False] * 7
    assert [launch.of_queries for launch in others].count(True) == 3
    assert all(launch.threads % launch.kernel.block == 0 for launch in own + others)


def test_launches_follow_the_device_and_shares_of_queries_do_not():
    kernels, n = cells_cuda.cell_kernels(Kind(3, False, lists=True, periodic=1)), 10**8
    small, large = (kernels.launches(n, n, False, multiprocessors) for multiprocessors in (2, 160))
    for few, many in zip(small, large, strict=True):
        assert few.kernel is many.kernel
        fixed = few.kernel in (kernels.bounds, kernels.query)
        assert many.threads == (1 if fixed else 80) * few.threads
    assert large[-1].threads == 32 * cells_cuda.query_blocks(n)


def test_few_queries_are_shared_among_more_warps():
    warps = cells_cuda.GRID["WARPS"]
    for m in (1, 1000, warps, warps + 1, 31 * warps, 32 * warps + 1, 10**8):
        blocks, share = cells_cuda.query_blocks(m), 2 ** cells_cuda.share_bits(m)
        assert (blocks - 1) * share < m <= blocks * share
        assert blocks <= warps if share < 32 else blocks >= warps // 2
        assert share == 1 or -(-m // (share // 2)) > warps
    assert cells_cuda.query_blocks(0) == 0


def test_parts_of_blocks_have_warps_to_spare():
    """Where blocks have parts and are few enough that one may be the last to end; queries beside the sources are not marked."""
    kernels = cells_cuda.cell_kernels(Kind(3, False, lists=True))
    for n, own, spare in ((16_000, True, 0), (64_000, True, 500), (64_000, False, 0), (10**6, True, 0)):
        assert kernels.launches(n, n, own, 132)[-1].threads == 32 * (cells_cuda.query_blocks(n) + spare)


SHARE = """
struct CountArguments {
    const int* queries;
    int* shared;
    int n;
};
struct Count {
    const CountArguments given;
    void run() {
        for (int k = 0; k < given.n; ++k) {
            const Shares found(given.queries[k]);
            given.shared[2 * k] = found.share_bits;
            given.shared[2 * k + 1] = found.query_blocks;
        }
    }
};
"""


def test_kernels_share_queries_as_launches_do():
    (count,) = declare(
        "shares", program(Kind(3, False), "shares.h", constants={"WARPS": cells_cuda.GRID["WARPS"]}) + SHARE, "Count.run"
    )
    edges = [cells_cuda.GRID["WARPS"] * 2**bits + k for bits in range(7) for k in (-1, 0, 1)]
    queries = np.array([0, 1, 31, 32, 33, 1000, *edges, 10**6, 2**31 - 1], np.int32)
    found = np.zeros((len(queries), 2), np.int32)
    launched.on_cpu(count, queries=queries, shared=found, n=len(queries))
    assert found.tolist() == [[cells_cuda.share_bits(m), cells_cuda.query_blocks(m)] for m in queries.tolist()]


def test_of_known_tables_the_host_asks_nothing():
    """Where cutoffs of species are known and alike, cells serve, and no sample is waited for; a loop may hand on such a list."""
    x, species = jnp.asarray(np.random.default_rng(0).random((5000, 3)).astype(np.float32)), np.arange(5000, dtype=np.int32) % 2

    def chooses(table, given=None):
        counted = jax.jit(lambda x, given: jfrnn.count(x, table if given is None else given, species=species, backend="warp"))
        return "stablehlo.case" in counted.trace(x, given).lower(lowering_platforms=("cuda",)).as_text()

    table = np.array([[0.1, 0.07], [0.07, 0.05]])
    assert not chooses(table) and not chooses(table.tolist())
    assert chooses(np.array([[0.1, 0.01], [0.01, 0.04]])) and chooses(None, jnp.asarray(table, jnp.float32))

    first = jfrnn.search(x, table, species=species, backend="warp", slack=1.5)

    @jax.jit
    def again(first, table):
        def step(nbrs, x):
            return jfrnn.search(x, table, species=species, capacity=nbrs.capacity, backend="warp"), nbrs.count

        return jax.lax.scan(step, first, jnp.stack([x, x]))[1]

    np.testing.assert_array_equal(again(first, jnp.asarray(table, jnp.float32))[1], first.count)
