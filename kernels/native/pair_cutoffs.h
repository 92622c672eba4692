// The cutoff of a pair where cutoffs differ from particle to particle, or from species to species: RULE says how it follows from both.
//
// A thread of CUDA looks at one source at a time, the CPU at LANES of them: so `Numbers` are one number, or a vector of them.
#pragma once
#include "exact.h"

constexpr int ONE_CUTOFF = -1, GATHER = 0, SCATTER = 1, EITHER = 2, BOTH = 3, MEAN = 4, TABLE = 5;  // RULE
constexpr bool DIFFER = RULE != ONE_CUTOFF;                                                         // cutoffs
constexpr bool VARY = DIFFER && RULE != GATHER;                             // the cutoffs of the pairs of a query
constexpr bool BANDED = RULE == SCATTER || RULE == EITHER || RULE == BOTH;  // the bands of a pair are those of one of its particles
constexpr bool BY_OWN = RULE == GATHER || RULE == BOTH || RULE == TABLE;    // no pair of a query is beyond its own cutoff
constexpr real EPS = DOUBLE ? real(2.220446049250313e-16) : real(1.1920929e-07f);
constexpr real LEAST = DOUBLE ? real(0x1p-459) : real(0x1p-40f);  // below, squares might underflow

struct PairCutoffs {
    static constexpr real BAND = 32 * EPS;  // of squares, relative: a mean and its halves are rounded
    // The cutoff of a pair, of those of both particles; a mean is rounded. Of a table, what no pair is beyond.
    template <class Numbers>
    JFRNN_MATH Numbers of_pair(Numbers own, Numbers other) {
        if constexpr (RULE == GATHER)
            return own;
        if constexpr (RULE == SCATTER)
            return other;
        if constexpr (RULE == EITHER)
            return own > other ? own : other;
        if constexpr (RULE == BOTH || RULE == TABLE)
            return own < other ? own : other;
        return own / 2 + other / 2;
    }
    // Squares below are surely those of pairs, squares beyond surely not; the latter is negative where species are no neighbors.
    template <class Numbers>
    struct Bounds {
        Numbers inside, outside;
    };
    // The square beyond which no pair is, whoever its particles are.
    template <class Numbers>
    JFRNN_MATH Numbers outside_of(Numbers r, real slack) {
        const Numbers least = Numbers{} + LEAST, outer = (r > least ? r : least) + slack;
        return outer * outer * (1 + BAND);
    }
    // The bounds of a cutoff in a unit; `slack` is by which distances of images may be wrong.
    template <class Numbers>
    JFRNN_MATH Bounds<Numbers> bounds_of(Numbers r, real slack) {
        const Numbers none = Numbers{} - 1, nearest = Numbers{} + LEAST + slack, inner = r - slack;
        const Numbers inside = r > nearest ? inner * inner * (1 - BAND) : none, outside = outside_of(r, slack);
        if constexpr (RULE == TABLE)
            return {inside, r > Numbers{} ? outside : none};
        return {inside, outside};
    }
};
