// Rows of neighbors, or their counts, of few particles on CUDA. Each block has a row of `info`: the length of the longest row of its
// queries, and the bits of their status. Nothing has to be cleared before.
#pragma once
#include "few.cuh"

struct FewRowsArguments {
    const real *positions, *queries, *cutoff;
    int *idx, *count, *info;
    int n, m, capacity, closed, drop_self, later_only, parts;
};

struct FewRows : FewRowsArguments {
    JFRNN_MEMBER explicit FewRows(const FewRowsArguments& given) : FewRowsArguments(given) {}

    JFRNN_MEMBER void run() {
        __shared__ unsigned int near[FEW_WORDS][FEW_THREADS];
        __shared__ int found_by[FEW_WARPS][32];
        const FewPairs pairs(*this, later_only);
        const bool finite = pairs.find(near);
        int found = 0;
        pairs.meet_all(near, [&](int, const real*, int) { ++found; });
        found_by[pairs.warp][pairs.lane] = found;
        const bool not_finite = __syncthreads_or(!finite || (pairs.is_query && !pairs.is_finite));
        int before = 0, all = 0;
        for (int w = 0; w < FEW_WARPS; ++w)
            for (int part = 0; part < parts; ++part) {
                if (w * parts + part == pairs.share)
                    before = all;
                all += found_by[w][pairs.slot * parts + part];
            }
        if (LIST && found > 0)
            write(pairs, near, idx + (long long)pairs.query * capacity, before);
        if constexpr (LIST)
            fill(pairs, all);
        if (pairs.warp > 0)
            return;
        if (pairs.is_query && pairs.share == 0)
            count[pairs.query] = all;
        tell(pairs, all, not_finite);
    }
    JFRNN_MEMBER void write(const FewPairs& pairs, const unsigned int (*near)[FEW_THREADS], int* row, int slot) const {
        for (int k = 0; k < pairs.words; ++k)
            for (unsigned int rest = near[k][threadIdx.x]; rest && slot < capacity; rest &= rest - 1)
                row[slot++] = pairs.first_of(k) + __ffs(rest) - 1;
    }
    // Fills what is left of rows, each by one warp.
    JFRNN_MEMBER void fill(const FewPairs& pairs, int all) const {
        for (int k = pairs.warp; k < 32 / parts; k += FEW_WARPS) {
            const int query = pairs.query - pairs.slot + k, from = __shfl_sync(0xffffffffu, all, k * parts);
            for (int slot = from + pairs.lane; query < m && slot < capacity; slot += 32)
                idx[(long long)query * capacity + slot] = n;
        }
    }
    // Writes the row of `info` of this block.
    JFRNN_MEMBER void tell(const FewPairs& pairs, int longest, bool not_finite) const {
        for (int step = 16; step > 0; step /= 2) {
            const int other = __shfl_down_sync(0xffffffffu, longest, step);
            longest = other > longest ? other : longest;
        }
        if (pairs.lane > 0)
            return;
        info[2 * blockIdx.x] = longest;
        info[2 * blockIdx.x + 1] = (not_finite ? 2 : 0) | (LIST && longest > capacity ? 1 : 0);
    }
};
