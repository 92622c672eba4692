// --- part: scalar_start

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
// --- part: vector_start

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
// --- part: end

};
#undef JFRNN_MATH
#undef JFRNN_TRUTH
#undef JFRNN_CONVERT
// --- part: scalar_float

JFRNN_MATH REAL of(NUMBER x) { return x; }
JFRNN_MATH REAL abs(REAL x) { return ::fabs_S(x); }
JFRNN_MATH REAL sqrt(REAL x) { return ::sqrt_S(x); }
JFRNN_MATH REAL floor(REAL x) { return ::floor_S(x); }
JFRNN_MATH REAL ceil(REAL x) { return ::ceil_S(x); }
JFRNN_MATH REAL round(REAL x) { return ::round_S(x); }
JFRNN_MATH REAL round_even(REAL x) { return ::rint_S(x); }
// --- part: vector_float

JFRNN_MATH REAL of(NUMBER x) { return x - REAL{}; }  // a sum would lose -0
JFRNN_MATH REAL abs(REAL x) { return __builtin_elementwise_abs(x); }
JFRNN_MATH REAL sqrt(REAL x) { return __builtin_elementwise_sqrt(x); }
JFRNN_MATH REAL floor(REAL x) { return __builtin_elementwise_floor(x); }
JFRNN_MATH REAL ceil(REAL x) { return __builtin_elementwise_ceil(x); }
JFRNN_MATH REAL round(REAL x) { return __builtin_elementwise_round(x); }
JFRNN_MATH REAL round_even(REAL x) { return __builtin_elementwise_rint(x); }
// --- part: scalar_select

JFRNN_MATH TYPE select(flag c, TYPE a, TYPE b) { return c ? a : b; }
// --- part: vector_select

JFRNN_MATH TYPE select(flag c, TYPE a, TYPE b) { return JFRNN_CONVERT(c, WHOLE) != WHOLE{} ? a : b; }
// --- part: comparisons

JFRNN_MATH flag eq(TYPE x, TYPE y) { return JFRNN_TRUTH(x == y); }
JFRNN_MATH flag ne(TYPE x, TYPE y) { return JFRNN_TRUTH(x != y); }
JFRNN_MATH flag lt(TYPE x, TYPE y) { return JFRNN_TRUTH(x < y); }
JFRNN_MATH flag le(TYPE x, TYPE y) { return JFRNN_TRUTH(x <= y); }
JFRNN_MATH flag gt(TYPE x, TYPE y) { return JFRNN_TRUTH(x > y); }
JFRNN_MATH flag ge(TYPE x, TYPE y) { return JFRNN_TRUTH(x >= y); }
// --- part: flags

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
// --- part: float

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
// --- part: whole

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
// --- part: conversions

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
// --- part: scalar_call
JFRNN_MATH REAL NAME(REAL x) { return ::CALL_S(x); }
// --- part: vector_call

JFRNN_MATH REAL NAME(REAL x) {
    REAL z;
    for (int l = 0; l < WIDTH; ++l)
        z[l] = ::CALL_S(x[l]);
    return z;
}
// --- part: scalar_call_of_two
JFRNN_MATH REAL NAME(REAL x, REAL y) { return ::CALL_S(x, y); }
// --- part: vector_call_of_two

JFRNN_MATH REAL NAME(REAL x, REAL y) {
    REAL z;
    for (int l = 0; l < WIDTH; ++l)
        z[l] = ::CALL_S(x[l], y[l]);
    return z;
}
// --- part: scalar_whole_call
JFRNN_MATH WHOLE NAME(WHOLE x, WHOLE y) { return CALL(x, y); }
// --- part: logistic
JFRNN_MATH REAL logistic(REAL x) { return of((NUMBER)1) / (of((NUMBER)1) + exp(-x)); }
// --- part: whole_of
JFRNN_MATH WHOLE of(NUMBER x) { return WHOLE{} + x; }
