// Which slots of a list hold a pair now, on CUDA: a byte for each.
#pragma once
#include "kept.cuh"

struct MaskArguments {
    const real *rows, *points, *cutoff, *steps;
    const int *idx, *count, *codes, *slots, *starts, *lengths;
    int* mask;
    int m, n, capacity, images, closed, apart;

    JFRNN_MEMBER KeptArguments of_list() const {
        return {rows, points, cutoff, steps, idx, count, codes, slots, starts, lengths, m, n, capacity, images, closed, apart};
    }
};
struct KeptMask : KeptLane {
    unsigned char* const mask;

    JFRNN_MEMBER explicit KeptMask(const MaskArguments& a) : KeptLane(a.of_list()), mask((unsigned char*)a.mask) {}

    JFRNN_MEMBER void run() const {
        if (!is_row)
            return;
        unsigned char* const out = mask + (long long)row * capacity;
        for (int place = entries(row) + lane; place < capacity; place += LANES_PER_ROW)
            out[place] = 0;
        auto nothing = [](int, int, const real*, const Verdict&, bool) {};
        walk(own_point(row), nothing, [&](int place, unsigned int pairs) {
            if constexpr (ALIGNED && AT_A_TIME == 4)
                *(unsigned int*)(out + place) = (pairs & 1) | (pairs & 2) << 7 | (pairs & 4) << 14 | (pairs & 8) << 21;
            else
                for (int k = 0; k < AT_A_TIME && place + k < capacity; ++k)
                    out[place + k] = pairs >> k & 1;
        });
    }
};
