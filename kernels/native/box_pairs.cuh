// Pairs in systems with boxes of their own on CUDA: LANES_PER_ROW lanes of a warp have a query.
//
// Each lane finds a run. Then all of them meet the sources of one run after the other or, where runs are short, since systems have few
// particles and many images, each lane those of its own. Queries of a warp walk together, as long as any of them has something left.
// Pairs in doubt are rare: if there are any, all queries of the warp walk once more and decide about these, so that the registers
// which that takes are not missed before. `Visitor`, the struct that derives from this one, has a member `take(hit, at, run)`, which
// all lanes call together: each with the place of a source, and whether it is a pair.
#pragma once
#include "box_pairs.h"

template <class Visitor>
struct BoxLanes : BoxPairs {
    static constexpr unsigned int EVERY = 0xffffffffu, OF_QUERY = EVERY >> (32 - LANES_PER_ROW);
    const int lane, first_lane;  // among those of its query, and the first of them in the warp
    const bool is_query;
    bool in_doubt;  // about a source that this lane has met

    JFRNN_MEMBER explicit BoxLanes(const BoxArguments& given)
        : BoxPairs(given),
          lane(threadIdx.x % LANES_PER_ROW),
          first_lane((threadIdx.x & 31) - lane),
          is_query(thread_index() / LANES_PER_ROW < given.m),
          in_doubt(false) {}

    JFRNN_MEMBER void walk() {
        ((Visitor*)this)->go_to(is_query ? (int)(thread_index() / LANES_PER_ROW) : 0);
        runs = is_query ? runs : 0;
        walk_runs<false>();
        if (__any_sync(EVERY, in_doubt))
            walk_runs<true>();
    }
    template <bool DECIDES>
    JFRNN_MEMBER void walk_runs() {
        for (int r = 0; __any_sync(EVERY, r < runs); r += LANES_PER_ROW) {
            BoxRun mine{0, 0, 0, {0, 0, 0}, {0, 0, 0}};
            if (r + lane < runs)
                mine = run_at(r + lane);
            const int longest = __reduce_max_sync(EVERY, mine.size);
            if (longest < __reduce_max_sync(EVERY, sum_of((mine.size + LANES_PER_ROW - 1) / LANES_PER_ROW)))
                meet<DECIDES>(mine, 0, 1, longest);
            else
                meet_in_turn<DECIDES>(mine);
        }
    }
    // The sum over the lanes of a query.
    JFRNN_FUNCTION int sum_of(int number) {
        for (int step = LANES_PER_ROW / 2; step > 0; step /= 2)
            number += __shfl_xor_sync(EVERY, number, step);
        return number;
    }
    JFRNN_MEMBER unsigned int of_query(unsigned int bits) const { return bits >> first_lane & OF_QUERY; }
    // Lets all lanes meet the run of one lane after the other.
    template <bool DECIDES>
    JFRNN_MEMBER void meet_in_turn(const BoxRun& mine) {
        unsigned int left = of_query(__ballot_sync(EVERY, mine.size > 0));
        for (; __any_sync(EVERY, left); left &= left - 1) {
            const int other = first_lane + (left ? __ffs(left) - 1 : 0);
            BoxRun run;
            run.from = __shfl_sync(EVERY, mine.from, other);
            run.size = __shfl_sync(EVERY, mine.size, other);
            run.code = __shfl_sync(EVERY, mine.code, other);
            for (int k = 0; k < 3; ++k) {
                run.moved[k] = k < DIM ? __shfl_sync(EVERY, mine.moved[k], other) : real(0);
                run.shift[k] = SUMS > 0 && k < DIM ? __shfl_sync(EVERY, mine.shift[k], other) : 0;
            }
            run.size = left ? run.size : 0;
            meet<DECIDES>(run, lane, LANES_PER_ROW, LANES_PER_ROW == 32 ? run.size : __reduce_max_sync(EVERY, run.size));
        }
    }
    // Lets each lane meet the sources of a run from number `first` on, every one of `step`; for the longest run of all lanes these are
    // below `longest`.
    template <bool DECIDES>
    JFRNN_MEMBER void meet(const BoxRun& run, int first, int step, int longest) {
        const int itself =
            run.code == at_home ? place - run.from : -1;  // it is its own neighbor whatever its cutoff, or not at all
        const real away[3] = {run.moved[0] - q[0], run.moved[1] - q[1], run.moved[2] - q[2]};
        const real* source = axes + run.from + first;
        constexpr int TOGETHER = DECIDES ? 1 : 4;  // steps whose sources are loaded at once
#pragma unroll TOGETHER
        for (int b = 0; b < longest; b += step) {
            const int number = first + b;
            const bool asked = number < run.size & (number != itself | !drop_self);
            const real* const source = axes + run.from + (number < run.size ? number : 0);
            real square = 0;
#pragma unroll
            for (int k = 0; k < DIM; ++k) {
                real d = source[(long long)k * stride] + away[k];
                if constexpr (SCALED)
                    d *= step_scale;
                square += d * d;
            }
            PairCutoffs::Bounds<real> bounds{inside, outside};
            if constexpr (RULE != ONE_CUTOFF)
                bounds = PairCutoffs::bounds_of(cutoff_at(run.from + (number < run.size ? number : 0)) * step_scale, slack);
            const bool sure = asked & (square < bounds.inside | (RULE != ONE_CUTOFF & number == itself));
            const bool open = asked & square <= bounds.outside & !sure;
            bool hit = DECIDES ? open : sure;
            if constexpr (DECIDES)
                hit = hit && is_pair(run.from + number, run.code);
            else
                in_doubt |= open;
            if constexpr (LATER)
                hit = hit && ids[run.from + number] >= first_asked(run.code);
            if constexpr (EXCLUDING)
                hit = hit && !is_excluded(ids[run.from + number], run.code);
            ((Visitor*)this)->take(hit, run.from + number, run);
        }
    }
};
