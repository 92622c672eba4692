// Reverse slots on CUDA: for the pair (i, j) in a row of i, eight lanes read the row of j together until i is found. Pairs whose j
// comes before i are found from the other side.
#pragma once
#include "reverse.h"

struct Reverse : ListOfRows {
    JFRNN_MEMBER explicit Reverse(const ReverseArguments& given) : ListOfRows(given) {}

    // A lane reads four ids of 32 at a time: at once, where rows begin at multiples of 16 bytes.
    JFRNN_MEMBER void run() const {
        constexpr unsigned int ALL_LANES = 0xffffffffu;
        const long long thread = thread_index();
        const int slot = (int)(thread >> 3), lane = (int)(thread & 7);
        const bool there = thread >> 3 < (long long)none();
        const int i = there ? slot / capacity : 0, j = there ? idx[slot] : n;
        const int code = j < n ? opposite(code_at(slot)) : 0, row = j < n ? j * capacity : 0;
        int found = capacity;
        bool searching = j < n && j >= i;
        for (int b = 0; __any_sync(ALL_LANES, searching); b += 32) {
            const int from = b + 4 * lane;
            if (searching)
#pragma unroll
                for (int k = 3; k >= 0; --k) {
                    const int place = from + k;
                    const bool same = place < capacity && idx[row + place] == i;
                    if (same && (CODE_BYTES == 0 || code_at(row + place) == code))
                        found = place;
                }
#pragma unroll
            for (int step = 4; step > 0; step /= 2) {
                const int other = __shfl_xor_sync(ALL_LANES, found, step);
                found = other < found ? other : found;
            }
            searching = searching && found == capacity && b + 32 < capacity;
        }
        if (found < capacity && lane == 0) {
            slots[slot] = row + found;
            slots[row + found] = slot;
        }
    }
    // Before that, no slot has any.
    JFRNN_MEMBER void clear() const {
        if (thread_index() < none())
            slots[thread_index()] = none();
    }
};
