// Candidates of the queries of a cell, copied side by side into the first-level cache, and which of them are pairs of a query.
#pragma once
#include "excluded.h"
#include "pair_cutoffs.h"
#include "places_cpu.h"
#include "wide.h"

struct SearchArguments {
    const real *positions, *queries, *cutoff;
    const int *excluded_starts, *excluded;
    const real *query_radii, *table_of_kinds;
    const int* kinds_of_queries;
    int *scratch, *grids;
    int n, m, own, table, closed, drop_self, kinds;
};
struct Points {
    vec p[3];
};

struct Scan : SearchArguments, SystemCells, SourcePlaces {
    const Wide wide;
    real inside, outside;             // the band of the pairs of a query, unless these VARY
    real slack;                       // by which scaled distances of images may be wrong
    int image;                        // that candidates are copied from, its code
    bool scaled_at_once;              // distances from the query, coordinate by coordinate
    bool several;                     // images among them: each says which one it is of
    int self, self_from, self_lanes;  // the number of the candidate that the query itself is (-1: none), of its vector, its bit
    real own_radius;                  // of the query
    const real* of_kinds;             // the cutoffs of its species
    alignas(64) real candidate[3][CANDIDATES + LANES];
    alignas(64) int candidate_ids[CANDIDATES + LANES];
    alignas(64) int row[CANDIDATES + LANES];                              // ids of pairs
    alignas(64) unsigned short unsure[CANDIDATES / LANES + LANES];        // one bit per candidate that step 1 leaves open
    alignas(64) int doubtful[CANDIDATES + LANES];                         // their numbers
    alignas(64) int vectors_in_doubt[CANDIDATES / LANES + LANES];         // numbers of the vectors that have any
    alignas(64) int candidate_images[PERIODIC ? CANDIDATES + LANES : 1];  // their codes
    alignas(64) real candidate_radius[VARY && RULE != TABLE ? CANDIDATES + LANES : 1];
    alignas(64) real candidate_inside[BANDED ? CANDIDATES + LANES : 1], candidate_outside[BANDED ? CANDIDATES + LANES : 1];
    alignas(64) int candidate_kind[RULE == TABLE ? CANDIDATES + LANES : 1];
    alignas(64) real kind_inside[RULE == TABLE ? LANES : 1][LANES], kind_outside[RULE == TABLE ? LANES : 1][LANES];
    const vec *inside_of_kinds, *outside_of_kinds;                            // of few species: the bands of that of the query
    alignas(64) int candidate_order[PERIODIC == 2 ? CANDIDATES + LANES : 1];  // by source, then by image: behind, at home, ahead

    explicit Scan(const SearchArguments& given)
        : SearchArguments(given),
          SystemCells(given.cutoff, given.grids, given.n <= FEW),
          SourcePlaces(given.scratch, given.n, given.m, given.own, given.table),
          wide(radius, given.closed),
          image(0),
          scaled_at_once(true),
          several(false),
          self(-1),
          self_from(-1),
          self_lanes(0),
          own_radius(0),
          of_kinds(nullptr),
          inside_of_kinds(nullptr),
          outside_of_kinds(nullptr) {
        memset(candidate_kind, 0, sizeof candidate_kind);  // those behind the last one are looked up, too
        find_band();
    }
    // Goes to the box of a system, where each has its own.
    void go_to(unsigned int system) {
        if (enter(system))
            find_band();
    }
    void find_band() {
        slack = PERIODIC ? 2 * lattice.slack() * step_scale : real(0);
        for (int k = 0; RULE == TABLE && k < kinds && kinds <= LANES; ++k) {
            vec r{};
            for (int l = 0; l < kinds; ++l)
                r[l] = table_of_kinds[kinds * k + l];
            const auto bounds = PairCutoffs::bounds_of(vec(r * step_scale), slack);
            __builtin_memcpy(kind_inside[k], &bounds.inside, sizeof r);
            __builtin_memcpy(kind_outside[k], &bounds.outside, sizeof r);
        }
        const Band<real> band = Bands::of_one(step_radius, slack, PERIODIC ? Bands::IMAGES : Bands::ONE);
        const real unit = shared.unit;  // of a lattice, on which nothing is between both
        const real between = !SCALED && unit > 0 ? real(square_between(radius, unit, closed)) * unit * unit : real(0);
        inside = between > 0 ? between : band.inside;
        outside = between > 0 ? between : band.outside;
    }

