// Has a point moved too far since a list with a skin was made? One text for CPU and CUDA.
//
// A periodic box stands along the axes. Lattice vectors do not count as motion. Where rounding leaves open how many lie between, a point
// has moved.
#pragma once
#include "near.h"

struct Motion {
    const real *now, *before;  // [n, DIM]
    const real* limit;         // [1] the square of a motion below which a list holds
    const Near near;

    // A point, near the box.
    JFRNN_MEMBER void take(long long i, real* p) const {
        for (int k = 0; k < DIM; ++k)
            p[k] = now[DIM * i + k];
        near.bring(p);
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
            if (PERIODIC && near.lattice.periodic(k)) {
                const real units = difference[k] * near.lattice.transform(k, k);
                turns[k] = nearest_whole(units);
                turned |= turns[k] != 0;
                most = size_of(units) > most ? size_of(units) : most;
                sure &= size_of(units - turns[k]) + 16 * EPS * (most + 2) < real(0.5);
            }
        }
        for (int k = 0; k < DIM; ++k) {
            real left = size_of(difference[k]);
            if (PERIODIC && turned) {
                sure &= !near.lattice.periodic(k) || size_of(near.turns_of(point, k)) <= LARGEST_TURN;
                const real taken = turns[k] * near.lattice.vector(k, k);
                left = size_of(difference[k] - taken) + 4 * EPS * (left + size_of(taken));
            }
            square += left * left;
        }
        return !(sure && square < limit[0]);
    }
};
