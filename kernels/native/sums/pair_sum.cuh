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
template <bool TURNED>
struct Taken {
    static constexpr int MOST = TURNED && TAKEN > 2 ? 2 : TAKEN;
    bool pairs[MOST];
    int id[MOST];
    struct Numbers {
        real at[ROW_LENGTH];  // what the term reads of j, coordinates first
        real place[4];        // coordinates of j, and its id, as a `Place` has them
        real given[4];        // coordinates of j as they were given, and its turns
    } numbers[MOST];
};

// The query that a lane serves, if there is one: its number in the group, and its id.
struct LaneQuery {
    int query, id;
    bool is_query;
};

struct Sums : Walk<Sums> {
    static constexpr bool BY_BLOCK = TOTALS > 0;
    static constexpr bool NAMED = SUMS == 2;  // the sources of summands are asked for
    const real *shared_values, *own_values, *values;
    const Results results;
    const int code_at_home;  // of the image in the box
    const bool turned;       // must turns be looked at, and coordinates as they were given?

    JFRNN_MEMBER explicit Sums(const SumsArguments& a)
        : Walk(a.of_search()),
          shared_values(a.shared_values),
          own_values(a.own_values),
          values(a.values + places_given(a.n)),
          results(a.sums, a.errors, a.n, a.totals, a.more),
          code_at_home(NAMED ? (count_codes() - 1) / 2 : 0),
          turned(are_turned(lattice)) {}

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
        Reduction reduction(n);
        // A lane of several takes every so many-th block of candidates.
        constexpr unsigned int EVERY = QUERY_LANES == 4 ? 0x11111111 : QUERY_LANES == 2 ? 0x55555555 : ALL;
        const int query = lane / QUERY_LANES;
        auto of_query = [&](auto x) { return QUERY_LANES > 1 ? __shfl_sync(ALL, x, query) : x; };
        const LaneQuery mine{query, of_query(group.my_id), query < group.size};
        Pairs of_lane = pairs;
        of_lane.met_in = of_query(pairs.met_in) & EVERY << lane % QUERY_LANES;
        if (READS_ROWS > 0 && turned)
            reduce_held<false, READS_ROWS != 0>(group, mine, of_lane, reduction);
        else
            reduce_held<PERIODIC != 0 && INSIDE, false>(group, mine, of_lane, reduction);
        if constexpr (QUERY_LANES > 1)
            reduction.reduce_over_warp<QUERY_LANES>();
        reduction.store(results, {lane, mine.id, served, mine.is_query && lane % QUERY_LANES == 0, pairs.fresh, finished});
    }
    // AT_HOME: no pair has a shift. TURNED: coordinates are those that were given, and shifts are counted between these.
    template <bool AT_HOME, bool TURNED>
    JFRNN_MEMBER void reduce_held(const Group& group, const LaneQuery& mine, const Pairs& pairs, Reduction& reduction) {
        const Term term(shared_values);
        const Place here = mine.is_query ? load_query(group.place + mine.query) : Place{{0, 0, 0}, 0};
        const Term::Own own_part =
            term.own<AT_HOME>(own_values + (long long)mine.id * OWN, here.p, TURNED ? queries + (long long)mine.id * ROW : nullptr);
        HeldPairs held(pairs, mine.query);
        held.advance();
        held.advance();
        Taken<TURNED> some, others;
        take(held, some);
        while (__any_sync(ALL, some.pairs[0])) {
            take(held, others);
            evaluate<AT_HOME>(term, own_part, some, reduction);
            if (!__any_sync(ALL, others.pairs[0]))
                break;
            take(held, some);
            evaluate<AT_HOME>(term, own_part, others, reduction);
        }
    }
    // Takes the next pairs of a block, and loads what is read of them.
    template <bool TURNED>
    JFRNN_MEMBER void take(HeldPairs& held, Taken<TURNED>& taken) {
        constexpr int MOST = Taken<TURNED>::MOST;
        unsigned int at[MOST];
#pragma unroll
        for (int k = 0; k < MOST; ++k) {
            taken.pairs[k] = held.hits != 0;
            at[k] = held.take();
        }
#pragma unroll
        for (int k = 0; k < MOST; ++k)
            taken.id[k] = load_id_now(at[k]);
        if constexpr (NAMED || FROM_PLACES)
#pragma unroll
            for (int k = 0; k < MOST; ++k)
                load_numbers<4>(sorted + source_of(taken.id[k]), taken.numbers[k].place);
        if constexpr (COLUMNS > 0)
#pragma unroll
            for (int k = 0; k < MOST; ++k)
                load_numbers<ROW_LENGTH>(values + (long long)ROW_LENGTH * source_of(taken.id[k]), taken.numbers[k].at);
        if constexpr (TURNED)
#pragma unroll
            for (int k = 0; k < MOST; ++k)
                load_numbers<4>(values - places_given(n) + 4ll * source_of(taken.id[k]), taken.numbers[k].given);
        held.advance();
    }
    template <bool AT_HOME, bool TURNED>
    JFRNN_MEMBER void evaluate(const Term& term, const Term::Own& own_part, const Taken<TURNED>& taken, Reduction& reduction) {
#pragma unroll
        for (int k = 0; k < Taken<TURNED>::MOST; ++k) {
            const typename Taken<TURNED>::Numbers& numbers = taken.numbers[k];
            const real* const place = FROM_PLACES ? numbers.place : numbers.at;
            int shift[3] = {0, 0, 0};
            if constexpr (CROSSING && STEPS > 0)
                shift_of(image_of(taken.id[k]), shift);
            auto column = [&](int c) -> number {  // of j, and behind them steps of the lattice
                if (c < OTHERS && COLUMN_AXES[c] < 0)
                    return numbers.at[PLACED + COLUMN_NUMBERS[c]];
                if (c < OTHERS)
                    return TURNED ? numbers.given[COLUMN_AXES[c]] : place[COLUMN_AXES[c]];
                const int axis = STEP_AXES[c - OTHERS];
                return real(TURNED ? shift[axis] - Lattice::turn(numbers.given[3], axis) : shift[axis]);
            };
            number summand[SUMMANDS];
            term.evaluate<AT_HOME>(own_part, place, column, summand);
            reduction.add(summand, taken.pairs[k], [&](int& source, int& code) {
                source = id_of(numbers.place[3]);
                code = CROSSING ? image_of(taken.id[k]) : code_at_home;
            });
        }
    }
};
