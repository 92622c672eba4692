// Which slots of a list hold a pair now, on the CPU: a byte for each, and (MEASURED) how far apart the two are.
#pragma once
#include "kept_cpu.h"

struct KeptMask : KeptRows<KeptMask> {
    unsigned char* const mask;
    real* const distances;

    explicit KeptMask(const MaskArguments& a) : KeptRows(a, a.info), mask((unsigned char*)a.mask), distances(a.distances) {}

    void serve(int row, const OwnPoint& own) {
        unsigned char* const out = mask + (long long)row * capacity;
        real* const lengths = MEASURED ? distances + (long long)row * capacity : distances;
        const int all = entries(row);
        memset(out + all, 0, capacity - all);
        if constexpr (MEASURED)
            memset(lengths + all, 0, sizeof(real) * (capacity - all));
        walk(row, own, [&](const KeptSlots& some) {
            unsigned char bytes[LANES];
            for (int l = 0; l < LANES; ++l)
                bytes[l] = some.pairs >> l & 1;
            const int left = all - some.places, count = left < LANES ? left : LANES;
            memcpy(out + some.places, bytes, count);
            if constexpr (MEASURED) {
                const Number length = Math::select(flags_of(some.pairs), length_of(some.verdict.vector), Number{});
                memcpy(lengths + some.places, &length, sizeof(real) * count);
            }
        });
    }
    void finish_chunk(int) {}
};
