// What becomes of the summands of a query, on the CPU and on CUDA: they are added up, or the largest ones are found.
#pragma once
#include "bits.h"
#include "term.h"

constexpr int SUMMANDS = TOTALS + ROW_SUMS;

// Where sums of queries go, a row each: the first ones to `sums`, those that are left to `more`. `errors` is what rounding took, in sums
// that are carried in twice the precision; of extremes it has the source and the code of the image of each, as integers among floats.
struct SumRows {
    real *sums, *errors;
    int n;  // sources: that number of one is none
    real* more;

    JFRNN_MEMBER real& at(long long id, int place) const {
        return place < FIRST_SUMS ? sums[id * FIRST_SUMS + place] : more[id * (ROW_SUMS - FIRST_SUMS) + place - FIRST_SUMS];
    }

    JFRNN_MEMBER void put_integer(long long at, int x) const {
        if constexpr (DOUBLE)
            errors[at] = x;
        else
            memcpy(errors + at, &x, 4);
    }
    JFRNN_MEMBER int integer_at(long long at) const { return Lattice::packed_turns(errors[at]); }
    // Fills the row of a query whose position is not finite, from the sum `first` on every one of `stride`.
    JFRNN_MEMBER void clear(int id, int first = 0, int stride = 1) const {
        for (int r = first; r < ROW_SUMS; r += stride)
            at(id, r) = MARKED[r] ? Bits::no_number() : real(0);
        for (int r = first; SUMS == 2 && r < 2 * ROW_SUMS; r += stride)
            put_integer(2ll * ROW_SUMS * id + r, r % 2 ? 0 : n);
    }
};

#if defined(__CUDA_ARCH__)
JFRNN_FUNCTION real plus(real a, real b) { return Lattice::add(a, b); }
#else
template <class Number>
JFRNN_INLINE static Number plus(Number a, Number b) {
    return a + b;
}
#endif
// Knuth 1969: the exact sum stays in both.
template <class Number>
JFRNN_INLINE static void two_sum(Number& sum, Number& error, Number x) {
    const Number s = plus(sum, x), b = plus(s, -sum);
    error = plus(error, plus(plus(sum, -plus(s, -b)), plus(x, -b)));
    sum = s;
}

// Of each summand the largest, its source and the code of its image. NaN is larger than all; of equal ones comes first the smallest
// source, then the smallest image.
struct LargestSummands {
    number best[SUMMANDS];
    Math::i32 source_of[SUMMANDS], code_of[SUMMANDS];

    JFRNN_INLINE explicit LargestSummands(int n) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            best[k] = Math::of(-Bits::not_finite());
            source_of[k] = Math::i32{} + n;
            code_of[k] = Math::i32{};
        }
    }
    // Takes the summands of pairs that are larger; `names` tells their sources and images.
    template <class Names>
    JFRNN_INLINE void add(const number* summand, Math::flag pairs, Names names) {
        Math::i32 source, code;
        names(source, code);
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            take(k, summand[k], source, code, pairs);
    }
    JFRNN_INLINE void take(int k, number x, Math::i32 source, Math::i32 code, Math::flag among) {
        const Math::flag is_nan = Math::ne(x, x), was_nan = Math::ne(best[k], best[k]);
        const Math::flag larger = Math::either(Math::gt(x, best[k]), Math::both(is_nan, Math::inverse(was_nan)));
        const Math::flag same = Math::either(Math::eq(x, best[k]), Math::both(is_nan, was_nan));
        const Math::flag same_source = Math::both(Math::eq(source, source_of[k]), Math::lt(code, code_of[k]));
        const Math::flag first = Math::either(Math::lt(source, source_of[k]), same_source);
        const Math::flag taken = Math::both(among, Math::either(larger, Math::both(same, first)));
        best[k] = Math::select(taken, x, best[k]);
        source_of[k] = Math::select(taken, source, source_of[k]);
        code_of[k] = Math::select(taken, code, code_of[k]);
    }
};

template <int WHICH, class Added, class Largest>
struct ReductionOf {
    typedef Added type;
};
template <class Added, class Largest>
struct ReductionOf<2, Added, Largest> {
    typedef Largest type;
};
