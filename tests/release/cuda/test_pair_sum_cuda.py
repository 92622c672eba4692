"""Pair sums on CUDA as far as a machine without a GPU can tell: every kind of term compiles for one.

What they answer is decided on a GPU.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from checked import slow, slowly

import jfrnn
from jfrnn._engine import boxes_warp, warp_sums
from jfrnn._engine.operands import SUMS, names_of_cutoffs, names_of_tree
from jfrnn._search.problem import Asked, check_problem
from jfrnn._sums import fused as _fused
from jfrnn._sums.verb import _with_engine
from jfrnn.kernels import Kind, _compile, few_cuda, pair_sum_cpu, pair_sum_cuda
from jfrnn.kernels._native import EXCLUDED, TABLE

CUTOFF = 0.1


def poly6(r, i, j):
    return j * jnp.maximum(CUTOFF**2 - r @ r, 0) ** 3


def everything(r, i, j):
    """A term that calls functions, and reads integers and truths."""
    far = jnp.exp(-jnp.sqrt(r @ r + 1)) * jnp.tanh(j["charge"])
    return {"far": far * r, "kinds": jnp.where(j["heavy"], i["kind"] - j["kind"], 3).astype(r.dtype)}


def square_sum(values, x, scale, fn=poly6, **options):
    sums = jfrnn.pair_sum(
        lambda r, i, j: jax.tree.map(lambda y: scale * y, fn(r, i, j)), x, CUTOFF, values, backend="warp", **options
    )
    return sum((leaf**2).sum() for leaf in jax.tree.leaves(sums))


def plan_of(function, *args):
    """Return the plan of the last pair sum of the program that a function becomes."""
    found = []

    def planned(*args):
        found.append(original(*args))
        return found[-1]

    original = _fused.make_plan
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_fused, "make_plan", planned)
        jax.jit(lambda *args: function(*args)).lower(*args)
    return found[-1]


def arguments(dtype, dim):
    values = {"charge": np.ones(4, dtype), "heavy": np.ones(4, bool), "kind": np.ones(4, np.int32)}
    return np.ones(4, dtype), jnp.zeros((4, dim), dtype), jnp.asarray(1, dtype), values


def compiles_for(plan, dim, double, **variant):
    kind = Kind(dim, double, **variant)
    kernels = [kernel for kernel in pair_sum_cuda.sum_kernels(kind, plan.text, plan.key) if kernel is not None]
    if not kind.scaled and kind.periodic <= 1:
        kernels.append(few_cuda.sum_kernel(kind, 32 if double else 8, plan.text, plan.key))
    return all(f".entry {x.name}(" in _compile.find_binary(x.program, arch=90).read_text() for x in kernels)


@pytest.mark.parametrize(
    ("dim", "dtype", "variant"),
    [
        slow(3, np.float32, {}),  # derivatives are of this kind
        slow(2, np.float32, {}),
        (3, np.float32, {"batched": True, "scaled": True}),
        (2, np.float64, {"compensated": True}),
        slow(3, np.float64, {"batched": True}),
    ],
)
def test_densities_compile(dim, dtype, variant):
    masses, x, scale, _ = arguments(dtype, dim)
    assert compiles_for(plan_of(square_sum, masses, x, scale), dim, dtype == np.float64, **variant)


@pytest.mark.parametrize("argnums", [slow(0, id="values"), pytest.param(2, id="closed over")])  # in positions: in boxes, below
def test_derivatives_compile(argnums):
    masses, x, scale, _ = arguments(np.float32, 3)
    plan = plan_of(jax.grad(square_sum, argnums), masses, x, scale)
    assert [part.total for part in plan.text.sums] == [argnums == 2] * len(plan.text.sums)
    assert compiles_for(plan, 3, False)


@pytest.mark.parametrize("dtype", [slow(np.float32), np.float64])
def test_functions_and_values_of_all_kinds_compile(dtype):
    _, x, scale, values = arguments(dtype, 3)
    plan = plan_of(functools.partial(square_sum, fn=everything), values, x, scale)
    assert {value.dtype for value in plan.text.others} == {np.dtype(dtype).name, "bool", "int32"}
    assert compiles_for(plan, 3, dtype == np.float64)


@pytest.mark.parametrize(("dim", "dtype", "length"), [(3, np.float32, 2.0), slow(2, np.float64, 0.1)])
def test_terms_in_boxes_compile(dim, dtype, length):
    """Of the nearest images, and of several; the lattice shift has no column, its turns have one."""
    masses, x, scale, _ = arguments(dtype, dim)
    periodic = (True, False, True)[:dim]
    plan = plan_of(jax.grad(functools.partial(square_sum, box=jfrnn.Box([length] * dim, periodic)), 1), masses, x, scale)
    assert {step.axis for step in plan.text.steps} == {k for k in range(dim) if periodic[k]}
    assert compiles_for(plan, dim, dtype == np.float64, periodic=1 if length > CUTOFF else 2)


@pytest.mark.parametrize(("dtype", "variant"), [slow(np.float32, {}), (np.float64, {"periodic": 2, "batched": True})])
def test_extremes_compile(dtype, variant):
    masses, x, _, _ = arguments(dtype, 3)
    plan = plan_of(lambda x: jfrnn.pair_sum(poly6, x, CUTOFF, masses, reduce="min", backend="warp"), x)
    assert compiles_for(plan, 3, dtype == np.float64, extremes=True, **variant)


def test_terms_that_read_nothing_compile():
    plan = plan_of(lambda x: jfrnn.pair_sum(lambda r, i, j: 1.0, x, CUTOFF, backend="warp"), jnp.zeros((4, 3), np.float32))
    assert not (plan.text.own or plan.text.source_columns)
    kernels = pair_sum_cuda.sum_kernels(Kind(3, False), plan.text, plan.key)
    assert kernels.sort_values is None
    assert compiles_for(plan, 3, False)


@pytest.mark.parametrize("periodic", [0, 1])
def test_what_a_term_reads_is_sorted_before_it_is_summed(periodic):
    """Queries that leave a box have a kernel beside the others."""
    box = jfrnn.Box([2.0, 2.0, 2.0]) if periodic else None
    plan = plan_of(functools.partial(square_sum, box=box), *arguments(np.float32, 3)[:3])
    kernels = pair_sum_cuda.sum_kernels(Kind(3, False, periodic=periodic), plan.text, plan.key)
    launches = kernels.launches(1000, 500, False, 132)
    assert [launch.kernel for launch in launches] == [kernels.sort_values, *[kernels.crossing] * periodic, kernels.query]
    assert [launch.beside for launch in launches] == [False, False] + [True] * periodic
    assert periodic or launches[-1].threads == 32 * pair_sum_cuda.slots(500)
    assert all(launch.threads % launch.kernel.block == 0 for launch in launches)


@pytest.mark.parametrize("double", [False, True])
def test_rows_of_values_begin_where_16_bytes_may_be_loaded(double):
    width = 8 if double else 4
    of_positions = tuple(pair_sum_cpu.Value(f"x{axis}", "float32", axis) for axis in range(3))
    for positions in ((), of_positions):
        for columns in range(40):
            values = tuple(pair_sum_cpu.Value(f"v{k}", "float32") for k in range(columns))
            term = pair_sum_cpu.TermText("", (), (), (), positions + values, ())
            length, numbers = pair_sum_cuda.row_length(term, 3, double), columns + len(positions) if columns else 0
            assert 0 <= length - numbers < 16 // width
            assert length * width % 16 == 0 or length * width in (4, 8)


def test_auto_takes_the_kernel_on_cuda_and_jax_elsewhere(monkeypatch):
    x = np.zeros((4, 3), np.float32)
    problem, inputs = check_problem(Asked(x, 1.0))
    monkeypatch.setattr("jfrnn._sums.verb.platform_of", lambda *_: "gpu")
    for backend in ("auto", "warp"):
        options = _with_engine(problem.options, inputs, backend == "auto")
        assert (options.engine.name, options.may_change) == ("warp", backend == "auto")
    monkeypatch.setattr("jfrnn._sums.verb.platform_of", lambda *_: "rocm")
    assert _with_engine(problem.options, inputs, True).engine.name == "jax"
    with pytest.raises(ValueError, match="on the platform 'rocm', only on the CPU and on CUDA"):
        _with_engine(problem.options, inputs, False)


def test_a_box_holds_as_many_particles_as_their_numbers_leave_room_for(monkeypatch):
    """An image's code takes bits of the number; on the CPU it does not."""
    monkeypatch.setattr(_fused.engine, "MOST_IN_BOX", 4)
    x, box = np.zeros((4, 3), np.float32), jfrnn.Box([4.0] * 3)
    _, inputs = check_problem(Asked(x, 1.0, box=box, backend="warp"))
    assert _fused.refusal(inputs, "cpu") is None
    assert _fused.refusal(inputs._replace(box=None), "gpu") is None
    assert _fused.refusal(inputs, "gpu") == "of more than 3 positions in a periodic box on the platform 'gpu'"


