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
    // Fills the row of a query whose position is not finite, or that is not there, from the sum `first` on every one of `stride`.
    JFRNN_MEMBER void clear(int id, int first = 0, int stride = 1) const {
        for (int r = first; r < ROW_SUMS; r += stride)
            at(id, r) = MARKED[r] ? Bits::no_number() : SUMS == 2 ? -Bits::not_finite() : real(0);
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

// The largest value of a summand, its source and the code of its image. NaN is larger than all. Equal values are ordered by their
// sources, then by their images: the smallest comes first.
struct Extreme {
    real best;
    int source, code;

    JFRNN_MEMBER Extreme() {}
    JFRNN_MEMBER explicit Extreme(int n) : best(-Bits::not_finite()), source(n), code(0) {}
    // What a row has already.
    JFRNN_MEMBER Extreme(const SumRows& rows, long long at)
        : best(rows.sums[at]), source(rows.integer_at(2 * at)), code(rows.integer_at(2 * at + 1)) {}
    JFRNN_MEMBER void take(real x, int of_source, int of_code, bool among) {
        const bool same = x == best || (x != x && best != best);
        const bool first = of_source < source || (of_source == source && of_code < code);
        if (!among || !(x > best || (x != x && best == best) || (same && first)))
            return;
        best = x;
        source = of_source;
        code = of_code;
    }
    JFRNN_MEMBER void put(const SumRows& rows, long long at) const {
        rows.sums[at] = best;
        rows.put_integer(2 * at, source);
        rows.put_integer(2 * at + 1, code);
    }
};
