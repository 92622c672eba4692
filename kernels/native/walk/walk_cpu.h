// How all queries meet their candidates on the CPU, 8 or 16 at a time: what listing and summing share.
//
// The threads hand themselves chunks of places from an atomic counter. The sources around a cell are copied once into the first-level
// cache, as a structure of arrays, and serve all queries of that cell. What becomes of the pairs is said by the struct that derives
// from `Walk`, by these members:
//   FLUSHED                  denormals are flushed to zero, as XLA does, while queries meet candidates
//   meet(q, id, fresh, finished)  a query at `q` meets the candidates, `filled` in number; these may be its first and its last ones
//   copied(from, near)       packs more of those of the sources from the place `from` on that are `near`, of the image `shift`
//   expect(id)               a query will soon meet candidates
//   none(id)                 a query that is not finite has no candidates
//   chunk_done(chunk), finish() come after the last query of a chunk, and of this thread
// How queries come to their candidates is said by a struct between both (`cell_walk_cpu.h`, `tree_walk_cpu.h`), by these members:
//   serve_chunk(place, end)  the queries at these places meet their candidates
//   strangers()              whether these may belong to other systems
//   placed(from, to, near)   comes after sources at places [from, to) were packed
//   number_of(place)         which of the candidates the query at a place is itself, -1: none, or it does not matter
//   forget()                 candidates are gone
#pragma once
#include "scan_cpu.h"

struct Box {
    real low[3], high[3];
};  // around points

template <class Query>
struct Walk : Scan {
    const int finite_places;
    int filled;           // candidates
    int begin, end;       // places of the queries that are served
    bool fresh;           // no candidates have been met
    unsigned int system;  // theirs
    // Where cutoffs differ: the largest of the queries, and the square beyond which no pair is by that alone.
    real group_radius, group_outside;
    int side;       // whether the image lies behind (-1), at home, or ahead
    int shift[3];   // of the image, in lattice vectors
    real moved[3];  // by which its sources are moved

    explicit Walk(const SearchArguments& given)
        : Scan(given), finite_places(shared.finite_queries), group_radius(0), group_outside(0), shift{0, 0, 0}, moved{0, 0, 0} {}
    Query& query() { return *(Query*)this; }
    const Query& query() const { return *(const Query*)this; }

    // Begins with the queries that are served: finds the largest of their cutoffs, and asks ahead for what stands anywhere.
    void begin_group() {
        group_radius = 0;
        for (int place = begin; EXCLUDING && place < end; ++place)
            __builtin_prefetch(excluded_starts + query_ids[place]);
        for (int place = begin; RULE == TABLE && place < end; ++place)
            __builtin_prefetch(kinds_of_queries + query_ids[place]);
        for (int place = begin; DIFFER && RULE != SCATTER && place < end; ++place) {
            const real r = query_radii[query_ids[place]];
            group_radius = r > group_radius ? r : group_radius;
        }
        if constexpr (DIFFER)
            group_outside = PairCutoffs::outside_of(group_radius * step_scale, slack);
    }
    // The squares beyond which the sources from a place on, or in nodes from a number on, are too far away from the group.
    auto farthest(int from) const {
        if constexpr (!DIFFER)
            return outside;
        else if constexpr (RULE == GATHER)
            return group_outside;
        else
            return farthest_by(query().radii_there + from);
    }
    auto farthest_by(const real* of_sources) const {
        if constexpr (RULE == GATHER)
            return group_outside;
        else if constexpr (RULE == MEAN)
            return PairCutoffs::outside_of(
                vec(PairCutoffs::of_pair(vec{} + group_radius, lanes_from(of_sources)) * step_scale), slack);
        else {
            const vec outside = PairCutoffs::outside_of(vec(lanes_from(of_sources) * step_scale), slack);
            return PairCutoffs::of_pair(vec{} + group_outside, outside);
        }
    }

    void position_of(int place, real* q) const {
        if (own)  // the places are those of the sources
            for (int k = 0; k < DIM; ++k)
                q[k] = axis[k][place];
        else
            point_of(queries + (long long)ROW * query_ids[place], q);
    }
    unsigned int system_at(int place) const { return BATCHED ? system_of(queries + (long long)ROW * query_ids[place]) : 0u; }

