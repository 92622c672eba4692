// Elementary functions as Taylor series on small intervals, for many lanes at a time; what Warp's compiler for the CPU has no function
// of the C library for, which are expm1 and log1p, for one lane as well.
//
// Each is reduced to a small interval first: exp by multiples of ln 2, log by powers of two, sin and cos by quarters of a turn. Errors,
// in units in the last place:
//   exp, exp2, log         1
//   expm1, log1p           2
//   tanh                   3
//   sin, cos, sinh, cosh, pow  0.6 in float32, by way of double precision; in float64 1.5 for sin and cos, the others by lanes
//   tan                    0.6 in float32, by way of double precision; 3 in float64
#pragma once
#include "arithmetic.h"

#if !defined(__CUDACC__)
struct Series : Arithmetic {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
    JFRNN_GENERIC T mad(T x, T y, T z) { return __builtin_elementwise_fma(x, y, z); }
#else
    JFRNN_GENERIC T mad(T x, T y, T z) { return x * y + z; }
#endif
    // A polynomial in Horner's form; its coefficients start at the lowest power.
    JFRNN_GENERIC T polynomial(T, double last) { return number<T>(last); }
    template <class T, class... Others>
    JFRNN_MATH T polynomial(T x, double lowest, Others... others) {
        return mad(polynomial(x, others...), x, number<T>(lowest));
    }
    JFRNN_GENERIC T shift() { return of(Format<Number<T>>::SHIFT); }
    JFRNN_GENERIC T shifted(T x) { return x + shift<T>(); }
    // 2^n, for n shifted to t.
    JFRNN_GENERIC T power_of_two(T t) {
        typedef Format<Number<T>> Of;
        return with_bits((Whole<T>)(((Natural<T>)bits(t) + Of::BIAS) << Of::DIGITS));
    }
    // NaN stays.
    JFRNN_GENERIC T between(Number<T> low, T x, Number<T> high) {
        const T y = select(lt(x, of(low)), of(low), x);
        return select(gt(y, of(high)), of(high), y);
    }
    JFRNN_GENERIC T powers_in(T x) { return shifted(x * number<T>(0x1.71547652b82fep+0)); }  // of e: x / ln 2
    // x - n ln 2.
    JFRNN_GENERIC T less_powers(T x, T n) {
        typedef Format<Number<T>> Of;
        return mad(n, of(-Of::LN2_LOW), mad(n, of(-Of::LN2_HIGH), x));
    }
    JFRNN_GENERIC T exp_series(T r) {  // (e^r - 1 - r) / r^2
        if constexpr (sizeof(Number<T>) == 4)
            return polynomial(r, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040);
        else
            return polynomial(r, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040, 1.0 / 40320, 1.0 / 362880,
                1.0 / 3628800, 1.0 / 39916800, 1.0 / 479001600, 1.0 / 6227020800);
    }
    JFRNN_GENERIC T small_expm1(T r) { return mad(exp_series(r) * r, r, r); }  // |r| < 0.35
    JFRNN_GENERIC T expm1(T x) {
        typedef Format<Number<T>> Of;
        const T y = between(Of::EXPM1_LEAST, x, Of::EXP_MOST), t = powers_in(y);
        const T p = small_expm1(less_powers(y, t - shift<T>()));
        const T a = power_of_two(t - number<T>(1)), half = mad(a, p, a - number<T>(0.5));
        return select(eq(x, T{}), x, half + half);
    }
    // log(1 + x), of u = 1 + x and what was found for log(u).
    JFRNN_GENERIC T corrected_log(T x, T u, T found) {
        const T one = number<T>(1), rest = (x - (u - one)) / u;
        return select(eq(u, one), x, select(is_finite(found), found + rest, found));
    }
};
#endif

