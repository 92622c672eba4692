// Sums over pairs on CUDA where cutoffs differ from particle to particle: a thread has a query, and evaluates the term for its pairs.
#pragma once
#include "levels.cuh"
#include "reduction.cuh"

struct LevelSumArguments {
    const real *positions, *queries, *axes, *radii;
    const int *ids, *keys, *top, *table, *header;
    const real *cutoff, *query_axes, *query_radii;
    const int *query_ids, *query_top, *places, *excluded_starts, *excluded;
    const real* table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    const real *shared_values, *own_values, *columns;
    real *sums, *totals, *errors;
    int* info;
    int n, m, own_queries, closed, drop_self, later_only, kinds;

    JFRNN_MEMBER LevelArguments of_search() const {
        return {positions, queries, axes, radii, ids, keys, top, table, header, cutoff, query_axes, query_radii, query_ids,
            query_top, places, info, n, m, own_queries, closed, drop_self, later_only};
    }
};

struct LevelSums : Levels<LevelSums> {
    const real *own_values, *columns;
    const Term term;
    const Results results;
    struct State {
        Reduction reduction;
        Term::Own own_part;
    };

    JFRNN_MEMBER explicit LevelSums(const LevelSumArguments& a)
        : Levels(a.of_search(), a),
          own_values(a.own_values),
          columns(a.columns),
          term(a.shared_values),
          results(a.sums, a.errors, a.n, a.totals) {}

    // Threads without a query take part where lanes of a warp exchange numbers.
    JFRNN_MEMBER void run() {
        const int lane = threadIdx.x & 31;
        const long long at = thread_index(), warp = at >> 5;
        if (32 * warp >= m)
            return;
        for (int t = lane; t < 2 * TOTALS; t += 32)
            results.totals[2ll * TOTALS * warp + t] = 0;
        __syncwarp();
        Reduction reduction(n);
        const bool is_query = at < m;
        if (is_query)
            reduction = serve((int)at).reduction;
        __syncwarp();
        reduction.store(results, {lane, is_query ? query_ids[at] : 0, (int)warp, is_query, true, true});
    }
    JFRNN_MEMBER State begin_query(const One& one) const {
        return State{Reduction(n), term.own(own_values + (long long)one.id * OWN, one.q)};
    }
    JFRNN_MEMBER void pair(State& state, const One& one, int other, int c, int image) const {
        number there[3] = {0, 0, 0}, summand[SUMMANDS];
        for (int k = 0; k < DIM; ++k)
            there[k] = axes[k * stride + c];
        auto column = [&](int number_of) -> number {  // of j, and behind them steps of the lattice
            if (number_of < OTHERS)
                return columns[(long long)number_of * n + c];
            const int axis = STEP_AXES[number_of - OTHERS];
            const int shift = axis == 0 ? one.shift[0] : axis == 1 ? one.shift[1] : one.shift[2];
            return real(shift - Lattice::turn(columns[(long long)OTHERS * n + c], axis));
        };
        term.evaluate(state.own_part, there, column, summand);
        state.reduction.add(summand, true, [&](int& source, int& code) {
            source = other;
            code = image;
        });
    }
    JFRNN_MEMBER void end_query(const State&, const One&) const {}
};
