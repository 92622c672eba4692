// Particles in a periodic box that stands along the axes: brought near it, where they are far away, and counted how many lattice vectors
// lie between. One text for CPU and CUDA.
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

struct Near {
    const Lattice lattice;
    real origin[3];  // of the cell, brought near as points are

    JFRNN_MEMBER explicit Near(const real* cutoff) : lattice(cutoff), origin{0, 0, 0} {
        for (int k = 0; PERIODIC && k < DIM; ++k)
            origin[k] = lattice.origin(k);
        bring(origin);
    }
    // Brings a point near: one that is far away is moved by multiples of 256 vectors, exactly (jfrnn/_geometry/far.py).
    JFRNN_MEMBER void bring(real* p) const {
        for (int k = 0; PERIODIC && k < DIM; ++k) {
            if (!lattice.periodic(k))
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
        return whole_below(Lattice::mul(Lattice::add(p[k], -origin[k]), lattice.transform(k, k)));
    }
    // Writes a row of a particle that was brought near: the point and its packed turns; returns what was met: bits of these, or that
    // the point is not finite, or too far away (jfrnn/_geometry/wrapping.py).
    JFRNN_MEMBER int write_row(const real* p, real* row) const {
        int packed = 0, met = 0;
        bool near = true;
        for (int k = 0; k < DIM; ++k) {
            const real turns = lattice.periodic(k) ? turns_of(p, k) : real(0);
            near &= size_of(turns) <= LARGEST_TURN;
            const int whole_turns = near ? (int)turns : 0;
            packed |= (whole_turns + 512) << (10 * k);
            met |= whole_turns < 0 ? -whole_turns : whole_turns;
        }
        if (!finite_point(p)) {
            packed = -1;
            met = MET_NOT_FINITE;
        } else if (!near) {
            packed = -2;
            met = MET_TOO_FAR;
        }
        for (int k = 0; k < DIM; ++k)
            row[k] = p[k];
        if constexpr (DOUBLE)
            row[DIM] = packed;
        else
            memcpy(row + DIM, &packed, 4);
        return met;
    }
};
