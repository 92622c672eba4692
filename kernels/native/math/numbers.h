// Numbers that translated text computes with: plain ones where JFRNN_SCALAR says so, as on CUDA, else Clang's vectors of LANES.
#pragma once
#include "lane_count.h"

// What the bits of floats are, and the constants of series: what is added to SHIFT is rounded to an integer, which its low bits then
// hold; ln 2 is split so that products of its leading part are exact, with or without fused operations.
template <class Number>
struct Format;
template <>
struct Format<float> {
    static constexpr int DIGITS = 23, BIAS = 127, MANTISSA = 0x7fffff, UP = 25;
    static constexpr float MOST = 0x1.fffffep+127f, LIMIT = 0x1p+31f, NORMAL = 0x1p-126f, SHIFT = 0x1.8p+23f;
    static constexpr float LN2_HIGH = 0x1.62e4p-1f, LN2_LOW = 0x1.7f7d1cp-20f;
    static constexpr float EXP_LEAST = -104, EXP_MOST = 89, EXP2_LEAST = -151, EXP2_MOST = 129, EXPM1_LEAST = -20;
};
template <>
struct Format<double> {
    static constexpr int DIGITS = 52, BIAS = 1023, UP = 54;
    static constexpr long long MANTISSA = 0xfffffffffffffll;
    static constexpr double MOST = 0x1.fffffffffffffp+1023, LIMIT = 0x1p+63, NORMAL = 0x1p-1022, SHIFT = 0x1.8p+52;
    static constexpr double LN2_HIGH = 0x1.62e42fee00000p-1, LN2_LOW = 0x1.a39ef35793c76p-33;
    static constexpr double EXP_LEAST = -746, EXP_MOST = 710, EXP2_LEAST = -1080, EXP2_MOST = 1025, EXPM1_LEAST = -40;
};

#if JFRNN_SCALAR
#define JFRNN_TRUTH(comparison) (comparison)
#define JFRNN_CONVERT(x, type) ((type)(x))
#else
#define JFRNN_TRUTH(comparison) __builtin_convertvector(comparison, flag)
#define JFRNN_CONVERT(x, type) __builtin_convertvector(x, type)
#endif
struct Types {
#if JFRNN_SCALAR
    typedef float f32;
    typedef double f64;
    typedef int i32;
    typedef long long i64;
    typedef unsigned int u32;
    typedef unsigned long long u64;
    typedef bool flag;
#else
    typedef float f32 __attribute__((vector_size(4 * LANES)));
    typedef double f64 __attribute__((vector_size(8 * LANES)));
    typedef int i32 __attribute__((vector_size(4 * LANES)));
    typedef long long i64 __attribute__((vector_size(8 * LANES)));
    typedef unsigned int u32 __attribute__((vector_size(4 * LANES)));
    typedef unsigned long long u64 __attribute__((vector_size(8 * LANES)));
    typedef bool flag __attribute__((ext_vector_type(LANES)));
#endif
    static float number_of(f32);
    static double number_of(f64);
    static int number_of(i32);
    static long long number_of(i64);
    static i32 whole_of(f32);
    static i64 whole_of(f64);
    static i32 whole_of(i32);
    static i64 whole_of(i64);
    static u32 natural_of(i32);
    static u64 natural_of(i64);
    template <class T>
    using Number = decltype(number_of(T{}));  // one of them
    template <class T>
    using Whole = decltype(whole_of(T{}));  // integers as wide
    template <class T>
    using Natural = decltype(natural_of(Whole<T>{}));
};

struct Numbers : Types {
    JFRNN_MATH i32 of(int x) { return i32{} + x; }
    JFRNN_MATH i64 of(long long x) { return i64{} + x; }
#if JFRNN_SCALAR
    JFRNN_MATH f32 of(float x) { return x; }
    JFRNN_MATH f64 of(double x) { return x; }
    JFRNN_MATH f32 abs(f32 x) { return ::fabsf(x); }
    JFRNN_MATH f64 abs(f64 x) { return ::fabs(x); }
    JFRNN_MATH flag of(bool x) { return x; }
    template <class To, class From>
    JFRNN_MATH To reread(From x) {
        To y;
        memcpy(&y, &x, sizeof y);
        return y;
    }
    JFRNN_GENERIC T select(flag c, T a, T b) { return c ? a : b; }
#else
    JFRNN_MATH f32 of(float x) { return x - f32{}; }  // a sum would lose -0
    JFRNN_MATH f64 of(double x) { return x - f64{}; }
    JFRNN_MATH f32 abs(f32 x) { return __builtin_elementwise_abs(x); }
    JFRNN_MATH f64 abs(f64 x) { return __builtin_elementwise_abs(x); }
    JFRNN_MATH flag of(bool x) { return JFRNN_TRUTH(i32{} + (x ? 1 : 0)); }
    template <class To, class From>
    JFRNN_MATH To reread(From x) {
        return (To)x;
    }
    JFRNN_GENERIC T select(flag c, T a, T b) { return JFRNN_CONVERT(c, Whole<T>) != Whole<T>{} ? a : b; }
#endif
    JFRNN_MATH flag select(flag c, flag a, flag b) { return (c & a) | ((c ^ of(true)) & b); }
    JFRNN_MATH i32 bits(f32 x) { return reread<i32>(x); }
    JFRNN_MATH i64 bits(f64 x) { return reread<i64>(x); }
    JFRNN_MATH f32 with_bits(i32 b) { return reread<f32>(b); }
    JFRNN_MATH f64 with_bits(i64 b) { return reread<f64>(b); }
    JFRNN_MATH f32 of_bits(unsigned int b) { return reread<f32>(u32{} + b); }
    JFRNN_MATH f64 of_bits(unsigned long long b) { return reread<f64>(u64{} + b); }
};
