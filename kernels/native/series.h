// --- part: series

#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
JFRNN_MATH REAL mad(REAL x, REAL y, REAL z) { return __builtin_elementwise_fma(x, y, z); }
#else
JFRNN_MATH REAL mad(REAL x, REAL y, REAL z) { return x * y + z; }
#endif
JFRNN_MATH REAL shifted(REAL x) { return x + of(SHIFT); }
JFRNN_MATH REAL power_of_two(REAL t) { return with_bits((WHOLE)(((NATURAL)bits(t) + BIAS) << DIGITS)); }  // t is shifted
JFRNN_MATH REAL between(REAL low, REAL x, REAL high) {  // NaN stays
    const REAL y = select(lt(x, low), low, x);
    return select(gt(y, high), high, y);
}
JFRNN_MATH REAL powers_in(REAL x) { return shifted(x * of((NUMBER)LOG2_E)); }
JFRNN_MATH REAL less_powers(REAL x, REAL n) { return mad(n, of(-LN2_LOW), mad(n, of(-LN2_HIGH), x)); }  // x - n ln 2
JFRNN_MATH REAL small_expm1(REAL r) { return mad(EXP_SERIES * r, r, r); }  // |r| < 0.35
JFRNN_MATH REAL expm1(REAL x) {
    const REAL y = between(of(EXPM1_LEAST), x, of(EXP_MOST)), t = powers_in(y);
    const REAL p = small_expm1(less_powers(y, t - of(SHIFT)));
    const REAL a = power_of_two(t - of((NUMBER)1)), half = mad(a, p, a - of((NUMBER)0.5));
    return select(eq(x, of((NUMBER)0)), x, half + half);
}
JFRNN_MATH REAL log1p(REAL x) {
    const REAL one = of((NUMBER)1), u = one + x, rest = (x - (u - one)) / u, found = log(u);
    return select(eq(u, one), x, select(is_finite(found), found + rest, found));
}
// --- part: vector_series

JFRNN_MATH REAL log(REAL x) {
    const flag denormal = lt(x, of(NORMAL));
    const REAL y = select(denormal, x * of((NUMBER)(1ll << UP)), x), zero = select(denormal, of(SHIFT + UP), of(SHIFT));
    const WHOLE root = bits(of((NUMBER)SQRT_HALF)), b = bits(y) - root;  // y = 2^n (1 + f), from sqrt(1/2) to sqrt(2)
    const REAL n = with_bits(bits(of(SHIFT)) + (b >> DIGITS)) - zero;
    const REAL f = with_bits((b & (WHOLE{} + MANTISSA)) + root) - of((NUMBER)1), s = f / (of((NUMBER)2) + f), z = s * s;
    const REAL found = mad(n, of(LN2_HIGH), f - mad(s, f - z * LOG_SERIES, n * of(-LN2_LOW)));
    const REAL below = select(eq(x, of((NUMBER)0)), of((NUMBER)-__builtin_inf()), of((NUMBER)__builtin_nan("")));
    return select(le(x, of((NUMBER)0)), below, select(is_finite(x), found, x));
}
JFRNN_MATH REAL scaled_exp(REAL r, REAL t) {  // 2^n e^r, for n shifted to t; in two steps, since it may be denormal
    const REAL h = shifted((t - of(SHIFT)) * of((NUMBER)0.5)), a = power_of_two(h), b = power_of_two(t - (h - of(SHIFT)));
    return mad(a, small_expm1(r), a) * b;
}
JFRNN_MATH REAL exp(REAL x) {
    const REAL y = between(of(EXP_LEAST), x, of(EXP_MOST)), t = powers_in(y);
    return scaled_exp(less_powers(y, t - of(SHIFT)), t);
}
JFRNN_MATH REAL exp2(REAL x) {
    const REAL y = between(of(EXP2_LEAST), x, of(EXP2_MOST)), t = shifted(y);
    return scaled_exp((y - (t - of(SHIFT))) * of((NUMBER)LN_2), t);
}
JFRNN_MATH REAL tanh(REAL x) {
    const REAL e = expm1(of((NUMBER)-2) * abs(x));
    return select(eq(x, of((NUMBER)0)), x, with_sign(-e / (of((NUMBER)2) + e), x));
}
// --- part: double_series

JFRNN_MATH bool far(f64 x) {  // any of them is too far for `less_turns`, or no number
    return __builtin_reduce_and(JFRNN_CONVERT(le(abs(x), of(1e6)), i32)) == 0;
}
JFRNN_MATH f64 less_turns(f64 x, f64 n) {  // x - n pi / 2
    return mad(n, of(-HALF_PI_LOW), mad(n, of(-HALF_PI_MIDDLE), mad(n, of(-HALF_PI_HIGH), x)));
}
JFRNN_MATH f64 small_sin(f64 r) { const f64 z = r * r; return mad(SINE_SERIES * z, r, r); }  // |r| < 0.79
JFRNN_MATH f64 small_cos(f64 r) {
    const f64 z = r * r;
    return of(1.0) + mad(z, of(-0.5), COSINE_SERIES * z * z);
}
JFRNN_MATH f64 sin_cos(f64 x, i64 quarter) {  // sin(x + quarter pi / 2)
    const f64 t = shifted(x * of(TWO_OVER_PI)), r = less_turns(x, t - of(SHIFT));
    const i64 q = bits(t) + quarter;
    const f64 y = select(ne(q & 1, i64{}), small_cos(r), small_sin(r));
    return with_bits(bits(y) ^ (i64)((u64)(q & 2) << 62));
}
JFRNN_MATH f64 sin(f64 x) {
    if (far(x))
        return called_sin(x);
    return select(eq(x, of(0.0)), x, sin_cos(x, i64{}));
}
JFRNN_MATH f64 cos(f64 x) {
    if (far(x))
        return called_cos(x);
    return sin_cos(x, i64{} + 1);
}
JFRNN_MATH f64 tan(f64 x) {
    if (far(x))
        return called_tan(x);
    return select(eq(x, of(0.0)), x, sin_cos(x, i64{}) / sin_cos(x, i64{} + 1));
}
JFRNN_MATH f32 sin(f32 x) { return to_f32(sin(to_f64(x))); }
JFRNN_MATH f32 cos(f32 x) { return to_f32(cos(to_f64(x))); }
JFRNN_MATH f32 tan(f32 x) { return to_f32(tan(to_f64(x))); }
JFRNN_MATH f32 sinh(f32 x) {
    const f64 e = expm1(to_f64(abs(x)));
    return with_sign(to_f32(select(is_finite(e), of(0.5) * (e + e / (e + of(1.0))), e)), x);
}
JFRNN_MATH f32 cosh(f32 x) {
    const f64 e = exp(to_f64(abs(x)));
    return to_f32(of(0.5) * (e + of(1.0) / e));
}
JFRNN_MATH f32 pow(f32 base, f32 power) {  // in double precision the error of y log x is out of sight
    const f64 one = of(1.0), x = to_f64(base), y = to_f64(power), size = abs(x);
    const flag whole = eq(round_even(y), y), odd = both(whole, ne(round_even(y * of(0.5)) * of(2.0), y));
    const flag still = both(eq(size, one), eq(y, y));  // else 0 * inf
    const f64 z = exp(select(still, of(0.0), y * log(size)));
    const f64 defined = select(both(lt(x, of(0.0)), both(inverse(whole), is_finite(x))), of(__builtin_nan("")), z);
    const f64 signed_power = select(both(odd, lt(with_sign(one, x), of(0.0))), -defined, defined);
    return to_f32(select(either(eq(x, one), eq(y, of(0.0))), one, signed_power));
}
