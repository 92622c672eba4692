// What distances of a list give to the derivatives of positions, on CUDA.
#pragma once
#include "kept.cuh"

struct KeptSlopes : KeptLane {
    const real *distances, *slopes;
    real* const sums;

    JFRNN_MEMBER explicit KeptSlopes(const KeptSlopesArguments& a)
        : KeptLane(a), distances(a.distances), slopes(a.slopes), sums(a.sums) {}

    JFRNN_MEMBER void run() const {
        real sum[DIM] = {};
        const OwnPoint own = own_point(is_row ? row : 0);
        const long long first = is_row ? (long long)row * capacity : 0;
        const int all = is_row ? entries(row) : 0;
        for (int place = AT_A_TIME * lane; place < all; place += AT_A_TIME * LANES_PER_ROW)
            add(own, first, place, all, sum);
#pragma unroll
        for (int k = 0; k < DIM; ++k)
            for (int step = LANES_PER_ROW / 2; step > 0; step /= 2)
                sum[k] += __shfl_down_sync(0xffffffffu, sum[k], step);
        if (is_row && lane == 0)
            for (int k = 0; k < DIM; ++k)
                sums[(long long)DIM * row + k] = -sum[k];
    }
    // Adds what the slots of a row from `place` on give.
    JFRNN_MEMBER void add(const OwnPoint& own, long long first, int place, int all, real* sum) const {
        Entries some;
        read(first, place, all, some);
        int back[AT_A_TIME];
        real distance[AT_A_TIME], slope[AT_A_TIME], other[AT_A_TIME], numbers[AT_A_TIME][LENGTH];
        read_slots(distances + first, place, distance);
        read_slots(slots + first, place, back);
        read_slots(slopes + first, place, slope);
#pragma unroll
        for (int k = 0; k < AT_A_TIME; ++k) {
            other[k] = 0;
            if (distance[k] >= LEAST_DISTANCE) {
                load_numbers<LENGTH>(points + (long long)LENGTH * some.ids[k], numbers[k]);
                if ((unsigned int)back[k] < (unsigned int)(m * capacity))
                    load_numbers<1>(slopes + back[k], &other[k]);
            }
        }
#pragma unroll
        for (int k = 0; k < AT_A_TIME; ++k)
            if (distance[k] >= LEAST_DISTANCE) {
                const Verdict verdict = judged<false>(own, numbers[k], some.ids[k], some.codes[k]);
                const real reciprocal = 1 / distance[k], along = slope[k] + other[k];
                for (int a = 0; a < DIM; ++a)
                    sum[a] += along * (verdict.vector[a] * reciprocal);
            }
    }
};
