// Rows of a common length become those of a flat list, which follow each other without gaps.
#pragma once
#include "chunks.h"
#include "constants.h"
#include "device.h"

// Row i has `counts[i]` of `capacity` entries, and begins at `starts[i]`; the last one ends at `starts[m]`. Behind that, senders are n
// and receivers m.
struct PackArguments {
    const int *rows, *counts, *starts;
    int *senders, *receivers, *info;
    int n, m, capacity, total;
};

struct Pack : PackArguments {
    JFRNN_MEMBER explicit Pack(const PackArguments& given) : PackArguments(given) {}

    JFRNN_MEMBER void write(long long edge, int sender, int receiver) const {
        if (edge < total) {
            senders[edge] = sender;
            receivers[edge] = receiver;
        }
    }
    JFRNN_MEMBER int length(int row) const { return counts[row] < capacity ? counts[row] : capacity; }
#if defined(__CUDACC__)
    // Eight lanes serve a row, and each of them reads four entries before it writes any.
    JFRNN_MEMBER void run() const {
        constexpr int LANES = 8, AT_ONCE = 4;
        const long long thread = thread_index(), row = thread / LANES;
        for (long long edge = starts[m] + thread; edge < total; edge += (long long)gridDim.x * blockDim.x)
            write(edge, n, m);
        if (row >= m)
            return;
        const long long start = starts[row];
        const int all = length((int)row);
        const int* const from = rows + row * capacity;
        for (int first = (int)(thread % LANES); first < all; first += LANES * AT_ONCE) {
            int entries[AT_ONCE];
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k)
                entries[k] = first + LANES * k < all ? from[first + LANES * k] : n;
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k)
                if (first + LANES * k < all)
                    write(start + first + LANES * k, entries[k], (int)row);
        }
    }
#else
    void run() const {
        each_chunk(*info, m, QUERY_CHUNK, [&](int from, int to, int) {
            for (int row = from; row < to; ++row)
                for (int k = 0; k < length(row); ++k)
                    write((long long)starts[row] + k, rows[(long long)row * capacity + k], row);
            for (long long edge = starts[m]; to == m && edge < total; ++edge)
                write(edge, n, m);
        });
    }
#endif
};
