// Step 1 of a particle and a triangle, in the precision of the positions, with the bounds of `sure_pairs` in
// jfrnn/_triangles/exact.py: what is neither near nor far is open. `vec` is `real`, or many of them side by side.
#pragma once
#include "space.h"

template <class vec>
struct Bounds {
    typedef decltype(vec{} < vec{}) mask;
    const real radius;
    const double scale;
    const real unit;  // lengths are multiplied by it
    JFRNN_MEMBER explicit Bounds(real radius) : radius(radius), scale(Bits::unit_scale(radius)), unit(real(scale)) {}

    JFRNN_FUNCTION vec size_of(vec a) {
#if defined(__CUDA_ARCH__)
        return fabs(a);
#else
        return __builtin_elementwise_abs(a);
#endif
    }
    JFRNN_FUNCTION vec product(const vec* a, const vec* b) {
        const vec sum = a[0] * b[0] + a[1] * b[1];
        return DIM == 3 ? sum + a[DIM - 1] * b[DIM - 1] : sum;
    }
    JFRNN_FUNCTION vec sum_of_sizes(const vec* a) {
        const vec sum = size_of(a[0]) + size_of(a[1]);
        return DIM == 3 ? sum + size_of(a[DIM - 1]) : sum;
    }
    JFRNN_FUNCTION vec sizes(const vec* a, const vec* b) {
        const vec sum = size_of(a[0] * b[0]) + size_of(a[1] * b[1]);
        return DIM == 3 ? sum + size_of(a[DIM - 1] * b[DIM - 1]) : sum;
    }
    JFRNN_FUNCTION void cross(vec* out, const vec* a, const vec* b) {
        for (int k = 0; k < 3; ++k)
            out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
    }

    // x [DIM][DIM]: corners as the particle sees them, times `unit`.
    JFRNN_MEMBER void bounded(const vec (&x)[DIM][DIM], mask& near, mask& far) const {
        constexpr real EPS = DOUBLE ? real(0x1p-52) : real(0x1p-23);
        const real r = radius * unit;
        vec weight[DIM], foot[DIM], direction[DIM], best;
        const vec none = vec{}, one = none + 1;
        for (int c = 0; c < (DIM == 3 ? 3 : 1); ++c) {
            const int next = (c + 1) % DIM;
            vec along[DIM], point[DIM];
            for (int k = 0; k < DIM; ++k)
                along[k] = x[next][k] - x[c][k];
            const vec length = product(along, along);
            vec t = length > 0 ? -product(x[c], along) / (length > 0 ? length : one) : none;
            t = t > 0 ? (t < 1 ? t : one) : none;
            for (int k = 0; k < DIM; ++k)
                point[k] = x[c][k] + t * along[k];
            const vec square = product(point, point);
            if (c == 0) {
                best = square;
                for (int k = 0; k < DIM; ++k) {
                    direction[k] = point[k];
                    weight[k] = none;
                }
                weight[0] = one - t;
                weight[next] = t;
                continue;
            }
            const mask nearer = square < best;
            best = nearer ? square : best;
            for (int k = 0; k < DIM; ++k) {
                direction[k] = nearer ? point[k] : direction[k];
                weight[k] = nearer ? (k == c ? one - t : k == next ? t : none) : weight[k];
            }
        }
        if constexpr (DIM == 3) {
            vec side[2][3], normal[3], area[3], part[3];
            for (int k = 0; k < 3; ++k) {
                side[0][k] = x[1][k] - x[0][k];
                side[1][k] = x[2][k] - x[0][k];
            }
            cross(normal, side[0], side[1]);
            for (int c = 0; c < 3; ++c) {
                cross(area, x[(c + 1) % 3], x[(c + 2) % 3]);
                part[c] = product(area, normal);
            }
            const mask inside = (part[0] > 0) & (part[1] > 0) & (part[2] > 0);
            const vec sum = inside ? part[0] + part[1] + part[2] : one;
            const vec toward = product(x[0], normal) < 0 ? none - 1 : one;
            for (int k = 0; k < 3; ++k) {
                weight[k] = inside ? part[k] / sum : weight[k];
                direction[k] = inside ? toward * normal[k] : direction[k];
            }
        }
        vec sum = weight[0], size = weight[0] * sum_of_sizes(x[0]);
        for (int c = 1; c < DIM; ++c) {
            sum = sum + weight[c];
            size = size + weight[c] * sum_of_sizes(x[c]);
        }
        for (int k = 0; k < DIM; ++k) {
            foot[k] = weight[0] * x[0][k];
            for (int c = 1; c < DIM; ++c)
                foot[k] = foot[k] + weight[c] * x[c][k];
        }
        const vec reach = r * sum * (1 - 8 * EPS) - 4 * EPS * size;
        near = (reach > 0) & (product(foot, foot) * (1 + 16 * EPS) < reach * reach);
        const vec largest = sum_of_sizes(direction);
        for (int k = 0; k < DIM; ++k)
            direction[k] = direction[k] / largest;
        const vec limit = r * r * product(direction, direction) * (1 + 16 * EPS);
        far = limit == limit;
        for (int c = 0; c < DIM; ++c) {
            const vec height = product(direction, x[c]) - 4 * EPS * sizes(direction, x[c]);
            far = far & (height > 0) & (height * height > limit);
        }
    }
};
