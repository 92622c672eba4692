// Pairs of a particle and a triangle, given one by one, on the CPU: which are closer than the cutoff, exactly.
//
// Threads hand themselves chunks of pairs from an atomic counter.
#pragma once
#include "triangle_exact.h"

struct TrianglePairArguments {
    const real *positions, *corners, *cutoff;
    const int *particle, *triangle, *asked;
    int *near, *info;
    int n;
};
struct TrianglePairs : TrianglePairArguments, Space {
    explicit TrianglePairs(const TrianglePairArguments& given) : TrianglePairArguments(given), Space(given.cutoff) {}

    void run() {
        const double scale = Bits::unit_scale(radius);
        int room[ROOM];
        for (;;) {
            const long long begin = (long long)__atomic_fetch_add(&info[0], 1, __ATOMIC_RELAXED) * CHUNK;
            if (begin >= n)
                break;
            for (long long q = begin; q < n && q < begin + CHUNK; ++q) {
                const real* p = positions + (long long)DIM * particle[q];
                const real* shape = corners + (long long)DIM * DIM * triangle[q];
                near[q] = asked[q] && Shape::near(p, shape, radius, scale, room);
            }
        }
    }
};
