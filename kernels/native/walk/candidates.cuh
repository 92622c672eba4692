// Candidates of a group: fetched run by run, kept where they are near its box, until the queries meet 32 of them at a time.
#pragma once
#include "matrix.cuh"
#include "tree_runs.cuh"

// What this lane knows of the pairs of its query.
struct Pairs {
    int found;                  // neighbors
    unsigned int kept, tested;  // candidates since pairs were last settled, and how many of them have met the queries
    unsigned int met_in;        // blocks of those that have a neighbor of this query, a bit each
    bool meets_itself;          // the first candidates are the queries, of which none is a neighbor of itself
    bool fresh;                 // no pairs of this group have been settled
};

// Keeps a candidate, the one of a number, if it is near; `x` is where it is from the center.
JFRNN_FUNCTION void keep(const PairSearch& search, bool is_near, const Place& candidate, const real* x, unsigned int number) {
    Warp& warp = shared_warp();
    if constexpr (!MATRIX) {
        if (is_near) {
#pragma unroll
            for (int a = 0; a < DIM; ++a)
                warp.candidates[a][number % RING] = candidate.p[a];
            if constexpr (VARY) {
                real known[2];
                search.cutoffs_of(search.source_named(id_of(candidate.id)), known);
#pragma unroll
                for (int k = 0; k < OF_CUTOFFS; ++k)
                    warp.candidates[DIM + k][number % RING] = known[k];
            }
        }
    } else {
        const unsigned int column = shared_address(warp.candidates[0]) + 4 * (number % RING);
        float square = 0;
#pragma unroll
        for (int a = 0; a < 3; ++a) {
            const float along = a < DIM ? (float)x[a] : 0;
            square += along * along;
            store_if(is_near, column + (unsigned int)sizeof(warp.candidates[0]) * a, halves(along, 1));
        }
        store_if(is_near, column + (unsigned int)sizeof(warp.candidates[0]) * 3, halves(square, 1));
        if constexpr (RULE == TABLE)
            if (is_near)
                search.cutoffs_of(search.source_named(id_of(candidate.id)), &warp.candidates[4][number % RING]);
    }
    const unsigned int to = HELD ? shared_address(warp.ids) + 4 * number : shared_address(warp.candidate_ids) + 4 * (number % RING);
    store_if(is_near, to, (unsigned int)id_of(candidate.id));
}

struct Candidates {
    int total, fetched;      // candidates of runs, those that were fetched
    int run_end, run_shift;  // of what this lane fetches
    const Run* run;
    Place places[FETCHED];
    int runs_of[FETCHED];  // crossing: nothing may wait here for what is loaded, so that it is moved later

    JFRNN_MEMBER Candidates() : total(0), fetched(0), run_end(0), run_shift(0), run(shared_warp().runs) {}
    JFRNN_MEMBER bool are_fetched() const { return fetched >= total; }
    // Begins with the next runs, the candidates of which are `number`.
    JFRNN_MEMBER void begin(int number) {
        total = number;
        fetched = 0;
        run_end = 0;
        run = shared_warp().runs;
    }
    // Fetches the next ones, if they are not the queries themselves, which are kept already.
    JFRNN_MEMBER void fetch(const PairSearch& search, const Group& group) {
        const Warp& warp = shared_warp();
        const Grid& grid = shared_known().grid;
        const unsigned int queries = search.own ? group.size : 0;
#pragma unroll
        for (int k = 0; k < FETCHED; ++k) {
            const int number = fetched + 32 * k + search.lane;
            while (number >= run_end) {
                run_end = run->end;
                run_shift = run->shift;
                ++run;
            }
            int at = number + run_shift;
            if (!grid.dense && at >= grid.finite)  // the ring of cells closes
                at -= grid.finite;
            places[k].p[0] = search.INF;
            bool taken = number < total;
            if constexpr (PairSearch::INSIDE)
                taken = taken && (unsigned int)(at - group.place) >= queries;
            else {
                runs_of[k] = taken ? (int)(run - warp.runs) - 1 : 0;  // what is not taken is infinite: moved by what is finite, too
                taken = taken && (warp.run_images[runs_of[k]] != search.home || (unsigned int)(at - group.place) >= queries);
            }
            load_if(taken, search.sorted + at, places[k]);
            if constexpr (SUMS)
                places[k].id = bits_as_real(at);
        }
    }
    // Keeps those of the fetched ones that are near the box, and fetches the next.
    JFRNN_MEMBER void keep_near(const PairSearch& search, const Group& group, Pairs& pairs) {
        const Warp& warp = shared_warp();
        const Box box = *(const Box*)&warp.box;  // from there, since registers are few
        real x[FETCHED][3];
        bool near[FETCHED];
#pragma unroll
        for (int k = 0; k < FETCHED; ++k) {
            move(search, k);
            real square = 0;
#pragma unroll
            for (int a = 0; a < DIM; ++a) {
                x[k][a] = group.from_center(places[k].p[a], box.center[a]);
                const real gap = larger(magnitude(x[k][a]) - box.half[a], 0);
                square += gap * gap;
            }
            real near_square = box.center[3];
            if constexpr (TREE && !BY_OWN)
                near_square =
                    square < search.INF ? group.near_with(search, search.radii[search.source_named(id_of(places[k].id))]) : -1;
            near[k] = square <= near_square;
            if (BATCHED && (TREE || !shared_known().grid.dense) && near[k]) {
                const int source = search.source_named(id_of(places[k].id));
                near[k] = system_of(search.positions + (long long)ROW * source) == group.system;
            }
        }
#pragma unroll
        for (int k = 0; k < FETCHED; ++k) {
            const unsigned int all_near = __ballot_sync(ALL, near[k]);
            keep(search, near[k], places[k], x[k], pairs.kept + __popc(all_near & ((1u << search.lane) - 1)));
            pairs.kept += __popc(all_near);
        }
        fetched += 32 * FETCHED;
        if (fetched < total)
            fetch(search, group);
    }
    // Moves a fetched one to where its image is.
    JFRNN_MEMBER void move(const PairSearch& search, int k) {
        const Warp& warp = shared_warp();
        if constexpr (PairSearch::IDS) {
            const int image = PairSearch::INSIDE ? search.home : warp.run_images[runs_of[k]];
            places[k].id = bits_as_real(search.id_of_image(id_of(places[k].id), image));
        }
        if constexpr (!PairSearch::INSIDE)
#pragma unroll
            for (int a = 0; a < DIM; ++a)
                places[k].p[a] = Lattice::add(places[k].p[a], warp.run_moved[runs_of[k]][a]);
    }
};

