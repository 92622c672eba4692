// Rows of neighbors, or their counts, in systems with boxes of their own on CUDA: LANES_PER_ROW lanes of a warp have a query.
//
// Each lane finds a run. Then all of them meet the sources of one run after the other or, where runs are short, since systems have few
// particles and many images, each lane those of its own. Queries of a warp walk together, as long as any of them has something left.
#pragma once
#include "box_pairs.h"
#include "row_places.h"

struct BoxRows : BoxPairs {
    static constexpr unsigned int EVERY = 0xffffffffu, OF_QUERY = EVERY >> (32 - LANES_PER_ROW);
    const int lane, first_lane;  // among those of its query, and the first of them in the warp
    int found;                   // of the query if they are listed, by this lane if they are counted
    int room;                    // of its row

    JFRNN_MEMBER explicit BoxRows(const BoxArguments& given)
        : BoxPairs(given), lane(threadIdx.x % LANES_PER_ROW), first_lane((threadIdx.x & 31) - lane), found(0), room(0) {}

    JFRNN_MEMBER void run() {
        const long long turn = thread_index() / LANES_PER_ROW;
        const bool is_query = turn < m;
        go_to(is_query ? (int)turn : 0);
        runs = is_query ? runs : 0;
        room = row_room(starts, query, capacity);
        for (int r = 0; __any_sync(EVERY, r < runs); r += LANES_PER_ROW) {
            BoxRun mine{0, 0, 0, {0, 0, 0}};
            if (r + lane < runs)
                mine = run_at(r + lane);
            const int longest = __reduce_max_sync(EVERY, mine.size);
            if (longest < __reduce_max_sync(EVERY, sum_of((mine.size + LANES_PER_ROW - 1) / LANES_PER_ROW)))
                for (int b = 0; b < longest; ++b)
                    meet(mine, b);
            else
                meet_in_turn(mine);
        }
        const int all = LIST ? found : sum_of(found);
        if (!is_query)
            return;
        for (int s = all + lane; LIST && s < room; s += LANES_PER_ROW)
            idx[row_begin(starts, query, capacity) + s] = fill_value();
        if (lane > 0)
            return;
        count[query] = all;
        if (all > *(volatile int*)&info[0])
            atomicMax(&info[0], all);
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
            for (int k = 0; k < 3; ++k)
                run.away[k] = k < DIM ? __shfl_sync(EVERY, mine.away[k], other) : real(0);
            run.size = left ? run.size : 0;
            const int longest = LANES_PER_ROW == 32 ? run.size : __reduce_max_sync(EVERY, run.size);
            for (int b = 0; b < longest; b += LANES_PER_ROW)
                meet(run, b + lane);
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
            if (later_only || open || ((LIST || EXCLUDING) && hit))
                source = ids[at];
            if (open)
                hit = is_pair(source, run.code);
            if (later_only)
                hit = hit && source >= first_asked(run.code);
            if constexpr (EXCLUDING)
                hit = hit && !Excluded(excluded_starts, excluded, query).has(source);
        }
        if constexpr (!LIST) {
            found += hit;
            return;
        }
        const unsigned int hits = of_query(__ballot_sync(EVERY, hit));
        const int slot = found + __popc(hits & ((1u << lane) - 1));
        if (hit && slot < room)
            write_slot(idx, receivers, row_begin(starts, query, capacity) + slot, name_of(source, run.code), query);
        found += __popc(hits);
    }
};
