// Rows of neighbors, or their counts, in systems with boxes of their own on CUDA: a warp has a query.
//
// Its lanes meet the sources of a run. Where runs are short, since systems have few particles and many images, each lane has a run.
#pragma once
#include "box_pairs.h"

struct BoxRows : BoxPairs {
    static constexpr unsigned int EVERY = 0xffffffffu;
    static constexpr int SHORT = 12;  // sources of a run
    const int lane;
    int found;

    JFRNN_MEMBER explicit BoxRows(const BoxArguments& given) : BoxPairs(given), lane(threadIdx.x & 31), found(0) {}

    JFRNN_MEMBER void run() {
        const long long turn = thread_index() >> 5;
        if (turn >= m)
            return;
        go_to((int)turn);
        const int all = counts[0] * counts[1] * counts[2], members = start[first + all] - start[first];
        const int along = visited[0] < counts[0] ? visited[0] : counts[0];
        if ((long long)members * along < (long long)SHORT * all)
            meet_short_runs();
        else
            meet_long_runs();
        for (int s = found + lane; LIST && s < capacity; s += 32)
            idx[(long long)query * capacity + s] = fill_value();
        if (lane > 0)
            return;
        count[query] = found;
        if (found > *(volatile int*)&info[0])
            atomicMax(&info[0], found);
    }
    JFRNN_MEMBER void meet_long_runs() {
        for (int r = 0; r < runs; ++r) {
            const BoxRun run = run_at(r);
            for (int b = 0; b < run.size; b += 32)
                meet(run, b + lane);
        }
    }
    JFRNN_MEMBER void meet_short_runs() {
        for (int r = 0; r < runs; r += 32) {
            BoxRun run;
            run.size = 0;
            if (r + lane < runs)
                run = run_at(r + lane);
            for (int b = 0; __any_sync(EVERY, b < run.size); ++b)
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
                real d = axes[(long long)k * stride + at] + run.moved[k] - q[k];
                if constexpr (SCALED)
                    d *= step_scale;
                square += d * d;
            }
            const bool asked = !(drop_self && run.code == at_home && at == place);
            hit = asked && square < inside;
            const bool open = asked && !hit && square <= outside;
            if (LIST || open || later_only)
                source = ids[at];
            if (open)
                hit = is_pair(source, run.code);
            hit = hit && source >= first_asked(run.code);
        }
        const unsigned int hits = __ballot_sync(EVERY, hit);
        const int slot = found + __popc(hits & ((1u << lane) - 1));
        if (LIST && hit && slot < capacity)
            idx[(long long)query * capacity + slot] = name_of(source, run.code);
        found += __popc(hits);
    }
};
