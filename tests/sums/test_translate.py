"""Translated functions against JAX, as scalars and as vectors of lanes.

The reference of both dtypes is JAX in float64 on the same numbers: it has neither the errors of XLA's own float32 functions nor
their flushed denormals. In float64 XLA flushes denormals too, so that there they are left out; and where its functions are off by
many ulp (sinh by hundreds), NumPy's `longdouble` decides.
"""

import functools
import itertools

import jax
import numpy as np
import pytest
from checked import refuses, slow, sparing
from jax import lax
from jax import numpy as jnp
from started import run_python
from translated import Case, kernel_of, run
from translated_cases import CASES, ELEMENTWISE, INTEGERS, PAIRS, N

from jfrnn._sums import translate as _translate
from jfrnn._sums.primitives import TABLE
from jfrnn._sums.scalars import NoTranslationError, literal
from jfrnn.kernels import _compile

SINGLE = ELEMENTWISE | INTEGERS
GROUPS = {"of_one": SINGLE, "of_many": {name: case for name, case in CASES.items() if name not in SINGLE}}


@functools.cache
def inputs_of(name, real):
    case = CASES[name]
    return case.draw(np.random.default_rng(sum(map(ord, name))), real)


@jax.jit
def answers(inputs):
    """Take a group of cases, compiled at once and for both dtypes."""
    return {name: jax.vmap(CASES[name].function)(*x) for name, x in inputs.items()}


@functools.cache
def references(real, group):
    """Return what JAX answers to a group of cases, in float64."""
    wide = {}
    for name, case in GROUPS[group].items():
        dtypes = [np.float64 if x.dtype == real else x.dtype for x in case.examples(real)]
        wide[name] = [as_dtype(x, dtype) for x, dtype in zip(inputs_of(name, real), dtypes)]
    found = jax.device_get(answers(wide))
    if real == "float64":
        better = [name for name, case in GROUPS[group].items() if case.exact is not None]
        with np.errstate(all="ignore"):
            found |= {name: CASES[name].exact(inputs_of(name, real)[0].astype(np.longdouble)) for name in better}
    return found


def as_dtype(x, dtype):
    with np.errstate(invalid="ignore"):
        return np.asarray(x, np.float64).astype(dtype)


@functools.cache
def kernel(real, kind, group):
    return kernel_of(list(GROUPS[group].values()), real, kind, group)


def rows_to_compare(inputs, real):
    """In float64 XLA takes denormals for 0; it is not asked about them."""
    if real == "float32":
        return np.ones(N, bool)
    tiny, rows = np.finfo(real).tiny, [x.reshape(N, -1) for x in inputs]
    return np.all([np.all(np.abs(x) >= tiny, 1) | np.all(x == 0, 1) for x in rows], 0)


def assert_close(found, expected, ulp, scale, rows, inputs):
    """Fail unless every element is within `ulp` units in the last place of max(|y|, scale), or is the same NaN or infinity."""
    real = found.dtype
    with np.errstate(all="ignore"):
        rounded = np.asarray(expected).astype(real)
        least = max(scale, np.finfo(real).smallest_subnormal)
        unit = np.spacing(np.maximum(np.abs(rounded), real.type(least))).astype(np.float64)
        off = (np.abs(found.astype(np.longdouble) - np.asarray(expected, np.longdouble)) / unit).astype(np.float64)
        tiny = (np.abs(rounded) < np.finfo(real).tiny) & (np.abs(found) <= np.finfo(real).tiny) & (real == np.float64)
    same = (found == rounded) | (np.isnan(found) & np.isnan(rounded)) | tiny
    same &= (found != 0) | (np.signbit(found) == np.signbit(rounded)) | (scale > 0)
    ok = same | (np.isfinite(found) & np.isfinite(rounded) & (off <= ulp))
    wrong = np.argwhere(~ok & rows.reshape(-1, *[1] * (ok.ndim - 1)))
    at = [(x[k[0]].tolist() for x in inputs) for k in wrong[:3]]
    shown = [(list(a), found[tuple(k)], rounded[tuple(k)], off[tuple(k)]) for a, k in zip(at, wrong)]
    assert not len(wrong), f"{len(wrong)} of {ok.size}: inputs, found, expected, ulp {shown}"


EACH = [
    (*kind, name) for kind in itertools.product(("float32", "float64"), ("scalar", "vector"), GROUPS) for name in GROUPS[kind[2]]
]
OFTEN = [case for case in EACH if case[1:3] != ("vector", "of_many")]  # which take Clang long as vectors: pair sums are such


