// Has a point moved too far since a list with a skin was made? One text for CPU and CUDA.
//
// A periodic box stands along the axes. Lattice vectors do not count as motion. Where rounding leaves open how many lie between, a point
// has moved.
#pragma once
#include "band.h"
#include "space.h"

#if defined(__CUDACC__)
JFRNN_FUNCTION real nearest_whole(real x) { return rint(x); }
JFRNN_FUNCTION real whole_below(real x) { return floor(x); }
#else
JFRNN_FUNCTION real nearest_whole(real x) { return DOUBLE ? rint(x) : rintf(x); }
JFRNN_FUNCTION real whole_below(real x) { return DOUBLE ? floor(x) : floorf(x); }
#endif

struct Motion {
    const real *now, *before;  // [n, DIM]
    const real* limit;         // [1] the square of a motion below which a list holds
    const Lattice lattice;

    // A point, near the box: one that is far away is moved by multiples of 256 vectors, exactly (jfrnn/_geometry/far.py).
    JFRNN_MEMBER void take(long long i, real* p) const {
        for (int k = 0; k < DIM; ++k) {
            p[k] = now[DIM * i + k];
            if (!PERIODIC || !lattice.periodic(k))
                continue;
            const real units = p[k] * lattice.transform(k, k), steps = nearest_whole(units / FAR_STEP);
            if (size_of(units) < FAR || !(size_of(steps) <= FAR_MOST) || steps == 0)
                continue;
            const real length = lattice.vector(k, k), high = half_of(length), low = length - high, turns = steps * FAR_STEP;
            p[k] = Lattice::add(Lattice::add(p[k], -Lattice::mul(turns, high)), -Lattice::mul(turns, low));
        }
    }
    // A float rounded to half its mantissa.
    JFRNN_FUNCTION real half_of(real x) {
        constexpr int DROPPED = DOUBLE ? 27 : 12;
        Choice<DOUBLE, unsigned long long, unsigned int>::Type bits;
        memcpy(&bits, &x, sizeof bits);
        bits = (bits + (decltype(bits)(1) << (DROPPED - 1))) >> DROPPED << DROPPED;
        memcpy(&x, &bits, sizeof bits);
        return x;
    }
    JFRNN_MEMBER real turns_of(const real* p, int k) const {
        return whole_below(Lattice::mul(Lattice::add(p[k], -lattice.origin(k)), lattice.transform(k, k)));
    }
    JFRNN_MEMBER bool has_moved(long long i) const {
        real point[3], difference[3], turns[3] = {0, 0, 0}, most = 0, square = 0;
        const real* const old = before + DIM * i;
        take(i, point);
        if (!finite_point(point) && !finite_point(old))
            return false;
        bool sure = true, turned = false;
        for (int k = 0; k < DIM; ++k) {
            difference[k] = point[k] - old[k];
            if (PERIODIC && lattice.periodic(k)) {
                const real units = difference[k] * lattice.transform(k, k);
                turns[k] = nearest_whole(units);
                turned |= turns[k] != 0;
                most = size_of(units) > most ? size_of(units) : most;
                sure &= size_of(units - turns[k]) + 16 * EPS * (most + 2) < real(0.5);
            }
        }
        for (int k = 0; k < DIM; ++k) {
            real left = size_of(difference[k]);
            if (PERIODIC && turned) {
                sure &= !lattice.periodic(k) || size_of(turns_of(point, k)) <= LARGEST_TURN;
                const real taken = turns[k] * lattice.vector(k, k);
                left = size_of(difference[k] - taken) + 4 * EPS * (left + size_of(taken));
            }
            square += left * left;
        }
        return !(sure && square < limit[0]);
    }
};
