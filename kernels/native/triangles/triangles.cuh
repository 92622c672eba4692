// Triangles near each particle on CUDA. The same text runs on the CPU, in tests: there threads come one after the other.
#pragma once
#include "triangle_bounds.h"
#include "triangle_cells.h"
#include "triangle_exact.h"

// What is sorted: the stages read no integers of pairs, and no bounds.
struct TrianglesArguments {
    const real *positions, *corners, *boxes, *cutoff;
    const int *start, *triangles, *levels, *level_count, *level_of;
    int *idx, *count, *scratch;
    int n, f, buckets, entries, capacity, workers, threads, first_thread;
};
struct Shared {
    int near;    // particles with candidates
    int queued;  // rows that wait for `settle`
};
struct alignas(DIM == 3 ? 16 : 2 * sizeof(real)) Entry {
    real low[DIM];
    whole triangle;  // of a node in a tree: its first child
    real high[DIM];
    whole level;  // of cells, or in a tree
};
// Adds to a sum, and returns what it was.
JFRNN_FUNCTION int add_to(int* sum, int number) {
#if defined(__CUDA_ARCH__)
    return atomicAdd(sum, number);
#else
    *sum += number;  // threads come one after the other
    return *sum - number;
#endif
}

struct Triangles : TrianglesArguments, Space {
    const int thread;  // counted from `first_thread` on, which is 0 on CUDA
    const Bounds<real> bounds;
    Shared& shared;
    int* cursor;
    int* first;  // particles of each key, then the first place of theirs
    int *key, *slot, *order;
    int* queue;  // takes the place of slots, which are not needed once particles are scattered
    Entry* entry_of;
    int* room;  // for integers

    JFRNN_MEMBER explicit Triangles(const TrianglesArguments& given)
        : TrianglesArguments(given),
          Space(given.cutoff),
          thread(first_thread + (int)thread_index()),
          bounds(radius),
          shared(*(Shared*)scratch),
          cursor(scratch) {
        take(HEADER);
        first = take(buckets);
        key = take(n);
        slot = take(n);
        order = take(n);
        queue = slot;
        entry_of = (Entry*)take((long long)entries * (sizeof(Entry) / 4));
        room = take((long long)workers * ROOM);
    }
    JFRNN_MEMBER int* take(long long words) {
        int* here = cursor;
        cursor += (words + 15) / 16 * 16;
        return here;
    }

    // Puts boxes of triangles into the order of entries, and clears what the others count in.
    JFRNN_MEMBER void prepare() {
        if (thread == 0)
            shared.near = shared.queued = 0;
        if (thread < buckets)
            first[thread] = 0;
        if (TREE && thread < entries) {
            Entry entry;
            int level = 0;
            while (thread >= start[level + 1])
                ++level;
            for (int k = 0; k < DIM; ++k) {
                entry.low[k] = boxes[(long long)entries * k + thread];
                entry.high[k] = boxes[(long long)entries * (DIM + k) + thread];
            }
            entry.triangle = level == 0 ? triangles[thread] : start[level - 1] + NODE * (thread - start[level]);
            entry.level = level;
            entry_of[thread] = entry;
        }
        if (!TREE && thread < entries) {
            Entry entry;
            const int t = triangles[thread];
            const bool there = t < f;
            for (int k = 0; k < DIM; ++k) {
                entry.low[k] = there ? boxes[(long long)2 * DIM * t + k] : Bits::not_finite();
                entry.high[k] = there ? boxes[(long long)2 * DIM * t + DIM + k] : real(0);
            }
            entry.triangle = t;
            entry.level = there ? level_of[t] : -1;
            entry_of[thread] = entry;
        }
    }

    // Where particles are sorted to: 64 cells of a block stand side by side, blocks anywhere.
    JFRNN_MEMBER int key_at(const real* p, int level) const {
        constexpr int BITS = DIM == 3 ? 2 : 3;
        int cell[DIM], within = 0;
        for (int k = 0; k < DIM; ++k) {
            cell[k] = cell_at(double(p[k]), scale_of(level));
            within |= (cell[k] & ((1 << BITS) - 1)) << BITS * k;
            cell[k] >>= BITS;
        }
        return ((bucket_of(level, cell, buckets) & ~63) | within) & (buckets - 1);
    }
    // Counts a particle where it is sorted to, if there is an entry in any of its buckets, or in a box of the root.
    JFRNN_MEMBER void place() {
        if (thread < n) {
            real p[DIM];
            for (int k = 0; k < DIM; ++k)
                p[k] = positions[(long long)DIM * thread + k];
            bool some = false;
            int level = 0;
            if constexpr (TREE) {
                real extent = 0;  // about that of the wall, per node below the root
                for (int e = entries - NODE; e < entries && finite_point(p); ++e) {
                    const Entry entry = entry_of[e];
                    bool inside = true;
                    for (int k = 0; k < DIM; ++k) {
                        inside = inside && entry.low[k] <= p[k] && entry.high[k] >= p[k];
                        const real wide = entry.high[k] - entry.low[k];
                        extent = wide > extent && Bits::finite(wide) ? wide : extent;
                    }
                    some = some || inside;
                }
                // 2^5 cells along it
                const int finest = 2 * Bits::BIAS + 5 - Bits::exponent(extent);
                level = finest < 1 ? 1 : finest > 2 * Bits::BIAS - 1 ? 2 * Bits::BIAS - 1 : finest;
            } else {
                level = levels[0];
                const int number = finite_point(p) ? level_count[0] : 0;
                for (int l = 0; l < number && !some; ++l) {
                    const int bucket = bucket_at(p, levels[l], buckets);
                    some = start[bucket] < start[bucket + 1];
                }
            }
            const int mine = some ? key_at(p, level) : -1;
            key[thread] = mine;
            if (some)
                slot[thread] = add_to(first + mine, 1);
            else
                count[thread] = 0;
        }
    }

