// The cutoff of a pair where cutoffs differ from particle to particle, or from species to species: RULE says how it follows from both.
//
// A thread of CUDA looks at one source at a time, the CPU at LANES of them: so `Numbers` are one number, or a vector of them.
#pragma once
#include "band.h"

constexpr bool VARY = DIFFER && RULE != GATHER;                             // the cutoffs of the pairs of a query
constexpr bool BANDED = RULE == SCATTER || RULE == EITHER || RULE == BOTH;  // the bands of a pair are those of one of its particles
constexpr bool BY_OWN = RULE == GATHER || RULE == BOTH || RULE == TABLE;    // no pair of a query is beyond its own cutoff

struct PairCutoffs : Bands {
    // The cutoff of a pair, of those of both particles; a mean is rounded. With a table it is the largest cutoff of all.
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
};
