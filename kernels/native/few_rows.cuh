// Rows of neighbors, or their counts, of few particles on CUDA; `info` is zeros at first.
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
        const bool finite = pairs.meet_all([&](int j, int, bool hit) {
            const unsigned int hits = __ballot_sync(EVERY, hit);
            const int slot = found + __popc(hits & lanes_below);
            if (LIST && hit && slot < capacity)
                row[slot] = j;
            found += __popc(hits);
        });
        if (blockIdx.x == 0 && !finite)
            atomicOr(&info[1], 2);
        if (!pairs.is_query)
            return;
        if (LIST)
            for (int slot = found + pairs.lane; slot < capacity; slot += 32)
                row[slot] = n;
        if (pairs.lane > 0)
            return;
        count[pairs.query] = found;
        if (found > *(volatile int*)&info[0])
            atomicMax(&info[0], found);
        const int state = (finite_point(pairs.q) ? 0 : 2) | (LIST && found > capacity ? 1 : 0);
        if (state)
            atomicOr(&info[1], state);
    }
};
