// Rows of particles in a periodic box, on CUDA.
#pragma once
#include "near_rows.h"

struct NearRows : NearRow {
    JFRNN_MEMBER explicit NearRows(const NearArguments& given) : NearRow(given) {}
    JFRNN_MEMBER void run() const {
        int found = 0;
        for (long long i = thread_index(); i < n; i += (long long)gridDim.x * blockDim.x)
            found = Near::joined(found, write(i));
        const int turns = __reduce_max_sync(0xffffffff, found & Near::MOST_TURNS);
        const int bits = __reduce_or_sync(0xffffffff, found & ~Near::MOST_TURNS);
        if (turns && threadIdx.x % 32 == 0)
            atomicMax(met, turns);
        if (bits && threadIdx.x % 32 == 0)
            atomicOr(met + 1, bits);
    }
};
