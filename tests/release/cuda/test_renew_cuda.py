"""Lists that renew themselves on CUDA, as far as a machine without a GPU can tell: what stands around a search runs on the CPU, by
one thread, and answers as array programs do. On a GPU, they are those of the other way.
"""

from fractions import Fraction

import jax
import jax.numpy as jnp
import launched
import numpy as np
import pytest
from checked import sparing

import jfrnn
from jfrnn._engine.operands import pack_particles
from jfrnn._engine.problem import Inputs, prepare_search
from jfrnn._engine.renew_warp import constants_of, numbers_of_box
from jfrnn._geometry import Status, make_cutoff
from jfrnn._search import neighbor_list
from jfrnn.kernels import Program, _compile, renew

SKIN, CUTOFF, LENGTH = 0.3, 1.0, 10.0
KINDS = [(3, np.float32, True), (2, np.float64, True), (3, np.float64, False)]
SEARCHED, MOVED = KINDS[:1], KINDS[1:]  # each box, width and dimension is in one of the two tests that compile longest
ONE_THREAD = """
#define __shared__ static
static const struct { unsigned int x; } threadIdx = {0}, blockIdx = {0};
static void __syncthreads() {}
static bool __syncthreads_or(bool x) { return x; }
static void atomicOr(int* to, int x) { *to |= x; }
static void atomicAdd(int* to, int x) { *to += x; }
static void atomicMax(int* to, int x) { *to = x > *to ? x : *to; }
static void cudaGraphSetConditional(unsigned long long condition, unsigned int x) { *(int*)condition = (int)x; }
static int __clz(int x) { return x ? __builtin_clz((unsigned int)x) : 32; }
template <class To, class From> static To same_bits(From x) { To y; memcpy(&y, &x, sizeof y); return y; }
static unsigned int __float_as_uint(float x) { return same_bits<unsigned int>(x); }
static float __uint_as_float(unsigned int x) { return same_bits<float>(x); }
static float __int_as_float(int x) { return same_bits<float>(x); }
static long long __double_as_longlong(double x) { return same_bits<long long>(x); }
static double __longlong_as_double(long long x) { return same_bits<double>(x); }
"""


class OneThread:
    """The kernels for a space, as kernels of the CPU, and the arrays of a list of n particles."""

    def __init__(self, dim, dtype, boxed, now, before):
        n = len(now)
        kernels = renew.renew_kernels(dim, dtype is np.float64, boxed, True, constants_of(dtype is np.float64))
        self.kernels = {name: self._on_the_cpu(kernel) for name, kernel in zip(kernels._fields, kernels, strict=True)}
        self.box = jfrnn.Box(np.full(dim, LENGTH, dtype)) if boxed else None
        made = jfrnn.search(jnp.asarray(now), CUTOFF, skin=SKIN, box=self.box, backend="jax", capacity=8)
        self.inputs = Inputs(jnp.asarray(now), None, None, made.box, made.problem.listed_within(None))
        self.options = made.problem.options
        numbers = np.zeros((1, 1), dtype) if not boxed else np.array(numbers_of_box(self.inputs, self.options))
        half = make_cutoff(SKIN / 2, np.dtype(dtype), closed=False)
        vectors, origin = np.full(3, LENGTH, dtype), np.zeros(3, dtype)
        self.arrays = {
            "now": now, "limit": np.array([half.inside], dtype), "cutoffs": numbers, "vectors": vectors, "origin": origin,
            "longest": np.array([7], np.int32), "bits": np.ones(1, np.int32), "reference": before.copy(),
            "scratch": np.arange(10_000 + 8 * n, dtype=np.int32),
            "kept_vectors": vectors.copy(), "kept_origin": origin.copy(), "status": np.zeros(1, np.int32),
            "required": np.array([3], np.int32), "rebuild_count": np.zeros(1, np.int32), "order": np.zeros(n, np.int32),
            "positions": np.zeros((n, dim + 1), dtype), "cutoff": np.full(30, CUTOFF + SKIN, dtype), "stale": np.zeros(1, np.int32),
            "parts": np.zeros((1, 2), np.int32), "condition": np.zeros(1, np.int32),
        }  # fmt: skip

    @staticmethod
    def _on_the_cpu(kernel):
        name, method = f"{kernel.name}_on_the_cpu", kernel.name.partition("_")[2]
        text = kernel.program.text[: kernel.program.text.rindex("\n}\n")] + "\n}\n"
        text = text.replace("constexpr int BLOCK = 256;", "constexpr int BLOCK = 1;").replace(
            "namespace {", ONE_THREAD + "namespace {", 1
        )
        entry = f'extern "C" void {name}(const RenewArguments* given) {{ Renew{{*given}}.{method}(); }}\n'
        return kernel._replace(name=name, program=Program(name, text + entry, cuda=False))

    def run(self, name):
        launched.on_cpu(self.kernels[name], **self.arrays, n=len(self.arrays["now"]), blocks=1)

    def is_stale(self, now, before):
        self.arrays |= {"now": np.ascontiguousarray(now[None]), "reference": np.ascontiguousarray(before[None])}
        self.arrays["condition"][0] = 0
        self.run("check")
        assert not self.arrays["condition"][0]
        self.run("decide")
        assert self.arrays["condition"][0] == self.arrays["stale"][0]
        return bool(self.arrays["stale"][0])


