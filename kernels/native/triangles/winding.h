// On which side of a closed wall points are, by rays through the tree of its boxes.
//
// What is decided, and why it is right, stands in jfrnn/_triangles/winding.py. Here all is computed in float64: of float32 positions
// a ray then tells the side but for some 1e-14 of the largest coordinate.
#pragma once
#include "space.h"

// boxes [2 DIM][entries]; start [levels + 1]: the first entry of each level
struct WindingArguments {
    const real *positions, *corners, *boxes, *cutoff, *rays;
    const int *start, *triangles, *asked, *least;
    int *side, *info;
    int n, levels, entries;
};
struct Siblings {
    int first, level;
};
struct Flat {
    JFRNN_FUNCTION double size_of(double a) { return a < 0 ? -a : a; }
    JFRNN_FUNCTION double larger(double a, double b) { return b > a ? b : a; }
    // a product of two, or of three, vectors; `sign` 1 for the sum of absolute values of its terms, -1 for what it is
    JFRNN_FUNCTION double two(const double* a, const double* b, int i, int j, int sign) {
        const double one = a[i] * b[j], other = a[j] * b[i];
        return sign < 0 ? one - other : size_of(one) + size_of(other);
    }
    JFRNN_FUNCTION double three(const double* a, const double* b, const double* c, int sign) {
        double sum = 0;
        for (int k = 0; k < 3; ++k) {
            const double part = two(b, c, (k + 1) % 3, (k + 2) % 3, sign);
            sum += sign < 0 ? a[k] * part : size_of(a[k]) * part;
        }
        return sum;
    }
};

struct Winding : WindingArguments, Space {
    static constexpr double EPS = 0x1p-52, STORED = DOUBLE ? 0x1p-52 : 0x1p-23;  // STORED: boxes were rounded so
    static constexpr double most = 0x1p1000;
    const double inner;
    JFRNN_MEMBER explicit Winding(const WindingArguments& given)
        : WindingArguments(given), Space(given.cutoff), inner(double(radius) * (1 - 8 * STORED)) {}

