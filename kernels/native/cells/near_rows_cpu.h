// Rows of particles in a periodic box, on the CPU.
#pragma once
#include "chunks.h"
#include "lanes.h"
#include "near_rows.h"

struct NearRows : FloatControl, NearRow {  // in this order: nothing is flushed to zero, also of the box
    explicit NearRows(const NearArguments& given) : FloatControl{}, NearRow(given) {}
    void run() const {
        each_chunk(*info, n, CHUNK, [&](int from, int to, int) {
            int found = 0;
            for (int i = from; i < to; ++i) {
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
            for (int k = SKEWED ? 0 : axis; k < (SKEWED ? DIM : axis + 1); ++k) {
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
};
