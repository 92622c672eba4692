// Rows of neighbors, or their counts, in systems with boxes of their own on CUDA.
#pragma once
#include "box_pairs.cuh"

struct BoxRows : BoxWarp<BoxRows> {
    int found;  // by the query of this lane

    JFRNN_MEMBER explicit BoxRows(const BoxArguments& given) : BoxWarp(given), found(0) {}

    JFRNN_MEMBER void run() {
        go_to_own();
        walk();
        const int longest = __reduce_max_sync(EVERY, is_query ? found : 0);
        if (lane == 0 && longest > *(volatile int*)&info[0])
            atomicMax(&info[0], longest);
        if (is_query)
            count[query] = found;
        if constexpr (LIST)
            for (unsigned int there = __ballot_sync(EVERY, is_query && found < capacity); there; there &= there - 1) {
                const int other = __ffs(there) - 1, row = __shfl_sync(EVERY, query, other);
                for (int s = __shfl_sync(EVERY, found, other) + lane; s < capacity; s += 32)
                    idx[(long long)row * capacity + s] = fill_value();
            }
    }
    // Writes the neighbors of one query after the other, each lane a source.
    JFRNN_MEMBER void take(const BoxRun& run, int at, int size, unsigned int hits) {
        if constexpr (LIST) {
            const int name = lane < size ? name_of(ids[at + lane], run.code) : 0;
            for (unsigned int there = __ballot_sync(EVERY, hits != 0); there; there &= there - 1) {
                const int other = __ffs(there) - 1, row = __shfl_sync(EVERY, query, other);
                const unsigned int bits = __shfl_sync(EVERY, hits, other);
                const int slot = __shfl_sync(EVERY, found, other) + __popc(bits & ((1u << lane) - 1));
                if (bits >> lane & 1 && slot < capacity)
                    idx[(long long)row * capacity + slot] = name;
            }
        }
        found += __popc(hits);
    }
};
