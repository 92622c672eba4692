// Reverse slots on CUDA: for the pair (i, j) in a row of i, a lane reads the row of j, eight ids at a time, until i is found. Rows are
// taken as their particles follow each other in space, so that the rows of neighbors are near, too.
#pragma once
#include "reverse.h"

struct Reverse : ListOfRows {
    const int row, lane;

    JFRNN_MEMBER explicit Reverse(const ReverseArguments& given)
        : ListOfRows(given), row(row_at((int)(thread_index() >> 5), given)), lane((int)(thread_index() & 31)) {}
    // Where the first number is negative, or there are none, rows are taken as they come.
    JFRNN_FUNCTION int row_at(int place, const ReverseArguments& given) {
        return ORDERED && place < given.n && given.order[0] >= 0 ? given.order[place] : place;
    }

    JFRNN_MEMBER void run() const {
        if (row >= n)
            return;
        for (int k = lane; k < capacity; k += 32) {
            const int slot = row * capacity + k, j = idx[slot];
            slots[slot] = j < n ? slot_in(j * capacity, row, opposite(code_at(slot))) : none();
        }
    }
    // The slot of a source, with a code, in the row that begins at `begin`. Four ids are read at once, from multiples of 16 bytes on.
    JFRNN_MEMBER int slot_in(int begin, int source, int code) const {
        const unsigned int end = (unsigned int)(begin + capacity);
        for (unsigned int from = (unsigned int)begin & ~3u; from < end; from += 8) {
            const int4 first = four_from(from), second = four_from(from + 4);
            const int ids[8] = {first.x, first.y, first.z, first.w, second.x, second.y, second.z, second.w};
            unsigned int same = 0;
#pragma unroll
            for (int k = 0; k < 8; ++k)
                same |= (unsigned int)(ids[k] == source) << k;
            for (; same; same &= same - 1) {
                const int found = (int)from + __ffs((int)same) - 1;
                if (found >= begin && found < begin + capacity && (CODE_BYTES == 0 || code_at(found) == code))
                    return found;
            }
        }
        return none();
    }
    JFRNN_MEMBER int4 four_from(unsigned int slot) const {
        const unsigned int all = (unsigned int)none();
        if (slot + 4 <= all)
            return *(const int4*)(idx + slot);
        int ids[4];
        for (int k = 0; k < 4; ++k)
            ids[k] = slot + k < all ? idx[slot + k] : n;
        return make_int4(ids[0], ids[1], ids[2], ids[3]);
    }
};
