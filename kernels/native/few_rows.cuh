// Rows of neighbors, or their counts, of few particles on CUDA. Each block has a row of `info`: the length of the longest row of its
// queries, and the bits of their status. Nothing has to be cleared before.
#pragma once
#include "few.cuh"

struct FewRowsArguments {
    const real *positions, *queries, *cutoff;
    int *idx, *count, *info;
    int n, m, capacity, closed, drop_self, later_only;
};

struct FewRows : FewRowsArguments {
    JFRNN_MEMBER explicit FewRows(const FewRowsArguments& given) : FewRowsArguments(given) {}

    JFRNN_MEMBER void run() {
        const FewPairs pairs(*this, later_only);
        int* const row = idx + (long long)pairs.query * capacity;
        const unsigned int lanes_below = (1u << pairs.lane) - 1;
        int found = 0;
        const bool finite = pairs.meet_all([&](int j, int, unsigned int hits) {
            const int slot = found + __popc(hits & lanes_below);
            if (LIST && (hits >> pairs.lane & 1) && slot < capacity)
                row[slot] = j;
            found += __popc(hits);
        });
        if (LIST && pairs.is_query)
            for (int slot = found + pairs.lane; slot < capacity; slot += 32)
                row[slot] = n;
        if (pairs.is_query && pairs.lane == 0)
            count[pairs.query] = found;
        tell(found, !finite || (pairs.is_query && !finite_point(pairs.q)));
    }
    // Writes the row of `info` of this block.
    JFRNN_MEMBER void tell(int found, bool not_finite) const {
        __shared__ int longest;
        if (threadIdx.x == 0)
            longest = 0;
        const bool any_not_finite = __syncthreads_or(not_finite);
        if ((threadIdx.x & 31) == 0)
            atomicMax(&longest, found);
        __syncthreads();
        if (threadIdx.x > 0)
            return;
        info[2 * blockIdx.x] = longest;
        info[2 * blockIdx.x + 1] = (any_not_finite ? 2 : 0) | (LIST && longest > capacity ? 1 : 0);
    }
};