// Keeps the candidates once more that are not tested, since rows have stood where they were.
JFRNN_FUNCTION void keep_untested(const PairSearch& search, const Group& group, Pairs& pairs) {
    const Warp& warp = shared_warp();
    pairs.kept = pairs.kept > pairs.tested ? pairs.kept - pairs.tested : 0;
    pairs.tested = 0;
    Place left[FETCHED];
#pragma unroll
    for (int k = 0; k < FETCHED; ++k) {
        const int id = warp.ids[32 * (BLOCKS + k) + search.lane];
        left[k].id = bits_as_real(id);
        if (32 * k + search.lane < pairs.kept)
            search.load_image(id, left[k].p);
    }
    __syncwarp();
#pragma unroll
    for (int k = 0; k < FETCHED; ++k) {
        real x[3];
#pragma unroll
        for (int a = 0; a < DIM; ++a)
            x[a] = group.from_center(left[k].p[a], warp.box.center[a]);
        const bool is_left = 32 * k + search.lane < pairs.kept;
        keep(search, is_left, left[k], x, 32 * k + search.lane);
    }
}

// What is put aside while something else needs the registers: a callee, who cannot use those that hold something across the call, or
// what is done with many pairs at once. Registers are few, so memory holds it.
struct Aside {
    volatile unsigned int words[4 * FETCHED + 8 + (RULE == TABLE ? 4 : 0)];
    JFRNN_MEMBER void put(const Candidates& candidates, const Matrix& matrix) {
        if constexpr (!DOUBLE) {
#pragma unroll
            for (int k = 0; k < FETCHED; ++k) {
#pragma unroll
                for (int a = 0; a < DIM; ++a)
                    words[4 * k + a] = __float_as_uint((float)candidates.places[k].p[a]);
                words[4 * k + 3] = __float_as_uint((float)candidates.places[k].id);
            }
#pragma unroll
            for (int k = 0; k < 4; ++k) {
                words[4 * FETCHED + k] = matrix.high[k];
                words[4 * FETCHED + 4 + k] = matrix.low[k];
                if constexpr (RULE == TABLE)
                    words[4 * FETCHED + 8 + k] = matrix.of_kinds[k];
            }
        }
    }
    JFRNN_MEMBER void take_back(Candidates& candidates, Matrix& matrix) const {
        if constexpr (!DOUBLE) {
#pragma unroll
            for (int k = 0; k < FETCHED; ++k) {
#pragma unroll
                for (int a = 0; a < DIM; ++a)
                    candidates.places[k].p[a] = __uint_as_float(words[4 * k + a]);
                candidates.places[k].id = __uint_as_float(words[4 * k + 3]);
            }
#pragma unroll
            for (int k = 0; k < 4; ++k) {
                matrix.high[k] = words[4 * FETCHED + k];
                matrix.low[k] = words[4 * FETCHED + 4 + k];
                if constexpr (RULE == TABLE)
                    matrix.of_kinds[k] = words[4 * FETCHED + 8 + k];
            }
        }
    }
};
