"""The functions that translated text calls (see `jfrnn._translate`), as native C++ text: the struct `Math`, in two kinds.

`SCALAR` is one number at a time, for Clang on the CPU and for NVRTC on CUDA. `VECTOR` is LANES numbers at a time in Clang's vector
types, on the CPU; where it stands, `LANES` is a constant expression, a power of two. Both define the same overloads of the types
`Math::f32`, `f64`, `i32`, `i64` and `flag`, so that one text compiles for each. Both are pieces of a function body.

Edge cases are JAX's: max and min hand NaN on, sign(0) is 0, integers wrap, x / 0 is -1 and x % 0 is x for integers, floats beyond
the range of integers saturate, and NaN becomes 0. Denormals are kept, if the block clears the processor's flush modes (`ENTER` of
`jfrnn.kernels._native`); XLA on the CPU flushes them. Nothing uses CUDA's fast approximations.

Warp's compiler for the CPU links the functions of the C library from a list of its own, which has neither expm1 nor log1p: there
these two are series in both kinds. `VECTOR` takes more series, in double precision also for float32, where they are an order of
magnitude faster than one call per lane, and calls the C library lane by lane elsewhere.
"""

import math
import re

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


def _fill(text: str, **names: str) -> str:
    """Return the text with names replaced: whole words, or what ends in a name that starts with an underscore."""
    pattern = "|".join(rf"{name}\b" if name[0] == "_" else rf"\b{name}\b" for name in names)
    return re.sub(pattern, lambda match: names[match[0]], text)


def _for_each(types: tuple[dict[str, str], ...], *texts: str) -> str:
    return "".join(_fill(text, **names) for names in types for text in texts)


def _polynomial(x: str, coefficients: list[float]) -> str:
    """Return an expression for a polynomial of f64 in Horner's form; its coefficients start at the lowest power."""
    text = f"of({coefficients[-1].hex()})"
    for c in reversed(coefficients[:-1]):
        text = f"mad({text}, {x}, of({c.hex()}))"
    return text


# --- types and arithmetic ---------------------------------------------------------------------------------------------

_SCALAR_START = """
#if defined(__CUDA_ARCH__)
#define JFRNN_MATH static __device__ __forceinline__
#else
#define JFRNN_MATH static inline __attribute__((always_inline))
#endif
#define JFRNN_TRUTH(comparison) (comparison)
#define JFRNN_CONVERT(x, type) ((type)(x))
struct Math {
typedef float f32;
typedef double f64;
typedef int i32;
typedef long long i64;
typedef bool flag;
typedef unsigned int u32;
typedef unsigned long long u64;
JFRNN_MATH f32 of_bits(unsigned int b) { f32 x; memcpy(&x, &b, 4); return x; }
JFRNN_MATH f64 of_bits(unsigned long long b) { f64 x; memcpy(&x, &b, 8); return x; }
JFRNN_MATH i32 bits(f32 x) { i32 b; memcpy(&b, &x, 4); return b; }
JFRNN_MATH i64 bits(f64 x) { i64 b; memcpy(&b, &x, 8); return b; }
JFRNN_MATH f32 with_bits(i32 b) { return of_bits((u32)b); }
JFRNN_MATH f64 with_bits(i64 b) { return of_bits((u64)b); }
JFRNN_MATH flag of(bool x) { return x; }
"""
_VECTOR_START = """
#define JFRNN_MATH static inline __attribute__((always_inline))
#define JFRNN_TRUTH(comparison) __builtin_convertvector(comparison, flag)
#define JFRNN_CONVERT(x, type) __builtin_convertvector(x, type)
struct Math {
enum { WIDTH = LANES };
typedef float f32 __attribute__((vector_size(4 * WIDTH)));
typedef double f64 __attribute__((vector_size(8 * WIDTH)));
typedef int i32 __attribute__((vector_size(4 * WIDTH)));
typedef long long i64 __attribute__((vector_size(8 * WIDTH)));
typedef bool flag __attribute__((ext_vector_type(WIDTH)));
typedef unsigned int u32 __attribute__((vector_size(4 * WIDTH)));
typedef unsigned long long u64 __attribute__((vector_size(8 * WIDTH)));
JFRNN_MATH f32 of_bits(unsigned int b) { return (f32)(u32{} + b); }
JFRNN_MATH f64 of_bits(unsigned long long b) { return (f64)(u64{} + b); }
JFRNN_MATH i32 bits(f32 x) { return (i32)x; }
JFRNN_MATH i64 bits(f64 x) { return (i64)x; }
JFRNN_MATH f32 with_bits(i32 b) { return (f32)b; }
JFRNN_MATH f64 with_bits(i64 b) { return (f64)b; }
JFRNN_MATH flag of(bool x) { return JFRNN_TRUTH(i32{} + (x ? 1 : 0)); }
"""
_END = """
};
#undef JFRNN_MATH
#undef JFRNN_TRUTH
#undef JFRNN_CONVERT
"""

