// Sums over the pairs of a list that is kept, on CUDA.
#pragma once
#include "kept.cuh"
#include "reduction.cuh"

struct KeptSums : KeptLane {
    const real *shared_values, *own_values;
    const Results results;

    JFRNN_MEMBER explicit KeptSums(const KeptSumsArguments& a)
        : KeptLane(a), shared_values(a.shared_values), own_values(a.own_values), results{a.sums, a.errors, a.n, a.totals} {}

    // An extreme has its place in the row where those of a search have the code of an image.
    JFRNN_MEMBER void run() const {
        const int lane_of_warp = threadIdx.x & 31;
        const long long warp = thread_index() >> 5;
        if (warp * (32 / LANES_PER_ROW) >= m)
            return;
        for (int t = lane_of_warp; t < 2 * TOTALS; t += 32)
            results.totals[2ll * TOTALS * warp + t] = 0;
        __syncwarp();
        const OwnPoint own = own_point(is_row ? row : 0);
        const Term term(shared_values);
        const Term::Own own_part = term.own(own_numbers(own_values, is_row ? row : 0), own.q);
        Reduction reduction(n);
        auto visit = [&](auto home, int place, int id, const real* numbers, const Verdict& verdict, bool pair) {
            number summand[SUMMANDS];
            auto column = [&](int c) -> number {  // chosen, not indexed: what is indexed by a table does not stay in registers
                const int axis = STEP_AXES[c < OTHERS ? 0 : c - OTHERS];
                return c < OTHERS  ? numbers[DIM + c]
                       : axis == 0 ? verdict.shift[0]
                       : axis == 1 ? verdict.shift[1]
                                   : verdict.shift[2];
            };
            term.evaluate<home.value>(own_part, numbers, column, summand);
            reduction.add(summand, pair, [&](int& source, int& code) {
                source = id;
                code = place;
            });
        };
        walk(own, visit, [](int, unsigned int, const real*) {});
        __syncwarp();
        reduction.reduce_over_warp<LANES_PER_ROW>();
        reduction.store(results, {lane_of_warp, row, (int)warp, is_row && lane == 0, true, true});
    }
};
