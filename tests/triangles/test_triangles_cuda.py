"""The CUDA kernels of triangles as far as a machine without a GPU can tell: they compile for one, and on the CPU, thread by thread,
their text lists what the oracle says, bit for bit in the order of the CPU kernel.

What they answer on a GPU is decided there: python -m experiments gpu experiments/configs/h200_triangles.toml --out DIR.
"""

import re
from itertools import product

import jax
import jax.numpy as jnp
import launched
import numpy as np
import pytest
from checked import refuses, sparing

import jfrnn
from jfrnn._engine import auto as _auto
from jfrnn._geometry.cutoffs import make_cutoff
from jfrnn._triangles import verb as _triangles
from jfrnn._triangles import warp as _triangles_warp
from jfrnn._triangles.cells import gather_corners
from jfrnn._triangles.tree import WIDTH
from jfrnn._triangles.warp import _Variant, query_inputs, sizes_on_cuda
from jfrnn.cases import meshes
from jfrnn.cases.triangles import TRIANGLE_CASES, padded
from jfrnn.kernels import Program, _compile, triangles_cuda
from jfrnn.kernels.triangles import pending

KINDS = {"warp": [(np.float32, 3), (np.float64, 2)], "bvh": [(np.float32, 2), (np.float64, 3)]}
GUARD = 64  # words behind the scratch, which nobody may touch


VARIANTS = list(product((2, 3), *[(False, True)] * 3))
PAIRWISE = [VARIANTS[k] for k in (0, 7, 11, 13, 14)]  # of any two options, each pair of what they may be stands in one


@pytest.mark.parametrize(("dim", "double", "lists", "tree"), sparing(VARIANTS, PAIRWISE))
def test_variants_compile(dim, double, lists, tree):
    """For float bounds that hold, and are those of the CPU: nothing is contracted."""
    programs = {kernel.program for kernel in triangles_cuda.triangle_kernels(dim, double, lists, tree, WIDTH)}
    assert len(programs) == 3
    for program in programs:
        text = _compile.find_binary(program, arch=90).read_text()
        assert not re.search(r"\bfma\.|\b(mul|add|sub)\.f(32|64)", text)
        # bytes of a thread: no big integer is among them, but what waits in a tree is
        assert sum(map(int, re.findall(r"\.local .*\[(\d+)\]", text))) <= 32 + 4 * pending(WIDTH) * tree


def on_the_cpu(kernel):
    """Return a kernel of CUDA as one of the CPU, whose threads come one after the other."""
    name = f"{kernel.name}_on_the_cpu"
    struct, _, method = kernel.name.partition("_")
    text = kernel.program.text[: kernel.program.text.rindex("\n}\n")] + "\n}\n"
    loop = f"for (; given.first_thread < given.threads; ++given.first_thread)\n{struct}{{given}}.{method}();"
    entry = f'extern "C" void {name}(const {struct}Arguments* all) {{\n{struct}Arguments given = *all;\n{loop}\n}}\n'
    return kernel._replace(name=name, program=Program(name, text + entry, cuda=False))


@jax.jit
def inputs_of(positions, vertices, faces, cells, cutoff):
    return query_inputs(positions, gather_corners(vertices, faces)[0], cells, cutoff)


class Answer:
    """What the kernels make of the cells of a list, on the CPU."""

    def __init__(self, tri, positions, lists=True):
        n, dim = positions.shape
        self.variant = _Variant(dim, positions.dtype == np.float64, lists, tri.backend == "bvh")
        inputs = inputs_of(positions, tri.vertices, tri.faces, tri.cells, make_cutoff(tri.cutoff, positions.dtype, closed=False))
        given = dict(zip(_triangles_warp._GIVEN, map(np.ascontiguousarray, inputs), strict=True))
        sizes = sizes_on_cuda(self.variant, *(given[name].shape for name in ("corners", "boxes", "start", "triangles")))
        words = triangles_cuda.scratch_words(n, *sizes, dim, self.variant.double)
        self.idx = np.full((n, tri.capacity) if lists else (1, 1), -7, np.int32)
        self.count, scratch = (np.full(size, -7, np.int32) for size in (n, words + GUARD))
        given |= {"idx": self.idx, "count": self.count, "scratch": scratch}
        plan = _triangles_warp.plan_on_cuda(self.variant, {name: array.shape for name, array in given.items()}, 132)
        self.steps = plan.steps
        for kernel, threads, numbers, _ in plan.steps:
            assert threads % kernel.block == 0
            numbers = {**plan.numbers, **numbers}
            launched.on_cpu(on_the_cpu(kernel), **{field.name: {**given, **numbers}[field.name] for field in kernel.fields})
        assert np.all(scratch[words:] == -7)
        self.near, self.queued = scratch[:2]


EACH = product((np.float32, np.float64), (2, 3), TRIANGLE_CASES, ("warp", "bvh"))
OFTEN = [(*kind, name, backend) for backend, kinds in KINDS.items() for kind in kinds for name in TRIANGLE_CASES]


