// Pairs in systems with boxes of their own on CUDA: a warp serves 32 queries that follow each other, and so are close.
//
// Those of one system visit what any of them has within reach. Each lane finds a run; then all of them meet the sources of one run
// after the other, 32 at a time, each lane as its own query. What becomes of the pairs is said by `Visitor`, the struct that derives
// from this one: all lanes together call its member `take(run, at, size, hits)`, with a bit for each of `size` sources from the place
// `at` on.
#pragma once
#include "box_pairs.h"

template <class Visitor>
struct BoxWarp : BoxPairs {
    static constexpr unsigned int EVERY = 0xffffffffu;
    static constexpr int UNROLLED = 8;  // sources whose coordinates are loaded at once; so many may be read behind the last one
    const int lane;
    const bool is_query;
    bool is_asking;  // it has a system, and something to visit

    JFRNN_MEMBER explicit BoxWarp(const BoxArguments& given)
        : BoxPairs(given), lane(threadIdx.x & 31), is_query(thread_index() < given.m), is_asking(false) {}

    JFRNN_MEMBER void go_to_own() {
        go_to(is_query ? (int)thread_index() : 0);
        is_asking = is_query && runs > 0;
    }
    // Serves all queries, system by system.
    JFRNN_MEMBER void walk() {
        int from[3], to[3];
        for (int k = 0; k < 3; ++k) {
            from[k] = low[k];
            to[k] = low[k] + visited[k];
        }
        const int own_system = system;
        unsigned int left = __ballot_sync(EVERY, is_asking);
        while (left) {
            const int chosen = __shfl_sync(EVERY, own_system, __ffs(left) - 1);
            const bool among = is_asking && own_system == chosen;
            left &= ~__ballot_sync(EVERY, among);
            if (system != chosen)
                enter(chosen);
            for (int k = 0; k < DIM; ++k) {
                low[k] = __reduce_min_sync(EVERY, among ? from[k] : 0x7fffffff);
                visited[k] = __reduce_max_sync(EVERY, among ? to[k] : -0x7fffffff) - low[k];
                if (!is_turning(k))
                    visited[k] = visited[k] < counts[k] ? visited[k] : counts[k];
            }
            walk_runs(among);
        }
    }
    JFRNN_MEMBER void walk_runs(bool among) {
        const int all = count_runs();
        for (int r = 0; r < all; r += 32) {
            BoxRun some{0, 0, 0, {0, 0, 0}, {0, 0, 0}};
            if (r + lane < all)
                some = run_at(r + lane);
            for (unsigned int there = __ballot_sync(EVERY, some.size > 0); there; there &= there - 1) {
                const BoxRun run = run_of(some, __ffs(there) - 1);
                for (int b = 0; b < run.size; b += 32)
                    meet(run, b, among);
            }
        }
    }
    // What another lane has found.
    JFRNN_FUNCTION BoxRun run_of(const BoxRun& some, int other) {
        BoxRun run;
        run.from = __shfl_sync(EVERY, some.from, other);
        run.size = __shfl_sync(EVERY, some.size, other);
        run.code = __shfl_sync(EVERY, some.code, other);
        for (int k = 0; k < 3; ++k) {
            run.moved[k] = k < DIM ? __shfl_sync(EVERY, some.moved[k], other) : real(0);
            run.shift[k] = SUMS > 0 && k < DIM ? __shfl_sync(EVERY, some.shift[k], other) : 0;
        }
        return run;
    }
    // Lets each query meet the sources of a run from number b on, up to 32.
    JFRNN_MEMBER void meet(const BoxRun& run, int b, bool among) {
        const int at = run.from + b, size = run.size - b < 32 ? run.size - b : 32;
        const real* const first = axes + at;
        unsigned int hits = 0, open = 0;
        for (int c = 0; c < size; c += UNROLLED)
#pragma unroll
            for (int e = 0; e < UNROLLED; ++e) {
                real square = 0;
#pragma unroll
                for (int k = 0; k < DIM; ++k) {
                    real d = first[(long long)k * stride + c + e] + (run.moved[k] - q[k]);
                    if constexpr (SCALED)
                        d *= step_scale;
                    square += d * d;
                }
                const unsigned int bit = 1u << (c + e);
                hits |= square < inside ? bit : 0;
                open |= square <= outside ? bit : 0;
            }
        unsigned int asked = among ? EVERY >> (32 - size) : 0;
        if (drop_self && run.code == at_home && place >= at && place < at + size)
            asked &= ~(1u << (place - at));
        hits &= asked;
        for (open &= asked & ~hits; open; open &= open - 1) {
            const int c = __ffs(open) - 1;
            hits |= is_pair(ids[at + c], run.code) ? 1u << c : 0;
        }
        for (unsigned int some = later_only ? hits : 0; some; some &= some - 1) {
            const int c = __ffs(some) - 1;
            hits &= ids[at + c] >= first_asked(run.code) ? EVERY : ~(1u << c);
        }
        __syncwarp();
        ((Visitor*)this)->take(run, at, size, hits);
    }
};
