"""The array engine: the numbers of accelerators decide as those of the CPU do, and its programs are pure array programs."""

import re

import by_numpy
import checked
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import slow, slowly

import jfrnn
from jfrnn._engine import arrays, blocks, tuning
from jfrnn._engine import rows as rows_module
from jfrnn.cases.hard import HARD_CASES

# blocks as small as these cases, so that each has several
SORTING = tuning.ACCELERATOR.sorting._replace(searched=300)
ELSEWHERE = tuning.ACCELERATOR._replace(words=1 << 12, few_pairs=1000, plain_pairs=1000, sorting=SORTING)
AT_ONCE = ELSEWHERE._replace(words=1 << 20, few_pairs=1 << 20, plain_pairs=1 << 20)  # all rows and their doubtful pairs
LOOPS = ELSEWHERE._replace(at_once=0)  # as blocks of many queries are processed
TIES = ("ulp_far_axis", "queries_fewer")


@pytest.fixture(scope="module")
def numbers():
    """Hold the numbers that programs are compiled with: what was compiled with others is dropped, once for tests in a row."""
    holder = [tuning.CPU]
    yield holder
    if holder != [tuning.CPU]:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def _compiled_with(request, numbers, monkeypatch):
    """Compile for the CPU, with the numbers of accelerators where a test asks for them. Two such tests share no shapes."""
    asked = ELSEWHERE if "elsewhere" in request.fixturenames else tuning.CPU
    if numbers != [asked]:
        jax.clear_caches()
    numbers[:] = [asked]
    monkeypatch.setattr(tuning, "CPU", asked)


@pytest.fixture
def elsewhere():
    """Ask for the numbers of accelerators."""


NUMBERS = {"elsewhere": ELSEWHERE, "all rows of a block at once": AT_ONCE, "blocks in loops": LOOPS}
EACH = [("elsewhere", name) for name in HARD_CASES if name != "denormal_lattice"]  # whose cutoff is refused
EACH += [(numbers, name) for numbers in NUMBERS if numbers != "elsewhere" for name in TIES]


@pytest.mark.parametrize(("which", "name"), slowly(*EACH))
def test_numbers_of_accelerators_find_the_same_pairs(which, name, elsewhere, monkeypatch):
    jax.clear_caches()  # cases share shapes
    monkeypatch.setattr(tuning, "CPU", NUMBERS[which])
    given = HARD_CASES[name].build(np.float32, 3)
    nbrs = checked.search_padded(given, max(704, len(given.positions)), 704, backend="jax")
    checked.assert_pairs(nbrs, reference.reference_pairs(given.positions, given.cutoff, queries=given.queries))


SOME = np.random.default_rng(1).random((600, 3)).astype(np.float32)
SYSTEMS = np.random.default_rng(2).integers(0, 5, 600)
LENGTHS = {"images": [1.0, 0.3, 1.0], "nearest images": [1.0, 1.0, 1.0]}


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("kind", ["images", *(slow(kind) for kind in ("batch", "half", "nearest images", "a cutoff per particle"))])
def test_options_with_the_numbers_of_accelerators(kind):
    x, cutoff, lengths, options = SOME, 0.2, LENGTHS.get(kind), {}
    if kind == "a cutoff per particle":
        cutoff = np.random.default_rng(2).uniform(0.02, 0.2, len(x)).astype(np.float32)
    elif kind == "batch":
        options = {"batch": SYSTEMS}
    elif kind == "half":
        options = {"half": True}
    else:
        options = {"box": jfrnn.Box(lengths)}
    near = by_numpy.image_counts(x, cutoff, None if lengths is None else np.array(lengths, np.float32))
    near = near * (SYSTEMS[:, None] == SYSTEMS) if kind == "batch" else np.triu(near) if kind == "half" else near
    assert near.sum() > 1000
    found = np.zeros_like(near)
    nbrs = jfrnn.search(x, cutoff, capacity=int(near.sum(1).max()), backend="jax", **options)
    np.add.at(found, nbrs.pairs(), 1)
    np.testing.assert_array_equal(found, near)
    np.testing.assert_array_equal(nbrs.count, near.sum(1))


