// Pairs in systems with boxes of their own on CUDA: LANES_PER_ROW lanes of a warp have a query.
//
// Each lane finds a run. Then all of them meet the sources of one run after the other or, where runs are short, since systems have few
// particles and many images, each lane those of its own. Queries of a warp walk together, as long as any of them has something left.
// Pairs in doubt are rare: if there are any, all queries of the warp walk once more and decide about these, so that the registers
// which that takes are not missed before. `Visitor`, the struct that derives from this one, has a member `take(hit, at, run)`, which
// all lanes call together: each with the place of a source, and whether it is a pair.
//
// Sources stand by system and by cell (box_space.h). `axes` are their coordinates, in their box and sorted, `stride` numbers of each
// axis, and `ids` their numbers. Rows of `positions` and `queries` are as they were given, with packed turns. Queries that are the
// sources are served in the order of `ids`, others as they come; `systems` are theirs.
// Where cutoffs differ (RULE, see pair_cutoffs.h), `radii` are those of the sources, sorted, `query_radii` those of the queries, as they
// come. A table has the cutoffs of `kinds` species with each other, row by row, -1 where they are no neighbors; `kinds_of_sources`,
// sorted, and `kinds_of_queries` are the species. The radius is then the largest of all cutoffs.
#pragma once
#include "box_space.h"
#include "excluded.h"
#include "pair_cutoffs.h"

struct BoxArguments {
    const real *positions, *queries, *boxes, *axes;
    const int *systems, *ids, *cells, *start, *excluded_starts, *excluded;
    const real *radii, *query_radii, *table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    int n, m, stride, own, closed, drop_self, kinds;
};

// The sources of a row of cells, in one image.
struct BoxRun {
    int from, size, code;
    int shift[3];   // of the image
    real moved[3];  // by which sources are moved into it
};

struct BoxPairs : BoxArguments, BoxSpace {
    Band<real> of_all;  // pairs, unless cutoffs DIFFER
    int low[3], visited[3];
    int runs;              // of the query
    int query;             // its number
    int place;             // where it stands among the sources, or -1
    int at_home, codes;    // the code of no shift, and how many there are
    real q[3];             // where it is, in its box
    real own_radius;       // its cutoff, where a rule asks for it
    const real* of_kinds;  // of a table, the row of its species
    real slack;            // by which distances of images may be wrong, in the unit of step 1

    JFRNN_MEMBER explicit BoxPairs(const BoxArguments& given)
        : BoxArguments(given), BoxSpace(given.boxes), at_home(0), codes(1), own_radius(0), of_kinds(nullptr), slack(0) {
        for (int k = 0; k < DIM; ++k) {
            at_home = at_home * (2 * lattice.images(k) + 1) + lattice.images(k);
            codes *= 2 * lattice.images(k) + 1;
        }
    }
    // Goes to the query that is served as number `turn`: it visits the cells within reach of it, numbered on beyond the ends of its box,
    // where the next image begins.
    JFRNN_MEMBER void go_to(int turn) {
        query = own ? ids[turn] : turn;
        place = own ? turn : -1;
        if (systems[query] != system)
            enter(systems[query]);
        point_of(queries + (long long)ROW * query, q);
        if constexpr (RULE == TABLE)
            of_kinds = table_of_kinds + (long long)kinds * kinds_of_queries[query];
        else if constexpr (RULE != ONE_CUTOFF && RULE != SCATTER)
            own_radius = query_radii[query];
        for (int k = 0; k < 3; ++k) {
            low[k] = 0;
            visited[k] = 1;
            if (k < DIM)
                visit(k);
        }
        runs = finite_point(q) ? count_runs() : 0;
    }
    JFRNN_MEMBER int count_runs() const {
        const int pieces = floor_of(low[0] + visited[0] - 1, counts[0]) - floor_of(low[0], counts[0]) + 1;
        return visited[0] > 0 ? pieces * visited[1] * visited[2] : 0;
    }
    JFRNN_MEMBER void visit(int k) {
        constexpr int LARGEST_TURN = 511;  // as in jfrnn/_geometry/images.py
        const real reach = lattice.reach(k);
        int high = cell_along(k, q, reach);
        low[k] = cell_along(k, q, -reach);
        if (is_turning(k)) {
            const int whole_reach = reach < LARGEST_TURN ? (int)reach + (reach > (int)reach) : LARGEST_TURN;
            const int most = whole_reach < lattice.images(k) ? whole_reach : lattice.images(k);
            low[k] = low[k] < -most * counts[k] ? -most * counts[k] : low[k];
            high = high < (most + 1) * counts[k] ? high : (most + 1) * counts[k] - 1;
        }
        visited[k] = high < low[k] ? 0 : high - low[k] + 1;
        if (!is_turning(k))
            visited[k] = visited[k] < counts[k] ? visited[k] : counts[k];
    }
    JFRNN_MEMBER void enter(int other) {
        const int* const mine = cells + 5ll * other;
        BoxSpace::enter(boxes, other, mine[4]);
        for (int k = 0; k < 3; ++k)
            counts[k] = k < DIM ? mine[k] : 1;
        first = mine[3];
        slack = 2 * lattice.slack() * step_scale;
        of_all = Bands::of_one(step_radius, slack, Bands::IMAGES);
    }
    JFRNN_MEMBER int fill_value() const { return PERIODIC == 2 ? n * codes : n; }
    JFRNN_MEMBER int name_of(int source, int code) const { return PERIODIC == 2 ? source + n * code : source; }