@pytest.mark.parametrize(("dtype", "dim", "name", "backend"), sparing(EACH, OFTEN))
def test_hard_case(name, backend, dtype, dim):
    """What the kernels of the CPU list is what the oracle says: tests/triangles/test_triangles.py."""
    given = padded(TRIANGLE_CASES[name].build(dtype, dim))
    tri = jfrnn.search_triangles(given.positions, given.vertices, given.faces, given.cutoff, capacity=40, backend=backend)
    answer = Answer(tri, given.positions)
    assert np.array_equal(answer.idx, tri.idx)
    assert np.array_equal(answer.count, tri.count)
    if name in ("ties", "sheet"):
        assert answer.queued > 0  # integers are asked


def around_a_gear(n, cutoff, backend="warp"):
    vertices, faces = meshes.gear(12, 1500)
    vertices = vertices.astype(np.float64 if backend == "bvh" else np.float32)  # as hard cases in 3D: kernels are shared
    x = np.random.default_rng(0).uniform(vertices.min(axis=0) - 1, vertices.max(axis=0) + 1, (n, 3)).astype(vertices.dtype)
    return x, jfrnn.search_triangles(x, vertices, faces, cutoff, backend=backend)


@pytest.mark.parametrize(("n", "cutoff", "backend"), [(1, 5.0, "warp"), (1, 5.0, "bvh"), (3001, 0.5, "warp"), (3001, 0.5, "bvh")])
def test_around_a_gear(n, cutoff, backend):
    """Cells of several sizes, and rows longer than what waits to be decided at a time; most particles are near nothing."""
    x, tri = around_a_gear(n, cutoff, backend)
    assert int(tri.required) > triangles_cuda._WAITING
    answer = Answer(tri, x)
    assert np.array_equal(answer.idx, tri.idx)
    assert np.array_equal(answer.count, tri.count)
    assert np.sum(answer.count > 0) <= answer.near <= n
    counted = Answer(tri, x, lists=False)
    assert np.array_equal(counted.count, tri.count)
    assert len(counted.steps) == len(answer.steps) - 1  # no row is filled
    assert np.all(counted.idx == -7)


def test_rows_that_are_too_short():
    """Counts stay true, and what fits is written."""
    x, tri = around_a_gear(501, 0.7)  # slots are no multiple of four
    few = tri.update(x)
    short = jfrnn.search_triangles(x, few.vertices, few.faces, 0.7, capacity=3, backend="warp")
    assert short.overflow
    answer = Answer(short, x)
    assert np.array_equal(answer.idx, short.idx)
    assert np.array_equal(answer.count, tri.count)


def test_programs_for_cuda_call_it():
    given = padded(TRIANGLE_CASES["random"].build(np.float32, 3))
    search = jax.jit(lambda x: jfrnn.search_triangles(x, given.vertices, given.faces, 1.0, capacity=40, backend="warp").idx)
    program = search.trace(given.positions).lower(lowering_platforms=("cuda",)).as_text()
    assert '"jfrnn_triangles_cuda_3d_f32_list@' in program
    assert "_build_" not in program  # XLA sorts the wall
    assert "cuda" not in search.lower(given.positions).as_text()


@pytest.mark.parametrize("lists", [False, True])
def test_rows_are_filled_beside_another_launch(lists):
    x, tri = around_a_gear(100, 0.5)
    assert [step.beside for step in Answer(tri, x, lists).steps] == [False, False, *[True] * lists, False, False, False, False]


def test_slots_are_filled_by_as_many_threads_as_a_device_runs():
    """All others are as many on each device: their buffers are laid out where a program is traced."""
    kernels = triangles_cuda.triangle_kernels(3, False, True, False, WIDTH)
    small, large = (dict(kernels.threads(10**7, 1000, 1000, 32, False, multiprocessors)) for multiprocessors in (2, 160))
    factors = {kernel: large[kernel] / threads for kernel, threads in small.items()}
    assert factors.pop(kernels.fill) == 80
    assert set(factors.values()) == {1}


@pytest.mark.parametrize("double", [False, True])
def test_scratch_follows_particles_and_triangles(double):
    for n in (10, 1_000_000, 100_000_000):
        words = triangles_cuda.scratch_words(n, 1 << 17, 16 * 12_000, 3, double)
        assert 4 * words <= 12 * n + (4 << 17) + 64 * (1 + double) * 16 * 12_000 + min(60e6, 30_000 * (n + 31)) + 1024


def test_platforms_without_kernels_take_arrays(monkeypatch):
    x = jnp.zeros((4, 3), np.float32)
    for module in (_auto, _triangles):
        monkeypatch.setattr(module, "platform_of", lambda *_: "rocm")
    assert _triangles._choose_engine("auto", x).name == "jax"
    refuses(RuntimeError, "on the CPU and on CUDA, got 'rocm'", _triangles._choose_engine, "bvh", x)
