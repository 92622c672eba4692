// Has any point moved too far since a list with a skin was made, on the CPU?
#pragma once
#include "chunks.h"
#include "lanes.h"
#include "motion.h"

struct MovedArguments {
    const real *now, *limit, *cutoff, *reference;                     // [n, DIM], [1], the lattice, [n, DIM]
    const real *vectors, *origin, *vectors_of_then, *origin_of_then;  // [DIM] of the box
    int *moved, *info;                                                // written: [1]; scratch, of 0
    int n;
};

struct Moved : MovedArguments {
    const FloatControl floats;
    const Motion motion;
    real near;  // a point has not moved too far if no coordinate has moved by more: images that are nearest then are the same

    explicit Moved(const MovedArguments& given)
        : MovedArguments(given), floats{}, motion{now, reference, limit, Near(cutoff)}, near(nearness()) {}
    real nearness() const {
        const real each = limit[0] / (DIM * (1 + 16 * EPS));
        real found = DOUBLE ? sqrt(each) : sqrtf(each);
        for (int k = 0; PERIODIC && k < DIM; ++k)
            if (motion.near.lattice.periodic(k) && !(found < motion.near.lattice.vector(k, k) / 4))
                found = motion.near.lattice.vector(k, k) / 4;
        return found;
    }
    void run() const {
        bool other_box = false;
        for (int k = 0; PERIODIC && k < DIM; ++k)
            other_box |= vectors[k] != vectors_of_then[k] || origin[k] != origin_of_then[k];
        if (other_box)
            __atomic_store_n(moved, 1, __ATOMIC_RELAXED);
        each_chunk(*info, n, QUERY_CHUNK, [&](int from, int to, int) {
            if (!__atomic_load_n(moved, __ATOMIC_RELAXED) && !is_near(from, to) && has_moved(from, to))
                __atomic_store_n(moved, 1, __ATOMIC_RELAXED);
        });
    }
    // Is it sure of all points from one to another at once?
    bool is_near(int from, int to) const {
        long long at = (long long)DIM * from;
        const long long end = (long long)DIM * to;
        unsigned int near_lanes = lanes_before(LANES);
        for (; at + LANES <= end; at += LANES)
            near_lanes &= mask_of(__builtin_elementwise_abs(lanes_from(now + at) - lanes_from(reference + at)), near, BelowOrAt());
        bool all = near_lanes == lanes_before(LANES);
        for (; at < end; ++at)
            all &= size_of(now[at] - reference[at]) <= near;
        return all;
    }
    bool has_moved(int from, int to) const {
        for (int i = from; i < to; ++i)
            if (motion.has_moved(i))
                return true;
        return false;
    }
};