    JFRNN_MEMBER BoxRun run_at(int number) const {
        int shift[3] = {0, 0, 0}, row = 0, at[3] = {0, 0, 0};
        for (int k = 1; k < DIM; ++k) {
            const int cell = low[k] + number % visited[k];
            number /= visited[k];
            shift[k] = floor_of(cell, counts[k]);
            at[k] = cell - shift[k] * counts[k];
        }
        shift[0] = floor_of(low[0], counts[0]) + number;
        const int begins = low[0] - shift[0] * counts[0], ends = begins + visited[0];
        for (int k = DIM - 1; k > 0; --k)
            row = (row + at[k]) * counts[k - 1];
        row += first;
        BoxRun run;
        run.from = start[row + (begins > 0 ? begins : 0)];
        run.size = start[row + (ends < counts[0] ? ends : counts[0])] - run.from;
        run.code = 0;
        for (int k = 0; k < DIM; ++k) {
            run.shift[k] = shift[k] = is_turning(k) ? shift[k] : 0;
            run.code = run.code * (2 * lattice.images(k) + 1) + shift[k] + lattice.images(k);
        }
        for (int k = 0; k < 3; ++k)
            run.moved[k] = k < DIM ? lattice.translation(shift[0], shift[1], shift[2], k) : real(0);
        return run;
    }
    // The smallest source that a query asks for in an image: of its own images, half lists have those ahead.
    JFRNN_MEMBER int first_asked(int code) const {
        return !LATER ? 0 : code == at_home ? query + drop_self : code < at_home ? query + 1 : query;
    }
    JFRNN_MEMBER bool is_excluded(int source, int code) const {
        return Excluded(excluded_starts, excluded, query, ~0ull).has(Excluded::id_of(source, code, n));
    }
    // The cutoff of the query and the source at a place, in a search where cutoffs differ; a mean is rounded.
    JFRNN_MEMBER real cutoff_at(int at) const {
        if constexpr (RULE == TABLE)
            return of_kinds[kinds_of_sources[at]];
        return PairCutoffs::of_pair(own_radius, RULE == GATHER ? real(0) : radii[at]);
    }
    // Decides exactly about the source at a place.
    JFRNN_MEMBER bool is_pair(int at, int code) const {
        const real* const source = positions + (long long)ROW * ids[at];
        const real first = RULE == ONE_CUTOFF ? radius : SUM ? own_radius / 2 : cutoff_at(at), more = SUM ? radii[at] / 2 : real(0);
        return exact_image(lattice, queries + (long long)ROW * query, source, code, first, more, closed);
    }
};

template <class Visitor>
struct BoxLanes : BoxPairs {
    static constexpr unsigned int EVERY = 0xffffffffu, OF_QUERY = EVERY >> (32 - LANES_PER_ROW);
    const int lane, first_lane;  // among those of its query, and the first of them in the warp
    const bool is_query;
    bool in_doubt;  // about a source that this lane has met

    JFRNN_MEMBER explicit BoxLanes(const BoxArguments& given)
        : BoxPairs(given),
          lane(threadIdx.x % LANES_PER_ROW),
          first_lane((threadIdx.x & 31) - lane),
          is_query(thread_index() / LANES_PER_ROW < given.m),
          in_doubt(false) {}

