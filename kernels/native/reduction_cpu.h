// What becomes of the summands of a query on the CPU: they are added up, or the largest ones are found.
#pragma once
#include "reduction.h"

static Math::flag flags_of(unsigned int bits) {
    Math::flag lanes;
    __builtin_memcpy(&lanes, &bits, sizeof lanes);
    return lanes;
}

// Where sums go: rows of queries, and of `totals` two per chunk, with what rounding took of them.
struct Results : SumRows {
    real* totals;
    real total[TOTALS + 1], total_carried[TOTALS + 1];  // of this chunk

    Results(real* sums, real* totals, real* errors, int n, real* more = nullptr) : SumRows{sums, errors, n, more}, totals(totals) {
        for (int t = 0; t <= TOTALS; ++t)
            total[t] = total_carried[t] = 0;
    }
    void store_totals(int chunk) {
        for (int t = 0; t < TOTALS; ++t) {
            totals[2ll * chunk * TOTALS + t] = total[t];
            totals[(2ll * chunk + 1) * TOTALS + t] = total_carried[t];
            total[t] = total_carried[t] = 0;
        }
    }
};

typedef real four __attribute__((vector_size(4 * sizeof(real))));

// Adds the upper half of the lanes to the lower one, until four are left.
template <int SIZE>
JFRNN_INLINE static four folded(const real* lanes) {
    typedef real half __attribute__((vector_size(SIZE / 2 * sizeof(real))));
    if constexpr (SIZE == 4) {
        four last;
        memcpy(&last, lanes, sizeof last);
        return last;
    } else {
        half low, high;
        memcpy(&low, lanes, sizeof low);
        memcpy(&high, lanes + SIZE / 2, sizeof high);
        const half both = low + high;
        return folded<SIZE / 2>((const real*)&both);
    }
}
// The sums of all lanes of four vectors at once, each in the order of `Added::add_lanes`.
JFRNN_INLINE static four lane_sums(const number* sum, int count) {
    four part[4];
#pragma unroll
    for (int k = 0; k < 4; ++k)
        part[k] = k < count ? folded<LANES>((const real*)&sum[k]) : four{};
    const four first =
        __builtin_shufflevector(part[0], part[1], 0, 4, 1, 5) + __builtin_shufflevector(part[0], part[1], 2, 6, 3, 7);
    const four second =
        __builtin_shufflevector(part[2], part[3], 0, 4, 1, 5) + __builtin_shufflevector(part[2], part[3], 2, 6, 3, 7);
    return __builtin_shufflevector(first, second, 0, 1, 4, 5) + __builtin_shufflevector(first, second, 2, 3, 6, 7);
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
    // Adds a number of each lane to a total in twice the precision, always in the same order.
    JFRNN_INLINE static void add_lanes(number sum, number error, real& total, real& carried) {
        real s[LANES], e[LANES];
        memcpy(s, &sum, sizeof s);
        memcpy(e, &error, sizeof e);
#pragma unroll
        for (int size = LANES / 2; size > 0; size /= 2)
#pragma unroll
            for (int l = 0; l < size; ++l) {
                two_sum(s[l], e[l], s[l + size]);
                e[l] += e[l + size];
            }
        two_sum(total, carried, s[0]);
        carried += e[0];
    }
    // Adds to what the query has already, and to the totals of the chunk; `fresh`: the query has nothing yet.
    JFRNN_INLINE void store(Results& results, int id, bool fresh, bool finished) {
        four plain[(SUMMANDS + 3) / 4];
#pragma unroll
        for (int k = 0; !COMPENSATED && k < SUMMANDS; k += 4)
            plain[k / 4] = lane_sums(sum + k, SUMMANDS - k);
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            const int place = PLACE[k];
            if (IS_TOTAL[k]) {
                real all = 0, carried = 0;
                if constexpr (COMPENSATED)
                    add_lanes(sum[k], error[k], all, carried);
                else
                    all = plain[k / 4][k % 4];
                two_sum(results.total[place], results.total_carried[place], all);
                results.total_carried[place] += carried;
                continue;
            }
            const long long at = (long long)id * ROW_SUMS + place;
            real all = fresh ? real(0) : results.at(id, place);
            real carried = fresh || !COMPENSATED ? real(0) : results.errors[at];
            if constexpr (COMPENSATED)
                add_lanes(sum[k], error[k], all, carried);
            else
                all += plain[k / 4][k % 4];
            if (COMPENSATED && finished && Bits::finite(all))
                all += carried;
            if (COMPENSATED && !finished)
                results.errors[at] = carried;
            results.at(id, place) = all;
        }
    }
};

struct Largest : LargestSummands {
    explicit Largest(int n) : LargestSummands(n) {}
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

typedef ReductionOf<SUMS, Added, Largest>::type Reduction;