    // Writes unused slots into all rows.
    JFRNN_MEMBER void fill() {
        const long long words = (long long)n * capacity, fours = words / 4;
        struct alignas(16) Four {
            int id[4];
        };  // an array from XLA begins where 16 bytes may be stored at once
        const Four none{{f, f, f, f}};
        for (long long i = thread; i < fours; i += threads)
            ((Four*)idx)[i] = none;
        if (thread < words - 4 * fours)
            idx[4 * fours + thread] = f;
    }

    // Turns counts into first places; in which order the buckets come is left to chance.
    JFRNN_MEMBER void allocate() {
        const long long begin = (long long)thread * RUN;
        int sum = 0;
        for (long long b = begin; b < begin + RUN && b < buckets; ++b)
            sum += first[b];
        int place = sum ? add_to(&shared.near, sum) : 0;
        for (long long b = begin; sum && b < begin + RUN && b < buckets; ++b) {
            const int number = first[b];
            first[b] = place;
            place += number;
        }
    }

    JFRNN_MEMBER void scatter() {
        if (thread < n && key[thread] >= 0)
            order[first[key[thread]] + slot[thread]] = thread;
    }

    // Lists the triangles near particle i; are all pairs decided? `decide(p, corners)`: 1 near, 0 far, -1 open.
    template <class Decide>
    JFRNN_MEMBER bool list_row(int i, Decide decide) {
#if defined(__CUDA_ARCH__)
        __shared__ int waiting_of[WAITING][THREADS];
        int* const mine = &waiting_of[0][threadIdx.x];
        constexpr int APART = THREADS;
#else
        int mine[WAITING];
        constexpr int APART = 1;
#endif
        real p[DIM];
        for (int k = 0; k < DIM; ++k)
            p[k] = positions[(long long)DIM * i + k];
        int* row = idx + (long long)capacity * i;
        const int sizes_of_cells = TREE ? 0 : level_count[0];
        int found = 0, l = 0, level = 0, e = TREE ? entries - NODE : 0, last = TREE ? entries : 0;
        int pending[TREE ? PENDING : 1], depth = 0;  // siblings whose parent's box holds the particle
        bool more = true, open = false;
        while (more && !open) {
            int number = 0;
            while (number < WAITING) {
                if (e < last) {
                    const Entry entry = entry_of[e++];
                    bool inside = TREE || entry.level == level;
                    for (int k = 0; k < DIM; ++k)
                        inside = inside && entry.low[k] <= p[k] && entry.high[k] >= p[k];
                    if (TREE && inside && entry.level > 0)
                        pending[depth++] = (int)entry.triangle;
                    else if (inside)
                        mine[APART * number++] = (int)entry.triangle;
                } else if (TREE && depth > 0) {
                    e = pending[--depth];
                    last = e + NODE;
                } else if (l < sizes_of_cells) {
                    level = levels[l++];
                    const int bucket = bucket_at(p, level, buckets);
                    e = start[bucket];
                    last = start[bucket + 1];
                } else {
                    more = false;
                    break;
                }
            }
            for (int w = 0; w < number && !open; ++w) {
                const int t = mine[APART * w], near = decide(p, corners + (long long)DIM * DIM * t);
                open = near < 0;
                if (near > 0) {
                    if (LIST && found < capacity)
                        row[found] = t;
                    ++found;
                }
            }
        }
        count[i] = found;
        return !open;
    }

    JFRNN_MEMBER void query() {
        auto with_floats = [&](const real* p, const real* shape) -> int {
            real x[DIM][DIM];
            for (int c = 0; c < DIM; ++c)
                for (int k = 0; k < DIM; ++k)
                    x[c][k] = (shape[DIM * c + k] - p[k]) * bounds.unit;
            bool near, far;
            bounds.bounded(x, near, far);
            return near ? 1 : far ? 0 : Shape::sure(p, shape, radius, bounds.scale);
        };
        if (thread < shared.near) {
            const int i = order[thread];
            if (!list_row(i, with_floats))
                queue[add_to(&shared.queued, 1)] = i;
        }
    }

    // Lists rows in which float64 left a pair open anew, with integers.
    JFRNN_MEMBER void settle() {
        int* const numbers = room + (long long)(thread / 32) * 32 * ROOM + thread % 32;
        auto with_integers = [&](const real* p, const real* shape) -> int {
            return Shape::near(p, shape, radius, bounds.scale, numbers);
        };
        for (int q = thread; q < shared.queued; q += threads)
            list_row(queue[q], with_integers);
    }
};