_SCALAR_FLOAT = """
JFRNN_MATH REAL of(NUMBER x) { return x; }
JFRNN_MATH REAL abs(REAL x) { return ::fabs_S(x); }
JFRNN_MATH REAL sqrt(REAL x) { return ::sqrt_S(x); }
JFRNN_MATH REAL floor(REAL x) { return ::floor_S(x); }
JFRNN_MATH REAL ceil(REAL x) { return ::ceil_S(x); }
JFRNN_MATH REAL round(REAL x) { return ::round_S(x); }
JFRNN_MATH REAL round_even(REAL x) { return ::rint_S(x); }
"""
_VECTOR_FLOAT = """
JFRNN_MATH REAL of(NUMBER x) { return x - REAL{}; }  // a sum would lose -0
JFRNN_MATH REAL abs(REAL x) { return __builtin_elementwise_abs(x); }
JFRNN_MATH REAL sqrt(REAL x) { return __builtin_elementwise_sqrt(x); }
JFRNN_MATH REAL floor(REAL x) { return __builtin_elementwise_floor(x); }
JFRNN_MATH REAL ceil(REAL x) { return __builtin_elementwise_ceil(x); }
JFRNN_MATH REAL round(REAL x) { return __builtin_elementwise_round(x); }
JFRNN_MATH REAL round_even(REAL x) { return __builtin_elementwise_roundeven(x); }
"""
_SCALAR_SELECT = """
JFRNN_MATH TYPE select(flag c, TYPE a, TYPE b) { return c ? a : b; }
"""
_VECTOR_SELECT = """
JFRNN_MATH TYPE select(flag c, TYPE a, TYPE b) { return JFRNN_CONVERT(c, WHOLE) != WHOLE{} ? a : b; }
"""
_COMPARISONS = """
JFRNN_MATH flag eq(TYPE x, TYPE y) { return JFRNN_TRUTH(x == y); }
JFRNN_MATH flag ne(TYPE x, TYPE y) { return JFRNN_TRUTH(x != y); }
JFRNN_MATH flag lt(TYPE x, TYPE y) { return JFRNN_TRUTH(x < y); }
JFRNN_MATH flag le(TYPE x, TYPE y) { return JFRNN_TRUTH(x <= y); }
JFRNN_MATH flag gt(TYPE x, TYPE y) { return JFRNN_TRUTH(x > y); }
JFRNN_MATH flag ge(TYPE x, TYPE y) { return JFRNN_TRUTH(x >= y); }
"""
_FLAGS = """
JFRNN_MATH flag both(flag x, flag y) { return x & y; }
JFRNN_MATH flag either(flag x, flag y) { return x | y; }
JFRNN_MATH flag differ(flag x, flag y) { return x ^ y; }
JFRNN_MATH flag inverse(flag x) { return x ^ of(true); }
JFRNN_MATH flag eq(flag x, flag y) { return inverse(differ(x, y)); }
JFRNN_MATH flag ne(flag x, flag y) { return x ^ y; }
JFRNN_MATH flag lt(flag x, flag y) { return inverse(x) & y; }
JFRNN_MATH flag le(flag x, flag y) { return inverse(x) | y; }
JFRNN_MATH flag gt(flag x, flag y) { return x & inverse(y); }
JFRNN_MATH flag ge(flag x, flag y) { return x | inverse(y); }
JFRNN_MATH flag max(flag x, flag y) { return x | y; }
JFRNN_MATH flag min(flag x, flag y) { return x & y; }
JFRNN_MATH flag select(flag c, flag a, flag b) { return (c & a) | (inverse(c) & b); }
"""
_FLOAT = """
JFRNN_MATH flag to_flag(REAL x) { return ne(x, of((NUMBER)0)); }
JFRNN_MATH flag is_finite(REAL x) { return le(abs(x), of(MOST)); }
JFRNN_MATH REAL max(REAL x, REAL y) { return select(either(gt(x, y), ne(x, x)), x, y); }
JFRNN_MATH REAL min(REAL x, REAL y) { return select(either(lt(x, y), ne(x, x)), x, y); }
JFRNN_MATH REAL clamp(REAL low, REAL x, REAL high) { return min(max(low, x), high); }
JFRNN_MATH REAL with_sign(REAL x, REAL s) { return with_bits(bits(x) | (bits(s) & bits(of((NUMBER)-0.0)))); }  // x >= 0
JFRNN_MATH REAL sign(REAL x) { return select(gt(abs(x), of((NUMBER)0)), with_sign(of((NUMBER)1), x), x); }
JFRNN_MATH REAL rsqrt(REAL x) { return of((NUMBER)1) / sqrt(x); }
JFRNN_MATH WHOLE truncated(REAL x) {
    const REAL limit = of((NUMBER)LIMIT);
    const WHOLE least = bits(of((NUMBER)-0.0)), inside = JFRNN_CONVERT(select(lt(abs(x), limit), x, of((NUMBER)0)), WHOLE);
    return select(ge(x, limit), ~least, select(le(x, -limit), least, inside));
}
"""
_WHOLE = """
JFRNN_MATH WHOLE add(WHOLE x, WHOLE y) { return (WHOLE)((NATURAL)x + (NATURAL)y); }
JFRNN_MATH WHOLE sub(WHOLE x, WHOLE y) { return (WHOLE)((NATURAL)x - (NATURAL)y); }
JFRNN_MATH WHOLE mul(WHOLE x, WHOLE y) { return (WHOLE)((NATURAL)x * (NATURAL)y); }
JFRNN_MATH WHOLE neg(WHOLE x) { return (WHOLE)(NATURAL{} - (NATURAL)x); }
JFRNN_MATH WHOLE both(WHOLE x, WHOLE y) { return x & y; }
JFRNN_MATH WHOLE either(WHOLE x, WHOLE y) { return x | y; }
JFRNN_MATH WHOLE differ(WHOLE x, WHOLE y) { return x ^ y; }
JFRNN_MATH WHOLE inverse(WHOLE x) { return ~x; }
JFRNN_MATH WHOLE max(WHOLE x, WHOLE y) { return select(gt(x, y), x, y); }
JFRNN_MATH WHOLE min(WHOLE x, WHOLE y) { return select(lt(x, y), x, y); }
JFRNN_MATH WHOLE clamp(WHOLE low, WHOLE x, WHOLE high) { return min(max(low, x), high); }
JFRNN_MATH WHOLE abs(WHOLE x) { return select(lt(x, WHOLE{}), neg(x), x); }
JFRNN_MATH WHOLE sign(WHOLE x) { return select(gt(x, WHOLE{}), WHOLE{} + 1, select(lt(x, WHOLE{}), WHOLE{} - 1, x)); }
JFRNN_MATH flag to_flag(WHOLE x) { return ne(x, WHOLE{}); }
JFRNN_MATH NUMBER quotient(NUMBER x, NUMBER y) { return y == 0 ? -1 : x == LEAST && y == -1 ? x : x / y; }
JFRNN_MATH NUMBER remainder(NUMBER x, NUMBER y) { return y == 0 ? x : y == -1 ? 0 : x % y; }
"""
_WHOLE_OF = "JFRNN_MATH WHOLE of(NUMBER x) { return WHOLE{} + x; }\n"
_CONVERSIONS = """
JFRNN_MATH f32 to_f32(f64 x) { return JFRNN_CONVERT(x, f32); }
JFRNN_MATH f32 to_f32(i32 x) { return JFRNN_CONVERT(x, f32); }
JFRNN_MATH f32 to_f32(i64 x) { return JFRNN_CONVERT(x, f32); }
JFRNN_MATH f32 to_f32(flag x) { return select(x, of(1.0f), of(0.0f)); }
JFRNN_MATH f64 to_f64(f32 x) { return JFRNN_CONVERT(x, f64); }
JFRNN_MATH f64 to_f64(i32 x) { return JFRNN_CONVERT(x, f64); }
JFRNN_MATH f64 to_f64(i64 x) { return JFRNN_CONVERT(x, f64); }
JFRNN_MATH f64 to_f64(flag x) { return select(x, of(1.0), of(0.0)); }
JFRNN_MATH i32 to_i32(i64 x) { return JFRNN_CONVERT(x, i32); }
JFRNN_MATH i32 to_i32(flag x) { return select(x, of(1), of(0)); }
JFRNN_MATH i32 to_i32(f32 x) { return truncated(x); }
JFRNN_MATH i32 to_i32(f64 x) {
    const f64 above = select(lt(x, of(-2147483648.0)), of(-2147483648.0), x);
    return JFRNN_CONVERT(truncated(select(gt(above, of(2147483647.0)), of(2147483647.0), above)), i32);
}
JFRNN_MATH i64 to_i64(i32 x) { return JFRNN_CONVERT(x, i64); }
JFRNN_MATH i64 to_i64(flag x) { return select(x, of(1ll), of(0ll)); }
JFRNN_MATH i64 to_i64(f32 x) { return truncated(to_f64(x)); }
JFRNN_MATH i64 to_i64(f64 x) { return truncated(x); }
"""

