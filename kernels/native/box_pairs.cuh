// Pairs in systems with boxes of their own on CUDA: LANES_PER_ROW lanes of a warp have a query.
//
// Each lane finds a run. Then all of them meet the sources of one run after the other or, where runs are short, since systems have few
// particles and many images, each lane those of its own. Queries of a warp walk together, as long as any of them has something left.
// `Visitor`, the struct that derives from this one, has a member `meet(run, number)`, which all lanes call together: each with the
// source of a number in a run, if there is one.
#pragma once
#include "box_pairs.h"

template <class Visitor>
struct BoxLanes : BoxPairs {
    static constexpr unsigned int EVERY = 0xffffffffu, OF_QUERY = EVERY >> (32 - LANES_PER_ROW);
    const int lane, first_lane;  // among those of its query, and the first of them in the warp
    const bool is_query;

    JFRNN_MEMBER explicit BoxLanes(const BoxArguments& given)
        : BoxPairs(given),
          lane(threadIdx.x % LANES_PER_ROW),
          first_lane((threadIdx.x & 31) - lane),
          is_query(thread_index() / LANES_PER_ROW < given.m) {}

    JFRNN_MEMBER void walk() {
        for (int r = 0; __any_sync(EVERY, r < runs); r += LANES_PER_ROW) {
            BoxRun mine{0, 0, 0, {0, 0, 0}, {0, 0, 0}};
            if (r + lane < runs)
                mine = run_at(r + lane);
            const int longest = __reduce_max_sync(EVERY, mine.size);
            if (longest < __reduce_max_sync(EVERY, sum_of((mine.size + LANES_PER_ROW - 1) / LANES_PER_ROW)))
                for (int b = 0; b < longest; ++b)
                    ((Visitor*)this)->meet(mine, b);
            else
                meet_in_turn(mine);
        }
    }
    JFRNN_MEMBER void go_to_own() {
        go_to(is_query ? (int)(thread_index() / LANES_PER_ROW) : 0);
        runs = is_query ? runs : 0;
    }
    // The sum over the lanes of a query.
    JFRNN_FUNCTION int sum_of(int number) {
        for (int step = LANES_PER_ROW / 2; step > 0; step /= 2)
            number += __shfl_xor_sync(EVERY, number, step);
        return number;
    }
    JFRNN_MEMBER unsigned int of_query(unsigned int bits) const { return bits >> first_lane & OF_QUERY; }
    // Lets all lanes meet the run of one lane after the other.
    JFRNN_MEMBER void meet_in_turn(const BoxRun& mine) {
        unsigned int left = of_query(__ballot_sync(EVERY, mine.size > 0));
        for (; __any_sync(EVERY, left); left &= left - 1) {
            const int other = first_lane + (left ? __ffs(left) - 1 : 0);
            BoxRun run;
            run.from = __shfl_sync(EVERY, mine.from, other);
            run.size = __shfl_sync(EVERY, mine.size, other);
            run.code = __shfl_sync(EVERY, mine.code, other);
            for (int k = 0; k < 3; ++k) {
                run.away[k] = k < DIM ? __shfl_sync(EVERY, mine.away[k], other) : real(0);
                run.shift[k] = SUMS > 0 && k < DIM ? __shfl_sync(EVERY, mine.shift[k], other) : 0;
            }
            run.size = left ? run.size : 0;
            const int longest = LANES_PER_ROW == 32 ? run.size : __reduce_max_sync(EVERY, run.size);
            for (int b = 0; b < longest; b += LANES_PER_ROW)
                ((Visitor*)this)->meet(run, b + lane);
        }
    }
    // Says whether the source of a number in a run is a pair, and which one it is, if that is needed.
    JFRNN_MEMBER bool is_met(const BoxRun& run, int number, bool named, int& source) const {
        if (number >= run.size)
            return false;
        const int at = run.from + number;
        real square = 0;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            real d = axes[(long long)k * stride + at] + run.away[k];
            if constexpr (SCALED)
                d *= step_scale;
            square += d * d;
        }
        const bool asked = !(drop_self && run.code == at_home && at == place);
        bool hit = asked && square < inside;
        const bool open = asked && !hit && square <= outside;
        if (later_only || open || (named && hit))
            source = ids[at];
        if (open)
            hit = is_pair(source, run.code);
        return hit && !(later_only && source < first_asked(run.code));
    }
};
