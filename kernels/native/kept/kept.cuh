// Lists that are kept, on CUDA: a few lanes serve a row, each of which takes some of its entries at a time.
#pragma once
#include "kept.h"
#include "loads.cuh"

constexpr int AT_A_TIME = LENGTH * sizeof(real) > 16 ? 2 : 4;  // entries of a lane

struct KeptLane : Kept {
    const int lane;  // of a row
    const bool is_row;
    const int row;

    JFRNN_MEMBER explicit KeptLane(const KeptArguments& given)
        : Kept(given, BOXES && is_place(given) ? row_at(given) : 0),
          lane((int)(thread_index() % LANES_PER_ROW)),
          is_row(is_place(given)),
          row(row_at(given)) {}
    JFRNN_FUNCTION bool is_place(const KeptArguments& given) { return thread_index() / LANES_PER_ROW < given.m; }
    // Where the first number is negative, rows are taken as they come: all threads read that one, and none waits for its own.
    JFRNN_FUNCTION int row_at(const KeptArguments& given) {
        const int place = (int)(thread_index() / LANES_PER_ROW);
        return ORDERED && is_place(given) && given.order[0] >= 0 ? given.order[place] : place;
    }

    template <bool VALUE>
    struct Home {
        static constexpr bool value = VALUE;
    };
    struct Entries {
        int ids[AT_A_TIME], codes[AT_A_TIME];
    };
    // Reads what belongs to the slots of a row from `place` on: at once, where rows begin at multiples of 16 bytes.
    template <class Element>
    JFRNN_MEMBER void read_slots(const Element* row, int place, Element* to) const {
        if constexpr (ALIGNED) {
            constexpr int TOGETHER = AT_A_TIME * sizeof(Element) > 16 ? 16 / sizeof(Element) : AT_A_TIME;
            struct alignas(sizeof(Element) * TOGETHER) Words {
                Element at[TOGETHER];
            };
#pragma unroll
            for (int part = 0; part < AT_A_TIME; part += TOGETHER)
                load_words((const Words*)(row + place + part), (Words*)(to + part));
        } else
#pragma unroll
            for (int k = 0; k < AT_A_TIME; ++k)
                to[k] = place + k < capacity ? row[place + k] : Element(0);
    }
    // Reads the entries from `place` on: at once, where rows begin at multiples of 16 bytes.
    JFRNN_MEMBER void read(long long first, int place, int all, Entries& some) const {
#pragma unroll
        for (int k = 0; k < AT_A_TIME; ++k) {
            some.ids[k] = n;
            some.codes[k] = 0;
        }
        if constexpr (ALIGNED && !REVERSED && !CODED) {
            if (place < all)
                read_slots(idx + first, place, some.ids);
        } else
#pragma unroll
            for (int k = 0; k < AT_A_TIME; ++k)
                if (place + k < all)
                    read_entry(first + place + k, some.ids[k], some.codes[k]);
    }
    // Calls `visit(home, place, id, numbers, verdict, pair)` for the entries of the row that this lane takes, at home (judge) where all
    // of the warp are. Those in doubt come once more, after they were decided: so rare a call stands outside of what every entry takes.
    // Those that were sure do not: the band of images is wider than that of points as they are. `settle(place, pairs, lengths)` comes
    // last: one bit for each of the entries from `place` on, and (MEASURED) distances.
    template <class Visit, class Settle>
    JFRNN_MEMBER void walk(const OwnPoint& own, Visit visit, Settle settle) const {
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
            bool open = false, sure[AT_A_TIME];
            real lengths[AT_A_TIME];
            auto judge_all = [&](auto home) {
#pragma unroll
                for (int k = 0; k < AT_A_TIME; ++k) {
                    const Verdict verdict = judged<home.value>(own, numbers[k], some.ids[k], some.codes[k]);
                    lengths[k] = MEASURED ? length_of(verdict.vector) : real(0);
                    open |= verdict.open;
                    sure[k] = verdict.sure;
                    visit(home, place + k, some.ids[k], numbers[k], verdict, verdict.sure);
                }
            };
            bool may = true;
            if constexpr (NEAREST) {
                may = false;
#pragma unroll
                for (int k = 0; k < AT_A_TIME; ++k)
                    may |= may_turn(own, numbers[k]);
                may = __any_sync(__activemask(), may);
            }
            if (may)
                judge_all(Home<false>());
            else if constexpr (NEAREST)
                judge_all(Home<true>());
            unsigned int pairs = 0;
            auto put_down = [&] {
#pragma unroll
                for (int k = 0; k < AT_A_TIME; ++k)
                    pairs |= sure[k] ? 1u << k : 0;
            };
            if (open) {  // what comes next is read again: it would leave its registers for calls that hardly ever happen
                put_down();
#pragma unroll 1
                for (int k = 0; k < AT_A_TIME && place + k < all; ++k) {
                    if (pairs >> k & 1)
                        continue;
                    int id, code;
                    read_entry(first + place + k, id, code);
                    real doubted[LENGTH];
                    load_numbers<LENGTH>(points + (long long)LENGTH * id, doubted);
                    const Verdict verdict = judged<false>(own, doubted, id, code);
                    if (verdict.sure || (verdict.open && decide(own, doubted, verdict))) {
                        pairs |= 1u << k;
                        visit(Home<false>(), place + k, id, doubted, verdict, true);
                    }
                }
                read(first, place + AT_A_TIME * LANES_PER_ROW, all, next);
            } else
                put_down();
            settle(place, pairs, lengths);
            some = next;
        }
    }
    template <bool HOME>
    JFRNN_MEMBER Verdict judged(const OwnPoint& own, const real* numbers, int id, int code) const {
        real step[3] = {0, 0, 0};
        for (int a = 0; CODED && a < DIM; ++a)
            step[a] = steps[DIM * code + a];
        return judge<HOME>(own, numbers, step, id != row);
    }
    JFRNN_MEMBER bool decide(const OwnPoint& own, const real* numbers, const Verdict& verdict) const {
        int shift[3] = {0, 0, 0};
        real p[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k) {
            p[k] = numbers[k];
            shift[k] = SHIFTED ? (int)verdict.shift[k] : 0;
        }
        return is_exact_pair(own, p, DIFFER ? numbers[DIFFER ? RADIUS : 0] : real(0), shift);
    }
};