def square_of_motion(now, before, boxed):
    """Return the exact square of the shortest motion, of a point that is wrapped at will in a box."""
    exact = [Fraction(float(x)) - Fraction(float(y)) for x, y in zip(now, before, strict=True)]
    return sum((x - round(x / Fraction(LENGTH)) * Fraction(LENGTH) if boxed else x) ** 2 for x in exact)


@pytest.mark.parametrize(("dim", "dtype", "boxed"), sparing(KINDS, MOVED))
def test_a_list_is_stale_where_a_point_has_moved_half_the_skin(dim, dtype, boxed):
    """Also by an ulp, across many boxes; and no list is that where all have moved a little less."""
    rng, one = np.random.default_rng(dim), np.ones((1, dim), dtype)
    kernels, limit = OneThread(dim, dtype, boxed, one, one), Fraction(float(dtype(SKIN / 2))) ** 2
    found = []
    for k in range(400):
        before = rng.uniform(0, LENGTH, dim).astype(dtype)
        way = rng.normal(size=dim)
        far = (0.02, 1e-5, 1e-7, 1e-9)[k % 4]
        now = before + way / np.linalg.norm(way) * SKIN / 2 * (1 + far * rng.normal())
        now = (now + boxed * LENGTH * rng.integers(-3, 4, dim) * (k % 3)).astype(dtype)
        square, stale = square_of_motion(now, before, boxed), kernels.is_stale(now, before)
        assert stale or square < limit, (before, now)
        assert not stale or square > limit * Fraction(1 - 1e-3), (before, now)
        found.append(stale)
    assert 50 < sum(found) < 350


@pytest.mark.parametrize(("dim", "dtype", "boxed"), KINDS)
def test_points_that_are_not_finite_move_when_they_become_finite(dim, dtype, boxed):
    one, nowhere = np.ones((1, dim), dtype), np.full((1, dim), np.nan, dtype)
    kernels = OneThread(dim, dtype, boxed, one, one)
    for now, before, stale in ((one, one, False), (nowhere, nowhere, False), (nowhere, one, True), (one, np.inf * one, True)):
        assert kernels.is_stale(now[0], before[0]) is stale
    kernels.arrays["kept_origin"][0] = 1e-30
    assert kernels.is_stale(one[0], one[0]) is boxed  # the box is another one


