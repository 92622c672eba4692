// Sums over pairs in systems with boxes of their own on CUDA: a lane evaluates the term for the pairs that it finds.
#pragma once
#include "box_pairs.cuh"
#include "reduction.cuh"

// `columns` has what a term reads of the sources, sorted as they are, `stride` numbers of each: OTHERS numbers, then for each of STEPS
// how many lattice vectors lie between the box and the source, along that axis.
struct BoxSumArguments : BoxArguments {
    const real *shared_values, *own_values, *columns;
    real *sums, *totals, *errors, *more;
};
struct BoxSums : BoxLanes<BoxSums> {
    const real *own_values, *columns;
    const Term term;
    const Results results;
    Reduction reduction;
    Term::Own own_part;

    JFRNN_MEMBER explicit BoxSums(const BoxSumArguments& a)
        : BoxLanes(a),
          own_values(a.own_values),
          columns(a.columns),
          term(a.shared_values),
          results(a.sums, a.errors, a.n, a.totals, a.more),
          reduction(a.n) {}

    JFRNN_MEMBER void run() {
        const int lane_of_warp = threadIdx.x & 31;
        const long long warp = thread_index() >> 5;
        if (warp * (32 / LANES_PER_ROW) >= m)
            return;
        for (int t = lane_of_warp; t < 2 * TOTALS; t += 32)
            results.totals[2ll * TOTALS * warp + t] = 0;
        __syncwarp();
        walk();
        __syncwarp();
        reduction.reduce_over_warp<LANES_PER_ROW>();
        reduction.store(results, {lane_of_warp, query, (int)warp, is_query && lane == 0, true, true});
    }
    JFRNN_MEMBER void go_to(int turn) {
        BoxPairs::go_to(turn);
        own_part = term.own(own_values + (long long)query * OWN, q);
    }
    JFRNN_MEMBER void take(bool hit, int at, const BoxRun& run) {
        if (!hit)
            return;
        number points[3] = {0, 0, 0}, summand[SUMMANDS];
        for (int k = 0; k < DIM; ++k)
            points[k] = axes[(long long)k * stride + at];
        auto column = [&](int c) -> number {  // chosen, not indexed: what is indexed by a table does not stay in registers
            const real x = columns[(long long)c * stride + at];
            const int axis = STEP_AXES[c < OTHERS ? 0 : c - OTHERS];
            return c < OTHERS ? x : real(axis == 0 ? run.shift[0] : axis == 1 ? run.shift[1] : run.shift[2]) - x;
        };
        term.evaluate(own_part, points, column, summand);
        reduction.add(summand, true, [&](int& source, int& code) {
            source = ids[at];
            code = run.code;
        });
    }
};