@pytest.mark.usefixtures("elsewhere")
def test_counts_with_the_numbers_of_accelerators():
    near = by_numpy.image_counts(SOME, 0.2) * (SYSTEMS[:, None] == SYSTEMS)
    np.testing.assert_array_equal(jfrnn.count(SOME, 0.2, batch=SYSTEMS, backend="jax"), near.sum(1))


def lattice_of(side, dim):
    """Return the sites of a square or cubic lattice with spacing 1, shuffled, [side^dim, dim] float32."""
    sites = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return np.random.default_rng(side).permutation(sites.astype(np.float32))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="numbers of the CPU are replaced by those of accelerators")
@pytest.mark.usefixtures("elsewhere")
def test_a_lattice_full_of_ties_has_no_more_words_than_are_tested_at_a_time(monkeypatch):
    """Its sites stand on walls of cells, so that there are more candidates per neighbor than elsewhere."""
    seen, word_table = [], blocks.BlockSearch.word_table

    def table(self, span, which):
        found = word_table(self, span, which)
        jax.debug.callback(lambda total: seen.append((int(total.max()), self.words)), found.total)
        return found

    monkeypatch.setattr(blocks.BlockSearch, "word_table", table)
    monkeypatch.setattr(tuning, "CPU", ELSEWHERE._replace(words=1 << 20))
    nbrs = jfrnn.search(lattice_of(12, 3), 3.0, capacity=96, backend="jax")
    assert not nbrs.overflow
    jax.effects_barrier()
    assert max(longest for longest, _ in seen) > 40
    assert all(longest <= words for longest, words in seen)


@pytest.mark.usefixtures("elsewhere")
def test_queries_with_more_words_than_are_tested_at_a_time_and_ties_among_all(monkeypatch):
    monkeypatch.setattr(tuning, "CPU", ELSEWHERE._replace(words=1 << 20))
    x = lattice_of(25, 2)
    square = (x * x).sum(1)[:, None] + (x * x).sum(1)[None] - 2 * x @ x.T  # whole numbers, far below 2^24
    near = (square < 100) & ~np.eye(len(x), dtype=bool)
    assert (square == 100).sum() > 4 * len(x)
    nbrs = jfrnn.search(x, 10.0, capacity=int(near.sum(1).max()), backend="jax")
    idx = np.asarray(nbrs.idx)
    found = np.zeros((len(x), len(x) + 1), bool)
    found[np.arange(len(x))[:, None], idx] = True
    np.testing.assert_array_equal(found[:, :-1], near)
    np.testing.assert_array_equal(nbrs.count, near.sum(1))
    np.testing.assert_array_equal((idx < len(x)).sum(1), near.sum(1))  # each once


def spring(r, i, j):
    return jnp.maximum(0.2 - jnp.sqrt(jnp.sum(r * r) + 1e-6), 0) ** 2


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("kind", ["few", slow("many"), slow("ties")])
def test_sums_with_the_numbers_of_accelerators(kind):
    """At once, with more neighbors than that allows, and with more doubtful candidates."""
    rng = np.random.default_rng(2)
    n = 601  # so that the last two blocks overlap
    x = rng.random((n, 3)) if kind == "few" else rng.random((n, 3)) / 3
    x = (np.round(x * 10) / 10 if kind == "ties" else x).astype(np.float32)

    def energy(x, factor):  # whose derivative is one sum over all pairs
        return jfrnn.pair_sum(lambda r, i, j: factor * spring(r, i, j), x, 0.2, backend="jax").sum()

    found = jax.jit(jax.value_and_grad(energy, (0, 1)))(x, np.float32(1))
    pairs, x = by_numpy.in_order(reference.reference_pairs(x, 0.2), 3), x.astype(float)
    r = by_numpy.vectors_of(pairs, x, x)
    apart = np.sqrt((r * r).sum(1) + 1e-6)
    over = np.maximum(0.2 - apart, 0)
    expected = (over**2).sum(), (by_numpy.pull(pairs, (-2 * over / apart)[:, None] * r, x), (over**2).sum())
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), found, expected)


def everything(x):
    """Return a list in a box, and a sum with its gradient."""
    nbrs = jfrnn.search(x, 0.2, capacity=64, box=jfrnn.Box([1.0] * 3), backend="jax")
    sums = jax.value_and_grad(lambda x: jfrnn.pair_sum(spring, x, 0.2, backend="jax").sum())(x)
    return nbrs.idx, nbrs.count, *sums


