// What belongs to the slots of a list, summed for their sources: each gathers from its slots, in order.
#pragma once
#include "chunks.h"
#include "constants.h"
#include "device.h"

// `slots` are rows of `capacity` for each source, or (REVERSED) `lengths` many from `starts` on; those from `all` on are none.
struct CollectArguments {
    const real* values;  // WIDTH of each slot
    const int *slots, *starts, *lengths;
    real* sums;
    int* info;
    int n, capacity, all;
};

struct Collect : CollectArguments {
    JFRNN_MEMBER explicit Collect(const CollectArguments& given) : CollectArguments(given) {}

    JFRNN_MEMBER long long first(int source) const { return REVERSED ? starts[source] : (long long)source * capacity; }
    JFRNN_MEMBER int count(int source) const { return REVERSED ? lengths[source] : capacity; }
    JFRNN_MEMBER void add(int slot, real* sum) const {
        if ((unsigned int)slot >= (unsigned int)all)
            return;
        const real* const from = values + (long long)WIDTH * slot;
        for (int w = 0; w < WIDTH; ++w)
            sum[w] += from[w];
    }
#if defined(__CUDACC__)
    // Eight lanes serve a source.
    JFRNN_MEMBER void run() const {
        constexpr unsigned int EVERY_LANE = 0xffffffffu;
        const int lane = (int)(thread_index() & 7), source = (int)(thread_index() >> 3);
        real sum[WIDTH] = {};
        if (source < n) {
            const int* const own = slots + first(source);
            const int length = count(source);
#pragma unroll 4
            for (int k = lane; k < length; k += 8)
                add(own[k], sum);
        }
#pragma unroll
        for (int w = 0; w < WIDTH; ++w)
            for (int step = 4; step > 0; step /= 2)
                sum[w] += __shfl_down_sync(EVERY_LANE, sum[w], step);
        if (source < n && lane == 0)
            for (int w = 0; w < WIDTH; ++w)
                sums[(long long)WIDTH * source + w] = sum[w];
    }
#else
    void run() const {
        each_chunk(*info, n, QUERY_CHUNK, [&](int from, int to, int) {
            for (int source = from; source < to; ++source) {
                const int* const own = slots + first(source);
                const int length = count(source);
                real sum[WIDTH] = {};
                for (int k = 0; k < length; ++k)
                    add(own[k], sum);
                for (int w = 0; w < WIDTH; ++w)
                    sums[(long long)WIDTH * source + w] = sum[w];
            }
        });
    }
#endif
};
