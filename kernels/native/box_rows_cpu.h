// Rows of neighbors, or their counts, in systems with boxes of their own on the CPU.
#pragma once
#include "box_pairs_cpu.h"

struct BoxRows : BoxLanes {
    explicit BoxRows(const BoxArguments& given) : BoxLanes(given) {}

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
        int* const row = idx + (LIST ? (long long)query * capacity : 0);
        int found = 0;
        for (int r = 0; r < runs; ++r) {
            const BoxRun run = run_at(r);
            for (int b = 0; b < run.size; b += LANES)
                found += meet(run, b, row, found);
        }
        for (int s = found; LIST && s < capacity; ++s)
            row[s] = fill_value();
        return found;
    }
    // Meets the sources of a run from number b on; those that are neighbors go into the row behind `found` others.
    int meet(const BoxRun& run, int b, int* row, int found) const {
        Tested some = test(run, b);
        decide(run, b, some);
        if (!LIST && !LATER)
            return __builtin_popcount(some.pairs);
        const ints sources = lanes_from(ids + run.from + b);
        if constexpr (LATER)
            some.pairs &= bits_of_flags(__builtin_convertvector(sources >= first_asked(run.code), flags));
        if (LIST && some.pairs)
            pack_within(sources + name_of(0, run.code), row + found, some.pairs, capacity - found);
        return __builtin_popcount(some.pairs);
    }
};
