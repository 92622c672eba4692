"""How many programs an eager call compiles for a new number of particles, and how many the library keeps."""

import gc
import itertools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from checked import slots_as_set, slow
from started import run_python

import jfrnn
from jfrnn._tracing import on_device
from jfrnn._tracing import programs as _programs

COMPILED = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **__: COMPILED.append(event) if event.endswith("backend_compile_duration") else None
)
BOX = jfrnn.Box([4.0, 4.0, 4.0])
SIZES = iter(range(40, 400))


@pytest.fixture(scope="module", autouse=True)
def _begin_anew():
    """Drop what other files compiled: past a number of programs or memory maps the library drops all, and would amid a test."""
    jax.clear_caches()
    gc.collect()


def compiled_by(call, *args, **kwargs):
    before = len(COMPILED)
    jax.block_until_ready(call(*args, **kwargs))
    return len(COMPILED) - before


def scene(n):
    return jax.device_put((np.random.default_rng(n).random((n, 3)) * 4).astype(np.float32))


def energy(r, i, j):
    return (r * r).sum()


SEARCHES = {
    "open": lambda x: {},
    "NumPy": lambda x: {},
    "skin": lambda x: {"skin": 0.1},
    "skin and active": lambda x: {"skin": 0.1, "active": np.arange(len(x)) > 3},
    "active": lambda x: {"active": jax.device_put(np.arange(len(x)) > 3)},
    "queries": lambda x: {"queries": jax.device_put(np.asarray(x)[::2])},
    "batch": lambda x: {"batch": np.arange(len(x)) % 3},
    "box": lambda x: {"box": BOX},
}


def warm(kind):
    """Compile what no number of particles changes."""
    x = scene(next(SIZES))
    return jfrnn.search(x, 0.6, **SEARCHES[kind](x))


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.slow] * (k in ("box", "active", "batch"))) for k in SEARCHES])
def test_a_search_of_a_new_size_compiles_a_count_and_a_list(kind):
    """But the count of few particles takes no program, until their number comes often."""
    warm(kind)
    x = scene(next(SIZES))
    options = SEARCHES[kind](x)
    x = np.asarray(x) if kind == "NumPy" else x
    few = kind in ("open", "NumPy", "skin", "box")
    assert compiled_by(jfrnn.search, x, 0.6, **options) == 2 - few
    assert compiled_by(jfrnn.search, x, 0.6, **options) == 0
    counted = {name: value for name, value in options.items() if name != "skin"}
    assert compiled_by(jfrnn.count, x, 0.6, **counted) == few  # else the search counted first
    if few:
        known = jfrnn.search(x, 0.6, **options).capacity
        assert sum(compiled_by(jfrnn.search, x, 0.6, **options) for _ in range(10)) == 0  # the count has compiled one
        assert jfrnn.search(x, 0.6, **options).capacity == known


def test_a_data_set_of_crystals_compiles_two_programs_for_each_number_of_atoms():
    """A list, and one program for displacements and shifts; besides, one for boxes of as many images, whatever they hold."""
    rng = np.random.default_rng(0)

    def look(atoms):
        edge = (atoms / 0.05) ** (1 / 3)
        x = (rng.random((atoms, 3)) * edge).astype(np.float32)
        nbrs = jfrnn.search(x, 5.0, box=jfrnn.Box([edge] * 3))
        displacement, mask = nbrs.vectors(x)
        moved = x[np.minimum(nbrs.idx, atoms - 1)] - x[:, None] + np.asarray(nbrs.shifts(x)) * np.float32(edge)
        np.testing.assert_allclose(np.asarray(displacement)[mask], moved[mask], atol=1e-4)

    look(17)
    look(60)  # in which the nearest image is enough
    for atoms in (20, 34, 55):
        assert compiled_by(look, atoms) <= 2


def test_a_search_with_a_capacity_compiles_one_program():
    warm("open")
    x = scene(next(SIZES))
    assert compiled_by(jfrnn.search, x, 0.6, capacity=16) == 1
    assert compiled_by(jfrnn.count, x, 0.6) == 1
    assert compiled_by(jfrnn.count, np.asarray(x), 0.6) == 0


@pytest.mark.slow
@pytest.mark.parametrize("skin", [0.0, 0.1])
def test_a_search_with_a_cutoff_per_particle_compiles_a_count_and_a_list(skin):
    x, y = scene(next(SIZES)), scene(next(SIZES))
    jfrnn.search(x, np.full(len(x), 0.6), radius_rule="mean", skin=skin, box=BOX)
    assert compiled_by(jfrnn.search, y, np.full(len(y), 0.6), radius_rule="mean", skin=skin, box=BOX) == 2


