// Rows of particles in a periodic box, as kernels of cells read them: points near the box, and their turns.
#pragma once
#include "chunks.h"
#include "near.h"
#if !defined(__CUDACC__)
#include "lanes.h"
#endif

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
            for (int i = from; i < to; ++i) {
                if constexpr (SKEWED)
                    while (i + LANES <= to && write_lanes(i, found))
                        i += LANES;
                found = i < to ? Near::joined(found, write(i)) : found;
            }
            int known = __atomic_load_n(met, __ATOMIC_RELAXED), both;
            do
                both = Near::joined(known, found);
            while (both != known && !__atomic_compare_exchange_n(met, &known, both, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
        });
    }
    // LANES points at once, if all are finite, and none is far away: as `write` does, which Clang does not do by itself.
    bool write_lanes(int i, int& found) const {
        vec point[3] = {};
        for (int l = 0; l < LANES; ++l)
            for (int k = 0; k < DIM; ++k)
                point[k][l] = points[DIM * (long long)(i + l) + k];
        ints packed{}, most{};
        unsigned int usual = lanes_before(LANES);
        for (int axis = 0; axis < DIM; ++axis) {
            vec turns{}, size{};
            for (int k = 0; k < DIM; ++k) {
                const vec product = (point[k] - near.origin[k]) * near.transform[k][axis];
                turns = turns + product;  // apart: rounded as one point is
                size += __builtin_elementwise_abs(point[k] * near.transform[k][axis]);
            }
            turns = __builtin_elementwise_floor(turns);
            usual &= mask_of(vec(size * real(1.001)), real(FAR), Below());  // nor is there NaN
            usual &= mask_of(vec(__builtin_elementwise_abs(turns)), real(LARGEST_TURN), BelowOrAt());
            const ints whole_turns = __builtin_convertvector(turns, ints) & -near.turns_along[axis];
            packed |= (whole_turns + 512) << (10 * axis);
            most = __builtin_elementwise_max(most, __builtin_elementwise_abs(whole_turns));
        }
        if (usual != lanes_before(LANES))
            return false;
        found = Near::joined(found, __builtin_reduce_max(most));
        for (int l = 0; l < LANES; ++l) {
            Row row;
            for (int k = 0; k < DIM; ++k)
                row.numbers[k] = point[k][l];
            Near::put_turns(packed[l], row.numbers);
            ((Row*)rows)[i + l] = row;
        }
        return true;
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
