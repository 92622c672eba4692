"""The functions that translated text calls (see `jfrnn._translate`), as native C++ text: the struct `Math`, in two kinds.

`SCALAR` is one number at a time, for Clang on the CPU and for NVRTC on CUDA. `VECTOR` is LANES numbers at a time in Clang's vector
types, on the CPU; where it stands, `LANES` is a constant expression, a power of two. Both define the same overloads of the types
`Math::f32`, `f64`, `i32`, `i64` and `flag`, so that one text compiles for each. Both are pieces of a function body.

Edge cases are JAX's: max and min hand NaN on, sign(0) is 0, integers wrap, x / 0 is -1 and x % 0 is x for integers, floats beyond
the range of integers saturate, and NaN becomes 0. Denormals are kept, if the processor's flush modes are cleared (`FloatControl` in
`native/float_control.h`); XLA on the CPU flushes them. Nothing uses CUDA's fast approximations.

Warp's compiler for the CPU links the functions of the C library from a list of its own, which has neither expm1 nor log1p: there
these two are series in both kinds. `VECTOR` takes more series, several times faster than one call per lane (see
`jfrnn.kernels._series`), and calls the C library lane by lane elsewhere.
"""

from jfrnn.kernels._series import SERIES, VECTOR_SERIES, fill, for_each
from jfrnn.kernels._text import read_part

# What stands for what in the texts below, once for each width.
_FLOATS = (
    {"REAL": "f32", "WHOLE": "i32", "NUMBER": "float", "_S": "f", "LIMIT": "0x1p+31f", "MOST": "0x1.fffffep+127f"},
    {"REAL": "f64", "WHOLE": "i64", "NUMBER": "double", "_S": "", "LIMIT": "0x1p+63", "MOST": "0x1.fffffffffffffp+1023"},
)
_WHOLES = (
    {"WHOLE": "i32", "NATURAL": "u32", "NUMBER": "int", "LEAST": "(-2147483647 - 1)"},
    {"WHOLE": "i64", "NATURAL": "u64", "NUMBER": "long long", "LEAST": "(-9223372036854775807ll - 1)"},
)
_TYPES = (
    {"TYPE": "f32", "WHOLE": "i32"},
    {"TYPE": "f64", "WHOLE": "i64"},
    {"TYPE": "i32", "WHOLE": "i32"},
    {"TYPE": "i64", "WHOLE": "i64"},
)


# --- types and arithmetic ---------------------------------------------------------------------------------------------

_SCALAR_START = read_part("math_parts.h", "scalar_start")
_VECTOR_START = read_part("math_parts.h", "vector_start")
_END = read_part("math_parts.h", "end")

_SCALAR_FLOAT = read_part("math_parts.h", "scalar_float")
_VECTOR_FLOAT = read_part("math_parts.h", "vector_float")
_SCALAR_SELECT = read_part("math_parts.h", "scalar_select")
_VECTOR_SELECT = read_part("math_parts.h", "vector_select")
_COMPARISONS = read_part("math_parts.h", "comparisons")
_FLAGS = read_part("math_parts.h", "flags")
_FLOAT = read_part("math_parts.h", "float")
_WHOLE = read_part("math_parts.h", "whole")
_WHOLE_OF = read_part("math_parts.h", "whole_of")
_CONVERSIONS = read_part("math_parts.h", "conversions")

# --- functions --------------------------------------------------------------------------------------------------------

_CALL = {"SCALAR": read_part("math_parts.h", "scalar_call"), "VECTOR": read_part("math_parts.h", "vector_call")}
_CALL_OF_TWO = {
    "SCALAR": read_part("math_parts.h", "scalar_call_of_two"),
    "VECTOR": read_part("math_parts.h", "vector_call_of_two"),
}
_WHOLE_CALL = {
    "SCALAR": read_part("math_parts.h", "scalar_whole_call"),
    "VECTOR": _CALL_OF_TWO["VECTOR"].replace("REAL", "WHOLE").replace("::CALL_S", "CALL"),
}


def _named(text: str, names: dict[str, str]) -> str:
    """Return the text once for each function, with what it calls."""
    return "".join(fill(text.replace("CALL", call), NAME=name) for name, call in names.items())


_LINKED = {name: name for name in ("asin", "acos", "atan", "cbrt", "erf", "erfc")}  # lane by lane in both widths
_IN_SERIES = {name: name for name in ("exp", "exp2", "log", "tanh", "sin", "cos", "tan")}
_FLOAT_SERIES = {name: name for name in ("sinh", "cosh")}  # in float32 alone
_NOT_LINKED = {name: name for name in ("expm1", "log1p")}
_TWO = {"atan2": "atan2", "rem": "fmod"}
_FAR = {f"called_{name}": name for name in ("sin", "cos", "tan")}
_LOGISTIC = read_part("math_parts.h", "logistic")


def _shared(kind: str) -> str:
    """Return what is written alike for both kinds."""
    division = _named(_WHOLE_CALL[kind], {"div": "quotient", "rem": "remainder"})
    comparisons = for_each(_TYPES, _COMPARISONS) + _FLAGS
    return comparisons + for_each(_FLOATS, _FLOAT, _LOGISTIC) + for_each(_WHOLES, _WHOLE_OF, _WHOLE, division) + _CONVERSIONS


def _scalar() -> str:
    start = [_SCALAR_START, for_each(_FLOATS, _SCALAR_FLOAT), for_each(_TYPES, _SCALAR_SELECT), _shared("SCALAR")]
    of_one, of_two = _CALL["SCALAR"], _CALL_OF_TWO["SCALAR"]
    calls = _named(of_one, _LINKED | _IN_SERIES | _FLOAT_SERIES) + _named(of_two, _TWO | {"pow": "pow"})
    missing = ["#if defined(__CUDA_ARCH__)\n", for_each(_FLOATS, _named(of_one, _NOT_LINKED)), "#else\n"]
    missing += [SERIES, "#endif\n"]
    return "".join([*start, for_each(_FLOATS, calls), *missing, _END])


def _vector() -> str:
    start = [_VECTOR_START, for_each(_FLOATS, _VECTOR_FLOAT), for_each(_TYPES, _VECTOR_SELECT), _shared("VECTOR")]
    of_one, of_two = _CALL["VECTOR"], _CALL_OF_TWO["VECTOR"]
    calls = [for_each(_FLOATS, _named(of_one, _LINKED) + _named(of_two, _TWO))]
    calls += [for_each(_FLOATS[1:], _named(of_one, _FLOAT_SERIES | _FAR) + _named(of_two, {"pow": "pow"}))]
    return "".join([*start, *calls, SERIES, VECTOR_SERIES, _END])


SCALAR = _scalar()
VECTOR = _vector()
