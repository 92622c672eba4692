// Which slots of a list hold a pair now, on the CPU: a byte for each.
#pragma once
#include "kept_cpu.h"

struct MaskArguments {
    const real *rows, *points, *cutoff, *steps;
    const int *idx, *count, *codes, *slots, *starts, *lengths;
    int *mask, *info;
    int m, n, capacity, images, closed, apart;

    KeptArguments of_list() const {
        return {rows, points, cutoff, steps, idx, count, codes, slots, starts, lengths, m, n, capacity, images, closed, apart};
    }
};
struct KeptMask : KeptRows<KeptMask> {
    unsigned char* const mask;

    explicit KeptMask(const MaskArguments& a) : KeptRows(a.of_list(), a.info), mask((unsigned char*)a.mask) {}

    void serve(int row, const OwnPoint& own) {
        unsigned char* const out = mask + (long long)row * capacity;
        const int length = capacity;
        memset(out, 0, length);
        walk(row, own, [&](const KeptSlots& some) {
            unsigned char bytes[LANES];
            for (int l = 0; l < LANES; ++l)
                bytes[l] = some.pairs >> l & 1;
            const int left = length - some.places;
            memcpy(out + some.places, bytes, left < LANES ? left : LANES);
        });
    }
    void finish_chunk(int) {}
};