# --- functions --------------------------------------------------------------------------------------------------------

_CALL = {
    "SCALAR": "JFRNN_MATH REAL NAME(REAL x) { return ::CALL_S(x); }\n",
    "VECTOR": """
JFRNN_MATH REAL NAME(REAL x) {
    REAL z;
    for (int l = 0; l < WIDTH; ++l)
        z[l] = ::CALL_S(x[l]);
    return z;
}
""",
}
_CALL_OF_TWO = {
    "SCALAR": "JFRNN_MATH REAL NAME(REAL x, REAL y) { return ::CALL_S(x, y); }\n",
    "VECTOR": """
JFRNN_MATH REAL NAME(REAL x, REAL y) {
    REAL z;
    for (int l = 0; l < WIDTH; ++l)
        z[l] = ::CALL_S(x[l], y[l]);
    return z;
}
""",
}
_WHOLE_CALL = {
    "SCALAR": "JFRNN_MATH WHOLE NAME(WHOLE x, WHOLE y) { return CALL(x, y); }\n",
    "VECTOR": _CALL_OF_TWO["VECTOR"].replace("REAL", "WHOLE").replace("::CALL_S", "CALL"),
}
_WIDENED = "JFRNN_MATH f32 NAME(f32 x) { return to_f32(NAME(to_f64(x))); }\n"


