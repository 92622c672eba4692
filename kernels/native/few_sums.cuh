// Sums over pairs of few particles on CUDA: each thread sums over its share of the sources, then shares are added, in their order.
#pragma once
#include "few.cuh"
#include "reduction.cuh"

struct FewSumsArguments {
    const real *positions, *queries, *cutoff, *shared_values, *own_values, *others;
    real *sums, *totals, *errors;
    int n, m, closed, drop_self, parts;
};

struct FewSums : FewSumsArguments {
    JFRNN_MEMBER explicit FewSums(const FewSumsArguments& given) : FewSumsArguments(given) {}

    JFRNN_MEMBER void run() {
        constexpr int COLUMNS = OTHERS + (STEPS > 0);  // turns stand behind the others
        __shared__ unsigned int near[FEW_WORDS][FEW_THREADS];
        const FewPairs pairs(*this, false);
        const Term term(shared_values);
        const Term::Own own_part = term.own(own_values + (long long)OWN * (pairs.is_query ? pairs.query : 0), pairs.q);
        Reduction reduction(n);
        pairs.find(near);
        pairs.meet_all(near, [&](int j, const real* p, int of_image) {
            const real* const row = others + (long long)COLUMNS * j;
            auto column = [&](int c) -> number {
                if (c < OTHERS)
                    return row[c];
                const int axis = STEP_AXES[c - OTHERS];
                return real(pairs.shift_in(of_image, axis) - Lattice::turn(row[OTHERS], axis));
            };
            number summand[SUMMANDS];
            term.evaluate(own_part, p, column, summand);
            reduction.add(summand, true, [&](int& source, int& code) {
                source = j;
                code = of_image;
            });
        });
        const Results results{sums, errors, n, totals};
        store_totals(pairs, results, reduction);
        if (parts > 1)
            reduction.template reduce_over_warp<FEW_PARTS>();
        exchange(reduction, near);
        store_rows(pairs, results, reduction);
    }
    // Each warp has parts of the sums over all pairs.
    JFRNN_MEMBER void store_totals(const FewPairs& pairs, const Results& results, const Reduction& reduction) const {
        if constexpr (TOTALS == 0 || SUMS == 2)
            return;
        const int part = blockIdx.x * FEW_WARPS + pairs.warp;
        for (int t = pairs.lane; t < 2 * TOTALS; t += 32)
            totals[2ll * TOTALS * part + t] = 0;
        __syncwarp();
        reduction.store(results, {pairs.lane, 0, part, false, true, true});
    }
    // Hands what each warp has of a query to FEW_WARPS lanes of one warp.
    JFRNN_MEMBER void exchange(Reduction& reduction, unsigned int (*room)[FEW_THREADS]) const {
        constexpr int WORDS = sizeof(Reduction) / 4;
        unsigned int words[WORDS];
        memcpy(words, &reduction, sizeof words);
        const int slot = threadIdx.x / FEW_WARPS, from = threadIdx.x % FEW_WARPS * 32 + slot * parts % 32;
#pragma unroll
        for (int begin = 0; begin < WORDS; begin += FEW_WORDS) {
            __syncthreads();
#pragma unroll
            for (int w = begin; w < begin + FEW_WORDS && w < WORDS; ++w)
                room[w - begin][threadIdx.x] = words[w];
            __syncthreads();
#pragma unroll
            for (int w = begin; w < begin + FEW_WORDS && w < WORDS; ++w)
                words[w] = room[w - begin][from];
        }
        memcpy(&reduction, words, sizeof words);
    }
    JFRNN_MEMBER void store_rows(const FewPairs& pairs, const Results& results, Reduction& reduction) const {
        const int slot = threadIdx.x / FEW_WARPS, id = pairs.query - pairs.slot + slot;
        reduction.template reduce_over_warp<FEW_WARPS>();
        if (threadIdx.x % FEW_WARPS > 0 || slot >= 32 / parts || id >= m)
            return;
        real q[3];
        pairs.point_of(queries + (long long)ROW * id, q);
        if (finite_point(q))
            reduction.store(results, {pairs.lane, id, NO_BLOCK, true, true, true});
        else
            results.clear(id);
    }
};
