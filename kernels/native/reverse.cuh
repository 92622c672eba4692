// Reverse slots on CUDA: for the pair (i, j) in a row of i, eight lanes read the row of j together until i is found: first where it is
// likely to stand, then from the beginning. Pairs whose j comes before i are found from the other side.
#pragma once
#include "reverse.h"

struct Reverse : ListOfRows {
    JFRNN_MEMBER explicit Reverse(const ReverseArguments& given) : ListOfRows(given) {}

    JFRNN_MEMBER void run() const {
        constexpr unsigned int ALL_LANES = 0xffffffffu;
        const long long thread = thread_index();
        const int slot = (int)(thread >> 3), lane = (int)(thread & 7);
        const bool there = thread >> 3 < (long long)none();
        const int i = there ? slot / capacity : 0, j = there ? idx[slot] : n;
        const int code = j < n ? opposite(code_at(slot)) : 0, row = j < n ? j * capacity : 0;
        int found = capacity, next = 0;
        bool searching = j < n && j >= i;
        const int likely = searching ? likely_place(j, slot - i * capacity) - 16 : 0;
        int b = likely > 0 ? likely & ~3 : 0;
        while (__any_sync(ALL_LANES, searching)) {
            if (searching)
                found = place_among(row, b + 4 * lane, i, code);
#pragma unroll
            for (int step = 4; step > 0; step /= 2) {
                const int other = __shfl_xor_sync(ALL_LANES, found, step);
                found = other < found ? other : found;
            }
            searching = searching && found == capacity && next < capacity;
            b = next;
            next += 32;
        }
        if (found < capacity && lane == 0) {
            slots[slot] = row + found;
            slots[row + found] = slot;
        }
    }
    // The first of four places at which a source with an image stands, or `capacity`: ids are read at once, where rows begin at
    // multiples of 16 bytes.
    JFRNN_MEMBER int place_among(int row, int from, int source, int code) const {
        int ids[4] = {n, n, n, n};
        if (ALIGNED && from < capacity) {
            const int4 four = *(const int4*)(idx + row + from);
            ids[0] = four.x, ids[1] = four.y, ids[2] = four.z, ids[3] = four.w;
        }
        int found = capacity;
#pragma unroll
        for (int k = 3; k >= 0; --k) {
            const int place = from + k;
            const bool same = place < capacity && (ALIGNED ? ids[k] : idx[row + place]) == source;
            if (same && (CODE_BYTES == 0 || code_at(row + place) == code))
                found = place;
        }
        return found;
    }
    // Before that, no slot has any.
    JFRNN_MEMBER void clear() const {
        if (thread_index() < none())
            slots[thread_index()] = none();
    }
};
