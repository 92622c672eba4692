// What becomes of the summands of a query on the CPU: they are added up, or the largest ones are found.
#pragma once
#include "bits.h"
#include "term.h"

constexpr int SUMMANDS = TOTALS + ROW_SUMS;

static Math::flag flags_of(unsigned int bits) {
    Math::flag lanes;
    __builtin_memcpy(&lanes, &bits, sizeof lanes);
    return lanes;
}

// Where sums go: `sums` and `errors` have a row per query, `totals` two per chunk. `errors` is what rounding took, in sums that are
// carried in twice the precision; of extremes it has the source and the code of the image of each, as integers among floats.
struct Results {
    real *sums, *totals, *errors;
    int n;                                              // sources: that number of one is none
    real total[TOTALS + 1], total_carried[TOTALS + 1];  // of this chunk

    Results(real* sums, real* totals, real* errors, int n) : sums(sums), totals(totals), errors(errors), n(n) {
        for (int t = 0; t <= TOTALS; ++t)
            total[t] = total_carried[t] = 0;
    }
    void put_integer(long long at, int x) {
        if constexpr (DOUBLE)
            errors[at] = x;
        else
            memcpy(errors + at, &x, 4);
    }
    int integer_at(long long at) const { return Lattice::packed_turns(errors[at]); }
    void clear(int id) {
        for (int r = 0; r < ROW_SUMS; ++r)
            sums[(long long)id * ROW_SUMS + r] = 0;
        for (int r = 0; SUMS == 2 && r < ROW_SUMS; ++r)
            put_integer(2 * ((long long)id * ROW_SUMS + r), n);
    }
    void store_totals(int chunk) {
        for (int t = 0; t < TOTALS; ++t) {
            totals[2ll * chunk * TOTALS + t] = total[t];
            totals[(2ll * chunk + 1) * TOTALS + t] = total_carried[t];
            total[t] = total_carried[t] = 0;
        }
    }
};

// Knuth 1969: the exact sum stays in both.
template <class Number>
JFRNN_INLINE static void two_sum(Number& sum, Number& error, Number x) {
    const Number s = sum + x, b = s - sum;
    error = error + ((sum - (s - b)) + (x - b));
    sum = s;
}

struct Added {
    number sum[SUMMANDS], error[SUMMANDS];

    explicit Added(int) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            sum[k] = error[k] = number{};
    }
    // Adds the summands of those lanes that are pairs.
    template <class Names>
    JFRNN_INLINE void add(const number* summand, Math::flag pairs, Names) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            const number x = Math::select(pairs, summand[k], number{});
            if constexpr (COMPENSATED)
                two_sum(sum[k], error[k], x);
            else
                sum[k] += x;
        }
    }
    // Adds a number of each lane to a total, always in the same order.
    JFRNN_INLINE static void add_lanes(number sum, number error, real& total, real& carried) {
        real s[LANES], e[LANES];
        memcpy(s, &sum, sizeof s);
        memcpy(e, &error, sizeof e);
#pragma unroll
        for (int size = LANES / 2; size > 0; size /= 2)
#pragma unroll
            for (int l = 0; l < size; ++l)
                if constexpr (COMPENSATED) {
                    two_sum(s[l], e[l], s[l + size]);
                    e[l] += e[l + size];
                } else
                    s[l] += s[l + size];
        if constexpr (COMPENSATED) {
            two_sum(total, carried, s[0]);
            carried += e[0];
        } else
            total += s[0];
    }
    // Adds to what the query has already, and to the totals of the chunk; `fresh`: the query has nothing yet.
    JFRNN_INLINE void store(Results& results, int id, bool fresh, bool finished) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            const int place = PLACE[k];
            if (IS_TOTAL[k]) {
                real all = 0, carried = 0;
                add_lanes(sum[k], error[k], all, carried);
                two_sum(results.total[place], results.total_carried[place], all);
                results.total_carried[place] += carried;
                continue;
            }
            const long long at = (long long)id * ROW_SUMS + place;
            real all = fresh ? real(0) : results.sums[at];
            real carried = fresh || !COMPENSATED ? real(0) : results.errors[at];
            add_lanes(sum[k], error[k], all, carried);
            if (COMPENSATED && finished && Bits::finite(all))
                all += carried;
            if (COMPENSATED && !finished)
                results.errors[at] = carried;
            results.sums[at] = all;
        }
    }
};

// Of each summand the largest, its source and the code of its image. NaN is larger than all; of equal ones comes first the smallest
// source, then the smallest image.
struct Largest {
    number best[SUMMANDS];
    Math::i32 source_of[SUMMANDS], code_of[SUMMANDS];

    explicit Largest(int n) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            best[k] = Math::of(-Bits::not_finite());
            source_of[k] = Math::i32{} + n;
            code_of[k] = Math::i32{};
        }
    }
    // `names` tells the sources and the images of the lanes.
    template <class Names>
    JFRNN_INLINE void add(const number* summand, Math::flag pairs, Names names) {
        Math::i32 source, code;
        names(source, code);
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            const number x = summand[k];
            const Math::flag is_nan = Math::ne(x, x), was_nan = Math::ne(best[k], best[k]);
            const Math::flag larger = Math::either(Math::gt(x, best[k]), Math::both(is_nan, Math::inverse(was_nan)));
            const Math::flag same = Math::either(Math::eq(x, best[k]), Math::both(is_nan, was_nan));
            const Math::flag same_source = Math::both(Math::eq(source, source_of[k]), Math::lt(code, code_of[k]));
            const Math::flag first = Math::either(Math::lt(source, source_of[k]), same_source);
            const Math::flag taken = Math::both(pairs, Math::either(larger, Math::both(same, first)));
            best[k] = Math::select(taken, x, best[k]);
            source_of[k] = Math::select(taken, source, source_of[k]);
            code_of[k] = Math::select(taken, code, code_of[k]);
        }
    }
    JFRNN_INLINE void store(Results& results, int id, bool fresh, bool) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            const long long at = (long long)id * SUMMANDS + k;
            real x = fresh ? -Bits::not_finite() : results.sums[at];
            int source = fresh ? results.n : results.integer_at(2 * at), code = fresh ? 0 : results.integer_at(2 * at + 1);
            for (int l = 0; l < LANES; ++l) {
                const real y = best[k][l];
                const bool same = x == y || (x != x && y != y);
                const bool first = source_of[k][l] < source || (source_of[k][l] == source && code_of[k][l] < code);
                if (!(y > x || (y != y && x == x) || (same && first)))
                    continue;
                x = y;
                source = source_of[k][l];
                code = code_of[k][l];
            }
            results.sums[at] = x;
            results.put_integer(2 * at, source);
            results.put_integer(2 * at + 1, code);
        }
    }
};

template <int WHICH>
struct ReductionOf {
    typedef Added type;
};
template <>
struct ReductionOf<2> {
    typedef Largest type;
};
typedef ReductionOf<SUMS>::type Reduction;