    // Does a ray meet the box of an entry? steps: along the ray per length along an axis.
    JFRNN_MEMBER bool meets(int e, const double* p, const double* steps) const {
        double first = 0, last = most;
        if (!(boxes[e] <= boxes[(long long)entries * DIM + e]))
            return false;
        for (int k = 0; k < DIM; ++k) {
            const double one = double(boxes[(long long)entries * k + e]);
            const double two = double(boxes[(long long)entries * (DIM + k) + e]);
            const double low = (one - p[k]) + (inner - 4 * STORED * (Flat::size_of(one) + inner));
            const double high = (two - p[k]) - (inner - 4 * STORED * (Flat::size_of(two) + inner));
            const double from = (low - 16 * EPS * Flat::size_of(low)) * steps[k];
            const double to = (high + 16 * EPS * Flat::size_of(high)) * steps[k];
            const double near = steps[k] > 0 ? from : to, far = steps[k] > 0 ? to : from;
            first = near > first ? near : first;
            last = far < last ? far : last;  // NaN, of numbers that are too large, is met
            if (last < first && first < most)
                return false;
        }
        return true;
    }
    // Adds bounds on how often a ray leaves a triangle, less how often it enters it.
    JFRNN_MEMBER void cross(int t, const double* p, const double* ray, int& low, int& high) const {
        double x[DIM][DIM], side[DIM], doubt[DIM], largest = 0;
        for (int c = 0; c < DIM; ++c)
            for (int k = 0; k < DIM; ++k) {
                x[c][k] = double(corners[((long long)DIM * t + c) * DIM + k]) - p[k];
                largest = Flat::larger(largest, Flat::size_of(x[c][k]));
            }
        if (!(largest > 0))
            largest = 1;
        bool behind = true;
        for (int c = 0; c < DIM; ++c) {
            double along = 0;
            for (int k = 0; k < DIM; ++k) {
                x[c][k] /= largest;
                along += ray[k] * x[c][k];
            }
            behind = behind && along < -64 * EPS;
        }
        if (behind)
            return;
        double height, room;
        if constexpr (DIM == 3) {
            for (int c = 0; c < 3; ++c) {
                side[c] = Flat::three(ray, x[(c + 1) % 3], x[(c + 2) % 3], -1);
                doubt[c] = Flat::three(ray, x[(c + 1) % 3], x[(c + 2) % 3], 1);
            }
            height = Flat::three(x[0], x[1], x[DIM - 1], -1);
            room = Flat::three(x[0], x[1], x[DIM - 1], 1);
        } else {
            for (int c = 0; c < 2; ++c) {
                side[c] = (c == 0 ? -1 : 1) * Flat::two(ray, x[c], 0, 1, -1);
                doubt[c] = Flat::two(ray, x[c], 0, 1, 1);
            }
            height = Flat::two(x[0], x[1], 0, 1, -1);
            room = Flat::two(x[0], x[1], 0, 1, 1);
        }
        room = 8 * EPS * room + 0x1p-1000;
        const bool leaves = height > room, enters = height < -room;
        bool left = false, right = false, all_left = leaves, all_right = enters;
        for (int c = 0; c < DIM; ++c) {
            const double error = 8 * EPS * doubt[c] + 0x1p-1000;
            const bool is_left = side[c] > error, is_right = side[c] < -error;
            left = left || is_left;
            right = right || is_right;
            all_left = all_left && is_left;
            all_right = all_right && is_right;
        }
        const bool may_leave = !right && !enters, may_enter = !left && !leaves;
        low += may_leave && all_left ? 1 : may_enter ? -1 : 0;
        high += may_enter && all_right ? -1 : may_leave ? 1 : 0;
    }
    // Adds such bounds for all triangles.
    JFRNN_MEMBER void cast(const double* p, const double* ray, int& low, int& high) const {
        Siblings pending[PENDING];
        double steps[DIM];
        for (int k = 0; k < DIM; ++k)
            steps[k] = 1 / ray[k];
        int depth = 0;
        pending[depth++] = Siblings{start[levels - 1], levels - 1};
        while (depth > 0) {
            const Siblings here = pending[--depth];
            for (int e = here.first; e < here.first + NODE; ++e) {
                if (!meets(e, p, steps))
                    continue;
                if (here.level > 0)
                    pending[depth++] = Siblings{start[here.level - 1] + NODE * (e - start[here.level]), here.level - 1};
                else
                    cross(triangles[e], p, ray, low, high);
            }
        }
    }
    // Where a point is: 1 inside, 0 outside, 2: no ray tells.
    JFRNN_MEMBER int side_of(long long i) const {
        double p[DIM], exit[2 * DIM];
        for (int k = 0; k < DIM; ++k) {
            p[k] = double(positions[DIM * i + k]);
            exit[k] = exit[DIM + k] = -most;
            for (int e = start[levels - 1]; e < entries; ++e) {
                exit[k] = Flat::larger(exit[k], double(boxes[(long long)entries * (DIM + k) + e]) - p[k]);
                exit[DIM + k] = Flat::larger(exit[DIM + k], p[k] - double(boxes[(long long)entries * k + e]));
            }
        }
        for (int tried = 0, used = 0; tried < 2 * DIM; ++tried) {  // the shortest way out meets the fewest boxes
            int way = -1, low = 0, high = 0;
            for (int w = 0; w < 2 * DIM; ++w)
                if (!(used >> w & 1) && (way < 0 || exit[w] < exit[way]))
                    way = w;
            used |= 1 << way;
            double ray[DIM];
            for (int k = 0; k < DIM; ++k)
                ray[k] = double(rays[DIM * way + k]);
            cast(p, ray, low, high);
            if (low >= least[0] || high < least[0])
                return low >= least[0];
        }
        return 2;
    }

#if defined(__CUDACC__)
    JFRNN_MEMBER void run() {
        const long long i = thread_index();
        if (i < n)
            side[i] = asked[i] ? side_of((int)i) : 0;
    }
#else
    void run() {
        for (;;) {
            const long long begin = (long long)__atomic_fetch_add(&info[0], 1, __ATOMIC_RELAXED) * CHUNK;
            if (begin >= n)
                break;
            for (long long i = begin; i < n && i < begin + CHUNK; ++i)
                side[i] = asked[i] ? side_of(i) : 0;
        }
    }
#endif
};
