// Groups of queries meet the sources in the leaves of a tree that are near them, on the CPU, where cutoffs differ.
//
// A group are queries that follow each other along the curve and have similar cutoffs. Which nodes are near its box is a matter of
// distances between boxes: rounding is monotone, so that no source of a node is nearer to a query, by `square_of`, than both boxes are.
#pragma once
#include "walk_cpu.h"

template <class Query>
struct TreeWalk : Walk<Query> {
    typedef Walk<Query> Base;
    using Base::begin, Base::copy, Base::end, Base::filled, Base::finite_places, Base::flush, Base::fresh, Base::image;
    using Base::is_periodic, Base::lattice, Base::levels, Base::moved, Base::node_high, Base::node_low, Base::node_radius;
    using Base::nodes, Base::position_of, Base::query, Base::query_ids, Base::several, Base::shared, Base::side, Base::slack;
    using Base::square_of, Base::step_scale, Base::system, Base::system_at;
    real group_radius;           // the largest cutoff of the queries
    int system_from, system_to;  // places of the sources of their system
    int run_from, run_to;        // places of sources that are near and not yet copied

    explicit TreeWalk(const SearchArguments& given)
        : Base(given), group_radius(0), system_from(0), system_to(0), run_from(0), run_to(0) {}
    // The squares beyond which the sources from a place on, or in nodes from a number on, are too far away from the group.
    auto farthest(int from) const {
        if constexpr (RULE == GATHER)
            return PairCutoffs::outside_of(group_radius * step_scale, slack);
        else
            return farthest_by(this->radii_there + from);
    }
    auto farthest_by(const real* of_sources) const {
        const vec r = RULE == GATHER ? vec{} + group_radius : PairCutoffs::of_pair(vec{} + group_radius, lanes_from(of_sources));
        return PairCutoffs::outside_of(vec(r * step_scale), slack);
    }
    static constexpr bool strangers() { return false; }
    void placed(int from, int, unsigned int near) {
        if constexpr (RULE == TABLE)
            pack(lanes_from(this->kinds_there + from), this->candidate_kind + filled, near);
        else if constexpr (VARY)
            pack(lanes_from(this->radii_there + from), this->candidate_radius + filled, near);
    }

    // Which of the LANES nodes from a number on are near a box.
    unsigned int near_nodes(const Box& box, int at) const {
        vec apart[3];
        const real origin[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k) {
            vec low = lanes_from(node_low[k] + at), high = lanes_from(node_high[k] + at);
            if constexpr (PERIODIC) {
                low += moved[k];
                high += moved[k];
            }
            const vec above = low - box.high[k], below = box.low[k] - high;
            apart[k] = above > below ? above : below;
            apart[k] = apart[k] > 0 ? apart[k] : vec{};
        }
        return mask_of(square_of(origin, apart), farthest_by(node_radius + at), BelowOrAt{});
    }
    // Copies the sources of those nodes [from, to) of a level that are near a box, and of the system.
    __attribute__((noinline)) void descend(const Box& box, int level, int from, int to) {
        const int first = this->first[level];
        for (int node = from; node < to; node += LANES) {
            unsigned int near = near_nodes(box, first + node) & lanes_before(to - node);
            for (; near; near &= near - 1) {
                const int found = node + __builtin_ctz(near);
                if (level > 0) {
                    const int low = system_from / size_of(level - 1), high = (system_to - 1) / size_of(level - 1) + 1;
                    const int begins = found * FANOUT, ends = begins + FANOUT;
                    descend(box, level - 1, begins > low ? begins : low, ends < high ? ends : high);
                } else
                    take_leaf(box, found * LEAF);
            }
        }
    }
    // How many sources a node of a level holds.
    static int size_of(int level) {
        int size = LEAF;
        for (int l = 0; l < level; ++l)
            size *= FANOUT;
        return size;
    }
    // Leaves that follow each other are copied together.
    void take_leaf(const Box& box, int from) {
        const int begins = from > system_from ? from : system_from;
        if (begins != run_to) {
            copy_run(box);
            run_from = begins;
        }
        run_to = from + LEAF < system_to ? from + LEAF : system_to;
    }
    __attribute__((noinline)) void copy_sources(const Box& box) {
        run_from = run_to = 0;
        const int top = levels - 1, size = size_of(top);
        descend(box, top, system_from / size, (system_to - 1) / size + 1);
        copy_run(box);
    }
    __attribute__((noinline)) void copy_run(const Box& box) { copy(box, run_from, run_to); }
    // Copies sources image by image, of all images that there are: nodes tell soon which ones are near.
    void copy_images(const Box& box) {
        int from[3] = {0, 0, 0}, to[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k) {
            to[k] = is_periodic(k) ? lattice.images(k) : 0;
            from[k] = -to[k];
        }
        several = true;
        this->each_image(from, to, [&] { copy_sources(box); });
    }

    // Finds the places of the sources of a system.
    void find_system() {
        system_from = 0;
        system_to = shared.grid.finite;
        if constexpr (BATCHED) {
            system_from = sources_before(system, false);
            system_to = sources_before(system, true);
        }
    }
    // How many sources stand before those of a system, or these included.
    int sources_before(unsigned int number, bool included) const {
        int low = 0, high = shared.grid.finite;
        while (low < high) {
            const int middle = low + (high - low) / 2;
            const unsigned int there = system_of(this->positions + (long long)ROW * this->ids[middle]);
            if (there < number || (included && there == number))
                low = middle + 1;
            else
                high = middle;
        }
        return low;
    }
    real radius_at(int place) const { return RULE == SCATTER ? real(0) : this->query_radii[query_ids[place]]; }

    void serve_chunk(int place, int chunk_end) {
        bool known = false;
        while (place < chunk_end) {
            if (place >= finite_places) {
                query().none(query_ids[place++]);
                continue;
            }
            Box box;
            position_of(place, box.low);
            position_of(place, box.high);
            group_radius = radius_at(place);
            if (!known || system_at(place) != system) {
                system = system_at(place);
                find_system();
                known = true;
            }
            int stop = place + 1;
            for (const int most = place + MOST_TOGETHER; stop < chunk_end && stop < finite_places && stop < most; ++stop) {
                Box wider = box;
                real q[3];
                position_of(stop, q);
                widen(wider.low, wider.high, q, q);
                if (system_at(stop) != system || (stop - place >= TOGETHER && !close(wider, radius_at(stop))))
                    break;
                box = wider;
                group_radius = radius_at(stop) > group_radius ? radius_at(stop) : group_radius;
            }
            serve(place, stop, box);
            place = stop;
        }
    }
    // Is a box not much wider than a cutoff?
    bool close(const Box& box, real r) const {
        bool all = true;
        for (int k = 0; k < DIM; ++k)
            all = all && box.high[k] - box.low[k] <= (RULE == SCATTER ? this->radius : r);
        return all;
    }
    void serve(int from, int to, const Box& box) {
        begin = from;
        end = to;
        filled = side = 0;
        fresh = true;
        if (system_from < system_to) {
            if constexpr (PERIODIC)
                copy_images(box);
            else
                copy_sources(box);
        }
        flush(true);
    }
};
template <class Query>
using QueryWalk = TreeWalk<Query>;
