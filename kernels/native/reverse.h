// Where the pairs of a list stand the other way round: what all threads of the CPU and of CUDA know of the list.
#pragma once
#include "codes.h"

// `codes` are of CODE_BYTES each: 0 where a pair has one image. The slot of a pair is row * capacity + its place in the row. `count`
// says how many slots of a row are used.
struct ReverseArguments {
    const int *idx, *codes, *count;
    int *slots, *info;
    int n, capacity, images;
};

struct ListOfRows : ReverseArguments {
    JFRNN_MEMBER explicit ListOfRows(const ReverseArguments& given) : ReverseArguments(given) {}

    JFRNN_MEMBER int none() const { return n * capacity; }
    JFRNN_MEMBER int code_at(int slot) const { return image_code(codes, slot); }
    // Where a pair is looked for first in the row of j: rows list neighbors in one order of space, so who has many behind i in its own
    // row has many before j in this one.
    JFRNN_MEMBER int likely_place(int j, int place) const {
        const int used = count[j] < capacity ? count[j] : capacity;
        return place < used ? used - 1 - place : 0;
    }
    // The code of the opposite shift: codes number the shifts in an order that begins with the opposite of the last one.
    JFRNN_MEMBER int opposite(int code) const { return CODE_BYTES == 0 ? 0 : images - 1 - code; }
};