    // Finds the bands of so many candidates.
    void find_bands(int count) {
        for (int b = 0; BANDED && b < count; b += LANES) {
            const auto bounds = PairCutoffs::bounds_of(vec(*(const vec*)(candidate_radius + b) * step_scale), slack);
            *(vec*)(candidate_inside + b) = bounds.inside;
            *(vec*)(candidate_outside + b) = bounds.outside;
        }
    }
    // Begins with a query of an id.
    void begin_with(int id) {
        if constexpr (!DIFFER)
            return;
        own_radius = RULE == SCATTER ? real(0) : query_radii[id];
        if constexpr (RULE == TABLE) {
            const int kind = kinds_of_queries[id];
            of_kinds = table_of_kinds + (long long)kinds * kind;
            inside_of_kinds = (const vec*)kind_inside[kinds <= LANES ? kind : 0];
            outside_of_kinds = (const vec*)kind_outside[kinds <= LANES ? kind : 0];
        }
        if constexpr (RULE == GATHER || RULE == EITHER || RULE == BOTH) {
            const auto bounds = PairCutoffs::bounds_of(own_radius * step_scale, slack);
            inside = bounds.inside;
            outside = bounds.outside;
        }
    }
    // The cutoffs of the query and the candidates in the vector that begins with the number b, or of those with such numbers.
    vec radii_at(int b) const {
        vec r;
        if constexpr (RULE == TABLE)
            for (int l = 0; l < LANES; ++l)
                r[l] = of_kinds[candidate_kind[b + l]];
        else
            r = PairCutoffs::of_pair(vec{} + own_radius, *(const vec*)(candidate_radius + b));
        return r;
    }
    real radius_of(int number) const {
        if constexpr (RULE == TABLE)
            return of_kinds[candidate_kind[number]];
        return VARY ? PairCutoffs::of_pair(own_radius, candidate_radius[number]) : DIFFER ? own_radius : radius;
    }
    vec radii_of(const int* numbers) const {
        vec r;
        for (int l = 0; l < LANES; ++l)
            r[l] = radius_of(numbers[l]);
        return r;
    }
    // The bands of candidates: that of the query, which stays in registers, or one of each. A band is the wider, the longer a cutoff.
    auto band_at(int b, const Band<real>& of_query) const {
        if constexpr (BANDED) {
            const vec inside = *(const vec*)(candidate_inside + b), outside = *(const vec*)(candidate_outside + b);
            if constexpr (RULE == SCATTER)
                return Band<vec>{inside, outside};
            return Band<vec>{
                PairCutoffs::of_pair(vec{} + of_query.inside, inside), PairCutoffs::of_pair(vec{} + of_query.outside, outside)};
        } else if constexpr (RULE == TABLE) {
            if (kinds > LANES)
                return PairCutoffs::bounds_of(vec(radii_at(b) * step_scale), slack);
            const ints kind = *(const ints*)(candidate_kind + b);
            return Band<vec>{looked_up(*inside_of_kinds, kind), looked_up(*outside_of_kinds, kind)};
        } else if constexpr (VARY)
            return PairCutoffs::bounds_of(vec(radii_at(b) * step_scale), slack);
        else
            return of_query;
    }
    auto band_of(const int* numbers, const Band<real>& of_query) const {
        if constexpr (VARY)
            return PairCutoffs::bounds_of(vec(radii_of(numbers) * step_scale), slack);
        else
            return of_query;
    }

