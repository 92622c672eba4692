// Sums over pairs on the CPU where cutoffs differ from particle to particle.
//
// What the term reads of the pairs is put down until there are CANDIDATES of them, or the query has no more; then the term is
// evaluated for LANES of them at a time.
#pragma once
#include "level_sums.h"
#include "reduction_cpu.h"

// Pairs that are held until the term is evaluated for them. They are no part of `LevelSums`, whose members stay in registers, since
// nothing that is called has their address.
struct HeldPairs {
    alignas(128) real points[3][CANDIDATES];
    alignas(128) real column[OTHERS + STEPS + 1][CANDIDATES];
    int ids[SUMS == 2 ? CANDIDATES : 1], images[SUMS == 2 ? CANDIDATES : 1];
    const real* own_values;
    const int n, home;
    const FloatControl& floats;
    const Term term;
    Results results;

    HeldPairs(const LevelSumArguments& a, int home, const FloatControl& floats)
        : own_values(a.own_values),
          n(a.n),
          home(home),
          floats(floats),
          term(a.shared_values),
          results(a.sums, a.totals, a.errors, a.n) {
        memset(points, 0, sizeof points);
        memset(column, 0, sizeof column);
        memset(ids, 0, sizeof ids);
        memset(images, 0, sizeof images);
    }
    // Evaluates the term for `hits` pairs of a query at q.
    __attribute__((noinline)) void add(int id, real x, real y, real z, int hits, bool fresh, bool finished) {
        const real q[3] = {x, y, z};
        floats.flush();
        const Term::Own own_part = term.own(own_values + (long long)id * OWN, q);
        Reduction reduction(n);
        for (int b = 0; b < hits; b += LANES) {
            number there[3], summand[SUMMANDS];
            for (int k = 0; k < DIM; ++k)
                there[k] = *(const number*)(points[k] + b);
            term.evaluate(own_part, there, [&](int c) { return *(const number*)(column[c] + b); }, summand);
            const unsigned int pairs = hits - b < LANES ? (1u << (hits - b)) - 1 : (1u << LANES) - 1;
            reduction.add(summand, flags_of(pairs), [&](Math::i32& source, Math::i32& code) {
                for (int l = 0; l < LANES; ++l) {
                    source[l] = ids[b + l];
                    code[l] = PERIODIC ? images[b + l] : home;
                }
            });
        }
        reduction.store(results, id, fresh, finished);
        floats.keep();
    }
};

struct LevelSums : Levels<LevelSums> {
    HeldPairs& held;
    const real* columns;
    struct State {
        int hits;
        bool fresh;
    };

    JFRNN_INLINE LevelSums(const LevelSumArguments& a, HeldPairs& held)
        : Levels(a.of_search(), a), held(held), columns(a.columns) {}

    JFRNN_INLINE State begin_query(const One&) { return State{0, true}; }
    JFRNN_INLINE void pair(State& state, const One& one, int other, int c, int image) {
        const int hits = state.hits++;
        for (int k = 0; !PERIODIC && k < DIM; ++k)
            held.points[k][hits] = axes[k * stride + c];
        for (int s = 0; s < OTHERS; ++s)
            memcpy(&held.column[s][hits], columns + (long long)s * n + c, sizeof(real));
        for (int s = 0; s < STEPS; ++s) {
            const int turn = Lattice::turn(columns[(long long)OTHERS * n + c], STEP_AXES[s]);
            held.column[OTHERS + s][hits] = real(one.shift[STEP_AXES[s]] - turn);
        }
        if constexpr (SUMS == 2) {
            held.ids[hits] = other;
            held.images[hits] = image;
        }
        if (__builtin_expect(state.hits == CANDIDATES, 0)) {
            add(state, one, false);
            state = State{0, false};
        }
    }
    JFRNN_INLINE void add(const State& state, const One& one, bool finished) {
        held.add(one.id, one.q[0], one.q[1], one.q[2], state.hits, state.fresh, finished);
    }
    JFRNN_INLINE void end_query(const State& state, const One& one) { add(state, one, true); }
    JFRNN_INLINE void chunk_done(int chunk) { held.results.store_totals(chunk); }
};

struct LevelSumsKernel {
    const LevelSumArguments given;
    void run() {
        const FloatControl floats;
        int codes = 1;  // of images
        if constexpr (PERIODIC) {
            const Lattice lattice(given.cutoff);
            for (int k = 0; k < DIM; ++k)
                codes *= 2 * lattice.images(k) + 1;
        }
        HeldPairs held(given, (codes - 1) / 2, floats);
        LevelSums(given, held).run();
    }
};
