// Sums over pairs of few particles on CUDA: each thread sums over its share of the sources, then shares are added, in their order.
#pragma once
#include "few.cuh"
#include "reduction.cuh"

struct FewSumsArguments : FewArguments {
    const real *shared_values, *own_values, *others;
    real *sums, *totals, *errors, *more;
};

struct FewSums : FewSumsArguments {
    JFRNN_MEMBER explicit FewSums(const FewSumsArguments& given) : FewSumsArguments(given) {}

    JFRNN_MEMBER void run() {
        constexpr int COLUMNS = OTHERS + (STEPS > 0);  // turns stand behind the others
        __shared__ FewPairs::Bits32 near[WORDS];
        const FewPairs pairs(*this, false);
        const Term term(shared_values);
        const Term::Own own_part = term.own(own_values + (long long)OWN * (pairs.is_query ? pairs.query : 0), pairs.q);
        Reduction reduction(n);
        bool doubtful;
        pairs.find(near, doubtful);
        pairs.meet_all(near, doubtful, [&](int j, const real* p, int of_image) {
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
        const Results results(sums, errors, n, totals, more);
        store_totals(pairs, results, reduction);
        exchange(pairs, reduction, near);
        store_row(pairs, results, reduction);
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
    // Hands what there is of each query to one warp, share by share.
    JFRNN_MEMBER void exchange(const FewPairs& pairs, Reduction& reduction, FewPairs::Bits32* room) const {
        constexpr int NUMBERS = sizeof(Reduction) / 4;
        unsigned int numbers[NUMBERS];
        memcpy(numbers, &reduction, sizeof numbers);
        const int from = 32 * (pairs.lane / OF_WARP) + OF_WARP * pairs.warp + pairs.lane % OF_WARP;
#pragma unroll
        for (int begin = 0; begin < NUMBERS; begin += WORDS) {
            __syncthreads();
#pragma unroll
            for (int k = begin; k < begin + WORDS && k < NUMBERS; ++k)
                room[k - begin][threadIdx.x] = numbers[k];
            __syncthreads();
#pragma unroll
            for (int k = begin; k < begin + WORDS && k < NUMBERS; ++k)
                numbers[k] = room[k - begin][from];
        }
        memcpy(&reduction, numbers, sizeof numbers);
    }
    JFRNN_MEMBER void store_row(const FewPairs& pairs, const Results& results, Reduction& reduction) const {
        const int id = blockIdx.x * FEW_WARPS + pairs.warp;
        reduction.reduce_over_warp();
        if (pairs.lane > 0 || id >= m)
            return;
        real q[3];
        pairs.point_of(queries + (long long)ROW * id, q);
        if (finite_point(q))
            reduction.store(results, {0, id, NO_BLOCK, true, true, true});
        else
            results.clear(id);
    }
};