def _named(text: str, names: dict[str, str]) -> str:
    """Return the text once for each function, with what it calls."""
    return "".join(_fill(text.replace("CALL", call), NAME=name) for name, call in names.items())


_LINKED = {name: name for name in ("asin", "acos", "atan", "cbrt", "erf", "erfc")}  # lane by lane in both widths
_IN_SERIES = {name: name for name in ("exp", "exp2", "log", "sin", "cos", "tan", "tanh")}
_FLOAT_SERIES = {name: name for name in ("sinh", "cosh")}  # in float32 alone
_NOT_LINKED = {name: name for name in ("expm1", "log1p")}
_TWO = {"atan2": "atan2", "rem": "fmod"}
_FAR = {f"called_{name}": name for name in ("sin", "cos", "tan")}
_LOGISTIC = "JFRNN_MATH REAL logistic(REAL x) { return of((NUMBER)1) / (of((NUMBER)1) + exp(-x)); }\n"

_FACTORS = [1 / math.factorial(k) for k in range(20)]
_LOG = [2 / (2 * k + 3) for k in range(11)]
_LN2 = ["0x1.62e42fee00000p-1", "0x1.a39ef35793c76p-33"]  # in parts: 33 bits times an integer of 20 bits are exact
_HALF_PI = ["0x1.921fb54400000p+0", "0x1.0b4611a600000p-34", "0x1.3198a2e037073p-69"]
_SINE = [(-1) ** k * _FACTORS[2 * k + 1] for k in range(1, 9)]
_COSINE = [(-1) ** k * _FACTORS[2 * k] for k in range(2, 10)]

