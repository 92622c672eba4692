// Lists that are kept, on CUDA: a few lanes serve a row, each of which takes some of its entries at a time.
#pragma once
#include "kept.h"
#include "loads.cuh"

constexpr int AT_A_TIME = LENGTH * sizeof(real) > 16 ? 2 : 4;  // entries of a lane

struct KeptLane : Kept {
    const int lane, row;  // of a row
    const bool is_row;

    JFRNN_MEMBER explicit KeptLane(const KeptArguments& given)
        : Kept(given),
          lane((int)(thread_index() % LANES_PER_ROW)),
          row((int)(thread_index() / LANES_PER_ROW)),
          is_row(row < given.m) {}

    struct Entries {
        int ids[AT_A_TIME], codes[AT_A_TIME];
        bool used[AT_A_TIME];
    };
    // Reads the entries from `place` on: at once, where rows begin at multiples of 16 bytes.
    JFRNN_MEMBER void read(long long first, int place, int all, Entries& some) const {
#pragma unroll
        for (int k = 0; k < AT_A_TIME; ++k) {
            some.used[k] = place + k < all;
            some.ids[k] = some.codes[k] = 0;
        }
        if constexpr (ALIGNED && !REVERSED && !CODED) {
            struct alignas(4 * AT_A_TIME) Ids {
                int at[AT_A_TIME];
            } ids;
            if (some.used[0]) {
                load_words((const Ids*)(idx + first + place), &ids);
#pragma unroll
                for (int k = 0; k < AT_A_TIME; ++k)
                    some.ids[k] = some.used[k] ? ids.at[k] : 0;
            }
        } else
#pragma unroll
            for (int k = 0; k < AT_A_TIME; ++k)
                if (some.used[k])
                    read_entry(first + place + k, some.ids[k], some.codes[k]);
    }
    // Calls `visit(place, id, numbers, verdict, pair)` for the entries of the row that this lane takes.
    template <class Visit>
    JFRNN_MEMBER void walk(const OwnPoint& own, Visit visit) const {
        const long long first = is_row ? first_entry(row) : 0;
        const int all = is_row ? entries(row) : 0;
        Entries some;
        read(first, AT_A_TIME * lane, all, some);
        for (int place = AT_A_TIME * lane; place < all; place += AT_A_TIME * LANES_PER_ROW) {
            real numbers[AT_A_TIME][LENGTH];
#pragma unroll
            for (int k = 0; k < AT_A_TIME; ++k)
                load_numbers<LENGTH>(points + (long long)LENGTH * some.ids[k], numbers[k]);
            Entries next;
            read(first, place + AT_A_TIME * LANES_PER_ROW, all, next);
#pragma unroll
            for (int k = 0; k < AT_A_TIME; ++k) {
                real step[3] = {0, 0, 0};
                for (int a = 0; CODED && a < DIM; ++a)
                    step[a] = steps[DIM * some.codes[k] + a];
                const Verdict verdict = judge(own, numbers[k], step, apart && some.ids[k] == row, some.used[k]);
                bool pair = verdict.sure;
                if (verdict.open)
                    pair = decide(own, numbers[k], verdict);
                visit(place + k, some.ids[k], numbers[k], verdict, pair);
            }
            some = next;
        }
    }
    JFRNN_MEMBER bool decide(const OwnPoint& own, const real* numbers, const Verdict& verdict) const {
        int shift[3] = {0, 0, 0};
        real p[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k) {
            p[k] = numbers[k];
            shift[k] = SHIFTED ? (int)verdict.shift[k] : 0;
        }
        return is_exact_pair(own, p, RADII > OF_ROW ? numbers[RADII > OF_ROW ? RADIUS : 0] : real(0), shift);
    }
};
