// The slots of a list that hold a pair, one after another: what is read is which of them do, and where those of each row begin.
#pragma once
#include "chunks.h"
#include "constants.h"
#include "device.h"

struct FlattenArguments {
    const int* mask;  // a byte for each of `capacity` slots of m rows
    const int* starts;
    int *receivers, *slots, *info;
    int m, capacity, total;
};

struct Flatten : FlattenArguments {
    JFRNN_MEMBER explicit Flatten(const FlattenArguments& given) : FlattenArguments(given) {}

    JFRNN_MEMBER bool holds_pair(int slot) const { return ((const unsigned char*)mask)[slot]; }
    JFRNN_MEMBER void write(int edge, int row, int slot) const {
        receivers[edge] = row;
        slots[edge] = slot;
    }
#if defined(__CUDACC__)
    // A warp serves a row.
    JFRNN_MEMBER void run() const {
        constexpr unsigned int EVERY_LANE = 0xffffffffu;
        const int lane = (int)(thread_index() & 31);
        const long long row = thread_index() >> 5;
        if (row >= m)
            return;
        int edge = starts[row];
        for (int k = lane; k - lane < capacity; k += 32) {
            const int slot = (int)row * capacity + k;
            const bool held = k < capacity && holds_pair(slot);
            const unsigned int all = __ballot_sync(EVERY_LANE, held);
            const int here = edge + __popc(all & ((1u << lane) - 1));
            if (held && here < total)
                write(here, (int)row, slot);
            edge += __popc(all);
        }
    }
#else
    void run() const {
        each_chunk(*info, m, QUERY_CHUNK, [&](int from, int to, int) {
            for (int row = from; row < to; ++row) {
                int edge = starts[row];
                for (int slot = row * capacity; slot < (row + 1) * capacity && edge < total; ++slot)
                    if (holds_pair(slot))
                        write(edge++, row, slot);
            }
        });
    }
#endif
};