@pytest.mark.parametrize(("real", "kind", "group", "name"), sparing(EACH, OFTEN))
def test_cases(real, kind, group, name):
    case, inputs = CASES[name], inputs_of(name, real)
    found = run(kernel(real, kind, group), list(GROUPS[group]).index(name), case, inputs)
    expected = jax.tree.leaves(references(real, group)[name])
    assert len(found) == len(expected)
    for f, e in zip(found, expected):
        assert_close(f, e, case.ulp, case.scale, rows_to_compare(inputs, real), inputs)


def test_every_primitive_that_is_translated_is_tested():
    """Nothing stands in the table that no case reaches, but for names of older or newer versions of JAX, and within shard_map."""

    def names(jaxpr):
        for eqn in jaxpr.eqns:
            yield eqn.primitive.name
            for nested in jax.tree.leaves(list(eqn.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
                yield from names(nested) if hasattr(nested, "eqns") else ()

    used = {name for case in CASES.values() for name in names(jax.make_jaxpr(case.function)(*case.examples("float32")).jaxpr)}
    older = {"pjit", "closed_call", "core_call", "custom_vjp_call_jaxpr", "checkpoint", "remat", "copy_p", "expand_dims"}
    newer = {"jit", "remat2", "stack", "unstack", "tile"}
    assert set(TABLE) - used <= older | newer | {"reshard"}  # reached by tests/distributed_checks.py


# --- constants --------------------------------------------------------------------------------------------------------

FLOATS = [0.0, -0.0, 1 / 3, -1e30, np.inf, -np.inf, 1e-40, -1e-45, 3.4028234e38]


def bits(x):
    return x.view({4: np.uint32, 8: np.uint64}[x.itemsize])


@pytest.mark.parametrize("kind", ["scalar", "vector"])
def test_constants_are_the_same_bits(kind, dtype):
    real = np.dtype(dtype).name
    quiet = bits(np.array([np.nan], dtype)) | np.array([0x1234], bits(np.zeros(1, dtype)).dtype)
    values = np.concatenate([np.array(FLOATS, dtype), quiet.view(dtype), -quiet.view(dtype), [np.finfo(dtype).smallest_subnormal]])
    case = Case(lambda x: jnp.where(jnp.isnan(x), x, values), ((),), None)
    (found,) = run(kernel_of([case], real, kind, "constants"), 0, case, [np.zeros(16, dtype)])
    assert (bits(np.ascontiguousarray(found)) == bits(values)).all()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (np.float32(1.5), "Math::of(0x1.8000000000000p+0f)"),
        (np.float64(0.1), "Math::of(0x1.999999999999ap-4)"),
        (np.float32(-np.inf), "Math::of_bits(0xff800000u)"),
        (np.float64(np.nan), "Math::of_bits(0x7ff8000000000000ull)"),
        (np.int32(-(2**31)), "Math::of(-2147483647 - 1)"),
        (np.int64(2**62), "Math::of(4611686018427387904ll)"),
        (np.True_, "Math::of(true)"),
    ],
)
def test_literals(value, text):
    assert literal(value) == text


# --- the text ---------------------------------------------------------------------------------------------------------


def translated(function, *arguments):
    return _translate.translate(jax.make_jaxpr(function)(*arguments))


def test_text():
    """What is written twice is computed once, what nobody reads is not computed, and what does nothing is not written."""
    found = translated(lambda r, unused, m: (jnp.sqrt(r[0] * r[1]) * m + r[1] * r[0] * 1, jnp.exp(r)[1]), *np.ones((3, 2)))
    assert found.text.splitlines() == [
        "const auto v0 = in0_0 * in0_1;",
        "const auto v1 = Math::sqrt(v0);",
        "const auto v2 = in2_0 * v1;",
        "const auto v3 = in2_1 * v1;",
        "const auto v4 = v0 + v2;",
        "const auto v5 = v0 + v3;",
        "const auto v6 = Math::exp(in0_1);",
        "const auto out0_0 = v4;",
        "const auto out0_1 = v5;",
        "const auto out1_0 = v6;",
    ]
    assert found.reads == ((0, 0), (0, 1), (2, 0), (2, 1))
    assert found.inputs == (((2,), "float64"),) * 3
    assert found.outputs == (((2,), "float64"), ((), "float64"))


