// Sums over pairs in systems with boxes of their own on the CPU: a term is evaluated for LANES sources of a run at a time.
#pragma once
#include "box_pairs_cpu.h"
#include "box_sums.h"
#include "chunks.h"
#include "reduction_cpu.h"

struct BoxSums : BoxLanes {
    static constexpr bool FLUSHED = !SCALED;  // denormals, as XLA does; but where cutoffs are scaled, what decides may be so small
    const real *own_values, *columns;
    const Term term;
    Results results;
    int* const next;  // chunk of queries, which threads hand themselves

    explicit BoxSums(const BoxSumArguments& a)
        : BoxLanes(a.of_search()),
          own_values(a.own_values),
          columns(a.columns),
          term(a.shared_values),
          results(a.sums, a.totals, a.errors, a.n, a.more),
          next(a.info) {}

    void run() {
        each_chunk(*next, m, QUERY_CHUNK, [&](int from, int to, int chunk) {
            for (int turn = from; turn < to; ++turn) {
                go_to(turn);
                serve();
            }
            results.store_totals(chunk);
        });
    }
    void serve() {
        const Term::Own own_part = term.own(own_values + (long long)query * OWN, q);
        const Term term = this->term;  // a variable, which stays in registers
        Reduction reduction(n);
        if constexpr (FLUSHED)
            floats.flush();
        for (int r = 0; r < runs; ++r) {
            const BoxRun run = run_at(r);
            for (int b = 0; b < run.size; b += LANES) {
                Tested some = test(run, b);
                if (some.open || (EXCLUDING && some.pairs)) {
                    if constexpr (FLUSHED)
                        floats.keep();
                    decide(run, b, some);
                    if constexpr (FLUSHED)
                        floats.flush();
                }
                if (some.pairs)
                    add(run, run.from + b, some.pairs, term, own_part, reduction);
            }
        }
        reduction.store(results, query, true, true);
        if constexpr (FLUSHED)
            floats.keep();
    }
    void add(
        const BoxRun& run, int at, unsigned int pairs, const Term& term, const Term::Own& own_part, Reduction& reduction) const {
        number points[3] = {number{}, number{}, number{}}, summand[SUMMANDS];
        for (int k = 0; k < DIM; ++k)
            points[k] = lanes_from(axes + (long long)k * stride + at);
        auto column = [&](int c) -> number {  // of j, and behind them steps of the lattice
            const vec numbers = lanes_from(columns + (long long)c * stride + at);
            return c < OTHERS ? numbers : real(run.shift[STEP_AXES[c < OTHERS ? 0 : c - OTHERS]]) - numbers;
        };
        term.evaluate(own_part, points, column, summand);
        reduction.add(summand, flags_of(pairs), [&](Math::i32& source, Math::i32& code) {
            source = lanes_from(ids + at);
            code = Math::i32{} + run.code;
        });
    }
};