    // Candidates but for the query itself, in the vector that begins with the number b.
    unsigned int others_mask(int b) const { return (!DIFFER || drop_self) && b == self_from ? ~self_lanes : ~0u; }
    // Candidates that are pairs whatever their cutoffs, and which of those with such numbers are.
    unsigned int sure_mask(int b) const { return DIFFER && !drop_self && b == self_from ? self_lanes : 0; }
    unsigned int sure_among(const int* numbers, unsigned int there) const {
        if constexpr (!DIFFER)
            return 0;
        const unsigned int found = bits_of_flags(__builtin_convertvector(lanes_from(numbers) == self, flags));
        return drop_self ? 0 : found & there;
    }
    // Candidates whose id is above the query's, or its own id where a particle is its own neighbor.
    unsigned int later_mask(int b, int own_id) const {
        const ints ids = *(const ints*)((PERIODIC == 2 ? candidate_order : candidate_ids) + b);
        const int first = PERIODIC == 2 ? 3 * own_id + 1 + drop_self : own_id + drop_self;
        return bits_of_flags(__builtin_convertvector(ids >= first, flags));
    }
    static constexpr bool NAMED = PERIODIC == 2 && !SUMS;  // ids name images, too
    // The source that a candidate is, or an image of.
    int source_at(int number) const { return NAMED ? candidate_ids[number] % n : candidate_ids[number]; }
    // What a query excludes. A short row needs no filter: `wanted` compares all of it at once.
    Excluded excluded_by(int id) const {
        Excluded mine(excluded_starts, excluded, id, 0);
        if (EXCLUDING && !is_compared(mine))
            mine.filter = mine.find_filter();
        return mine;
    }
    static bool is_compared(const Excluded& row) { return EXCLUDING == 1 && !NAMED && row.end - row.begin <= Excluded::MOST_KEPT; }
    // Those of the candidates from number b on, of which some are `near`, that a query does not exclude.
    unsigned int wanted(const Excluded& excluded, int b, unsigned int near) const {
        const ints ids = *(const ints*)(candidate_ids + b);
        if (is_compared(excluded)) {
            for (const int* id = excluded.begin; id < excluded.end; ++id)
                near &= ~bits_of_flags(__builtin_convertvector(ids == *id, flags));
            return near;
        }
        unsigned int rest = excluded.begin < excluded.end ? near : 0;
        if constexpr (EXCLUDING == 1 && !NAMED) {  // what the filter tells of all at once
            const ints low = ints{} + (int)(unsigned int)excluded.filter,
                       high = ints{} + (int)(unsigned int)(excluded.filter >> 32);
            const ints words = (ids & 32) != 0 ? high : low;
            rest &= bits_of_flags(__builtin_convertvector((words >> (ids & 31) & 1) != 0, flags));
        }
        for (; rest; rest &= rest - 1) {
            const int lane = __builtin_ctz(rest);
            const int source = source_at(b + lane), code = PERIODIC && several ? candidate_images[b + lane] : image;
            near &= excluded.has(Excluded::id_of(source, code, n)) ? ~(1u << lane) : ~0u;
        }
        return near;
    }
    Points candidates_at(int b) const {
        Points points;
        for (int k = 0; k < DIM; ++k)
            points.p[k] = *(const vec*)(candidate[k] + b);
        return points;
    }
    Points doubtful_at(int b) const {
        Points points;
        for (int k = 0; k < DIM; ++k)
            points.p[k] = gathered(candidate[k], doubtful + b);
        return points;
    }
    // Squares of the distances of points in lanes. By a power of two both coordinates are multiplied, and rounded once, where that of
    // the query stays finite: so it takes no operation more.
    vec square_of(const real* q, const vec* p) const {
        vec square;
        for (int k = 0; k < DIM; ++k) {
            vec d = p[k] - q[k];
#if defined(__FMA__)
            if constexpr (SCALED)
                d = scaled_at_once ? __builtin_elementwise_fma(p[k], vec{} + step_scale, vec{} - q[k] * step_scale)
                                   : d * step_scale;
            if constexpr (SUMS && !SCALED)  // as a term computes it, too
                square = k == 0 ? d * d : square + d * d;
            else
                square = k == 0 ? d * d : __builtin_elementwise_fma(d, d, square);
#else
            if constexpr (SCALED)
                d *= step_scale;
            square = k == 0 ? d * d : square + d * d;
#endif
        }
        return square;
    }
    void scale_at_once(const real* q) {
        scaled_at_once = true;
        for (int k = 0; SCALED && k < DIM; ++k)
            scaled_at_once = scaled_at_once && Bits::finite(q[k] * step_scale);
    }