#if !JFRNN_SCALAR
struct VectorSeries : Series {
    JFRNN_GENERIC T log_series(T z) {  // of f / (2 + f), squared, beyond the first term
        if constexpr (sizeof(Number<T>) == 4)
            return polynomial(z, 2.0 / 3, 2.0 / 5, 2.0 / 7, 2.0 / 9);
        else
            return polynomial(
                z, 2.0 / 3, 2.0 / 5, 2.0 / 7, 2.0 / 9, 2.0 / 11, 2.0 / 13, 2.0 / 15, 2.0 / 17, 2.0 / 19, 2.0 / 21, 2.0 / 23);
    }
    JFRNN_GENERIC T log(T x) {
        typedef Format<Number<T>> Of;
        const flag denormal = lt(x, of(Of::NORMAL));
        const T y = select(denormal, x * number<T>(double(1ll << Of::UP)), x);
        const T zero = select(denormal, of(Of::SHIFT + Of::UP), shift<T>());
        // y = 2^n (1 + f), from sqrt(1/2) to sqrt(2)
        const Whole<T> root = bits(number<T>(0x1.6a09e667f3bcdp-1)), b = bits(y) - root;
        const T n = with_bits(bits(shift<T>()) + (b >> Of::DIGITS)) - zero;
        const T f = with_bits((b & (Whole<T>{} + Of::MANTISSA)) + root) - number<T>(1), s = f / (number<T>(2) + f), z = s * s;
        const T found = mad(n, of(Of::LN2_HIGH), f - mad(s, f - z * log_series(z), n * of(-Of::LN2_LOW)));
        const T below = select(eq(x, T{}), number<T>(-__builtin_inf()), number<T>(__builtin_nan("")));
        return select(le(x, T{}), below, select(is_finite(x), found, x));
    }
    JFRNN_GENERIC T log1p(T x) {
        const T u = number<T>(1) + x;
        return corrected_log(x, u, log(u));
    }
    // 2^n e^r, for n shifted to t; in two steps, since it may be denormal.
    JFRNN_GENERIC T scaled_exp(T r, T t) {
        const T h = shifted((t - shift<T>()) * number<T>(0.5)), a = power_of_two(h), b = power_of_two(t - (h - shift<T>()));
        return mad(a, small_expm1(r), a) * b;
    }
    JFRNN_GENERIC T exp(T x) {
        typedef Format<Number<T>> Of;
        const T y = between(Of::EXP_LEAST, x, Of::EXP_MOST), t = powers_in(y);
        return scaled_exp(less_powers(y, t - shift<T>()), t);
    }
    JFRNN_GENERIC T exp2(T x) {
        typedef Format<Number<T>> Of;
        const T y = between(Of::EXP2_LEAST, x, Of::EXP2_MOST), t = shifted(y);
        return scaled_exp((y - (t - shift<T>())) * number<T>(0x1.62e42fefa39efp-1), t);
    }
    JFRNN_GENERIC T tanh(T x) {
        const T e = expm1(number<T>(-2) * abs(x));
        return select(eq(x, T{}), x, with_sign(-e / (number<T>(2) + e), x));
    }
    // Is any of them too far for `less_turns`, or no number?
    JFRNN_MATH bool far(f64 x) { return __builtin_reduce_and(JFRNN_CONVERT(le(abs(x), of(1e6)), i32)) == 0; }
    // x - n pi / 2; each of the first two parts of pi / 2 has 33 bits.
    JFRNN_MATH f64 less_turns(f64 x, f64 n) {
        return mad(n, of(-0x1.3198a2e037073p-69), mad(n, of(-0x1.0b4611a600000p-34), mad(n, of(-0x1.921fb54400000p+0), x)));
    }
    JFRNN_MATH f64 small_sin(f64 r) {  // |r| < 0.79
        const f64 z = r * r;
        const f64 series = polynomial(z, -1.0 / 6, 1.0 / 120, -1.0 / 5040, 1.0 / 362880, -1.0 / 39916800, 1.0 / 6227020800,
            -1.0 / 1307674368000, 1.0 / 355687428096000);
        return mad(series * z, r, r);
    }
    JFRNN_MATH f64 small_cos(f64 r) {
        const f64 z = r * r;
        const f64 series = polynomial(z, 1.0 / 24, -1.0 / 720, 1.0 / 40320, -1.0 / 3628800, 1.0 / 479001600, -1.0 / 87178291200,
            1.0 / 20922789888000, -1.0 / 6402373705728000);
        return of(1.0) + mad(z, of(-0.5), series * z * z);
    }
    JFRNN_MATH f64 sin_cos(f64 x, i64 quarter) {  // sin(x + quarter pi / 2)
        const f64 t = shifted(x * of(0x1.45f306dc9c883p-1)), r = less_turns(x, t - shift<f64>());
        const i64 q = bits(t) + quarter;
        const f64 y = select(ne(q & 1, i64{}), small_cos(r), small_sin(r));
        return with_bits(bits(y) ^ (i64)((u64)(q & 2) << 62));
    }
};
#endif
