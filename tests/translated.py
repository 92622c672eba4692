"""Translate functions, put all of them into one kernel, and run it on the CPU."""

import functools
from typing import Any, NamedTuple

import jax
import launched
import numpy as np

from jfrnn._sums import translate as _translate
from jfrnn._sums.scalars import TYPES
from jfrnn.kernels import Kind, declare
from jfrnn.kernels._native import program

LANES = {"float32": 16, "float64": 8}
NUMBER = {"float32": "float", "float64": "double"}


STRUCT = """
struct ChooseArguments {
const real* given;
real* found;
int n, which;
};
struct Choose : ChooseArguments {
JFRNN_MEMBER explicit Choose(const ChooseArguments& a) : ChooseArguments(a) {}
JFRNN_MEMBER void run() {
"""


class Case(NamedTuple):
    """A function, the shapes and dtypes of its inputs ("real" is the dtype under test), how far it may be off, what it is given.

    The error of an element y may be `ulp` units in the last place of max(|y|, scale). `draw` makes one array [n, *shape] per input.
    `exact` is NumPy's function, where JAX's is not good enough a reference.
    """

    function: Any
    shapes: tuple[tuple[int, ...], ...]
    draw: Any
    ulp: float = 0
    scale: float = 0
    dtypes: tuple[str, ...] = ()
    exact: Any = None

    def examples(self, real):
        dtypes = self.dtypes or ("real",) * len(self.shapes)
        return [jax.ShapeDtypeStruct(s, real if d == "real" else d) for s, d in zip(self.shapes, dtypes)]


@functools.cache
def translated(case, real):
    """Return a case as text, for a dtype."""
    return _translate.translate(jax.make_jaxpr(case.function)(*case.examples(real)))


def statements(text, real):
    """Return text that loads inputs from the rows of `given`, from column i on, computes, and stores into the rows of `found`."""
    of_real, lines = TYPES[real], []
    before = np.cumsum([0, *(np.prod(spec.shape, dtype=int) for spec in text.inputs)])
    for k, e in text.reads:
        name, of = _translate.input_name(k, e), TYPES[text.inputs[k].dtype]
        loaded = f"load(given + {before[k] + e} * n + i)"
        lines.append(f"const Math::{of} {name} = {loaded if of == of_real else f'Math::to_{of}({loaded})'};")
    lines.append(text.text)
    row = 0
    for k, spec in enumerate(text.outputs):
        for e in range(int(np.prod(spec.shape))):
            y = _translate.output_name(k, e)
            y = y if TYPES[spec.dtype] == of_real else f"Math::to_{of_real}({y})"
            lines.append(f"store(found + {row} * n + i, {y});")
            row += 1
    return "\n".join(lines)


def native_text(texts, real, kind):
    """Return a program that runs the text of the number `which` on n columns."""
    lanes, number, of_real = LANES[real] if kind == "vector" else 1, NUMBER[real], TYPES[real]
    count = f"#define JFRNN_SCALAR {int(kind != 'vector')}\nconstexpr int LANES = {lanes};\n"
    given = {"lane_count.h": '#include "constants.h"\n#include "device.h"\n' + count}
    text = program(Kind(3, real == "float64"), "constants.h", "float_control.h", "math.h", given=given)
    start = ["const FloatControl floats;"]
    if kind == "vector":
        start.append(
            f"auto load = [](const {number}* from) {{ Math::{of_real} x; __builtin_memcpy(&x, from, sizeof x); return x; }};"
        )
        start.append(f"auto store = []({number}* to, Math::{of_real} x) {{ memcpy(to, &x, sizeof x); }};")
    else:
        start.append(f"auto load = [](const {number}* from) {{ return *from; }};")
        start.append(f"auto store = []({number}* to, {number} x) {{ *to = x; }};")
    cases = [
        f"case {k}:\nfor (int i = 0; i < n; i += LANES) {{\n{text}\n}}\nbreak;"
        for k, text in enumerate(texts)
    ]  # fmt: skip
    return text + STRUCT + "\n".join([*start, "switch (which) {", *cases, "}", "}", "};", ""])


def kernel_of(cases, real, kind, name, cuda=False):
    """Return a kernel that runs one of the cases: given [rows, n], found [rows, n], n, which."""
    texts = [statements(translated(case, real), real) for case in cases]
    return declare(f"translated_{name}_{kind}_{real}", native_text(texts, real, kind), "Choose.run", cuda=cuda)[0]


def run(kernel, which, case, inputs):
    """Return the outputs [n, *shape] of one case, in the dtype under test, for inputs [n, *shape] in it."""
    n, outputs = len(inputs[0]), translated(case, inputs[0].dtype.name).outputs
    given = np.concatenate([x.reshape(n, -1).T for x in inputs])
    sizes = [int(np.prod(spec.shape)) for spec in outputs]
    found = np.zeros((sum(sizes), n), given.dtype)
    launched.on_cpu(kernel, given=np.ascontiguousarray(given), found=found, n=n, which=which)
    rows = np.split(found, np.cumsum(sizes)[:-1])
    return [x.T.reshape(n, *spec.shape) for x, spec in zip(rows, outputs)]
