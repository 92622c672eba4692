"""Elementary functions as Taylor series on small intervals, for many lanes at a time: text for the struct `Math`.

Each is reduced to a small interval first: exp by multiples of ln 2, log by powers of two, sin and cos by quarters of a turn;
constants are split so that the products of their leading parts are exact, with or without fused operations. What is added to SHIFT
is rounded to an integer, which its low bits then hold. Errors, in units in the last place:

| function | float32 | float64 |
| --- | --- | --- |
| exp, exp2, log | 1 | 1 |
| expm1, log1p | 2 | 2 |
| tanh | 3 | 3 |
| sin, cos, sinh, cosh, pow | 0.6, by way of double precision | 1.5 for sin and cos, the others by lanes |
| tan | 0.6, by way of double precision | 3 |
"""

import math
import re


def fill(text: str, **names: str) -> str:
    """Return the text with names replaced: whole words, or what ends in a name that starts with an underscore."""
    pattern = "|".join(rf"{name}\b" if name[0] == "_" else rf"\b{name}\b" for name in names)
    return re.sub(pattern, lambda match: names[match[0]], text)


def for_each(types: tuple[dict[str, str], ...], *texts: str) -> str:
    """Return the texts once for each of some types."""
    return "".join(fill(text, **names) for names in types for text in texts)


def _polynomial(x: str, coefficients: list[float]) -> str:
    """Return an expression for a polynomial of REAL in Horner's form; its coefficients start at the lowest power."""
    text = f"of((NUMBER){coefficients[-1].hex()})"
    for c in reversed(coefficients[:-1]):
        text = f"mad({text}, {x}, of((NUMBER){c.hex()}))"
    return text


_FACTORS = [1 / math.factorial(k) for k in range(20)]
_LOG = [2 / (2 * k + 3) for k in range(11)]
_SINE = [(-1) ** k * _FACTORS[2 * k + 1] for k in range(1, 9)]
_COSINE = [(-1) ** k * _FACTORS[2 * k] for k in range(2, 10)]
_HALF_PI = ["0x1.921fb54400000p+0", "0x1.0b4611a600000p-34", "0x1.3198a2e037073p-69"]  # its sum; 33 bits in each of the first two

_FLOAT = {"REAL": "f32", "WHOLE": "i32", "NATURAL": "u32", "NUMBER": "float", "DIGITS": "23", "BIAS": "127"}
_FLOAT |= {"SHIFT": "0x1.8p+23f", "LN2_HIGH": "0x1.62e4p-1f", "LN2_LOW": "0x1.7f7d1cp-20f", "MANTISSA": "0x7fffff"}
_FLOAT |= {"EXP_LEAST": "-104.0f", "EXP_MOST": "89.0f", "EXP2_LEAST": "-151.0f", "EXP2_MOST": "129.0f", "EXPM1_LEAST": "-20.0f"}
_FLOAT |= {"NORMAL": "0x1p-126f", "UP": "25"}
_DOUBLE = {"REAL": "f64", "WHOLE": "i64", "NATURAL": "u64", "NUMBER": "double", "DIGITS": "52", "BIAS": "1023"}
_DOUBLE |= {"SHIFT": "0x1.8p+52", "LN2_HIGH": "0x1.62e42fee00000p-1", "LN2_LOW": "0x1.a39ef35793c76p-33"}
_DOUBLE |= {"MANTISSA": "0xfffffffffffffll", "EXP_LEAST": "-746.0", "EXP_MOST": "710.0", "EXP2_LEAST": "-1080.0"}
_DOUBLE |= {"EXP2_MOST": "1025.0", "EXPM1_LEAST": "-40.0", "NORMAL": "0x1p-1022", "UP": "54"}
_POLYNOMIALS = (
    {"EXP_SERIES": _polynomial("r", _FACTORS[2:8]), "LOG_SERIES": _polynomial("z", _LOG[:4])},
    {"EXP_SERIES": _polynomial("r", _FACTORS[2:14]), "LOG_SERIES": _polynomial("z", _LOG)},
)


def _in_both(text: str) -> str:
    return "".join(fill(fill(text, **series), **names) for series, names in zip(_POLYNOMIALS, (_FLOAT, _DOUBLE), strict=True))