# Taylor series on small intervals. What is added to `shift` is rounded to an integer, which its low bits then hold.
_SERIES = f"""
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
JFRNN_MATH f64 mad(f64 x, f64 y, f64 z) {{ return __builtin_elementwise_fma(x, y, z); }}
#else
JFRNN_MATH f64 mad(f64 x, f64 y, f64 z) {{ return x * y + z; }}
#endif
JFRNN_MATH f64 shift() {{ return of(0x1.8p+52); }}
JFRNN_MATH f64 power_of_two(f64 shifted) {{ return with_bits((i64)(((u64)bits(shifted) + 1023) << 52)); }}
JFRNN_MATH f64 between(f64 low, f64 x, f64 high) {{  // NaN stays
    const f64 y = select(lt(x, low), low, x);
    return select(gt(y, high), high, y);
}}
JFRNN_MATH f64 less_powers(f64 x, f64 n) {{ return mad(n, of(-{_LN2[1]}), mad(n, of(-{_LN2[0]}), x)); }}  // x - n ln 2
JFRNN_MATH f64 small_expm1(f64 r) {{ return mad({_polynomial("r", _FACTORS[2:14])} * r, r, r); }}  // |r| < 0.35
JFRNN_MATH f64 expm1(f64 x) {{
    const f64 y = between(of(-40.0), x, of(710.0)), t = mad(y, of({math.log2(math.e).hex()}), shift()), n = t - shift();
    const f64 p = small_expm1(less_powers(y, n)), a = power_of_two(t - of(1.0)), half = mad(a, p, a - of(0.5));
    return select(eq(x, of(0.0)), x, half + half);
}}
JFRNN_MATH f64 log1p(f64 x) {{
    const f64 u = of(1.0) + x, rest = (x - (u - of(1.0))) / u, found = log(u);
    return select(eq(u, of(1.0)), x, select(is_finite(found), found + rest, found));
}}
"""
_VECTOR_SERIES = f"""
JFRNN_MATH f64 log(f64 x) {{
    const flag tiny = lt(x, of(0x1p-1022));
    const f64 y = select(tiny, x * of(0x1p+54), x), from = select(tiny, of(0x1.8p+52 + 54), shift());
    const i64 root = bits(of({math.sqrt(0.5).hex()})), b = bits(y) - root;  // y = 2^n (1 + f), between sqrt(1/2) and sqrt(2)
    const f64 n = with_bits(bits(shift()) + (b >> 52)) - from;
    const f64 f = with_bits((b & (i64{{}} + 0xfffffffffffffll)) + root) - of(1.0), s = f / (of(2.0) + f), z = s * s;
    const f64 small = mad(s, f - z * {_polynomial("z", _LOG)}, n * of(-{_LN2[1]}));
    const f64 found = mad(n, of({_LN2[0]}), f - small);
    const f64 edge = select(eq(x, of(0.0)), of(-__builtin_inf()), select(lt(x, of(0.0)), of(__builtin_nan("")), x));
    return select(both(gt(x, of(0.0)), is_finite(x)), found, edge);
}}
JFRNN_MATH f64 scaled_exp(f64 y, f64 r, f64 t) {{  // 2^(t - shift) e^r, in two steps where it may be denormal
    const f64 h = mad(t - shift(), of(0.5), shift()), a = power_of_two(h), b = power_of_two(t - (h - shift()));
    return mad(a, small_expm1(r), a) * b;
}}
JFRNN_MATH f64 exp(f64 x) {{
    const f64 y = between(of(-746.0), x, of(710.0)), t = mad(y, of({math.log2(math.e).hex()}), shift());
    return scaled_exp(y, less_powers(y, t - shift()), t);
}}
JFRNN_MATH f64 exp2(f64 x) {{
    const f64 y = between(of(-1080.0), x, of(1025.0)), t = y + shift();
    return scaled_exp(y, (y - (t - shift())) * of({math.log(2).hex()}), t);
}}
JFRNN_MATH f64 tanh(f64 x) {{
    const f64 e = expm1(of(-2.0) * abs(x));
    return select(eq(x, of(0.0)), x, with_sign(-e / (of(2.0) + e), x));
}}
JFRNN_MATH bool far(f64 x) {{  // any of them is too far for `turns`, or no number
    return __builtin_reduce_and(JFRNN_CONVERT(le(abs(x), of(1e6)), i32)) == 0;
}}
JFRNN_MATH f64 less_turns(f64 x, f64 n) {{  // x - n pi / 2
    return mad(n, of(-{_HALF_PI[2]}), mad(n, of(-{_HALF_PI[1]}), mad(n, of(-{_HALF_PI[0]}), x)));
}}
JFRNN_MATH f64 small_sin(f64 r) {{ const f64 z = r * r; return mad({_polynomial("z", _SINE)} * z, r, r); }}
JFRNN_MATH f64 small_cos(f64 r) {{
    const f64 z = r * r;
    return of(1.0) + mad(z, of(-0.5), {_polynomial("z", _COSINE)} * z * z);
}}
JFRNN_MATH f64 sin_cos(f64 x, i64 quarter) {{  // sin(x + quarter pi / 2)
    const f64 t = mad(x, of({(2 / math.pi).hex()}), shift()), r = less_turns(x, t - shift());
    const i64 q = bits(t) + quarter;
    const f64 y = select(ne(q & 1, i64{{}}), small_cos(r), small_sin(r));
    return with_bits(bits(y) ^ (i64)((u64)(q & 2) << 62));
}}
JFRNN_MATH f64 sin(f64 x) {{
    if (far(x))
        return called_sin(x);
    return select(eq(x, of(0.0)), x, sin_cos(x, i64{{}}));
}}
JFRNN_MATH f64 cos(f64 x) {{
    if (far(x))
        return called_cos(x);
    return sin_cos(x, i64{{}} + 1);
}}
JFRNN_MATH f64 tan(f64 x) {{
    if (far(x))
        return called_tan(x);
    return select(eq(x, of(0.0)), x, sin_cos(x, i64{{}}) / sin_cos(x, i64{{}} + 1));
}}
JFRNN_MATH f32 sinh(f32 x) {{
    const f64 e = expm1(to_f64(abs(x)));
    return with_sign(to_f32(select(is_finite(e), of(0.5) * (e + e / (e + of(1.0))), e)), x);
}}
JFRNN_MATH f32 cosh(f32 x) {{
    const f64 e = exp(to_f64(abs(x)));
    return to_f32(of(0.5) * (e + of(1.0) / e));
}}
JFRNN_MATH f32 pow(f32 base, f32 power) {{  // in double precision the error of y log x is out of sight
    const f64 one = of(1.0), x = to_f64(base), y = to_f64(power), size = abs(x);
    const flag whole = eq(round_even(y), y), odd = both(whole, ne(round_even(y * of(0.5)) * of(2.0), y));
    const flag still = both(eq(size, one), eq(y, y));  // else 0 * inf
    const f64 z = exp(select(still, of(0.0), y * log(size)));
    const f64 defined = select(both(lt(x, of(0.0)), both(inverse(whole), is_finite(x))), of(__builtin_nan("")), z);
    const f64 signed_power = select(both(odd, lt(with_sign(one, x), of(0.0))), -defined, defined);
    return to_f32(select(either(eq(x, one), eq(y, of(0.0))), one, signed_power));
}}
"""


