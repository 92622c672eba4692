// Reverse slots on CUDA: eight lanes take the row of i, and for each pair (i, j) in it read the row of j until i is found. Pairs whose
// j comes before i are found from the other side.
#pragma once
#include "reverse.h"

struct Reverse : ListOfRows {
    static constexpr unsigned int ALL_LANES = 0xffffffffu;
    const int lane, group;  // of the lanes of a row, and of the rows of a warp
    const int i;
    JFRNN_MEMBER explicit Reverse(const ReverseArguments& given)
        : ListOfRows(given), lane(threadIdx.x & 7), group(threadIdx.x >> 3 & 3), i((int)(thread_index() >> 3)) {}

    JFRNN_MEMBER void run() const {
        for (int first = 0; __any_sync(ALL_LANES, first < capacity); first += 8) {
            const int place = first + lane;
            const int mine = i < n && place < capacity ? idx[i * capacity + place] : n;
            if (!__any_sync(ALL_LANES, mine < n))  // unused slots come last
                break;
            unsigned int left = of_row(mine < n && mine >= i);
            while (__any_sync(ALL_LANES, left != 0)) {
                const int which = left ? __ffs(left) - 1 : 0;
                find(first + which, __shfl_sync(ALL_LANES, mine, which, 8), left != 0);
                left &= left - 1;
            }
        }
    }
    // What the lanes of this row say.
    JFRNN_MEMBER unsigned int of_row(bool said) const { return __ballot_sync(ALL_LANES, said) >> 8 * group & 0xff; }
    // Finds i in the row of j, its neighbor at a place. The lanes read 32 ids at a time, eight that follow each other at once.
    JFRNN_MEMBER void find(int place, int j, bool searching) const {
        const int slot = i * capacity + place, row = j * capacity, code = searching ? opposite(code_at(slot)) : 0;
        for (int b = 0; __any_sync(ALL_LANES, searching); b += 32) {
            bool found = false;
            if (searching)
#pragma unroll
                for (int k = 0; k < 4; ++k) {
                    const int there = b + 8 * k + lane, at = row + there;
                    if (there < capacity && idx[at] == i && (CODE_BYTES == 0 || code_at(at) == code)) {
                        slots[slot] = at;
                        slots[at] = slot;
                        found = true;
                    }
                }
            searching = of_row(found) == 0 && searching && b + 32 < capacity;
        }
    }
    // Before that, no slot has any.
    JFRNN_MEMBER void clear() const {
        if (thread_index() < none())
            slots[thread_index()] = none();
    }
};
