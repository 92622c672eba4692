// Rows of neighbors, or their counts, in systems with boxes of their own on the CPU: a query meets LANES sources of a run at a time.
#pragma once
#include "box_pairs.h"
#include "lanes.h"
#include "row_places.h"

struct BoxRows : BoxPairs {
    explicit BoxRows(const BoxArguments& given) : BoxPairs(given) {}

    // Threads hand themselves chunks of queries; `info` holds the length of the longest row, and the next chunk.
    void run() {
        int longest = 0;
        for (;;) {
            const long long begin = (long long)QUERY_CHUNK * __atomic_fetch_add(&info[1], 1, __ATOMIC_RELAXED);
            if (begin >= m)
                break;
            for (long long turn = begin; turn < m && turn < begin + QUERY_CHUNK; ++turn) {
                go_to((int)turn);
                const int found = serve();
                count[query] = found;
                longest = found > longest ? found : longest;
            }
        }
        int known = __atomic_load_n(&info[0], __ATOMIC_RELAXED);
        while (
            known < longest && !__atomic_compare_exchange_n(&info[0], &known, longest, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
    }
    int serve() const {
        const long long begin = LIST ? row_begin(starts, query, capacity) : 0;
        const int room = row_room(starts, query, capacity);
        int found = 0;
        for (int r = 0; r < runs; ++r) {
            const BoxRun run = run_at(r);
            for (int b = 0; b < run.size; b += LANES)
                found += meet(run, b, idx + begin + found, room - found);
        }
        for (int s = found; LIST && !FLAT && s < room; ++s)
            idx[begin + s] = fill_value();
        for (int s = 0; FLAT && s < room; ++s)
            receivers[begin + s] = query;
        return found;
    }
    // Meets the sources of a run from number b on; those that are neighbors go to `to`, where there is `room`.
    int meet(const BoxRun& run, int b, int* to, int room) const {
        const int at = run.from + b;
        vec square{};
        for (int k = 0; k < DIM; ++k) {
            vec d = lanes_from(axes + (long long)k * stride + at) + run.away[k];
            if constexpr (SCALED)
                d *= step_scale;
            square += d * d;
        }
        unsigned int asked = lanes_before(run.size - b);
        if (drop_self && run.code == at_home && place >= at && place < at + LANES)
            asked &= ~(1u << (place - at));
        unsigned int pairs = mask_of(square, inside, Below{}) & asked;
        unsigned int open = mask_of(square, outside, BelowOrAt{}) & asked & ~pairs;
        if (!LIST && !open && !later_only && !EXCLUDING)
            return __builtin_popcount(pairs);
        const ints sources = lanes_from(ids + at);
        for (; open; open &= open - 1) {
            const int lane = __builtin_ctz(open);
            pairs |= is_pair(sources[lane], run.code) ? 1u << lane : 0;
        }
        if (later_only)
            pairs &= bits_of_flags(__builtin_convertvector(sources >= first_asked(run.code), flags));
        const Excluded mine(excluded_starts, excluded, query);
        for (unsigned int rest = EXCLUDING ? pairs : 0; rest; rest &= rest - 1)
            if (mine.has(sources[__builtin_ctz(rest)]))
                pairs &= ~(rest & -rest);
        if (LIST && pairs)
            pack_within(sources + name_of(0, run.code), to, pairs, room);
        return __builtin_popcount(pairs);
    }
};
