// Sorts triangles into cells on the CPU, one by one.
#pragma once
#include "triangle_cells.h"
#include "triangle_exact.h"

// corners [f][DIM][DIM], good [f], start [buckets + 1], triangles [f MOST_CELLS], levels [limit], level_count [1], level_of [f],
// scratch [f MOST_CELLS]: the buckets of each triangle, -1 behind the last
struct TriangleSortArguments {
    const real* corners;
    const int* good;
    const real* cutoff;
    int *start, *triangles, *levels, *level_count, *level_of, *scratch;
    int f, buckets;
};
struct TriangleSort : TriangleSortArguments, Space {
    const double reach_of, MOST;
    const int finest;
    explicit TriangleSort(const TriangleSortArguments& given)
        : TriangleSortArguments(given),
          Space(given.cutoff),
          reach_of(double(radius) * (1 + 8 * (DOUBLE ? 0x1p-52 : 0x1p-23))),
          MOST(DOUBLE ? 0x1.fffffffffffffp1023 : 0x1.fffffep127),
          finest(Bits::exponent(real(Bits::unit_scale(radius)))) {}

    static double within(double x, double most) { return x < -most ? -most : x > most ? most : x; }

    // Does a direction keep the box [0, 1]^DIM around `cell`, widened by `reach`, apart from the triangle? All is in units of a cell.
    static bool apart(const double* direction, const double (*x)[DIM], const int* cell, double reach) {
        double whole = 0, square = 0, most = 0, high = 0, low = 0;
        for (int k = 0; k < DIM; ++k) {
            whole += Shape::size_of(direction[k]);
            square += direction[k] * direction[k];
        }
        for (int c = 0; c < DIM; ++c) {
            double height = 0, doubt = 0;
            for (int k = 0; k < DIM; ++k) {
                const double part = direction[k] * (x[c][k] - (cell[k] + 0.5));
                height += part;
                doubt += Shape::size_of(part);
            }
            low = c == 0 || height < low ? height : low;
            high = c == 0 || height > high ? height : high;
            most = doubt > most ? doubt : most;
        }
        const double room = (0.5 * whole + reach * __builtin_sqrt(square)) * (1 + 0x1p-48) + 0x1p-48 * most;
        return whole > 0x1p-60 && room < 0x1p1000 && (low > room || high < -room);
    }
    // Finds the buckets of a triangle at a level, and returns their number, or -1 for too many cells.
    int hold(const real* corners, const double* low, const double* high, int level, int* buckets_of) const {
        const double scale = scale_of(level);
        int first[3] = {0, 0, 0}, last[3] = {0, 0, 0}, cell[3], held = 0, found = 0;
        double size = 1;
        for (int k = 0; k < DIM; ++k) {
            first[k] = cell_at(low[k], scale);
            last[k] = cell_at(high[k], scale);
            size *= double(last[k]) - double(first[k]) + 1;
        }
        if (size > MOST_ALONG)
            return -1;
        double x[DIM][DIM], direction[10][DIM];
        for (int c = 0; c < DIM; ++c)
            for (int k = 0; k < DIM; ++k)
                x[c][k] = double(corners[DIM * c + k]) * scale;
        int directions = 1;
        if constexpr (DIM == 2) {
            direction[0][0] = -(x[1][1] - x[0][1]);
            direction[0][1] = x[1][0] - x[0][0];
        } else {
            double side[3][3];
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < 3; ++k)
                    side[c][k] = x[(c + 1) % 3][k] - x[c][k];
            for (int k = 0; k < 3; ++k)
                direction[0][k] = side[0][(k + 1) % 3] * side[1][(k + 2) % 3] - side[0][(k + 2) % 3] * side[1][(k + 1) % 3];
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < 3; ++k, ++directions) {
                    direction[directions][k] = 0;
                    direction[directions][(k + 1) % 3] = -side[c][(k + 2) % 3];
                    direction[directions][(k + 2) % 3] = side[c][(k + 1) % 3];
                }
        }
        for (cell[2] = first[2]; cell[2] <= last[2]; ++cell[2])
            for (cell[1] = first[1]; cell[1] <= last[1]; ++cell[1])
                for (cell[0] = first[0]; cell[0] <= last[0]; ++cell[0]) {
                    bool free = false;
                    for (int d = 0; d < directions && !free; ++d)
                        free = apart(direction[d], x, cell, reach_of * scale);
                    if (free)
                        continue;
                    if (++held > MOST_CELLS && level > 0)
                        return -1;
                    const int bucket = bucket_of(level, cell, buckets);
                    bool fresh = true;  // two cells may be hashed alike
                    for (int i = 0; i < found; ++i)
                        fresh = fresh && buckets_of[i] != bucket;
                    if (fresh)
                        buckets_of[found++] = bucket;
                }
        return found;
    }

    void build() {
        for (int b = 0; b < buckets + 2; ++b)
            if (b <= buckets)
                start[b] = 0;
        const int limit = DOUBLE ? 2048 : 256;
        for (int l = 0; l < limit; ++l)
            levels[l] = 0;
        for (int t = 0; t < f; ++t) {
            int* buckets_of = scratch + (long long)MOST_CELLS * t;
            level_of[t] = 0;
            buckets_of[0] = -1;
            if (!good[t])
                continue;
            const real* shape = corners + (long long)DIM * DIM * t;
            double low[DIM], high[DIM], farthest = 0, extent = 0;
            for (int k = 0; k < DIM; ++k) {
                low[k] = high[k] = double(shape[k]);
                for (int c = 1; c < DIM; ++c) {
                    const double x = double(shape[DIM * c + k]);
                    low[k] = x < low[k] ? x : low[k];
                    high[k] = x > high[k] ? x : high[k];
                }
                low[k] = within(low[k] - reach_of, MOST);
                high[k] = within(high[k] + reach_of, MOST);
                const double far = -low[k] > high[k] ? -low[k] : high[k], wide = within(high[k] - low[k], MOST);
                farthest = far > farthest ? far : farthest;
                extent = wide > extent ? wide : extent;
            }
            // cells are numbered up to 2^22, and a box has no more than MOST_ALONG along an axis
            int level = finest, bound = 2 * Bits::BIAS + 21 - Bits::exponent(real(farthest));
            level = bound < level ? bound : level;
            bound = 2 * Bits::BIAS + MOST_ALONG_LOG2 - Bits::exponent(real(extent));
            level = bound < level ? bound : level;
            level = level < 0 ? 0 : level;
            int found = hold(shape, low, high, level, buckets_of);
            while (found < 0)
                found = hold(shape, low, high, --level, buckets_of);
            if (found < MOST_CELLS)
                buckets_of[found] = -1;
            level_of[t] = level;
            levels[level] = 1;
            for (int i = 0; i < found; ++i)
                ++start[buckets_of[i] + 1];
        }
        for (int b = 0; b < buckets; ++b)
            start[b + 1] += start[b];
        const int filled = start[buckets];
        for (long long e = filled; e < (long long)f * MOST_CELLS; ++e)
            triangles[e] = f;
        for (int t = f - 1; t >= 0; --t)  // from the back: entries of a bucket end up in the order of triangles
            for (int i = 0; i < MOST_CELLS && scratch[(long long)MOST_CELLS * t + i] >= 0; ++i)
                triangles[--start[scratch[(long long)MOST_CELLS * t + i] + 1]] = t;
        for (int b = 0; b < buckets; ++b)  // each start was moved to that of the bucket before
            start[b] = start[b + 1];
        start[buckets] = filled;
        int used = 0;
        for (int l = limit - 1; l >= 0; --l)
            used += levels[l];
        level_count[0] = used;
        for (int l = 0, place = used; l < limit; ++l)  // the smallest cells, which have the highest level, come first
            if (levels[l])
                scratch[--place] = l;
        for (int l = 0; l < limit; ++l)
            levels[l] = l < used ? scratch[l] : 0;
    }
};
