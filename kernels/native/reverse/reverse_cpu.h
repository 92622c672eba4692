// Reverse slots on the CPU: for the pair (i, j) in a row of i, the row of j is read until i is found, LANES ids at a time.
#pragma once
#include "chunks.h"
#include "lanes.h"
#include "reverse.h"

struct Reverse : ListOfRows {
    explicit Reverse(const ReverseArguments& given) : ListOfRows(given) {}

    // The place of a source with an image in a row, or `capacity`.
    int place_of(int row, int source, int code) const {
        const int* const ids = idx + (long long)row * capacity;
        int b = 0;
        for (; b + LANES <= capacity; b += LANES) {
            unsigned int same = bits_of_flags(__builtin_convertvector(lanes_from(ids + b) == source, flags));
            for (; same; same &= same - 1) {
                const int place = b + __builtin_ctz(same);
                if (CODE_BYTES == 0 || code_at(row * capacity + place) == code)
                    return place;
            }
        }
        for (; b < capacity; ++b)
            if (ids[b] == source && (CODE_BYTES == 0 || code_at(row * capacity + b) == code))
                return b;
        return capacity;
    }
    // Finds the reverse slots of those whose source does not come before the row, and is found for these, too.
    void reverse_row(int i) const {
        for (int k = 0; k < capacity; ++k) {
            const int slot = i * capacity + k, j = idx[slot];
            const int place = j < n && j >= i ? place_of(j, i, opposite(code_at(slot))) : capacity;
            if (place < capacity) {
                slots[slot] = j * capacity + place;
                slots[j * capacity + place] = slot;
            }
        }
    }
    // Before that, no slot has any.
    void clear() const {
        for (int slot = 0; slot < none(); ++slot)
            slots[slot] = none();
    }
    void run() const {
        each_chunk(*info, n, QUERY_CHUNK, [&](int from, int to, int) {
            for (int i = from; i < to; ++i)
                reverse_row(i);
        });
    }
};

struct TransposeArguments {
    const int* idx;
    int *slots, *starts, *lengths;
    int n, m, capacity;
};
// The slots of a list in the order of their sources, by a counting sort: those of source j are `lengths[j]` from `starts[j]` on.
struct Transpose : TransposeArguments {
    explicit Transpose(const TransposeArguments& given) : TransposeArguments(given) {}

    void run() const {
        const int all = m * capacity;
        memset(lengths, 0, sizeof(int) * n);
        for (int slot = 0; slot < all; ++slot)
            if (idx[slot] < n)
                ++lengths[idx[slot]];
        int used = 0;
        for (int j = 0; j < n; ++j) {
            starts[j] = used;
            used += lengths[j];
        }
        for (int slot = 0; slot < all; ++slot)
            if (idx[slot] < n)
                slots[starts[idx[slot]]++] = slot;
        for (int j = 0; j < n; ++j)
            starts[j] -= lengths[j];
        for (int place = used; place < all; ++place)
            slots[place] = all;
    }
};
