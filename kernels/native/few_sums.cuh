// Sums over pairs of few particles on CUDA: what the term reads is gathered until there are 32 pairs of a query, one per lane.
#pragma once
#include "few.cuh"
#include "reduction.cuh"

struct FewSumsArguments {
    const real *positions, *queries, *cutoff, *shared_values, *own_values, *others;
    real *sums, *totals, *errors;
    int n, m, closed, drop_self;
};

struct FewSums : FewSumsArguments {
    JFRNN_MEMBER explicit FewSums(const FewSumsArguments& given) : FewSumsArguments(given) {}

    JFRNN_MEMBER void run() {
        constexpr int CODE = 16;                       // bits of the number of a source; the code of its image stands above
        constexpr int COLUMNS = OTHERS + (STEPS > 0);  // turns stand behind the others
        __shared__ int waiting_of[FEW_QUERIES][64];
        const FewPairs pairs(*this, false);
        const int lane = pairs.lane, id = pairs.is_query ? pairs.query : 0;
        int* const waiting = waiting_of[threadIdx.x >> 5];
        const unsigned int lanes_below = (1u << lane) - 1;
        const Term term(shared_values);
        const Term::Own own_part = term.own(own_values + (long long)id * OWN, pairs.q);
        Reduction reduction(n);
        int held = 0;
        auto evaluate = [&]() {  // the first 32 that wait, or as many as there are
            const int named = lane < held ? waiting[lane] : 0, j = named & ((1 << CODE) - 1), of_image = named >> CODE;
            const real* const row = others + (long long)COLUMNS * j;
            real p[3];
            pairs.point_of(positions + (long long)ROW * j, p);
            number summand[SUMMANDS];
            auto column = [&](int c) -> number {
                if (c < OTHERS)
                    return row[c];
                const int axis = STEP_AXES[c - OTHERS];
                return real(pairs.shift_in(of_image, axis) - Lattice::turn(row[OTHERS], axis));
            };
            term.evaluate(own_part, p, column, summand);
            reduction.add(summand, lane < held, [&](int& source, int& code) {
                source = j;
                code = of_image;
            });
        };
        pairs.meet_all([&](int j, int code, unsigned int hits) {
            if (hits >> lane & 1)
                waiting[held + __popc(hits & lanes_below)] = j | code << CODE;
            held += __popc(hits);
            __syncwarp();
            if (held < 32)
                return;
            evaluate();
            held -= 32;
            const int rest = waiting[32 + lane];
            __syncwarp();
            waiting[lane] = rest;
            __syncwarp();
        });
        if (!pairs.is_query)
            return;
        if (held > 0)
            evaluate();
        const Results results{sums, errors, n, totals};
        for (int t = lane; t < 2 * TOTALS; t += 32)
            totals[2ll * TOTALS * id + t] = 0;
        __syncwarp();
        if (!finite_point(pairs.q)) {
            results.clear(id, lane, 32);
            return;
        }
        reduction.reduce_over_warp();
        reduction.store(results, {lane, id, id, lane == 0, true, true});
    }
};