    // Lets all candidates meet the queries of the cell, and forgets them.
    JFRNN_APART void flush(bool finished) {
        for (int e = 0; e < LANES; ++e)
            for (int k = 0; k < DIM; ++k)
                candidate[k][filled + e] = __builtin_nanf("");
        this->find_bands(filled);
        for (int place = begin; place < end; ++place) {
            query().expect(query_ids[place]);
            if constexpr (EXCLUDING)
                __builtin_prefetch(excluded + excluded_starts[query_ids[place]]);
        }
        if constexpr (Query::FLUSHED)
            floats.flush();
        for (int place = begin; place < end; ++place) {
            real q[3];
            query().position_of(place, q);
            this->begin_with(query_ids[place]);
            this->scale_at_once(q);
            self = query().number_of(place);
            self_from = self < 0 ? -1 : self & -LANES;  // to change it among the candidates would delay all loads of them
            self_lanes = 1 << (self & (LANES - 1));
            query().meet(q, query_ids[place], fresh, finished);
        }
        if constexpr (Query::FLUSHED)
            floats.keep();
        fresh = false;
        filled = 0;
        query().forget();
    }

    // Copies those of the sources at places [from, to) that may be near one of the queries: others are too far from the box around
    // these. Rounding is monotone, so that no query is nearer to a source, by `square_of`, than the nearest point of the box is.
    JFRNN_APART void copy(const Box& box, int from, int to) {
        for (; from < to; from += LANES) {
            if (filled > CANDIDATES - LANES)
                flush(false);
            Points points;
            vec beside[3];
            const real origin[3] = {0, 0, 0};
            for (int k = 0; k < DIM; ++k) {
                points.p[k] = lanes_from(axis[k] + from);
                if constexpr (PERIODIC)
                    points.p[k] += moved[k];
                const vec least = points.p[k] > box.low[k] ? points.p[k] : vec{} + box.low[k];
                beside[k] = points.p[k] - (least < box.high[k] ? least : vec{} + box.high[k]);
            }
            unsigned int near = lanes_before(to - from);
            near &= mask_of(square_of(origin, beside), farthest(from), BelowOrAt{});
            const ints numbers = lanes_from(ids + from);
            for (int l = 0; BATCHED && query().strangers() && l < LANES && from + l < to; ++l)
                if (system_of(positions + (long long)ROW * numbers[l]) != system)
                    near &= ~(1u << l);
            for (int k = 0; k < DIM; ++k)
                pack(points.p[k], candidate[k] + filled, near);
            pack_names(numbers, near);
            query().copied(from, near);
            query().placed(from, from + LANES < to ? from + LANES : to, near);
            filled += __builtin_popcount(near);
        }
    }
    // Goes from image to image, from the first to the last one along each axis, and calls `copy_it` there.
    template <class Copy>
    void each_image(const int* from, const int* to, Copy copy_it) {
        for (int x = from[0]; x <= to[0]; ++x)
            for (int y = from[1]; y <= to[1]; ++y)
                for (int z = from[2]; z <= to[2]; ++z) {
                    const int lead = x ? x : y ? y : z;
                    side = (lead > 0) - (lead < 0);
                    shift[0] = x;
                    shift[1] = y;
                    shift[2] = z;
                    image = 0;
                    for (int k = 0; k < DIM; ++k) {
                        moved[k] = lattice.translation(x, y, z, k);
                        image = image * (2 * lattice.images(k) + 1) + shift[k] + lattice.images(k);
                    }
                    copy_it();
                }
    }
    // Packs what says their cutoffs.
    void pack_cutoffs(int from, unsigned int near) {
        if constexpr (RULE == TABLE)
            pack(lanes_from(query().kinds_there + from), candidate_kind + filled, near);
        else if constexpr (VARY)
            pack(lanes_from(query().radii_there + from), candidate_radius + filled, near);
    }
    // Packs what tells the candidates apart: their sources, and which images they are.
    void pack_names(ints numbers, unsigned int near) {
        if constexpr (SUMS != 1 || PERIODIC || EXCLUDING || DIFFER)
            pack(numbers + (PERIODIC == 2 && !SUMS ? n * image : 0), candidate_ids + filled, near);
        if constexpr (PERIODIC) {
            const ints codes = ints{} + image;
            __builtin_memcpy(candidate_images + filled, &codes, sizeof codes);
        }
        if constexpr (PERIODIC == 2)
            pack(3 * numbers + (1 + side), candidate_order + filled, near);
    }
    void run() {
        each_chunk(shared.next_chunk, m, QUERY_CHUNK, [&](int from, int to, int chunk) {
            query().serve_chunk(from, to);
            query().chunk_done(chunk);
        });
        query().finish();
    }
};