    JFRNN_MEMBER void walk() {
        ((Visitor*)this)->go_to(is_query ? (int)(thread_index() / LANES_PER_ROW) : 0);
        runs = is_query ? runs : 0;
        walk_runs<false>();
        if (__any_sync(EVERY, in_doubt))
            walk_runs<true>();
    }
    template <bool DECIDES>
    JFRNN_MEMBER void walk_runs() {
        for (int r = 0; __any_sync(EVERY, r < runs); r += LANES_PER_ROW) {
            BoxRun mine{0, 0, 0, {0, 0, 0}, {0, 0, 0}};
            if (r + lane < runs)
                mine = run_at(r + lane);
            const int longest = __reduce_max_sync(EVERY, mine.size);
            if (longest < __reduce_max_sync(EVERY, sum_of((mine.size + LANES_PER_ROW - 1) / LANES_PER_ROW)))
                meet<DECIDES>(mine, 0, 1, longest);
            else
                meet_in_turn<DECIDES>(mine);
        }
    }
    // The sum over the lanes of a query.
    JFRNN_FUNCTION int sum_of(int number) {
        for (int step = LANES_PER_ROW / 2; step > 0; step /= 2)
            number += __shfl_xor_sync(EVERY, number, step);
        return number;
    }
    JFRNN_MEMBER unsigned int of_query(unsigned int bits) const { return bits >> first_lane & OF_QUERY; }
    // Lets all lanes meet the run of one lane after the other.
    template <bool DECIDES>
    JFRNN_MEMBER void meet_in_turn(const BoxRun& mine) {
        unsigned int left = of_query(__ballot_sync(EVERY, mine.size > 0));
        for (; __any_sync(EVERY, left); left &= left - 1) {
            const int other = first_lane + (left ? __ffs(left) - 1 : 0);
            BoxRun run;
            run.from = __shfl_sync(EVERY, mine.from, other);
            run.size = __shfl_sync(EVERY, mine.size, other);
            run.code = __shfl_sync(EVERY, mine.code, other);
            for (int k = 0; k < 3; ++k) {
                run.moved[k] = k < DIM ? __shfl_sync(EVERY, mine.moved[k], other) : real(0);
                run.shift[k] = SUMS > 0 && k < DIM ? __shfl_sync(EVERY, mine.shift[k], other) : 0;
            }
            run.size = left ? run.size : 0;
            meet<DECIDES>(run, lane, LANES_PER_ROW, LANES_PER_ROW == 32 ? run.size : __reduce_max_sync(EVERY, run.size));
        }
    }
    // Lets each lane meet the sources of a run from number `first` on, every one of `step`; for the longest run of all lanes these are
    // below `longest`.
    template <bool DECIDES>
    JFRNN_MEMBER void meet(const BoxRun& run, int first, int step, int longest) {
        const int itself =
            run.code == at_home ? place - run.from : -1;  // it is its own neighbor whatever its cutoff, or not at all
        const real away[3] = {run.moved[0] - q[0], run.moved[1] - q[1], run.moved[2] - q[2]};
        const real* source = axes + run.from + first;
        constexpr int TOGETHER = DECIDES ? 1 : 4;  // steps whose sources are loaded at once
#pragma unroll TOGETHER
        for (int b = 0; b < longest; b += step) {
            const int number = first + b;
            const bool asked = number < run.size & (number != itself | !drop_self);
            const real* const source = axes + run.from + (number < run.size ? number : 0);
            real square = 0;
#pragma unroll
            for (int k = 0; k < DIM; ++k) {
                real d = source[(long long)k * stride] + away[k];
                if constexpr (SCALED)
                    d *= step_scale;
                square += d * d;
            }
            Band<real> bounds = of_all;
            if constexpr (RULE != ONE_CUTOFF)
                bounds = PairCutoffs::bounds_of(cutoff_at(run.from + (number < run.size ? number : 0)) * step_scale, slack);
            const bool sure = asked & (square < bounds.inside | (RULE != ONE_CUTOFF & number == itself));
            const bool open = asked & square <= bounds.outside & !sure;
            bool hit = DECIDES ? open : sure;
            if constexpr (DECIDES)
                hit = hit && is_pair(run.from + number, run.code);
            else
                in_doubt |= open;
            if constexpr (LATER)
                hit = hit && ids[run.from + number] >= first_asked(run.code);
            if constexpr (EXCLUDING)
                hit = hit && !is_excluded(ids[run.from + number], run.code);
            ((Visitor*)this)->take(hit, run.from + number, run);
        }
    }
};