@pytest.mark.parametrize(("dim", "dtype", "boxed"), sparing(KINDS, SEARCHED))
@pytest.mark.parametrize("spread", [1, 30, 900, 1e7])
def test_a_search_is_given_what_another_one_is(dim, dtype, boxed, spread):
    """Rows of points with their turns, numbers of the lattice, a status; and the order in which they stand, if they are apart."""
    rng = np.random.default_rng(dim)
    now = (rng.uniform(0, LENGTH, (40, dim)) * np.where(np.arange(40) % 5 > 0, 1, spread)[:, None]).astype(dtype)
    now[7, 0] = np.nan if spread == 30 else now[7, 0]
    kernels = OneThread(dim, dtype, boxed, now, np.zeros_like(now))
    kernels.run("prepare")
    kernels.run("settle")
    given, arrays = prepare_search(kernels.inputs, kernels.options), kernels.arrays
    rows, _, numbers = map(np.asarray, pack_particles(given))
    np.testing.assert_array_equal(arrays["reference"], given.sources)
    if boxed:
        np.testing.assert_array_equal(arrays["positions"].view(f"i{dtype().itemsize}"), rows.view(f"i{dtype().itemsize}"))
        bounds = [22, 23, 24, 28, 29]  # reach, slack and turns: of at least as many turns
        np.testing.assert_array_equal(np.delete(arrays["cutoff"], bounds), np.delete(numbers, bounds))
        np.testing.assert_array_less(numbers[bounds], 1e-30 + arrays["cutoff"][bounds] * (1 + 4 * np.finfo(dtype).eps))
        assert arrays["cutoff"][28] <= 3 * numbers[28]
    assert (int(arrays["longest"][0]), int(arrays["bits"][0])) == (0, 0)  # as a search begins
    arrays["longest"][0] = 5
    kernels.run("keep")
    checks = {bit: not bool(ok) for bit, ok in given.checks.items()}
    checks |= {Status.NONFINITE: boxed and bool(np.isnan(now).any())}
    assert int(arrays["status"][0]) == sum(bit.value for bit, wrong in checks.items() if wrong)
    assert (int(arrays["required"][0]), int(arrays["rebuild_count"][0])) == (5, 1)
    assert (arrays["order"] >= 0).all()  # neighbors in memory are none in space
    kernels.arrays["now"] = np.ones_like(now)
    for name in ("prepare", "settle", "keep"):
        kernels.run(name)
    assert (arrays["order"] == -1).all()


@pytest.mark.parametrize(("dim", "dtype", "boxed"), KINDS)
def test_kernels_compile_for_a_gpu(dim, dtype, boxed):
    for ordered in (False, True):
        found = renew.renew_kernels(dim, dtype is np.float64, boxed, ordered, constants_of(dtype is np.float64))
        assert ".entry Renew_keep(" in _compile.find_binary(found.check.program, arch=90).read_text()
        linked = _compile.find_binary(found.decide.program, arch=90).read_text()
        assert ".version 8.3\n" in linked and "call.uni \n\tcudaGraphSetConditional" in linked and "keep" not in linked


@pytest.mark.skipif(jax.default_backend() != "gpu", reason="only on CUDA lists renew themselves")
@pytest.mark.parametrize("n", [700, 9000])
@pytest.mark.parametrize("boxed", [False, True])
def test_on_a_gpu_lists_are_those_of_the_other_way(monkeypatch, n, boxed):
    """In every step of a loop: counts, statuses, how often they were made anew; then their rows."""
    length = LENGTH * (n / 700) ** (1 / 3)
    rng = np.random.default_rng(n)
    x, v = (jnp.asarray(each, jnp.float32) for each in (rng.uniform(0, length, (n, 3)), rng.normal(size=(n, 3)) * 0.01))
    nbrs = jfrnn.search(x, CUTOFF, skin=SKIN, box=jfrnn.Box(np.full(3, length, np.float32)) if boxed else None)

    def run():
        def step(state, _):
            x, nbrs = state[0] + v, state[1].update(state[0] + v)
            return (x, nbrs), (nbrs.count, nbrs.status, nbrs.required, nbrs.rebuild_count)

        return jax.jit(lambda: jax.lax.scan(step, (x, nbrs), None, length=25))()

    (_, ours), steps = run()
    monkeypatch.setattr(neighbor_list, "can_renew", lambda *_: False)
    jax.clear_caches()
    (_, others), other_steps = run()
    for mine, other in zip(steps, other_steps, strict=True):
        np.testing.assert_array_equal(mine, other)
    assert 3 < int(ours.rebuild_count) < 20
    np.testing.assert_array_equal(np.sort(ours.idx, axis=1), np.sort(others.idx, axis=1))
