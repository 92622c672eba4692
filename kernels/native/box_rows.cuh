// Rows of neighbors, or their counts, in systems with boxes of their own on CUDA: a warp has a query.
//
// Each lane finds a run. Then all of them meet the sources of one run after the other or, where runs are short, since systems have few
// particles and many images, each lane those of its own.
#pragma once
#include "box_pairs.h"

struct BoxRows : BoxPairs {
    static constexpr unsigned int EVERY = 0xffffffffu;
    const int lane;
    int found;  // by all lanes if they are listed, by this one if they are counted

    JFRNN_MEMBER explicit BoxRows(const BoxArguments& given) : BoxPairs(given), lane(threadIdx.x & 31), found(0) {}

    JFRNN_MEMBER void run() {
        const long long turn = thread_index() >> 5;
        if (turn >= m)
            return;
        go_to((int)turn);
        for (int r = 0; r < runs; r += 32) {
            BoxRun mine{0, 0, 0, {0, 0, 0}};
            if (r + lane < runs)
                mine = run_at(r + lane);
            const int longest = __reduce_max_sync(EVERY, mine.size);
            if (longest < __reduce_add_sync(EVERY, (mine.size + 31) / 32))
                for (int b = 0; b < longest; ++b)
                    meet(mine, b);
            else
                meet_in_turn(mine);
        }
        const int all = LIST ? found : __reduce_add_sync(EVERY, found);
        for (int s = all + lane; LIST && s < capacity; s += 32)
            idx[(long long)query * capacity + s] = fill_value();
        if (lane > 0)
            return;
        count[query] = all;
        if (all > *(volatile int*)&info[0])
            atomicMax(&info[0], all);
    }
    // Lets all lanes meet the run of one lane after the other.
    JFRNN_MEMBER void meet_in_turn(const BoxRun& mine) {
        for (unsigned int left = __ballot_sync(EVERY, mine.size > 0); left; left &= left - 1) {
            const int other = __ffs(left) - 1;
            BoxRun run;
            run.from = __shfl_sync(EVERY, mine.from, other);
            run.size = __shfl_sync(EVERY, mine.size, other);
            run.code = __shfl_sync(EVERY, mine.code, other);
            for (int k = 0; k < 3; ++k)
                run.away[k] = k < DIM ? __shfl_sync(EVERY, mine.away[k], other) : real(0);
            for (int b = lane; b - lane < run.size; b += 32)
                meet(run, b);
        }
    }
    // Lets each lane meet the source of a number in its run; those that are neighbors go into the row, by their lanes.
    JFRNN_MEMBER void meet(const BoxRun& run, int number) {
        bool hit = false;
        int source = 0;
        if (number < run.size) {
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
            hit = asked && square < inside;
            const bool open = asked && !hit && square <= outside;
            if (later_only || open || (LIST && hit))
                source = ids[at];
            if (open)
                hit = is_pair(source, run.code);
            if (later_only)
                hit = hit && source >= first_asked(run.code);
        }
        if constexpr (!LIST) {
            found += hit;
            return;
        }
        const unsigned int hits = __ballot_sync(EVERY, hit);
        const int slot = found + __popc(hits & ((1u << lane) - 1));
        if (hit && slot < capacity)
            idx[(long long)query * capacity + slot] = name_of(source, run.code);
        found += __popc(hits);
    }
};
