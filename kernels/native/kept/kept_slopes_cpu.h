// What distances of a list give to the derivatives of positions, on the CPU.
#pragma once
#include "kept_cpu.h"

struct KeptSlopes : KeptRows<KeptSlopes> {
    const real *distances, *slopes;
    real* const sums;

    explicit KeptSlopes(const KeptSlopesArguments& a)
        : KeptRows(a, a.info), distances(a.distances), slopes(a.slopes), sums(a.sums) {}

    void serve(int row, const OwnPoint& own) {
        const long long first = (long long)row * capacity;
        const int all = entries(row);
        Number sum[DIM] = {};
        // slopes of the next row are on their way while those of this one are added: they stand in as many rows as it has neighbors
        for (int k = 0; row + 1 < m && k < entries(row + 1); ++k)
            __builtin_prefetch(slopes + (unsigned int)slots[first + capacity + k]);
        walk(row, own, [&](const KeptSlots& some) {
            const int left = all - some.places, count = left < LANES ? left : LANES;
            Number distance{}, slope{};
            memcpy(&distance, distances + first + some.places, sizeof(real) * count);
            memcpy(&slope, slopes + first + some.places, sizeof(real) * count);
            ints back{};
            memcpy(&back, slots + first + some.places, sizeof(int) * count);
            const auto there = (back >= 0) & (back < m * capacity);
            const ints from = back & there;  // without branches, which would be guessed wrongly while numbers are on their way
            Number others;
            for (int l = 0; l < LANES; ++l)
                others[l] = slopes[from[l]];
            slope = slope + Math::select(__builtin_convertvector(there, Math::flag), others, Number{});
            const Math::flag apart = Math::ge(distance, Math::of(LEAST_DISTANCE));
            const Number reciprocal = real(1) / Math::select(apart, distance, Math::of(real(1)));
            for (int k = 0; k < DIM; ++k)
                sum[k] = sum[k] + Math::select(apart, slope * (some.verdict.vector[k] * reciprocal), Number{});
        });
        for (int k = 0; k < DIM; ++k) {
            real total = 0;
            for (int l = 0; l < LANES; ++l)
                total -= sum[k][l];
            sums[(long long)DIM * row + k] = total;
        }
    }
    void finish_chunk(int) {}
};