def test_few_particles_are_not_sorted(monkeypatch):
    monkeypatch.setattr(tuning, "CPU", tuning.CPU._replace(plain_pairs=1 << 20))
    x = np.round(np.random.default_rng(3).random((600, 3)).astype(np.float32) * 16) / 16  # with ties
    nbrs = jax.jit(lambda x: jfrnn.search(x, 0.25, capacity=100, backend="jax", half=True))(x)
    idx = np.asarray(nbrs.idx)
    assert ((idx[:, 1:] > idx[:, :-1]) | (idx[:, 1:] == 600)).all()  # all pairs are tested in the order of indices
    checked.assert_pairs(nbrs, reference.reference_pairs(x, 0.25, half=True))


def test_more_particles_than_places_are_refused():
    x = jax.ShapeDtypeStruct((2**30, 2), np.float32)
    with pytest.raises(ValueError, match=r"positions: backend='jax' looks for neighbors among at most 1073741808 .*got 1073741824"):
        jax.eval_shape(lambda x: jfrnn.count(x, 0.1, backend="jax"), x)


@pytest.mark.parametrize(("told", "scratch"), [(None, 900_000_000), (-1, 900_000_000), (4 << 30, 1 << 29), (0, 900_000_000)])
def test_scratch_is_a_share_of_the_device(told, scratch, monkeypatch):
    class Device:
        platform = "gpu"

        def memory_stats(self):
            if told == 0:
                raise jax.errors.JaxRuntimeError("UNIMPLEMENTED")
            return told and {"bytes_limit": told}

    monkeypatch.setattr(jax, "local_devices", lambda: [Device()])
    assert tuning._fit_memory(tuning.ACCELERATOR).scratch == scratch


def test_programs_are_exported_for_every_platform():
    """One program for CPUs, GPUs of two makers and TPUs, with no custom call but what XLA itself means by one."""
    x = jax.ShapeDtypeStruct((5000, 3), np.float32)
    program = jax.export.export(jax.jit(everything), platforms=["cpu", "cuda", "rocm", "tpu"])(x)
    assert program.platforms == ("cpu", "cuda", "rocm", "tpu")
    assert set(re.findall(r"custom_call @(\w+)", str(program.mlir_module()))) <= {"Sharding", "annotate_device_placement"}


@pytest.mark.filterwarnings("ignore:backend='auto' takes the slower engine:RuntimeWarning")
def test_a_sum_that_has_no_translation_calls_no_kernel():
    """Checks of particles in a box are array programs where the sum is one, whatever serves others here."""
    box = jfrnn.Box([1.0, 1.0, 1.0])
    program = jax.jit(lambda x: jfrnn.pair_sum(lambda r, i, j: jnp.sort(r)[0], x, 0.2, box=box))
    text = jax.export.export(program, platforms=["cpu", "tpu"])(jax.ShapeDtypeStruct((500, 3), np.float32)).mlir_module()
    assert "custom_call" not in str(text)


def searched(x):
    return jfrnn.search(x, 0.2, capacity=64, backend="jax").idx


slopes = jax.grad(lambda x: jfrnn.pair_sum(spring, x, 0.2, backend="jax").sum())
MADE_FOR = [(searched, "cpu"), (slopes, "cuda"), (searched, "cpu", "cuda")]


@pytest.mark.parametrize(("function", "platforms"), [(f, names) for f, *names in MADE_FOR], ids=["cpu", "cuda", "both"])
def test_a_program_is_traced_for_its_platforms_alone(function, platforms, monkeypatch):
    """A search, or the gradient of a sum."""
    used, fold = [], arrays.fold_candidates
    for module in (arrays, rows_module):
        monkeypatch.setattr(module, "fold_candidates", lambda *given: used.append(given[2]) or fold(*given))
    jax.export.export(jax.jit(function), platforms=platforms)(jax.ShapeDtypeStruct((601, 3), np.float32))
    numbers = {"cpu": tuning.CPU, "cuda": tuning.ACCELERATOR}
    assert set(used) == {numbers[name] for name in platforms}
