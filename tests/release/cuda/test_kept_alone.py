"""Lists that are kept: what kernels of CUDA decide and sum, run on the CPU by one thread after another, each with a row of its own.

So far a machine without a GPU can tell what they answer. Warps of several rows, loads and the order of sums are not looked at.
"""

import re
from itertools import product

import jax
import kept_scenes
import numpy as np
import pytest
from checked import slow, sparing

from jfrnn.kernels import Program, kept

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of a CPU answer in place of those of a GPU")
ALONE = """
static struct { unsigned int x; } threadIdx = {0};
static long long thread_alone = 0;
constexpr unsigned int ALL = 1;
static void __syncwarp() {}
static unsigned int __activemask() { return 1; }
static bool __any_sync(unsigned int, bool x) { return x; }
template <class T> static T __shfl_down_sync(unsigned int, T, int) { return T(0); }
"""
ENTRY = """
extern "C" void NAME(const ARGUMENTS* given) {
    if (__atomic_fetch_add(given->info, 1, __ATOMIC_RELAXED) > 0)
        return;  // one thread of the CPU takes all rows
    for (thread_alone = 0; thread_alone < given->m; ++thread_alone) {
        threadIdx.x = (unsigned int)thread_alone & 31;
        STRUCT{*given}.run();
    }
}
"""


def by_one_thread(kernel, of_cpu):
    """Return a kernel of CUDA as one of the CPU, whose arguments are those of another."""
    text = kernel.program.text[: kernel.program.text.rindex("\n}\n")] + "\n}\n"
    text = text.replace("namespace {", ALONE + "namespace {", 1).replace("#define JFRNN_SCALAR 0", "#define JFRNN_SCALAR 1")
    text = re.sub(r"thread_index\(\) \{ return 0; \}", "thread_index() { return thread_alone; }", text)
    text = re.sub(
        r"unsigned int w\[4\];.*?memcpy\(to, w, sizeof\(Words\)\);", "memcpy(to, from, sizeof(Words));", text, flags=re.DOTALL
    )
    length = re.search(r"constexpr int LENGTH = \d+;", of_cpu.program.text)
    text = re.sub(r"constexpr int LENGTH = \d+;", length[0], text)
    struct = of_cpu.name.partition("_")[0]
    arguments = re.search(rf"explicit {struct}\(const (\w+)&", text)
    entry = ENTRY.replace("NAME", of_cpu.name).replace("STRUCT", struct).replace("ARGUMENTS", arguments[1])
    assert of_cpu.fields == kernel.fields
    return of_cpu._replace(program=Program(f"{kernel.program.name}_alone", text + entry, cuda=False))


@pytest.fixture
def alone(monkeypatch):
    """Let sums and masks of lists be those of kernels of CUDA; return which of these were asked for."""
    asked = []

    def instead(make):
        def made(kind, *more):
            asked.append(make.__name__)
            return by_one_thread(make(kind._replace(lanes=1), *more), make(kind, *more))

        return made

    for make in (kept.sum_kernel, kept.mask_kernel):
        monkeypatch.setattr(kept, make.__name__, instead(make))
    return asked


APART = [(1, np.float32), (5, np.float64), (700, np.float32)]


# other numbers of points than elsewhere: what was planned before stays
@pytest.mark.parametrize("dtype", [np.float32, slow(np.float64)])
def test_ties_beside_pairs_that_a_wide_box_leaves_in_doubt(alone, dtype):
    kept_scenes.ties_in_a_wide_box(dtype, n=13)
    assert set(alone) == {"sum_kernel", "mask_kernel"}


@pytest.mark.parametrize(("most", "dtype"), sparing(product((1, 5, 700), (np.float32, np.float64)), APART))
def test_pairs_whose_points_lie_boxes_apart(alone, dtype, most):
    kept_scenes.boxes_apart(dtype, most, n=301 + min(most, 9))
    assert set(alone) == {"sum_kernel", "mask_kernel"}


@pytest.mark.parametrize("dtype", [slow(np.float32), np.float64])
def test_in_a_box_as_narrow_as_it_may_be(alone, dtype):
    kept_scenes.narrow_box(2.06, dtype, n=5)
    assert set(alone) == {"sum_kernel", "mask_kernel"}
