// Triangles near each particle on the CPU, LANES at a time.
#pragma once
#include "lanes.h"
#include "triangle_bounds.h"
#include "triangle_sort.h"

// boxes [2 DIM][stride]: corners of the boxes of entries, which hold nothing where there is no triangle; a vector reaches no farther.
// In a tree (TREE) start [levels + 1] is the first entry of each level, and `buckets` is how many levels there are.
struct TriangleArguments {
    const real *positions, *corners, *boxes, *cutoff;
    const int *start, *triangles, *levels, *level_count, *level_of;
    int *idx, *count, *info;
    int n, f, buckets, capacity, stride;
};

// It is launched once per thread: threads hand themselves chunks of particles from an atomic counter.
struct TriangleRows : TriangleArguments, Space {
    static constexpr int MOST = 512;  // triangles whose boxes hold a particle that wait to be decided
    typedef Bounds<vec>::mask mask;
    const Bounds<vec> bounds;
    int waiting[MOST + LANES], room[ROOM];
    int longest;
    const real* p;  // where the particle is
    int* row;
    int found, number;  // triangles that are near, and those that wait

    explicit TriangleRows(const TriangleArguments& given)
        : TriangleArguments(given), Space(given.cutoff), bounds(radius), longest(0) {}

    // Which of LANES triangles are near, one bit each, and which of them floats leave open.
    unsigned int surely_near(const int* which, unsigned int& open) const {
        vec x[DIM][DIM];
        for (int c = 0; c < DIM; ++c)
            for (int k = 0; k < DIM; ++k) {
                for (int l = 0; l < LANES; ++l)
                    x[c][k][l] = corners[(long long)DIM * DIM * which[l] + DIM * c + k];
                x[c][k] = (x[c][k] - p[k]) * bounds.unit;
            }
        mask near, far;
        bounds.bounded(x, near, far);
        const unsigned int yes = bits_of_flags(__builtin_convertvector(near, flags));
        open = ~yes & ~bits_of_flags(__builtin_convertvector(far, flags));
        return yes;
    }
    // Decides all that wait.
    void decide() {
        for (int l = 0; l < LANES; ++l)
            waiting[number + l] = waiting[0];
        for (int first = 0; first < number; first += LANES) {
            unsigned int open, near = surely_near(waiting + first, open);
            const unsigned int asked = lanes_before(number - first);
            for (open &= asked; open; open &= open - 1) {
                const int l = __builtin_ctz(open);
                const real* shape = corners + (long long)DIM * DIM * waiting[first + l];
                if (Shape::near(p, shape, radius, bounds.scale, room))
                    near |= 1u << l;
            }
            for (near &= asked; near; near &= near - 1, ++found)
                if (LIST && found < capacity)
                    row[found] = waiting[first + __builtin_ctz(near)];
        }
        number = 0;
    }
    // Which of LANES boxes hold the particle, one bit each.
    unsigned int inside(int e) const {
        mask within = vec{} == vec{};
        for (int k = 0; k < DIM; ++k) {
            const vec low = lanes_from(boxes + (long long)stride * k + e);
            const vec high = lanes_from(boxes + (long long)stride * (DIM + k) + e);
            within &= (low <= p[k]) & (high >= p[k]);
        }
        return bits_of_flags(__builtin_convertvector(within, flags));
    }
    void look_in_cells() {
        for (int l = 0; l < level_count[0]; ++l) {
            const int level = levels[l];
            const int bucket = bucket_at(p, level, buckets);
            const int last = start[bucket + 1];
            for (int e = start[bucket]; e < last; e += LANES)
                for (unsigned int hold = inside(e) & lanes_before(last - e); hold; hold &= hold - 1) {
                    const int t = triangles[e + __builtin_ctz(hold)];
                    waiting[number] = t;
                    number += level_of[t] == level;
                    if (number == MOST)
                        decide();
                }
        }
    }
    void look_in_tree() {
        struct Siblings {
            int first, level;
        };
        Siblings pending[PENDING];
        int depth = 0;
        pending[depth++] = Siblings{start[buckets - 1], buckets - 1};
        while (depth > 0) {
            const Siblings here = pending[--depth];
            for (int part = 0; part < NODE; part += LANES)
                for (unsigned int hold = inside(here.first + part); hold; hold &= hold - 1) {
                    const int e = here.first + part + __builtin_ctz(hold);
                    if (here.level > 0) {
                        const int level = here.level - 1;
                        pending[depth++] = Siblings{start[level] + NODE * (e - start[level + 1]), level};
                        continue;
                    }
                    waiting[number++] = triangles[e];
                    if (number == MOST)
                        decide();
                }
        }
    }
    void list(long long i) {
        p = positions + DIM * i;
        row = idx + (long long)capacity * i;
        found = number = 0;
        if (finite_point(p)) {
            if constexpr (TREE)
                look_in_tree();
            else
                look_in_cells();
        }
        if (number)
            decide();
        if constexpr (LIST)
            for (int s = found; s < capacity; ++s)
                row[s] = f;
        count[i] = found;
        longest = found > longest ? found : longest;
    }
    void run() {
        for (;;) {
            const long long begin = (long long)__atomic_fetch_add(&info[2], 1, __ATOMIC_RELAXED) * CHUNK;
            if (begin >= n)
                break;
            for (long long i = begin; i < n && i < begin + CHUNK; ++i)
                list(i);
        }
        int known = __atomic_load_n(&info[0], __ATOMIC_RELAXED);
        while (
            known < longest && !__atomic_compare_exchange_n(&info[0], &known, longest, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
    }
};
