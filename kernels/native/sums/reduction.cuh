// What becomes of the summands of a query on CUDA: they are added up, or the largest ones are found.
#pragma once
#include "device.h"
#include "reduction.h"

// Where sums go: rows of queries, and of sums over all pairs two numbers per block of shares: a part, and what rounding took of it.
struct Results : SumRows {
    real* totals;

    JFRNN_MEMBER Results(real* sums, real* errors, int n, real* totals, real* more = nullptr)
        : SumRows{sums, errors, n, more}, totals(totals) {}
    // Adds numbers of all lanes, always in the same order, to the part of a block.
    JFRNN_MEMBER void add_total(int t, real sum, real error, int block, int lane) const {
        for (int step = 16; step > 0; step /= 2) {
            const real other = __shfl_down_sync(ALL, sum, step), other_error = __shfl_down_sync(ALL, error, step);
            two_sum(sum, error, other);
            error += other_error;
        }
        if (lane == 0) {
            real* const part = totals + 2ll * TOTALS * block + t;
            two_sum(part[0], part[TOTALS], sum);
            part[TOTALS] += error;
        }
    }
};

constexpr int NO_BLOCK = -1;
// The query whose summands are reduced; `fresh`: it has nothing yet, `finished`: nothing follows. NO_BLOCK gets no totals.
struct Destination {
    int lane, id, block;
    bool is_query, fresh, finished;  // there is a query in this lane
};

// Sums, and what rounding took of them, which is added in the end, or goes on as they do.
struct Added {
    real sum[SUMMANDS], error[SUMMANDS];

    JFRNN_MEMBER explicit Added(int) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            sum[k] = error[k] = 0;
    }
    JFRNN_FUNCTION void add_number(real& sum, real& error, bool is_pair, real x) {
        if constexpr (COMPENSATED)
            two_sum(sum, error, is_pair ? x : real(0));
        else
            sum = is_pair ? sum + x : sum;
    }
    template <class Names>
    JFRNN_MEMBER void add(const number* summand, bool is_pair, Names) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            add_number(sum[k], error[k], is_pair, summand[k]);
    }
    // Adds up the sums of WIDTH lanes into those of the first one, always in the same order; totals stay as they are.
    template <int WIDTH = 32>
    JFRNN_MEMBER void reduce_over_warp() {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            for (int step = WIDTH / 2; !IS_TOTAL[k] && step > 0; step /= 2) {
                const real other = __shfl_down_sync(ALL, sum[k], step), other_error = __shfl_down_sync(ALL, error[k], step);
                add_number(sum[k], error[k], true, other);
                error[k] += other_error;
            }
    }
    // Adds to what the query has already, and to the totals of its block.
    JFRNN_MEMBER void store(const Results& results, const Destination& of) const {
        if (of.is_query)
#pragma unroll
            for (int k = 0; k < SUMMANDS; ++k)
                if (!IS_TOTAL[k])
                    store_row(results, PLACE[k], sum[k], error[k], of);
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            if (IS_TOTAL[k] && of.block != NO_BLOCK)
                results.add_total(PLACE[k], sum[k], error[k], of.block, of.lane);
    }
    JFRNN_FUNCTION void store_row(const Results& results, int place, real sum, real error, const Destination& of) {
        const long long at = (long long)of.id * ROW_SUMS + place;
        real all = of.fresh ? real(0) : results.at(of.id, place);
        real carried = of.fresh || !COMPENSATED ? real(0) : results.errors[at];
        add_number(all, carried, true, sum);
        carried += error;
        if (COMPENSATED && of.finished && Bits::finite(all))
            all += carried;
        if (COMPENSATED && !of.finished)
            results.errors[at] = carried;
        results.at(of.id, place) = all;
    }
};

struct Largest {
    Extreme extreme[SUMMANDS];

    JFRNN_MEMBER explicit Largest(int n) {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            extreme[k] = Extreme(n);
    }
    // Takes the summands of a pair that are larger; `names` tells its source and image.
    template <class Names>
    JFRNN_MEMBER void add(const number* summand, bool is_pair, Names names) {
        int source, code;
        names(source, code);
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            extreme[k].take(summand[k], source, code, is_pair);
    }
    // Finds the largest of WIDTH lanes for the first one.
    template <int WIDTH = 32>
    JFRNN_MEMBER void reduce_over_warp() {
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k)
            for (int step = WIDTH / 2; step > 0; step /= 2) {
                const real other = __shfl_down_sync(ALL, extreme[k].best, step);
                const int source = __shfl_down_sync(ALL, extreme[k].source, step);
                extreme[k].take(other, source, __shfl_down_sync(ALL, extreme[k].code, step), true);
            }
    }
    // Keeps what is larger than what the query has already.
    JFRNN_MEMBER void store(const Results& results, const Destination& of) const {
        if (!of.is_query)
            return;
#pragma unroll
        for (int k = 0; k < SUMMANDS; ++k) {
            const long long at = (long long)of.id * SUMMANDS + k;
            Extreme kept = of.fresh ? Extreme(results.n) : Extreme(results, at);
            kept.take(extreme[k].best, extreme[k].source, extreme[k].code, true);
            kept.put(results, at);
        }
    }
};

using Reduction = Choice<SUMS == 2, Largest, Added>::Type;