def test_what_is_asked_of_a_list_of_a_new_size_compiles_one_program_each():
    warm("skin").shifts(scene(next(SIZES) - 1))
    x = scene(next(SIZES))
    nbrs = jfrnn.search(x, 0.6, skin=0.1)
    assert compiled_by(nbrs.update, x) == 1
    assert compiled_by(nbrs.check) == compiled_by(nbrs.pairs) == compiled_by(nbrs.csr) == compiled_by(nbrs.grow, x) == 0
    total = len(nbrs.pairs()[0])
    assert compiled_by(nbrs.pairs, total) == 2
    assert compiled_by(nbrs.csr, total) == 0
    assert compiled_by(nbrs.shifts, x) == 1
    assert compiled_by(nbrs.vectors, x) == 1
    assert compiled_by(nbrs.distances, x) == 1  # and the program of vectors
    assert compiled_by(jfrnn.sort_order, x, 0.6) == 1


@pytest.mark.parametrize(
    "options",
    [slow({}), slow({"box": BOX}), {"fn": lambda r, i, j: r, "symmetry": "antisymmetric"}],
    ids=["open", "box", "symmetry"],
)
def test_a_sum_over_pairs_of_a_new_size_compiles_one_program_or_in_a_box_two(options):
    given = {"fn": energy} | options
    fn = given.pop("fn")
    jfrnn.pair_sum(fn, scene(next(SIZES)), 0.6, **given)
    x = scene(next(SIZES))
    assert compiled_by(jfrnn.pair_sum, fn, x, 0.6, **given) == 1 + ("box" in given)  # one marks rows where pairs may be missing


FIRST_GRADIENT = """
import jax, numpy as np, jfrnn
compiled = []
def listen(event, *_, **__):
    compiled.extend([event] * event.endswith("backend_compile_duration"))
x, ones = (jax.device_put(a.astype(np.float32)) for a in (np.random.default_rng(0).random((50, 3)), np.ones(50)))
jax.monitoring.register_event_duration_secs_listener(listen)
rows, back = jax.vjp(lambda x: jfrnn.pair_sum(lambda r, i, j: r @ r, x, 0.6), x)
jax.block_until_ready(back(ones))
print(len(compiled))
"""


def test_a_first_gradient_compiles_the_sum_and_its_derivative_alone():
    """Numbers that are known are made on the host: a program for each would take longer than these two."""
    assert run_python("-c", FIRST_GRADIENT, timeout=300).stdout.split() == ["2"]


def test_programs_of_few_particles_run_on_the_thread_that_calls_them():
    """XLA hands what takes a thousand operations and more to another thread, for which a caller waits longer than for the work."""

    def both(x):
        rows, back = jax.vjp(lambda x: jfrnn.pair_sum(energy, x, 0.6), x)
        return rows, back(jnp.ones_like(rows))

    found = [jax.jit(call).lower(scene(4000)).compile() for call in (lambda x: jfrnn.search(x, 0.6, capacity=16).idx, both)]
    assert [program.cost_analysis()["flops"] for program in found] == [-1, -1]  # those of a kernel count as -1; both sums are one


@pytest.mark.parametrize("half", [slow(False), True])
def test_a_sum_over_a_list_of_a_new_size_compiles_two_programs_and_vectors(half):
    x, y = scene(next(SIZES)), scene(next(SIZES))
    jfrnn.pair_sum(energy, x, None, neighbors=jfrnn.search(x, 0.6, half=half))
    nbrs = jfrnn.search(y, 0.6, half=half)
    nbrs.vectors(y)
    assert compiled_by(jfrnn.pair_sum, energy, y, None, neighbors=nbrs) == 2


