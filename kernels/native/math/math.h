// The functions that translated text calls (see jfrnn/_sums/translate.py): the struct `Math`.
//
// It defines the same overloads of the types f32, f64, i32, i64 and flag for one number at a time, on CUDA, and for LANES, on the CPU,
// so that one text compiles for each. Denormals are kept, if the processor's flush modes are cleared (`FloatControl`); XLA on the CPU
// flushes them. Of CUDA's approximations, divisions of float32 alone are taken, as XLA takes them: of full range, and off by at most
// two units in the last place, they need no branch.
#pragma once
#include "series.h"

#if JFRNN_SCALAR
#if defined(__CUDACC__)
struct Math : Arithmetic {
    JFRNN_MATH f32 div(f32 x, f32 y) {
        f32 z;
        asm("div.full.f32 %0, %1, %2;" : "=f"(z) : "f"(x), "f"(y));
        return z;
    }
    JFRNN_MATH f32 reciprocal(f32 x) {
        f32 y;
        asm("rcp.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
        return y;
    }
    JFRNN_MATH f32 expm1(f32 x) { return ::expm1f(x); }
    JFRNN_MATH f64 expm1(f64 x) { return ::expm1(x); }
    JFRNN_MATH f32 log1p(f32 x) { return ::log1pf(x); }
    JFRNN_MATH f64 log1p(f64 x) { return ::log1p(x); }
#else
struct Math : Series {
    JFRNN_MATH f32 div(f32 x, f32 y) { return x / y; }
    JFRNN_MATH f32 reciprocal(f32 x) { return of(1.0f) / x; }
    JFRNN_GENERIC T log1p(T x) {
        const T u = number<T>(1) + x;
        return corrected_log(x, u, log(u));
    }
#endif
#define JFRNN_CALLED(name)                              \
    JFRNN_MATH f32 name(f32 x) { return ::name##f(x); } \
    JFRNN_MATH f64 name(f64 x) { return ::name(x); }
    JFRNN_CALLED(sqrt)
    JFRNN_CALLED(floor)
    JFRNN_CALLED(ceil)
    JFRNN_CALLED(round)
    JFRNN_CALLED(rint)
    JFRNN_CALLED(asin)
    JFRNN_CALLED(acos)
    JFRNN_CALLED(atan)
    JFRNN_CALLED(cbrt)
    JFRNN_CALLED(erf)
    JFRNN_CALLED(erfc)
    JFRNN_CALLED(exp)
    JFRNN_CALLED(exp2)
    JFRNN_CALLED(log)
    JFRNN_CALLED(tanh)
    JFRNN_CALLED(sin)
    JFRNN_CALLED(cos)
    JFRNN_CALLED(tan)
    JFRNN_CALLED(sinh)
    JFRNN_CALLED(cosh)
#undef JFRNN_CALLED
    JFRNN_GENERIC T round_even(T x) { return rint(x); }
    JFRNN_MATH f32 atan2(f32 x, f32 y) { return ::atan2f(x, y); }
    JFRNN_MATH f64 atan2(f64 x, f64 y) { return ::atan2(x, y); }
    JFRNN_MATH f32 pow(f32 x, f32 y) { return ::powf(x, y); }
    JFRNN_MATH f64 pow(f64 x, f64 y) { return ::pow(x, y); }
    JFRNN_MATH f32 rem(f32 x, f32 y) { return ::fmodf(x, y); }
    JFRNN_MATH f64 rem(f64 x, f64 y) { return ::fmod(x, y); }
    JFRNN_MATH f64 div(f64 x, f64 y) { return x / y; }
    JFRNN_MATH f64 reciprocal(f64 x) { return of(1.0) / x; }
    JFRNN_GENERIC T rem(T x, T y) { return remainder(x, y); }
    JFRNN_GENERIC T div(T x, T y) { return quotient(x, y); }
#else
struct Math : VectorSeries {
    template <class T, class Call>
    JFRNN_MATH T each(T x, T y, Call call) {
        T z;
        for (int l = 0; l < LANES; ++l)
            z[l] = call(x[l], y[l]);
        return z;
    }
    JFRNN_GENERIC T sqrt(T x) { return __builtin_elementwise_sqrt(x); }
    JFRNN_GENERIC T floor(T x) { return __builtin_elementwise_floor(x); }
    JFRNN_GENERIC T ceil(T x) { return __builtin_elementwise_ceil(x); }
    JFRNN_GENERIC T round(T x) { return __builtin_elementwise_round(x); }
    JFRNN_GENERIC T round_even(T x) { return __builtin_elementwise_rint(x); }
#define JFRNN_CALLED_AS(Real, name, called)                                          \
    JFRNN_MATH Real name(Real x) {                                                   \
        return each(x, x, [](Number<Real> a, Number<Real>) { return ::called(a); }); \
    }
#define JFRNN_CALLED_OF_TWO(Real, name, called)                                           \
    JFRNN_MATH Real name(Real x, Real y) {                                                \
        return each(x, y, [](Number<Real> a, Number<Real> b) { return ::called(a, b); }); \
    }
#define JFRNN_CALLED(name) JFRNN_CALLED_AS(f32, name, name##f) JFRNN_CALLED_AS(f64, name, name)
    JFRNN_CALLED(asin)
    JFRNN_CALLED(acos)
    JFRNN_CALLED(atan)
    JFRNN_CALLED(cbrt)
    JFRNN_CALLED(erf)
    JFRNN_CALLED(erfc)
    JFRNN_CALLED_AS(f64, sinh, sinh)
    JFRNN_CALLED_AS(f64, cosh, cosh)
    JFRNN_CALLED_AS(f64, called_sin, sin)
    JFRNN_CALLED_AS(f64, called_cos, cos)
    JFRNN_CALLED_AS(f64, called_tan, tan)
    JFRNN_CALLED_OF_TWO(f32, atan2, atan2f)
    JFRNN_CALLED_OF_TWO(f64, atan2, atan2)
    JFRNN_CALLED_OF_TWO(f32, rem, fmodf)
    JFRNN_CALLED_OF_TWO(f64, rem, fmod)
    JFRNN_CALLED_OF_TWO(f64, pow, pow)
#undef JFRNN_CALLED_AS
#undef JFRNN_CALLED_OF_TWO
#undef JFRNN_CALLED
    JFRNN_GENERIC T rem(T x, T y) {
        return each(x, y, [](Number<T> a, Number<T> b) { return remainder(a, b); });
    }
    JFRNN_MATH f32 div(f32 x, f32 y) { return x / y; }
    JFRNN_MATH f64 div(f64 x, f64 y) { return x / y; }
    JFRNN_MATH f32 reciprocal(f32 x) { return of(1.0f) / x; }
    JFRNN_MATH f64 reciprocal(f64 x) { return of(1.0) / x; }
    JFRNN_GENERIC T div(T x, T y) {
        return each(x, y, [](Number<T> a, Number<T> b) { return quotient(a, b); });
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
#endif
    JFRNN_GENERIC T rsqrt(T x) { return number<T>(1) / sqrt(x); }
    JFRNN_GENERIC T logistic(T x) { return number<T>(1) / (number<T>(1) + exp(-x)); }
};
#undef JFRNN_TRUTH
#undef JFRNN_CONVERT
