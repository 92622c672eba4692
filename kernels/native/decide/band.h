// Who is surely a pair by a distance in working precision, and who is surely none. What is in between is decided exactly (exact.h).
//
// With u = eps / 2, a computed difference of coordinates is off by u, relative to itself, its square by 3 u, a sum of three squares
// by 5 u at most, and the square of a cutoff times 1 -+ a band by 2 u: 3.5 eps in all (jfrnn/_geometry/exact.py).
// Products that are contracted with sums round less. Denormals are kept, or too small to matter.
//   ONE      is for one cutoff and points as they are.
//   IMAGES   is for images of points, whose distances may be off by a `slack` besides: the square of cutoff minus slack counts two
//            roundings more, 4.5 eps. More is not needed, since the slack is more than what images are off by: no more than 1.74
//            times the slack, the length of three errors, which would have to be the worst along each axis.
//   CUTOFFS  is for cutoffs of pairs that are computed from those of both particles: a mean and its halves are rounded.
// Kernels of CUDA whose sums of squares begin with -r^2 round once more per axis: their bands are in few.cuh and pair_search.cuh.
#pragma once
#include "exact.h"

constexpr real EPS = DOUBLE ? real(2.220446049250313e-16) : real(1.1920929e-07f);
constexpr real LEAST = DOUBLE ? real(0x1p-459) : real(0x1p-40f);  // below, squares might underflow

// Squares of distances below `inside` are surely those of pairs, squares beyond `outside` surely not.
template <class Numbers>
struct Band {
    Numbers inside, outside;
};
// Bands of one number, or of a vector of them. `slack` is by which distances may be wrong besides.
struct Bands {
    static constexpr int ONE = 4, IMAGES = 16, CUTOFFS = 32;  // eps

    // The band of one cutoff, in a unit in which its square does not underflow.
    template <class Numbers>
    JFRNN_MATH Band<Numbers> of_one(Numbers r, Numbers slack, int width) {
        const Numbers inner = r > slack ? r - slack : Numbers{}, outer = r + slack;
        return {inner * inner * (1 - width * EPS), outer * outer * (1 + width * EPS)};
    }
    // The square beyond which no pair is, whoever its particles are.
    template <class Numbers, class Slack>
    JFRNN_MATH Numbers outside_of(Numbers r, Slack slack) {
        const Numbers least = Numbers{} + LEAST, outer = (r > least ? r : least) + slack;
        return outer * outer * (1 + CUTOFFS * EPS);
    }
    // The band of one of many cutoffs. One from a table may be below 0: then species are no neighbors.
    template <class Numbers, class Slack>
    JFRNN_MATH Band<Numbers> bounds_of(Numbers r, Slack slack) {
        const Numbers none = Numbers{} - 1, nearest = Numbers{} + LEAST + slack, inner = r - slack;
        const Numbers inside = r > nearest ? inner * inner * (1 - CUTOFFS * EPS) : none, outside = outside_of(r, slack);
        if constexpr (RULE == TABLE)
            return {inside, r > Numbers{} ? outside : none};
        return {inside, outside};
    }
    template <class Numbers>
    using Bounds = Band<Numbers>;
};
