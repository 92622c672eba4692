// Pairs in systems with boxes of their own on the CPU: a query meets LANES sources of a run at a time.
#pragma once
#include "box_pairs.h"
#include "lanes.h"

struct BoxLanes : BoxPairs {
    explicit BoxLanes(const BoxArguments& given) : BoxPairs(given) {}

    // One bit per lane: those that are pairs, and those that have to be decided.
    struct Tested {
        unsigned int pairs, open;
    };
    // Tests the sources of a run from number b on.
    Tested test(const BoxRun& run, int b) const {
        const int at = run.from + b;
        vec square{};
        for (int k = 0; k < DIM; ++k) {
            vec d = lanes_from(axes + (long long)k * stride + at) + (run.moved[k] - q[k]);
            if constexpr (SCALED)
                d *= step_scale;
            square += d * d;
        }
        unsigned int asked = lanes_before(run.size - b), itself = 0;
        if (run.code == at_home && place >= at && place < at + LANES)
            itself = asked & 1u << (place - at);
        if (drop_self)
            asked &= ~itself;
        if constexpr (RULE == ONE_CUTOFF) {
            const unsigned int pairs = mask_of(square, inside, Below{}) & asked;
            return {pairs, mask_of(square, outside, BelowOrAt{}) & asked & ~pairs};
        }
        const auto bounds = PairCutoffs::bounds_of(vec(cutoffs_from(at) * step_scale), slack);
        unsigned int pairs = bits_of_flags(__builtin_convertvector(square < bounds.inside, flags)) & asked;
        pairs |= drop_self ? 0 : itself;  // whatever its cutoff
        return {pairs, bits_of_flags(__builtin_convertvector(square <= bounds.outside, flags)) & asked & ~pairs};
    }
    // The cutoffs of the query and the sources from a place on.
    vec cutoffs_from(int at) const {
        vec own = vec{} + own_radius;
        if constexpr (RULE == TABLE)
            for (int l = 0; l < LANES; ++l)
                own[l] = of_kinds[kinds_of_sources[at + l]];
        if constexpr (RULE == TABLE || RULE == GATHER)
            return own;
        return PairCutoffs::of_pair(own, lanes_from(radii + at));
    }
    // Decides about those in doubt, and leaves out those that are excluded.
    void decide(const BoxRun& run, int b, Tested& some) const {
        for (; some.open; some.open &= some.open - 1) {
            const int lane = __builtin_ctz(some.open);
            some.pairs |= is_pair(run.from + b + lane, run.code) ? 1u << lane : 0;
        }
        for (unsigned int rest = EXCLUDING ? some.pairs : 0; rest; rest &= rest - 1)
            if (is_excluded(ids[run.from + b + __builtin_ctz(rest)], run.code))
                some.pairs &= ~(rest & -rest);
    }
};
