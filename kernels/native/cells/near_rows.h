// Rows of particles in a periodic box, as kernels of cells read them: points near the box, and their turns.
#pragma once
#include "chunks.h"
#include "near.h"

struct NearArguments {
    const real *points, *cutoff;  // [n, DIM], and the lattice
    real* rows;                   // written: [n, DIM + 1]
    int *met, *info;              // [2] 0 before, of which the bits say what was met of any (near.h); scratch of the CPU, of 0
    int n;
};

struct NearRows : NearArguments {
    struct alignas(DIM == 3 && !DOUBLE ? 16 : sizeof(real)) Row {
        real numbers[DIM + 1];
    };
#if defined(__CUDACC__)
    const Near near;

    JFRNN_MEMBER explicit NearRows(const NearArguments& given) : NearArguments(given), near(given.cutoff) {}
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
#else
    const FloatControl floats;
    const Near near;

    explicit NearRows(const NearArguments& given) : NearArguments(given), floats{}, near(given.cutoff) {}
    void run() const {
        each_chunk(*info, n, CHUNK, [&](int from, int to, int) {
            int found = 0;
            for (int i = from; i < to; ++i)
                found = Near::joined(found, write(i));
            int known = __atomic_load_n(met, __ATOMIC_RELAXED), both;
            do
                both = Near::joined(known, found);
            while (both != known && !__atomic_compare_exchange_n(met, &known, both, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
        });
    }
#endif
    JFRNN_MEMBER int write(long long i) const {
        real point[3];
        for (int k = 0; k < DIM; ++k)
            point[k] = points[DIM * i + k];
        near.bring(point);
        Row row;
        const int found = near.write_row(point, row.numbers);
        ((Row*)rows)[i] = row;
        return found;
    }
};
