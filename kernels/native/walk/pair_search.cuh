// How a pair is decided: nearly always in working precision, in doubt exactly.
//
// Where cutoffs DIFFER, a lane knows those of its query: what is beyond `upper` is surely no neighbor of it. Where they VARY with the
// candidate, too, what is known of that stands beside its coordinates.
#pragma once
#include "image_search.cuh"
#include "pair_cutoffs.h"

JFRNN_FUNCTION unsigned int upper_word(real x) { return DOUBLE ? __double2hiint(x) : __float_as_uint((float)x); }
JFRNN_FUNCTION real magnitude(real x) { return DOUBLE ? (real)fabs(x) : (real)fabsf(x); }
JFRNN_FUNCTION real larger(real a, real b) {
    if constexpr (DOUBLE)
        return a > b ? a : b;
    else
        return fmaxf(a, b);
}

struct PairSearch : ImageSearch {
    real outer_radius;  // what is farther away is surely no neighbor, scaled
    real sure_square;   // what is closer surely is one, squared
    real band;  // half of the difference between both, squared: pairs in between are decided exactly; negative: there are none
    real own_radius, upper;  // where cutoffs DIFFER: that of this lane's query, and the longest that a pair of it may have
    const real* of_kinds;    // the cutoffs of its species
    PairCutoffs::Bounds<real> own_bounds;
    real between;  // what `Known` says of one cutoff, for that of this query
    int served;    // the block of queries that is served
    // Where coordinates lie on a lattice, cutoffs of queries are decided on it as one cutoff is.
    static constexpr bool SITED = RULE == GATHER && !TREE;