def _shared(kind: str) -> str:
    """Return what is written alike for both kinds."""
    division = _named(_WHOLE_CALL[kind], {"div": "quotient", "rem": "remainder"})
    comparisons = _for_each(_TYPES, _COMPARISONS) + _FLAGS
    return comparisons + _for_each(_FLOATS, _FLOAT, _LOGISTIC) + _for_each(_WHOLES, _WHOLE_OF, _WHOLE, division) + _CONVERSIONS


def _scalar() -> str:
    start = [_SCALAR_START, _for_each(_FLOATS, _SCALAR_FLOAT), _for_each(_TYPES, _SCALAR_SELECT), _shared("SCALAR")]
    of_one, of_two = _CALL["SCALAR"], _CALL_OF_TWO["SCALAR"]
    calls = _named(of_one, _LINKED | _IN_SERIES | _FLOAT_SERIES) + _named(of_two, _TWO | {"pow": "pow"})
    missing = ["#if defined(__CUDA_ARCH__)\n", _for_each(_FLOATS, _named(of_one, _NOT_LINKED)), "#else\n"]
    missing += [_SERIES, _named(_WIDENED, _NOT_LINKED), "#endif\n"]
    return "".join([*start, _for_each(_FLOATS, calls), *missing, _END])


def _vector() -> str:
    start = [_VECTOR_START, _for_each(_FLOATS, _VECTOR_FLOAT), _for_each(_TYPES, _VECTOR_SELECT), _shared("VECTOR")]
    of_one, of_two = _CALL["VECTOR"], _CALL_OF_TWO["VECTOR"]
    calls = [_for_each(_FLOATS, _named(of_one, _LINKED) + _named(of_two, _TWO))]
    calls += [_for_each(_FLOATS[1:], _named(of_one, _FLOAT_SERIES | _FAR) + _named(of_two, {"pow": "pow"}))]
    return "".join([*start, *calls, _SERIES, _VECTOR_SERIES, _named(_WIDENED, _NOT_LINKED | _IN_SERIES), _END])


SCALAR = _scalar()
VECTOR = _vector()
