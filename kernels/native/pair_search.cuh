// How a pair is decided: nearly always in working precision, in doubt exactly.
#pragma once
#include "exact.h"
#include "image_search.cuh"

JFRNN_FUNCTION unsigned int upper_word(real x) { return DOUBLE ? __double2hiint(x) : __float_as_uint((float)x); }
JFRNN_FUNCTION real magnitude(real x) { return DOUBLE ? (real)fabs(x) : (real)fabsf(x); }
JFRNN_FUNCTION real larger(real a, real b) {
    if constexpr (DOUBLE)
        return a > b ? a : b;
    else
        return fmaxf(a, b);
}

struct PairSearch : ImageSearch {
    real outer_radius;  // what is farther away is surely no neighbor, scaled
    real sure_square;   // what is closer surely is one, squared
    real band;  // half of the difference between both, squared: pairs in between are decided exactly; negative: there are none

    JFRNN_MEMBER explicit PairSearch(const SearchArguments& given) : ImageSearch(given) {
        Known& known = shared_known();
        if (lane == 0) {
            known.site = SCALED ? real(0) : shared.unit;
            known.between = known.site > 0 ? (real)square_between(radius, known.site, closed) : real(0);
            known.grid = shared.grid;
            known.finite_queries = shared.finite_queries;
            known.longest_before = SUMS ? 0 : *(volatile int*)&info[0];
        }
        __syncwarp();
        // differences of images may be off by more than rounding takes from a difference
        const real off = CROSSING ? 2 * lattice.slack() * step_scale : real(0);
        outer_radius = step_radius + off;
        const real inner_radius = step_radius > off ? step_radius - off : real(0), square_radius = step_radius * step_radius;
        // where coordinates lie on a lattice nothing is in doubt, and bands are negative
        sure_square = DOUBLE && known.between > 0 ? known.between * known.site * known.site
                                                  : inner_radius * inner_radius - 8 * (1 + SHIFTED) * step_eps * square_radius;
        const real beyond = outer_radius * outer_radius * (1 + 16 * step_eps) - sure_square;
        band = DOUBLE && known.between > 0 ? real(-1) : CROSSING ? real(0.5) * beyond : 8 * step_eps * square_radius;
    }
    // |b - a|^2 - r^2 + band in working precision, fused or not: off by less than 5 eps r^2 where it is near [0, 2 band], see
    // jfrnn/_geometry/exact.py. Negative: surely closer than the cutoff. Its upper word has the sign and, if not negative, the order
    // of all.
    JFRNN_MEMBER real excess(const real* a, const real* b) const {
        real sum = -sure_square;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            real d = b[k] - a[k];
            if constexpr (SCALED)
                d *= step_scale;
            sum += d * d;
        }
        return sum;
    }
    // Is a candidate a neighbor of the query at `q`? It is decided exactly where working precision leaves it open; few pairs are.
    JFRNN_MEMBER bool is_neighbor(const real* q, int my_id, int id) const {
        real p[3];
        load_image(id, p);
        const real over = excess(q, p);
        bool hit = over < 0;
        if (over >= 0 && over <= 2 * band) {
            if constexpr (INSIDE)
                hit = exact_pair(q, p, radius, 0, closed);
            else {
                const real* source = positions + (long long)ROW * source_named(id);
                hit = exact_image(lattice, queries + (long long)ROW * my_id, source, image_of(id), radius, 0, closed);
            }
        }
        return hit;
    }
};