SPARED = {*EXCLUDED, *TABLE, "radii", "query_radii", "longest"}  # what kernels name, and these do not read


@pytest.mark.parametrize("periodic", [0, 1])
def test_programs_for_cuda_call_it_and_plans_have_the_arguments_of_their_kernels(periodic):
    x, box = np.zeros((few_cuda.MOST + 1, 3), np.float32), jfrnn.Box([2.0] * 3) if periodic else None
    program = jax.jit(lambda x: square_sum(x[:, 0], x, 1.0, box=box)).trace(x).lower(lowering_platforms=("cuda",)).as_text()
    assert f'"jfrnn_pair_sum_cuda_3d_f32_own_dropself_{"nearest_" * periodic}' in program
    plan = plan_of(functools.partial(square_sum, box=box), *arguments(np.float32, 3)[:3])
    assert f'"jfrnn_sorting_cuda_3d_f32_own{"_nearest" * periodic}@' in program
    kind = Kind(3, False, own=True, drop_self=True, periodic=periodic)
    given = {name: (40, 3) for name in warp_sums._GIVEN}
    sorting = warp_sums._sorting_callable(kind).args[0].plan(given, 132)
    summing = warp_sums._cuda_callable(kind, plan.text, plan.key).args[0].plan(given, 132)
    assert (len(sorting.steps), len(summing.steps)) == (6, 2 + periodic)
    assert [step.beside for step in summing.steps] == [False] * (1 + periodic) + [bool(periodic)]
    words = {"bits", "scratch"}
    for found, arrays in ((sorting, {*warp_sums._GIVEN[:3], *words}), (summing, {*given, *words, *SUMS, "values"})):
        for step in found.steps:
            numbers = {**found.numbers, **step.numbers}
            assert {field.name for field in step.kernel.fields if field.is_array} <= arrays | {*found.absent, *SPARED}
            assert all(0 <= numbers[field.name] < 2**31 for field in step.kernel.fields if not field.is_array)


