// Pairs in systems of which each has a box of its own: what a query visits, on the CPU and on CUDA.
//
// Sources stand by system and by cell (box_space.h). `axes` are their coordinates, in their box and sorted, `stride` numbers of each
// axis, and `ids` their numbers. Rows of `positions` and `queries` are as they were given, with packed turns. Queries that are the
// sources are served in the order of `ids`, others as they come; `systems` are theirs.
// Where cutoffs differ (RULE, see pair_cutoffs.h), `radii` are those of the sources, sorted, `query_radii` those of the queries, as they
// come. Of a table the cutoffs of `kinds` species with each other follow row by row, -1 where they are no neighbors; whose species is
// which say `kinds_of_sources`, sorted, and `kinds_of_queries`. The radius is then the largest of all, which nobody's cutoff exceeds.
#pragma once
#include "box_space.h"
#include "excluded.h"
#include "pair_cutoffs.h"

struct BoxArguments {
    const real *positions, *queries, *boxes, *axes;
    const int *systems, *ids, *cells, *start, *excluded_starts, *excluded;
    const real *radii, *query_radii, *table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries, *starts;
    int *idx, *receivers, *count, *info;
    int n, m, stride, own, capacity, closed, drop_self, kinds;
};

// The sources of a row of cells, in one image.
struct BoxRun {
    int from, size, code;
    int shift[3];   // of the image
    real moved[3];  // by which sources are moved into it
};

struct BoxPairs : BoxArguments, BoxSpace {
    real inside, outside;  // squares of distances below are surely those of pairs, squares beyond surely not
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
        const real inner = step_radius > slack ? step_radius - slack : real(0), outer = step_radius + slack;
        const real band = 8 * (1 + PERIODIC) * step_eps;
        inside = inner * inner * (1 - band);
        outside = outer * outer * (1 + band);
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