def test_what_zeros_and_nan_could_tell_is_written():
    x = np.float32(2)
    assert "in0_0 + Math::of(0x0.0p+0f)" in translated(lambda x: x + 0.0, x).text
    assert "in0_0 * Math::of(0x0.0p+0f)" in translated(lambda x: x * 0.0, x).text
    assert "in0_0 - in0_0" in translated(lambda x: x - x, x).text
    assert "Math::div(in0_0, in0_0)" in translated(lambda x: x / x, x).text


def test_what_is_the_same_bit_by_bit_is_written_once():
    """Squares of differences, whichever way they are taken; what is divided by numbers, as in the derivative of max."""
    x, y = np.ones((2, 1), np.float32)
    lines = translated(lambda x, y: (x - y) * x + (x - y) ** 2 + (y - x) ** 2 * (y - x), x, y).text.splitlines()
    assert sum("v0 * v0" in line for line in lines) == 1
    assert len(lines) == 8
    assert "v1 * v1" in translated(lambda x, y: y / x + (x / y) ** 2, x[0], y[0]).text  # of a quotient, not of its reciprocal
    assert "in0_0 * Math::of(0x1.0000000000000p-3f)" in translated(lambda x: x / 8, x).text
    assert "in0_0 * Math::of(0x1.5555560000000p-2f)" in translated(lambda x: x / 3, x).text
    assert "Math::div" not in translated(jax.grad(lambda x: jnp.maximum(x, 0)), np.float32(1)).text
    assert "Math::div(in0_0, " in translated(lambda x: x / 1e38, x).text  # whose reciprocal is denormal


KEY = """
import jax
from jfrnn._sums.translate import translate
print(translate(jax.make_jaxpr(lambda x: x * jax.numpy.sin(x) + 2)(1.0)).key)
"""


def test_key_is_the_same_in_every_process():
    said = run_python("-c", KEY, PYTHONHASHSEED="1").stdout  # another one than that of this process
    assert said == translated(lambda x: 2 + x * jnp.sin(x), np.float32(1)).key + "\n"
    assert translated(lambda x: 3 + x * jnp.sin(x), np.float32(1)).key not in said


# --- CUDA -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("real", ["float32", slow("float64")])
def test_cases_compile_for_cuda(real):
    kernel = kernel_of([*ELEMENTWISE.values(), *INTEGERS.values(), *PAIRS.values()], real, "scalar", "cuda", cuda=True)
    assert f".entry {kernel.name}(" in _compile.find_binary(kernel.program, arch=90).read_text()


# --- what has no translation ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (jnp.sort, "'sort' has no translation.*backend"),
        (lambda x: lax.fori_loop(0, x[0].astype(int), lambda _, x: 2 * x, x), "'while' has no translation"),
        (lambda x: lax.scan(lambda c, y: (c + y, c), x[0], x), "'scan' has no translation"),
        (lambda x: jnp.zeros((9, 9)).at[x[0].astype(int), x[1].astype(int)].add(x[2]), "more than 64 places.*backend"),
        (lambda x: x.at[x[0].astype(int)].multiply(2), "'scatter-mul' has no translation"),
        (lambda x: jax.debug.print("{}", x[0]), "'debug_"),
        (lambda x: x.astype(jnp.float16), "dtype float16.*backend"),
        (lambda x: x.astype(int) ** x.astype(int), "no translation"),
        (lambda x: jnp.concatenate([x] * 86).sum(), r"shape \(258,\).*256.*backend"),
        (lambda x: functools.reduce(lambda m, k: jnp.sin(m + k), range(100), jnp.outer(x, jnp.arange(80.0))), "20000.*backend"),
    ],
)
def test_what_has_no_translation(function, message):
    refuses(NoTranslationError, message, translated, function, np.ones(3))


def test_traced_constants_are_refused():
    def outer(x):
        closed = jax.make_jaxpr(lambda y: x * y)(1.0)
        return _translate.translate(closed)

    refuses(NoTranslationError, "being traced: hand it over as an argument", jax.jit(outer), 1.0)


def test_inside_a_trace():
    """Where a function is traced, indices are still known."""

    def outer(x):
        closed = jax.make_jaxpr(lambda y: y[jnp.array([1, 0])])(np.ones(2))
        assert "const auto out0_0 = in0_1" in _translate.translate(closed).text
        return x

    jax.jit(outer)(1.0)
