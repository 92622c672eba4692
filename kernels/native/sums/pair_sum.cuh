// Sums over pairs on CUDA: terms are evaluated where their pairs are found, by the lane of the query.
//
// Several pairs are taken at once, and what is read of the next ones is loaded meanwhile: it takes longer than what is done with it.
// Two sets take turns, since to copy one would be to wait for it. Whether more is left is asked in between, since the compiler puts
// what is loaded off until it is used, but not beyond that question.
#pragma once
#include "held.cuh"
#include "loads.cuh"
#include "reduction.cuh"
#include "sort_values.cuh"
#include "walk.cuh"

JFRNN_FUNCTION int load_id_now(unsigned int at) {
    int id;
    asm volatile("ld.shared.u32 %0, [%1];" : "=r"(id) : "r"(at));
    return id;
}
// Pairs that a lane takes at once, and what is loaded of them; only what is read takes registers.
struct Taken {
    bool pairs[TAKEN];
    int id[TAKEN];
    struct Numbers {
        real at[ROW_LENGTH];  // what the term reads of j, coordinates first
        real place[4];        // coordinates of j, and its id, as a `Place` has them
    } numbers[TAKEN];
};

struct Sums : Walk<Sums> {
    static constexpr bool NAMED = SUMS == 2;  // the sources of summands are asked for
    const real *shared_values, *own_values, *values;
    const Results results;
    const int code_at_home;  // of the image in the box

    JFRNN_MEMBER explicit Sums(const SumsArguments& a)
        : Walk(a.of_search()),
          shared_values(a.shared_values),
          own_values(a.own_values),
          values(a.values),
          results(a.sums, a.errors, a.n, a.totals, a.more),
          code_at_home(NAMED ? (count_codes() - 1) / 2 : 0) {}

    JFRNN_MEMBER void open(int block) {
        for (int t = lane; block < query_blocks && t < 2 * TOTALS; t += 32)
            results.totals[2ll * TOTALS * block + t] = 0;
    }
    JFRNN_MEMBER void none(int id) { results.clear(id, lane, 32); }
    JFRNN_MEMBER void done(const Group&, int) {}

    // Reduces the pairs that are held to what their queries get.
    JFRNN_MEMBER void settle(const Group& group, const Pairs& pairs, bool finished) {
        Warp& warp = shared_warp();
        warp.hits[pairs.tested / 32][lane] = 0;  // no lane has met the block behind the last one
        // a lane that has no pair left reads the id behind a block's, and nothing comes of it; but it must be a place
        if (lane < 2 && pairs.kept <= pairs.tested + 32 * lane)
            warp.ids[pairs.tested + 32 * lane] = 0;
        __syncwarp();
        const Term term(shared_values);
        const Place here = lane < group.size ? load_query(group.place + lane) : Place{{0, 0, 0}, 0};
        const Term::Own own_part = term.own(own_values + (long long)group.my_id * OWN, here.p);
        Reduction reduction(n);
        HeldPairs held(pairs, lane);
        held.advance();
        held.advance();
        Taken some, others;
        take(held, some);
        while (__any_sync(ALL, some.pairs[0])) {
            take(held, others);
            evaluate(term, own_part, some, reduction);
            if (!__any_sync(ALL, others.pairs[0]))
                break;
            take(held, some);
            evaluate(term, own_part, others, reduction);
        }
        reduction.store(results, {lane, group.my_id, served, lane < group.size, pairs.fresh, finished});
    }
    // Takes the next pairs of a block, and loads what is read of them.
    JFRNN_MEMBER void take(HeldPairs& held, Taken& taken) {
        unsigned int at[TAKEN];
#pragma unroll
        for (int k = 0; k < TAKEN; ++k) {
            taken.pairs[k] = held.hits != 0;
            at[k] = held.take();
        }
#pragma unroll
        for (int k = 0; k < TAKEN; ++k)
            taken.id[k] = load_id_now(at[k]);
        if constexpr (NAMED || FROM_PLACES)
#pragma unroll
            for (int k = 0; k < TAKEN; ++k)
                load_numbers<4>(sorted + source_of(taken.id[k]), taken.numbers[k].place);
        if constexpr (OTHERS + STEPS > 0)
#pragma unroll
            for (int k = 0; k < TAKEN; ++k)
                load_numbers<ROW_LENGTH>(values + (long long)ROW_LENGTH * source_of(taken.id[k]), taken.numbers[k].at);
        held.advance();
    }
    JFRNN_MEMBER void evaluate(const Term& term, const Term::Own& own_part, const Taken& taken, Reduction& reduction) {
#pragma unroll
        for (int k = 0; k < TAKEN; ++k) {
            const Taken::Numbers& numbers = taken.numbers[k];
            int shift[3] = {0, 0, 0};
            if constexpr (CROSSING && STEPS > 0)
                shift_of(image_of(taken.id[k]), shift);
            auto column = [&](int c) -> number {  // of j, and behind them steps of the lattice
                if (c < OTHERS)
                    return numbers.at[PLACED + c];
                const int axis = STEP_AXES[c - OTHERS];
                return real(shift[axis] - Lattice::turn(numbers.at[PLACED + OTHERS], axis));
            };
            number summand[SUMMANDS];
            term.evaluate(own_part, FROM_PLACES ? numbers.place : numbers.at, column, summand);
            reduction.add(summand, taken.pairs[k], [&](int& source, int& code) {
                source = id_of(numbers.place[3]);
                code = CROSSING ? image_of(taken.id[k]) : code_at_home;
            });
        }
    }
};
