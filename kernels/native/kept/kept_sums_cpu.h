// Sums over the pairs of a list that is kept, on the CPU.
#pragma once
#include "kept_cpu.h"
#include "reduction_cpu.h"

struct KeptSums : KeptRows<KeptSums> {
    const real* const own_values;
    const Term term;
    Results results;

    explicit KeptSums(const KeptSumsArguments& a)
        : KeptRows(a, a.info), own_values(a.own_values), term(a.shared_values), results(a.sums, a.totals, a.errors, a.n) {}

    // An extreme has its place in the row where those of a search have the code of an image.
    void serve(int row, const OwnPoint& own) {
        const Term::Own own_part = term.own(own_numbers(own_values, row), own.q);
        const Term term = this->term;  // a variable, which stays in registers
        Reduction reduction(n);
        auto names = [&](int first, int lane, int& source, int& place) {
            int code;
            place = first + lane;
            read_entry(first_entry(row) + place, source, code);
        };
        walk(row, own, [&](const KeptSlots& some) {
            if (some.pairs == 0)
                return;
            number summand[SUMMANDS];
            auto column = [&](int c) -> number {
                return c < OTHERS ? some.numbers[DIM + c] : some.verdict.shift[STEP_AXES[c < OTHERS ? 0 : c - OTHERS]];
            };
            if (some.home)
                term.evaluate<true>(own_part, some.numbers, column, summand);
            else
                term.evaluate<false>(own_part, some.numbers, column, summand);
            reduction.add(summand, flags_of(some.pairs), some.places, names);
        });
        reduction.store(results, row, true, true, names);
    }
    void finish_chunk(int chunk) { results.store_totals(chunk); }
};