@pytest.mark.parametrize(("rule", "boxes"), [("table", True), *slowly(("mean", True), ("mean", False), ("table", False))])
def test_cutoffs_that_differ_compile_and_plans_have_the_arguments_of_their_kernels(rule, boxes):
    x, n, species = np.zeros((40, 3), np.float32), 40, np.zeros(40, np.int32)
    cutoff, given = (np.ones((2, 2), np.float32), {"species": species}) if rule == "table" else (np.ones(n, np.float32), {})
    given |= {"box": jfrnn.Box(np.stack([np.eye(3)] * 2), images=1), "batch": species} if boxes else {}
    given |= {"radius_rule": rule} if rule == "mean" else {}
    density = lambda x: jfrnn.pair_sum(poly6, x, cutoff, x[:, 0], backend="warp", **given)  # noqa: E731
    program = jax.jit(lambda x: (density(x), jfrnn.search(x, cutoff, capacity=8, backend="warp", **given).idx))
    text = program.trace(x).lower(lowering_platforms=("cuda",)).as_text()
    plan = plan_of(density, x)
    if boxes:
        assert f'"jfrnn_box_sums_cuda_3d_f32_scaled_own_dropself_images_skewed_boxes_{rule}_' in text
        assert f'"jfrnn_box_rows_cuda_3d_f32_scaled_own_dropself_list_images_skewed_boxes_{rule}@' in text
        kind = Kind(3, False, scaled=True, own=True, drop_self=True, periodic=4, batched=2, rule=rule)
        names = (*boxes_warp._GIVEN, "shared_values", "own_values", "columns", *names_of_cutoffs(rule), *SUMS)
        found = boxes_warp._plan_sums_on_cuda(kind, plan.text, plan.key, {name: (n, 4) for name in names}, 132)
        assert len(found.steps) == 1
    else:
        assert f'"jfrnn_pair_sum_cuda_3d_f32_scaled_own_dropself_{rule}_tree_' in text
        assert f'"jfrnn_sorting_cuda_3d_f32_scaled_own_{rule}_tree@' in text
        assert f'"jfrnn_pair_sum_cuda_3d_f32_scaled_own_dropself_{rule}_' in text
        kind = Kind(3, False, scaled=True, own=True, drop_self=True, rule=rule, tree=True)
        names = (*warp_sums._GIVEN, *names_of_tree(rule), *SUMS, "values", "bits", "scratch")
        shapes = {name: (n, 4) for name in names}
        found = warp_sums._sorting_callable(kind).args[0].plan(shapes, 132)
        assert [getattr(step, "threads", 0) for step in found.steps] == [0, 0, 64, 32]  # two leaves, and a root
        summing = warp_sums._cuda_callable(kind, plan.text, plan.key).args[0].plan(shapes, 132)
        numbers = {**found.numbers, **summing.numbers, "level": 1}
        found = summing._replace(steps=[*found.steps[-1:], *summing.steps], numbers=numbers)
    for launch in found.steps:
        assert f".entry {launch.kernel.name}(" in _compile.find_binary(launch.kernel.program, arch=90).read_text()
        assert {field.name for field in launch.kernel.fields if field.is_array} <= {*names, *SPARED, "more"}
        assert all(0 <= found.numbers[field.name] < 2**31 for field in launch.kernel.fields if not field.is_array)