SERIES = _in_both(f"""
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
JFRNN_MATH REAL mad(REAL x, REAL y, REAL z) {{ return __builtin_elementwise_fma(x, y, z); }}
#else
JFRNN_MATH REAL mad(REAL x, REAL y, REAL z) {{ return x * y + z; }}
#endif
JFRNN_MATH REAL shifted(REAL x) {{ return x + of(SHIFT); }}
JFRNN_MATH REAL power_of_two(REAL t) {{ return with_bits((WHOLE)(((NATURAL)bits(t) + BIAS) << DIGITS)); }}  // t is shifted
JFRNN_MATH REAL between(REAL low, REAL x, REAL high) {{  // NaN stays
    const REAL y = select(lt(x, low), low, x);
    return select(gt(y, high), high, y);
}}
JFRNN_MATH REAL powers_in(REAL x) {{ return shifted(x * of((NUMBER){math.log2(math.e).hex()})); }}
JFRNN_MATH REAL less_powers(REAL x, REAL n) {{ return mad(n, of(-LN2_LOW), mad(n, of(-LN2_HIGH), x)); }}  // x - n ln 2
JFRNN_MATH REAL small_expm1(REAL r) {{ return mad(EXP_SERIES * r, r, r); }}  // |r| < 0.35
JFRNN_MATH REAL expm1(REAL x) {{
    const REAL y = between(of(EXPM1_LEAST), x, of(EXP_MOST)), t = powers_in(y);
    const REAL p = small_expm1(less_powers(y, t - of(SHIFT)));
    const REAL a = power_of_two(t - of((NUMBER)1)), half = mad(a, p, a - of((NUMBER)0.5));
    return select(eq(x, of((NUMBER)0)), x, half + half);
}}
JFRNN_MATH REAL log1p(REAL x) {{
    const REAL one = of((NUMBER)1), u = one + x, rest = (x - (u - one)) / u, found = log(u);
    return select(eq(u, one), x, select(is_finite(found), found + rest, found));
}}
""")

VECTOR_SERIES = _in_both(f"""
JFRNN_MATH REAL log(REAL x) {{
    const flag denormal = lt(x, of(NORMAL));
    const REAL y = select(denormal, x * of((NUMBER)(1ll << UP)), x), zero = select(denormal, of(SHIFT + UP), of(SHIFT));
    const WHOLE root = bits(of((NUMBER){math.sqrt(0.5).hex()})), b = bits(y) - root;  // y = 2^n (1 + f), from sqrt(1/2) to sqrt(2)
    const REAL n = with_bits(bits(of(SHIFT)) + (b >> DIGITS)) - zero;
    const REAL f = with_bits((b & (WHOLE{{}} + MANTISSA)) + root) - of((NUMBER)1), s = f / (of((NUMBER)2) + f), z = s * s;
    const REAL found = mad(n, of(LN2_HIGH), f - mad(s, f - z * LOG_SERIES, n * of(-LN2_LOW)));
    const REAL below = select(eq(x, of((NUMBER)0)), of((NUMBER)-__builtin_inf()), of((NUMBER)__builtin_nan("")));
    return select(le(x, of((NUMBER)0)), below, select(is_finite(x), found, x));
}}
JFRNN_MATH REAL scaled_exp(REAL r, REAL t) {{  // 2^n e^r, for n shifted to t; in two steps, since it may be denormal
    const REAL h = shifted((t - of(SHIFT)) * of((NUMBER)0.5)), a = power_of_two(h), b = power_of_two(t - (h - of(SHIFT)));
    return mad(a, small_expm1(r), a) * b;
}}
JFRNN_MATH REAL exp(REAL x) {{
    const REAL y = between(of(EXP_LEAST), x, of(EXP_MOST)), t = powers_in(y);
    return scaled_exp(less_powers(y, t - of(SHIFT)), t);
}}
JFRNN_MATH REAL exp2(REAL x) {{
    const REAL y = between(of(EXP2_LEAST), x, of(EXP2_MOST)), t = shifted(y);
    return scaled_exp((y - (t - of(SHIFT))) * of((NUMBER){math.log(2).hex()}), t);
}}
JFRNN_MATH REAL tanh(REAL x) {{
    const REAL e = expm1(of((NUMBER)-2) * abs(x));
    return select(eq(x, of((NUMBER)0)), x, with_sign(-e / (of((NUMBER)2) + e), x));
}}
""") + fill(
    f"""
JFRNN_MATH bool far(f64 x) {{  // any of them is too far for `less_turns`, or no number
    return __builtin_reduce_and(JFRNN_CONVERT(le(abs(x), of(1e6)), i32)) == 0;
}}
JFRNN_MATH f64 less_turns(f64 x, f64 n) {{  // x - n pi / 2
    return mad(n, of(-{_HALF_PI[2]}), mad(n, of(-{_HALF_PI[1]}), mad(n, of(-{_HALF_PI[0]}), x)));
}}
JFRNN_MATH f64 small_sin(f64 r) {{ const f64 z = r * r; return mad({_polynomial("z", _SINE)} * z, r, r); }}  // |r| < 0.79
JFRNN_MATH f64 small_cos(f64 r) {{
    const f64 z = r * r;
    return of(1.0) + mad(z, of(-0.5), {_polynomial("z", _COSINE)} * z * z);
}}
JFRNN_MATH f64 sin_cos(f64 x, i64 quarter) {{  // sin(x + quarter pi / 2)
    const f64 t = shifted(x * of({(2 / math.pi).hex()})), r = less_turns(x, t - of(SHIFT));
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
JFRNN_MATH f32 sin(f32 x) {{ return to_f32(sin(to_f64(x))); }}
JFRNN_MATH f32 cos(f32 x) {{ return to_f32(cos(to_f64(x))); }}
JFRNN_MATH f32 tan(f32 x) {{ return to_f32(tan(to_f64(x))); }}
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
""",
    **_DOUBLE,
)
