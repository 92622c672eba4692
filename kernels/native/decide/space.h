// What every kernel knows of space: the radius of the cutoff, the lattice of a box, and what rows of positions hold.
#pragma once
#include "float_control.h"
#include "lattice.h"

constexpr int ONE_CUTOFF = -1, GATHER = 0, SCATTER = 1, EITHER = 2, BOTH = 3, MEAN = 4, TABLE = 5;  // RULE
constexpr bool DIFFER = RULE != ONE_CUTOFF;                                                         // cutoffs

JFRNN_FUNCTION bool finite_point(const real* p) {
    bool finite = true;
    for (int k = 0; k < DIM; ++k)
        finite = finite && Bits::finite(p[k]);
    return finite;
}
// An unsigned integer that travels among floats: as the bits of a float, or as the value of a double.
JFRNN_FUNCTION unsigned int unsigned_of(real x) {
    unsigned int bits;
    if constexpr (DOUBLE)
        bits = (unsigned int)x;
    else
        memcpy(&bits, &x, 4);
    return bits;
}
// The number of the system that a row of positions belongs to.
JFRNN_FUNCTION unsigned int system_of(const real* row) { return BATCHED ? unsigned_of(row[ROW - 1]) : 0u; }
// Grows the bounding box [low, high] until it holds the box [l, h].
JFRNN_FUNCTION void widen(real* low, real* high, const real* l, const real* h) {
    for (int k = 0; k < DIM; ++k) {
        low[k] = l[k] < low[k] ? l[k] : low[k];
        high[k] = h[k] > high[k] ? h[k] : high[k];
    }
}

struct Space {
    FloatControl floats;  // comes first: all that is computed afterwards keeps denormals
    real radius;
    real step_scale;   // a power of two by which step 1 multiplies distances, so that their squares neither overflow nor underflow
    real step_radius;  // the radius, so scaled
    static constexpr real step_eps = DOUBLE ? real(2.220446049250313e-16) : real(1.1920929e-07f);
    unsigned int last_system;  // the highest number of one
    Lattice lattice;

    JFRNN_MEMBER explicit Space(const real* cutoff)
        : floats{},
          radius(cutoff[0]),
          step_scale(SCALED ? real(Bits::unit_scale(radius)) : real(1)),
          step_radius(SCALED ? radius * step_scale : radius),
          last_system(BATCHED ? unsigned_of(cutoff[LATTICE_END]) : 0),
          lattice(cutoff) {}
    Space(const Space&) = delete;  // denormals are treated as before where it ends, once

    // The point of a row of positions, brought into the box where space is periodic.
    JFRNN_MEMBER void point_of(const real* row, real* p) const {
        if constexpr (PERIODIC)
            lattice.wrap(row, p);
        else
            for (int k = 0; k < DIM; ++k)
                p[k] = row[k];
    }
};
