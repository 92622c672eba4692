// Systems of which each has a box of its own (jfrnn/_geometry/box_cells.py): the lattice of one, and its cells.
//
// `boxes` has the numbers of each lattice (lattice.h), behind the radius. `cells` has five integers of each system: cells along each
// axis, the first cell, and a bit per periodic axis; those of a system follow those of the one before it, x fastest, and `start` says
// where the sources of each begin. Open axes are folded: cells a whole number of turns apart have one number.
#pragma once
#include "space.h"

struct BoxSpace : Space {
    int system, axes_turning, first, counts[3];

    JFRNN_MEMBER explicit BoxSpace(const real* boxes) : Space(boxes), system(-1), axes_turning(0), first(0), counts{1, 1, 1} {}
    JFRNN_MEMBER void enter(const real* boxes, int other, int turning) {
        system = other;
        lattice = Lattice(boxes + (long long)LATTICE_END * other);
        axes_turning = turning;
    }
    JFRNN_MEMBER bool is_turning(int k) const { return axes_turning >> k & 1; }
    JFRNN_FUNCTION int floor_of(int x, int of) { return x >= 0 ? x / of : -1 - (-1 - x) / of; }
    // The cell along an axis of what lies `off` from a point; along periodic axes those of the box begin at 0. There is a farthest one,
    // up to which whole numbers are exact.
    JFRNN_MEMBER int cell_along(int k, const real* p, real off) const {
        constexpr real FARTHEST = 4194304;
        real x = p[k];
        if (SKEWED || is_turning(k)) {
            x = (p[k] - lattice.origin(k)) * lattice.transform(k, k);
            for (int l = 0; SKEWED && l < DIM; ++l)
                if (l != k)
                    x += (p[l] - lattice.origin(l)) * lattice.transform(l, k);
        }
        if (is_turning(k))
            x = x > 0 ? x < 1 ? x : real(1) : real(0);
        x = is_turning(k) ? (x + off) * counts[k] : (x + off) / lattice.reach(k);
        x = x > -FARTHEST ? x < FARTHEST ? x : FARTHEST : -FARTHEST;
        return (int)x - (x < (int)x);
    }
};
