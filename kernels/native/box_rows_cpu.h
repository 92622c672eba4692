// Rows of neighbors, or their counts, in systems with boxes of their own on the CPU.
#pragma once
#include "box_pairs_cpu.h"
#include "chunks.h"
#include "row_places.h"

struct BoxRows : BoxLanes {
    explicit BoxRows(const BoxArguments& given) : BoxLanes(given) {}

    // Threads hand themselves chunks of queries; `info` holds the length of the longest row, and the next chunk.
    void run() {
        int longest = 0;
        each_chunk(info[1], m, QUERY_CHUNK, [&](int from, int to, int) {
            for (int turn = from; turn < to; ++turn) {
                go_to(turn);
                const int found = serve();
                count[query] = found;
                longest = found > longest ? found : longest;
            }
        });
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
        Tested some = test(run, b);
        decide(run, b, some);
        if (!LIST && !LATER)
            return __builtin_popcount(some.pairs);
        const ints sources = lanes_from(ids + run.from + b);
        if constexpr (LATER)
            some.pairs &= bits_of_flags(__builtin_convertvector(sources >= first_asked(run.code), flags));
        if (LIST && some.pairs)
            pack_within(sources + name_of(0, run.code), to, some.pairs, room);
        return __builtin_popcount(some.pairs);
    }
};