def test_few_particles_take_one_launch():
    x = jnp.zeros((40, 3), np.float32)
    plan = plan_of(lambda x: jfrnn.pair_sum(poly6, x, CUTOFF, x[:, 0], backend="warp"), x)
    kind = Kind(3, False, own=True, drop_self=True)
    found = warp_sums._few_callable(kind, plan.text, plan.key).args[0].plan({name: (40, 3) for name in warp_sums._GIVEN}, 132)
    (launch,) = found.steps
    assert launch.threads // launch.kernel.block == few_cuda.blocks(40) == 5
    assert [few_cuda.blocks(m) * few_cuda.warps(m) for m in (1, 41, 1025, 4095)] == [8, 48, 1040, 4096]  # everyone is served
    assert [few_cuda.warps(m) for m in (0, 1, 1024, 1025, 2048, 2049, few_cuda.MOST)] == [8, 8, 8, 16, 16, 32, 32]
    arrays = {*warp_sums._GIVEN, *SUMS}
    assert {field.name for field in launch.kernel.fields} <= arrays | {*found.numbers, *EXCLUDED}
    for size, few in ((few_cuda.MOST, True), (few_cuda.MOST + 1, False)):
        program = jax.jit(lambda x: jfrnn.count(x, CUTOFF, backend="warp")).trace(jnp.zeros((size, 3), np.float32))
        assert ("jfrnn_few_cuda_" in program.lower(lowering_platforms=("cuda",)).as_text()) == few
