// Particles in a periodic box: brought near it, where they are far away, and counted how many lattice vectors lie between. One text
// for CPU and CUDA.
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
    static constexpr int MOST_TURNS = MET_NOT_FINITE - 1;  // what is met has its bits above
    const Lattice lattice;
    // What all points ask for is copied, since CUDA would load it anew for each of them.
    real transform[3][3];
    bool turns_along[3];
    real origin[3];  // of the cell, brought near as points are

    JFRNN_MEMBER explicit Near(const real* cutoff) : lattice(cutoff) {
        for (int k = 0; k < 3; ++k) {
            for (int axis = 0; axis < 3; ++axis)
                transform[k][axis] = PERIODIC ? lattice.transform(k, axis) : real(0);
            turns_along[k] = PERIODIC && lattice.periodic(k);
            origin[k] = PERIODIC ? lattice.origin(k) : real(0);
        }
        bring(origin);
    }
    // Brings a point near: one that is far away is moved by multiples of 256 vectors, exactly, if it can be (jfrnn/_geometry/far.py).
    JFRNN_MEMBER void bring(real* p) const {
        if constexpr (SKEWED) {
            if (may_be_far(p))
                bring_skewed(p);
            return;
        }
        for (int k = 0; PERIODIC && k < DIM; ++k) {
            const real turns = far_turns(p[k] * transform[k][k], k);
            if (turns == 0)
                continue;
            const real length = lattice.vector(k, k), high = half_of(length);
            p[k] = Lattice::add(Lattice::add(p[k], -Lattice::mul(turns, high)), -Lattice::mul(turns, length - high));
        }
    }
    // By how many vectors a point is moved that is so many away.
    JFRNN_MEMBER real far_turns(real units, int axis) const {
        const real steps = nearest_whole(units / FAR_STEP);
        return !turns_along[axis] || size_of(units) < FAR || !(size_of(steps) <= FAR_MOST) ? real(0) : steps * FAR_STEP;
    }
    JFRNN_MEMBER bool may_be_far(const real* p) const {
        bool may_be = false;
        for (int k = 0; k < DIM; ++k) {
            real most = 0;
            for (int l = 0; l < DIM; ++l)
                most += size_of(p[l] * transform[l][k]);
            may_be |= most * real(1.001) >= FAR;
        }
        return may_be;
    }
    // The same of vectors that lie anywhere: how far it is, in twice the precision, and what remains, if nothing is rounded.
    JFRNN_MEMBER void bring_skewed(real* p) const {
        real turns[3] = {0, 0, 0}, moved[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k)
            turns[k] = far_turns(units_of(p, k), k);
        bool exact = true;
        for (int k = 0; k < DIM; ++k) {
            real total = p[k], rest = 0, error;
            for (int l = 0; l < 2 * DIM; ++l) {
                const real vector = lattice.vector(l % DIM, k), high = half_of(vector);
                total = two_sum(total, -Lattice::mul(turns[l % DIM], l < DIM ? high : vector - high), error);
                rest = two_sum(rest, error, error);
                exact = exact && error == 0;
            }
            moved[k] = two_sum(total, rest, error);
            exact = exact && error == 0;
        }
        for (int k = 0; k < DIM && exact; ++k)
            p[k] = moved[k];
    }
    // Along an axis of the lattice, rounded once: products of half mantissas are exact.
    JFRNN_MEMBER real units_of(const real* p, int axis) const {
        real total = 0, lost = 0, error;
        for (int k = 0; k < DIM; ++k) {
            const real x = half_of(p[k]), t = transform[k][axis], y = half_of(t);
            const real products[4] = {
                Lattice::mul(x, y), Lattice::mul(x, t - y), Lattice::mul(p[k] - x, y), Lattice::mul(p[k] - x, t - y)};
            for (int l = 0; l < 4; ++l) {
                total = two_sum(total, products[l], error);
                lost = Lattice::add(lost, error);
            }
        }
        return Bits::finite(total) ? Lattice::add(total, lost) : total;
    }
    JFRNN_FUNCTION real two_sum(real a, real b, real& error) {  // Knuth 1969
        const real s = Lattice::add(a, b), of_b = Lattice::add(s, -a);
        error = Lattice::add(Lattice::add(a, -Lattice::add(s, -of_b)), Lattice::add(b, -of_b));
        return s;
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
    JFRNN_MEMBER real turns_of(const real* p, int axis) const {
        real sum = Lattice::mul(Lattice::add(p[SKEWED ? 0 : axis], -origin[SKEWED ? 0 : axis]), transform[SKEWED ? 0 : axis][axis]);
        for (int k = 1; SKEWED && k < DIM; ++k)
            sum = Lattice::add(sum, Lattice::mul(Lattice::add(p[k], -origin[k]), transform[k][axis]));
        return whole_below(sum);
    }
    // What was met of two rows: the larger number of turns, and the bits of both.
    JFRNN_FUNCTION int joined(int a, int b) {
        const int turns_a = a & MOST_TURNS, turns_b = b & MOST_TURNS;
        return (turns_a > turns_b ? turns_a : turns_b) | ((a | b) & ~MOST_TURNS);
    }
    // Writes a row of a particle that was brought near: the point and its packed turns; returns what was met: the most turns along an
    // axis, or that the point is not finite, or too far away (jfrnn/_geometry/wrapping.py).
    JFRNN_MEMBER int write_row(const real* p, real* row) const {
        int packed = 0, met = 0;
        bool near = true;
        for (int k = 0; k < DIM; ++k) {
            const real turns = turns_along[k] ? turns_of(p, k) : real(0);
            near &= size_of(turns) <= LARGEST_TURN;
            const int whole_turns = near ? (int)turns : 0;
            packed |= (whole_turns + 512) << (10 * k);
            met = joined(met, whole_turns < 0 ? -whole_turns : whole_turns);
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
        put_turns(packed, row);
        return met;
    }
    JFRNN_FUNCTION void put_turns(int packed, real* row) {
        if constexpr (DOUBLE)
            row[DIM] = packed;
        else
            memcpy(row + DIM, &packed, 4);
    }
};