def test_concrete_positions_are_counted_inside_jit_by_the_program_of_an_eager_count():
    x = scene(next(SIZES))
    longest = int(jfrnn.count(x, 0.6).max())
    capacities = []

    @jax.jit
    def moved(y):
        capacities.append(jfrnn.search(x, 0.6).capacity)
        return y + 1

    assert compiled_by(moved, jnp.zeros(3)) == 1
    assert capacities == [-(-longest // 8) * 8]


def test_arrays_of_numpy_are_copied():
    x = np.asarray(scene(next(SIZES)))
    room = np.zeros(x.size + 16, x.dtype)
    first = -room.ctypes.data // 4 % 16  # of an array that begins at 64 bytes, JAX takes the memory itself
    y = room[first : first + x.size].reshape(x.shape)
    y[:] = x
    nbrs, held = jfrnn.search(y, 0.6, skin=0.1), on_device(y)
    y[:] = 0
    np.testing.assert_array_equal(nbrs.verlet.positions, x)
    np.testing.assert_array_equal(held, x)


def test_padded_structures_in_boxes_of_their_own_share_a_program():
    size, programs = 48, []
    for n, edge in ((30, 2.5), (35, 2.3), (44, 2.9)):
        lengths = np.array([edge, 2.0, 2.5], np.float32)
        x, padded = np.random.default_rng(n).random((n, 3)).astype(np.float32) * lengths, np.zeros((size, 3), np.float32)
        padded[:n] = x
        given = {"active": np.arange(size) < n, "box": jfrnn.Box(lengths, images=1), "capacity": 24}
        programs.append(compiled_by(jfrnn.search, padded, 0.7, **given))
        nbrs = jfrnn.search(padded, 0.7, **given)
        nbrs.check()
        found = slots_as_set(nbrs.idx, np.asarray(nbrs.idx) < size, nbrs.shifts(padded))
        assert len(found) > 50
        assert found == reference.reference_images(x, 0.7, matrix=np.diag(lengths), periodic=(True,) * 3)
    assert programs[1:] == [0, 0]


@pytest.mark.slow
def test_programs_of_many_sizes_are_let_go(monkeypatch):
    _programs.clear_programs()
    monkeypatch.setattr(_programs, "MOST", 20)
    held = []
    for _ in range(40):
        jfrnn.count(scene(next(SIZES)), 0.6)
        held.append(_programs.program_count())
    assert max(held) <= 20 + _programs._LOOK_EVERY
    assert max(held) > 16  # they are kept until then
    x = scene(next(SIZES))
    assert compiled_by(jfrnn.count, x, 0.6) == 1
    assert compiled_by(jfrnn.count, x, 0.6) == 0


MANY_SIZES = """
import gc, jax, numpy as np, jfrnn

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6

def maps():
    return sum(1 for _ in open("/proc/self/maps"))

def look(numbers):
    for n in numbers:
        jfrnn.search(np.random.default_rng(n).random((n, 3)).astype(np.float32), 0.3)
        yield resident()

def clear():
    jax.clear_caches()
    gc.collect()

first = list(look(range(99, 130)))[0]
clear()
before, most, between = maps(), max(look(range(130, 1130))) - first, maps()
clear()
print(most, resident() - first, before, between, maps())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts memory maps")
def test_memory_of_a_thousand_numbers_of_particles_is_bounded_and_given_back():
    """Below 200 MB; of memory maps, too."""
    most, left, before, between, after = map(float, run_python("-c", MANY_SIZES).stdout.split())
    assert most < 200
    assert left < 0.75 * most
    assert between > before + 60
    assert after <= before + 20


@pytest.mark.parametrize(("box", "most"), [(None, 30), (BOX, 40)], ids=["open", "box"])
def test_vectors_are_few_kernels(box, most):
    """Kernels are what XLA's CPU compiler spends its time on, about 20 ms each."""
    x = scene(39)
    nbrs = jfrnn.search(x, 0.6, box=box)
    text = jax.jit(lambda x: nbrs.vectors(x)).lower(x).compile().as_text()
    assert text is not None
    assert text.count(" fusion(") <= most


def test_kernels_of_many_sums_are_let_go(monkeypatch):
    """Programs that call a kernel which was let go go on: it is made again. What was compiled is unloaded."""
    from jfrnn._engine import launch
    from jfrnn.kernels import _compile

    monkeypatch.setattr(launch, "_MOST", 3)
    x = scene(38)
    sums = [jax.jit(lambda x, c=c: jfrnn.pair_sum(lambda r, i, j: c * (r @ r), x, 0.6)) for c in (2.0, 3.0, 4.0, 5.0)]
    found = [np.asarray(pair_sum(x)) for pair_sum in sums]
    assert len(launch._plans) == 3
    gc.collect()
    loaded = len(_compile._loaded)
    for pair_sum, known in zip(sums, found, strict=True):
        np.testing.assert_array_equal(pair_sum(x), known)
    assert len(launch._plans) == 3
    gc.collect()
    assert len(_compile._loaded) == loaded


def test_programs_of_a_data_set_are_dropped_and_those_of_a_loop_stay(monkeypatch):
    """Memory grows by about 2 MB for each: those of numbers of particles that come once go first."""
    _programs.clear_programs()
    monkeypatch.setattr(_programs, "_MOST_BYTES", -1)
    x, held = scene(next(SIZES)), []
    for _ in range(30):
        for _ in range(3):
            jfrnn.count(x, 0.6)
        jfrnn.search(scene(next(SIZES)), 0.6, capacity=8)
        held.append(_programs.program_count())
    assert max(held) <= _programs._FEWEST + _programs._LOOK_EVERY
    assert sum(new < old for old, new in itertools.pairwise(held)) >= 1
    assert compiled_by(jfrnn.count, x, 0.6) == 0


def test_clearing_the_caches_of_jax_clears_programs_of_the_library():
    jfrnn.search(scene(next(SIZES)), 0.6, capacity=8)
    assert _programs.program_count() > 0
    jax.clear_caches()
    assert _programs.program_count() == 0