    // Two numbers whose sum is the cutoff of the query and a candidate; a mean is not rounded.
    real first_of(int number) const { return SUM ? own_radius / 2 : radius_of(number); }
    real more_of(int number) const { return SUM ? candidate_radius[SUM ? number : 0] / 2 : real(0); }
    // Is a candidate a pair, given where it is and its number?
    bool exactly_decided(const real* q, int own_id, const real* p, int number) const {
        if constexpr (PERIODIC) {
            const real* there = positions + (long long)ROW * source_at(number);
            const int code = several ? candidate_images[number] : image;
            return exact_image(lattice, queries + (long long)ROW * own_id, there, code, first_of(number), more_of(number), closed);
        }
        return exact_pair(q, p, first_of(number), more_of(number), closed);
    }
    // Which of the points in lanes are surely pairs, also while denormals are flushed; others stay `open` or are none.
    unsigned int sure(const real* q, const Points& points, unsigned int& open) const {
        return SCALED || DIFFER || PERIODIC > 0 ? 0 : wide.sure(q, points.p, open);
    }
    // Which of the points in lanes, of which some are `open`, are pairs; `numbers` are theirs among the candidates.
    unsigned int decided(const real* q, int own_id, const Points& points, const int* numbers, unsigned int open) const {
        unsigned int pairs = 0;
        if constexpr (!PERIODIC && !DIFFER)
            pairs = wide.decided(q, points.p, open);
        else if constexpr (!PERIODIC && RULE == GATHER)
            pairs = own_radius > 0 ? Wide(own_radius, closed).decided(q, points.p, open) : 0;
        for (; open; open &= open - 1) {
            const int lane = __builtin_ctz(open);
            real p[3];
            for (int k = 0; k < DIM; ++k)
                p[k] = points.p[k][lane];
            pairs |= exactly_decided(q, own_id, p, numbers[lane]) ? 1u << lane : 0;
        }
        return pairs;
    }
    // Collects the numbers of what is unsure among `count` candidates in `doubtful`, and returns how many there are. Loops are of
    // known length: what would be a branch per vector is hard to predict.
    JFRNN_APART int collect_doubtful(int count) {
        const ints numbers = first_numbers();
        const int vectors = (count + LANES - 1) / LANES;
        for (int e = vectors; e < vectors + LANES; ++e)
            unsure[e] = 0;
        int chosen = 0, doubts = 0;
        for (int v = 0; v < vectors; v += LANES) {
            typedef unsigned short shorts __attribute__((vector_size(2 * LANES)));
            const shorts masks = *(const shorts*)(unsure + v);
            const unsigned int bits = bits_of_flags(__builtin_convertvector(masks != 0, flags));
            pack(numbers + v, vectors_in_doubt + chosen, bits);
            chosen += __builtin_popcount(bits);
        }
        for (int k = 0; k < chosen; ++k) {
            const int v = vectors_in_doubt[k];
            pack(numbers + v * LANES, doubtful + doubts, unsure[v]);
            doubts += __builtin_popcount(unsure[v]);
        }
        for (int e = 0; e < LANES; ++e)
            doubtful[doubts + e] = 0;
        return doubts;
    }
    // Adds the pairs among what is unsure of `count` candidates to `hits`, as `scan` does. It is apart, or compilers would take as long
    // for it as for all the rest.
    JFRNN_APART int settle_unsure(const real* q, int own_id, int count, int* to, int room, int hits) {
        const int doubts = collect_doubtful(count);
        for (int b = 0; b < doubts; b += LANES) {
            unsigned int pairs = decided(q, own_id, doubtful_at(b), doubtful + b, lanes_before(doubts - b));
            for (; pairs; pairs &= pairs - 1, ++hits)
                if (LIST && hits < room)
                    to[hits] = candidate_ids[doubtful[b + __builtin_ctz(pairs)]];
        }
        return hits;
    }
    // Counts which of `count` candidates are pairs of a query; LIST: leaves their ids in `to`, of which as many as fit into `room`;
    // without BOUNDED there is room for all. It takes a load, a difference, a product and a comparison per axis or candidate, LANES at
    // a time.
    template <bool BOUNDED>
    int scan(const real* q, int own_id, int count, int* to, int room) {
        const Band<real> of_query{inside, outside};  // stays in registers, whatever is stored
        const Excluded mine = excluded_by(own_id);
        unsigned int any_unsure = 0;
        int hits = 0;
        for (int b = 0, v = 0; b < count; b += LANES, ++v) {
            const vec square = square_of(q, candidates_at(b).p);
            const auto band = band_at(b, of_query);
            unsigned int allowed = others_mask(b) & (LATER ? later_mask(b, own_id) : ~0u);
            if constexpr (EXCLUDING)
                allowed = wanted(mine, b, allowed & (mask_of(square, band.outside, BelowOrAt{}) | sure_mask(b)));
            const unsigned int hit = (mask_of(square, band.inside, Below{}) | sure_mask(b)) & allowed;
            unsure[v] = ~hit & mask_of(square, band.outside, BelowOrAt{}) & allowed;
            any_unsure |= unsure[v];
            if constexpr (LIST && BOUNDED)
                pack_within(*(const ints*)(candidate_ids + b), to + hits, hit, room - hits);
            else if constexpr (LIST)
                pack(*(const ints*)(candidate_ids + b), to + hits, hit);
            hits += __builtin_popcount(hit);
        }
        return any_unsure ? settle_unsure(q, own_id, count, to, BOUNDED ? room : 0x7fffffff, hits) : hits;
    }
};
