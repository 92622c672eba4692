// Arithmetic of translated text, alike for numbers of all kinds. Edge cases are JAX's: max and min hand NaN on, sign(0) is 0, integers
// wrap, x / 0 is -1 and x % 0 is x for integers, floats beyond the range of integers saturate, and NaN becomes 0.
#pragma once
#include "numbers.h"

struct Arithmetic : Numbers {
    JFRNN_GENERIC flag eq(T x, T y) { return JFRNN_TRUTH(x == y); }
    JFRNN_GENERIC flag ne(T x, T y) { return JFRNN_TRUTH(x != y); }
    JFRNN_GENERIC flag lt(T x, T y) { return JFRNN_TRUTH(x < y); }
    JFRNN_GENERIC flag le(T x, T y) { return JFRNN_TRUTH(x <= y); }
    JFRNN_GENERIC flag gt(T x, T y) { return JFRNN_TRUTH(x > y); }
    JFRNN_GENERIC flag ge(T x, T y) { return JFRNN_TRUTH(x >= y); }
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

    // Numbers of all kinds.
    JFRNN_GENERIC T number(double x) { return of(Number<T>(x)); }
    JFRNN_GENERIC flag to_flag(T x) { return ne(x, T{}); }
    JFRNN_GENERIC T max(T x, T y) { return select(either(gt(x, y), ne(x, x)), x, y); }
    JFRNN_GENERIC T min(T x, T y) { return select(either(lt(x, y), ne(x, x)), x, y); }
    JFRNN_GENERIC T clamp(T low, T x, T high) { return min(max(low, x), high); }
    using Numbers::abs;
    JFRNN_GENERIC T abs(T x) { return select(lt(x, T{}), neg(x), x); }
    JFRNN_GENERIC T sign(T x) {
        if constexpr (Number<T>(0.5) != 0)  // floats
            return select(gt(abs(x), T{}), with_sign(number<T>(1), x), x);
        else
            return select(gt(x, T{}), T{} + 1, select(lt(x, T{}), T{} - 1, x));
    }

    // Floats.
    JFRNN_GENERIC flag is_finite(T x) { return le(abs(x), of(Format<Number<T>>::MOST)); }
    // Takes the sign of s; x is not negative.
    JFRNN_GENERIC T with_sign(T x, T s) { return with_bits(bits(x) | (bits(s) & bits(number<T>(-0.0)))); }
    JFRNN_GENERIC Whole<T> truncated(T x) {
        const T limit = of(Format<Number<T>>::LIMIT);
        const Whole<T> least = bits(number<T>(-0.0));
        const Whole<T> inside = JFRNN_CONVERT(select(lt(abs(x), limit), x, T{}), Whole<T>);
        return select(ge(x, limit), ~least, select(le(x, -limit), least, inside));
    }

    // Integers.
    JFRNN_GENERIC T add(T x, T y) { return (T)((Natural<T>)x + (Natural<T>)y); }
    JFRNN_GENERIC T sub(T x, T y) { return (T)((Natural<T>)x - (Natural<T>)y); }
    JFRNN_GENERIC T mul(T x, T y) { return (T)((Natural<T>)x * (Natural<T>)y); }
    JFRNN_GENERIC T neg(T x) { return (T)(Natural<T>{} - (Natural<T>)x); }
    JFRNN_GENERIC T both(T x, T y) { return x & y; }
    JFRNN_GENERIC T either(T x, T y) { return x | y; }
    JFRNN_GENERIC T differ(T x, T y) { return x ^ y; }
    JFRNN_GENERIC T inverse(T x) { return ~x; }
    // These take one number each.
    JFRNN_GENERIC T quotient(T x, T y) {
        constexpr T LEAST = T(1ull << (8 * sizeof(T) - 1));
        return y == 0 ? -1 : x == LEAST && y == -1 ? x : x / y;
    }
    JFRNN_GENERIC T remainder(T x, T y) { return y == 0 ? x : y == -1 ? 0 : x % y; }

    JFRNN_GENERIC f32 to_f32(T x) { return JFRNN_CONVERT(x, f32); }
    JFRNN_GENERIC f64 to_f64(T x) { return JFRNN_CONVERT(x, f64); }
    JFRNN_MATH f32 to_f32(flag x) { return select(x, of(1.0f), of(0.0f)); }
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
};