    JFRNN_MEMBER explicit PairSearch(const SearchArguments& given)
        : ImageSearch(given), own_radius(0), upper(0), of_kinds(nullptr), own_bounds{0, 0}, between(0), served(0) {
        Known& known = shared_known();
        if (lane == 0) {
            known.site = !SCALED || SITED ? shared.unit : real(0);
            known.between = known.site > 0 && !DIFFER ? (real)square_between(radius, known.site, closed) : real(0);
            known.grid = shared.grid;
            known.finite_queries = shared.finite_queries;
            known.longs = LONG && has_long_queries() ? shared.longs : 0;
            known.longest_before = SUMS ? 0 : *(volatile int*)longest;
        }
        __syncwarp();
        const real off = this->off();
        outer_radius = step_radius + off;
        const real inner_radius = step_radius > off ? step_radius - off : real(0), square_radius = step_radius * step_radius;
        // where coordinates lie on a lattice nothing is in doubt, and bands are negative
        sure_square = DOUBLE && known.between > 0 ? known.between * known.site * known.site
                                                  : inner_radius * inner_radius - 8 * (1 + SHIFTED) * step_eps * square_radius;
        const real beyond = outer_radius * outer_radius * (1 + 16 * step_eps) - sure_square;
        band = DOUBLE && known.between > 0 ? real(-1) : PERIODIC ? real(0.5) * beyond : 8 * step_eps * square_radius;
    }
    // By which distances in a box may be off, beyond what rounding takes from a difference: of images, and of points brought into it.
    JFRNN_MEMBER real off() const { return PERIODIC ? 2 * lattice.slack() * step_scale : real(0); }
    // Where cutoffs DIFFER: takes those of the query of this lane, if it has one.
    JFRNN_MEMBER void take_cutoffs(int id, bool has_query) {
        own_radius = RULE != SCATTER && has_query ? query_radii[id] : real(0);
        of_kinds = RULE != TABLE ? nullptr : has_query ? row_of_kind(id) : table_of_kinds;
        upper = BY_OWN || TREE ? own_radius : RULE == MEAN ? (own_radius / 2 + radius / 2) * (1 + 4 * step_eps) : radius;
        own_bounds = PairCutoffs::bounds_of(own_radius * step_scale, off());
        sure_square = own_bounds.inside;  // of GATHER
        band = (own_bounds.outside - own_bounds.inside) / 2;
        const real site = SITED && !is_long(own_radius) ? shared_known().site : real(0);
        between = site > 0 ? (real)square_between(own_radius, site, closed) : real(0);
        if (DOUBLE && site > 0) {
            sure_square = between * (site * step_scale) * (site * step_scale);
            band = -1;
        }
    }
    // Is a cutoff longer than cells know?
    JFRNN_MEMBER bool is_long(real cutoff) const { return LONG && cutoff > radius; }
    // Are species so few that tensor cores know the cutoffs of their pairs?
    JFRNN_MEMBER bool few_kinds() const { return RULE == TABLE && kinds <= MOST_KINDS; }
    // What is known of the cutoffs of a source.
    JFRNN_MEMBER void cutoffs_of(int source, real* known) const {
        if constexpr (RULE == TABLE)
            known[0] = bits_as_real(kinds_of_sources[source]);
        else if constexpr (RULE == MEAN)
            known[0] = radii[source] / 2 * step_scale;
        else if constexpr (VARY) {
            const auto bounds = PairCutoffs::bounds_of(radii[source] * step_scale, off());
            known[0] = bounds.inside;
            known[1] = bounds.outside;
        }
    }
    // The bounds of the query of this lane and a candidate of which that is known.
    JFRNN_MEMBER PairCutoffs::Bounds<real> bounds_with(const real* known) const {
        if constexpr (BANDED)
            return {PairCutoffs::of_pair(own_bounds.inside, known[0]), PairCutoffs::of_pair(own_bounds.outside, known[1])};
        if constexpr (SUM)
            return PairCutoffs::bounds_of(own_radius / 2 * step_scale + known[0], off());
        const int other = id_of(known[0]), kind = (unsigned int)other < (unsigned int)kinds ? other : 0;  // maybe of no candidate
        return PairCutoffs::bounds_of(of_kinds[kind] * step_scale, off());
    }
    // Around the square of any mean that a query of cells may have: the band in which pairs are decided exactly, to either side.
    JFRNN_MEMBER real mean_band() const {
        const real most = larger(upper * step_scale, LEAST), off = this->off();
        return PairCutoffs::CUTOFFS * step_eps * most * most + (2 * most + off) * off;
    }
    // |b - a|^2 - r^2 + band in working precision, fused or not: off by less than 5 eps r^2 where it is near [0, 2 band], see
    // jfrnn/_geometry/exact.py. Negative: surely closer than the cutoff. Its upper word has the sign and, if not negative, the order
    // of all.
    JFRNN_MEMBER real excess(const real* a, const real* b) const {
        real sum = -sure_square;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            real d = b[k] - a[k];
            if constexpr (SCALED)
                d *= step_scale;
            sum += d * d;
        }
        return sum;
    }
    // Is a candidate a neighbor of the query at `q`? It is decided exactly where working precision leaves it open; few pairs are.
    JFRNN_MEMBER bool is_neighbor(const real* q, int my_id, int id) const {
        real p[3];
        load_image(id, p);
        if constexpr (DIFFER)
            return is_neighbor_by_cutoffs(q, p, my_id, id, own_radius);
        const real over = excess(q, p);
        return over < 0 || (over <= 2 * band && is_pair(q, p, my_id, id, radius, 0));
    }
    // The cutoffs of the species of a query with each other.
    JFRNN_MEMBER const real* row_of_kind(int query) const { return table_of_kinds + (long long)kinds * kinds_of_queries[query]; }
    // The same for a candidate at `p`, by the cutoffs of both.
    JFRNN_MEMBER bool is_neighbor_by_cutoffs(const real* q, const real* p, int my_id, int id, real own) const {
        const int source = source_named(id);
        const real other = RULE == GATHER || RULE == TABLE ? real(0) : radii[source];
        const real r = RULE == TABLE ? row_of_kind(my_id)[kinds_of_sources[source]] : PairCutoffs::of_pair(own, other);
        const auto bounds = PairCutoffs::bounds_of(r * step_scale, off());
        real square = 0;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const real d = (p[k] - q[k]) * step_scale;
            square += d * d;
        }
        if (square < bounds.inside || !(square <= bounds.outside))
            return square < bounds.inside;
        const real first = SUM ? own / 2 : r, more = SUM ? other / 2 : real(0);
        return is_pair(q, p, my_id, id, first, more);
    }
    // Decides a pair exactly: of a box, by what was given, since points that were brought into it are rounded.
    JFRNN_MEMBER bool is_pair(const real* q, const real* p, int my_id, int id, real first, real more) const {
        if constexpr (!PERIODIC)
            return exact_pair(q, p, first, more, closed);
        const real *here = queries + (long long)ROW * my_id, *there = positions + (long long)ROW * source_named(id);
        return exact_image(lattice, here, there, INSIDE ? (count_codes() - 1) / 2 : image_of(id), first, more, closed);
    }
};
