// Lists that are kept, on the CPU: LANES slots of a row at a time, whose pairs are told, or what a term makes of them.
#pragma once
#include "chunks.h"
#include "kept.h"
#include "wide.h"

// LANES slots that are taken together: their sources, the numbers of these, and which of them are pairs.
struct KeptSlots {
    const int* ids;
    int places;  // their places in the row, from `places` on
    Number numbers[LENGTH];
    Kept::Verdict verdict;
    unsigned int pairs;
    bool home;  // all of them: no nearest image is another one than the source itself
};

template <class Visitor>
struct KeptRows : Kept {
    static constexpr bool FLUSHED = !SCALED && !DIFFER;  // else what decides may be so small as to be flushed to zero
    static constexpr bool PLAIN = !SHIFTED && !DIFFER;   // one cutoff in open space
    const Wide wide;
    int* const next;  // chunk of rows, which threads hand themselves

    KeptRows(const KeptArguments& given, int* next) : Kept(given), wide(radius, given.closed), next(next) {}
    Visitor& visitor() { return *(Visitor*)this; }

    // Reads LENGTH numbers of each source: four at a time, and then exchanges rows and columns in registers.
    JFRNN_INLINE void read_points(const int* ids, Number* numbers) const {
#if defined(__x86_64__)
        if constexpr (!DOUBLE && LENGTH % 4 == 0) {
            typedef float four __attribute__((vector_size(16)));
            for (int c = 0; c < LENGTH; c += 4) {
                auto row = [&](int l) {
                    four x;
                    __builtin_memcpy(&x, points + (long long)LENGTH * ids[l] + c, 16);
                    return x;
                };
                auto two = [&](int l) { return __builtin_shufflevector(row(l), row(l + 4), 0, 1, 2, 3, 4, 5, 6, 7); };
                auto all = [&](int l) {
                    if constexpr (LANES == 16)
                        return __builtin_shufflevector(two(l), two(l + 8), 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
                    else
                        return two(l);
                };
                exchange(all(0), all(1), all(2), all(3), numbers + c, __make_integer_seq<Lanes, int, LANES>{});
            }
            return;
        }
#endif
        for (int c = 0; c < LENGTH; ++c)
            for (int l = 0; l < LANES; ++l)
                numbers[c][l] = points[(long long)LENGTH * ids[l] + c];
    }
    template <class Integer, Integer... L>
    struct Lanes {};
    // Exchanges rows and columns of four numbers by four, in all four lanes that follow each other at once.
    template <class Vector, int... L>
    JFRNN_INLINE static void exchange(Vector a, Vector b, Vector d, Vector e, Number* to, Lanes<int, L...>) {
        const Vector al = __builtin_shufflevector(a, b, (L / 4 * 4 + L % 4 / 2 + L % 2 * LANES)...);
        const Vector ah = __builtin_shufflevector(a, b, (L / 4 * 4 + L % 4 / 2 + L % 2 * LANES + 2)...);
        const Vector dl = __builtin_shufflevector(d, e, (L / 4 * 4 + L % 4 / 2 + L % 2 * LANES)...);
        const Vector dh = __builtin_shufflevector(d, e, (L / 4 * 4 + L % 4 / 2 + L % 2 * LANES + 2)...);
        to[0] = __builtin_shufflevector(al, dl, (L / 4 * 4 + L % 2 + L % 4 / 2 * LANES)...);
        to[1] = __builtin_shufflevector(al, dl, (L / 4 * 4 + L % 2 + L % 4 / 2 * LANES + 2)...);
        to[2] = __builtin_shufflevector(ah, dh, (L / 4 * 4 + L % 2 + L % 4 / 2 * LANES)...);
        to[3] = __builtin_shufflevector(ah, dh, (L / 4 * 4 + L % 2 + L % 4 / 2 * LANES + 2)...);
    }

    // Calls `visit` with all entries of a row, LANES at a time; those in doubt are decided.
    template <class Visit>
    JFRNN_INLINE void walk(int row, const OwnPoint& own, Visit visit) const {
        const long long first = first_entry(row);
        const int all = entries(row);
        KeptSlots some;
        int last[LANES];  // ids, where they do not stand side by side
        for (int b = 0; b < all; b += LANES) {
            some.places = b;
            Number step[3] = {Number{}, Number{}, Number{}};
            some.ids = idx + first + b;
            if (REVERSED || CODED || (capacity % LANES && b + LANES > all)) {
                some.ids = last;
                for (int l = 0; l < LANES; ++l) {
                    int code = 0;
                    last[l] = n;
                    if (b + l < all)
                        read_entry(first + b + l, last[l], code);
                    for (int k = 0; CODED && k < DIM; ++k)
                        step[k][l] = steps[DIM * code + k];
                }
            }
            read_points(some.ids, some.numbers);
            const Math::flag other = __builtin_convertvector(lanes_from(some.ids) != row, Math::flag);
            some.home = NEAREST && bits_of_flags(may_turn(own, some.numbers)) == 0;
            if (some.home)
                some.verdict = judge<true>(own, some.numbers, step, other);
            else
                some.verdict = judge<false>(own, some.numbers, step, other);
            some.pairs = bits_of_flags(some.verdict.sure);
            if (unsigned int open = bits_of_flags(some.verdict.open)) {
                const KeptSlots doubted = some;  // a copy, so that `some` needs no memory
                if constexpr (PLAIN && !SCALED)
                    some.pairs |= wide.sure(own.q, (const vec*)doubted.numbers, open);
                if (open)
                    some.pairs |= decide(own, doubted, open);
            }
            visit(some);
        }
    }
    JFRNN_APART unsigned int decide(const OwnPoint& own, const KeptSlots& some, unsigned int open) const {
        if constexpr (FLUSHED)
            floats.keep();
        unsigned int pairs = !PLAIN ? 0 : wide.decided(own.q, (const vec*)some.numbers, open);
        for (; open; open &= open - 1) {
            const int l = __builtin_ctz(open);
            real p[3] = {0, 0, 0};
            int shift[3] = {0, 0, 0};
            for (int k = 0; k < DIM; ++k) {
                p[k] = some.numbers[k][l];
                shift[k] = SHIFTED ? (int)some.verdict.shift[k][l] : 0;
            }
            const real theirs = DIFFER ? some.numbers[DIFFER ? RADIUS : 0][l] : real(0);
            pairs |= is_exact_pair(own, p, theirs, shift) ? 1u << l : 0;
        }
        if constexpr (FLUSHED)
            floats.flush();
        return pairs;
    }
    void run() {
        if constexpr (FLUSHED)
            floats.flush();
        each_chunk(*next, m, QUERY_CHUNK, [&](int from, int to, int chunk) {
            for (int row = from; row < to; ++row) {
                enter(row);
                visitor().serve(row, own_point(row));
            }
            visitor().finish_chunk(chunk);
        });
    }
};
