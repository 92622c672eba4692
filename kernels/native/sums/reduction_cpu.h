// What becomes of the summands of a query on the CPU: they are added up, or the largest ones are found.
#pragma once
#include "lanes.h"
#include "reduction.h"

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
    JFRNN_INLINE void add(const number* summand, Math::flag pairs, int, Names) {
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
    template <class Names>
    JFRNN_INLINE void store(Results& results, int id, bool fresh, bool finished, Names) {
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

// The largest of all lanes, none of which is NaN.
template <class Lanes>
JFRNN_INLINE static real largest_of(Lanes lanes) {
    if constexpr (sizeof lanes == sizeof(real)) {
        return lanes[0];
    } else {
        typedef real half __attribute__((vector_size(sizeof lanes / 2)));
        half low, high;
        memcpy(&low, &lanes, sizeof low);
        memcpy(&high, (const char*)&lanes + sizeof low, sizeof high);
        return largest_of(half(low > high ? low : high));
    }
}

// Holds some vectors of summands. Only when there are no more, or no room, it is looked up who has the largest ones.
struct Largest {
    enum { HELD = SUMMANDS > 16 ? 8 : 32 };  // vectors: no more than an integer has bits
    number summand_of[HELD][SUMMANDS];
    int first_of[HELD];           // what tells the names of a vector
    unsigned int pairs_of[HELD];  // a bit for each lane
    int held;
    Extreme extreme[SUMMANDS];

    JFRNN_INLINE explicit Largest(int n) : held(0) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            extreme[k] = Extreme(n);
    }
    // Takes the summands of pairs; `names(first, lane, source, code)` tells the source of a lane, and its image.
    template <class Names>
    JFRNN_INLINE void add(const number* summand, Math::flag pairs, int first, Names names) {
        if (held == HELD)
            settle(names);
        first_of[held] = first;
        pairs_of[held] = bits_of_flags(pairs);
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            summand_of[held][k] = Math::select(pairs, summand[k], Math::of(-Bits::not_finite()));
        ++held;
    }
    template <class Names>
    JFRNN_APART void settle(Names names) {
        for (int k = 0; k < SUMMANDS; ++k) {
            number largest = Math::of(-Bits::not_finite());
            for (int v = 0; v < held; ++v) {
                const number x = summand_of[v][k];
                largest = x > largest ? x : largest;
            }
            const real most = largest_of(largest);
            unsigned int have = 0, strange = 0;  // vectors that hold it, mostly one, wherever it is; and those that hold NaN
            for (int v = 0; v < held; ++v) {
                const number x = summand_of[v][k];
                have |= (unsigned int)((bits_of_flags(Math::eq(x, Math::of(most))) & pairs_of[v]) != 0) << v;
                strange |= (unsigned int)(bits_of_flags(Math::ne(x, x)) != 0) << v;
            }
            for (unsigned int vectors = strange ? strange : have; vectors; vectors &= vectors - 1) {
                const int v = __builtin_ctz(vectors);
                const number x = summand_of[v][k];
                unsigned int lanes = bits_of_flags(strange ? Math::ne(x, x) : Math::eq(x, Math::of(most))) & pairs_of[v];
                for (; lanes; lanes &= lanes - 1) {
                    const int lane = __builtin_ctz(lanes);
                    int source, code;
                    names(first_of[v], lane, source, code);
                    extreme[k].take(strange ? Bits::no_number() : most, source, code, true);
                }
            }
        }
        held = 0;
    }
    template <class Names>
    JFRNN_INLINE void store(Results& results, int id, bool fresh, bool, Names names) {
        settle(names);
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            const long long at = (long long)id * SUMMANDS + k;
            if (!fresh) {
                const Extreme before(results, at);
                extreme[k].take(before.best, before.source, before.code, true);
            }
            extreme[k].put(results, at);
        }
    }
};

using Reduction = Choice<SUMS == 2, Largest, Added>::Type;
