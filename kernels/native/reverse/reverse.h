// Where the pairs of a list stand the other way round: what all threads of the CPU and of CUDA know of the list.
#pragma once
#include "codes.h"

// `codes` are of CODE_BYTES each: 0 where a pair has one image; `order` is read where rows are ORDERED, on CUDA. The slot of a pair is
// row * capacity + its place in the row.
struct ReverseArguments {
    const int *idx, *codes, *order;
    int *slots, *info;
    int n, capacity, images;
};

struct ListOfRows : ReverseArguments {
    JFRNN_MEMBER explicit ListOfRows(const ReverseArguments& given) : ReverseArguments(given) {}

    JFRNN_MEMBER int none() const { return n * capacity; }
    JFRNN_MEMBER int code_at(int slot) const { return image_code(codes, slot); }
    // The code of the opposite shift: codes number the shifts in an order that begins with the opposite of the last one.
    JFRNN_MEMBER int opposite(int code) const { return CODE_BYTES == 0 ? 0 : images - 1 - code; }
};
