// Groups of queries meet the sources in the leaves of a tree that are near them, on the CPU, where cutoffs differ.
//
// A group are queries that follow each other along the curve, with similar cutoffs, in a cube about as wide as these. Which nodes are
// near its box is a matter of distances between boxes: rounding is monotone, so that no source of a node is nearer to a query, by
// `square_of`, than both boxes are.
#pragma once
#include "walk_cpu.h"

template <class Query>
struct TreeWalk : Walk<Query> {
    typedef Walk<Query> Base;
    using Base::begin, Base::copy, Base::end, Base::filled, Base::finite_places, Base::flush, Base::fresh, Base::image;
    using Base::is_periodic, Base::lattice, Base::levels, Base::moved, Base::node_high, Base::node_low, Base::node_radius;
    using Base::nodes, Base::own, Base::query, Base::query_ids, Base::several, Base::shared, Base::side, Base::slack;
    using Base::square_of, Base::step_scale, Base::system;
    static constexpr int NOWHERE = 0x7fffffff;
    int system_from, system_to;  // places of the sources of their system
    int next_own;                // the first of the queries that was not yet seen among the sources
    int own_place[MOST_TOGETHER + 1], own_number[MOST_TOGETHER];  // where the queries are sources, and their numbers as candidates
    // The queries of a chunk, from the place `chunk` on: where they are, how wide a group of them may be, and their systems.
    int chunk;
    alignas(64) real query_at[3][QUERY_CHUNK + LANES];
    alignas(64) real query_reach[QUERY_CHUNK + LANES];
    unsigned int query_system[BATCHED ? QUERY_CHUNK : 1];

    explicit TreeWalk(const SearchArguments& given) : Base(given), system_from(0), system_to(0), next_own(0), chunk(0) {
        memset(query_at, 0, sizeof query_at);
        memset(query_reach, 0, sizeof query_reach);
    }
    void position_of(int place, real* q) const {
        for (int k = 0; k < DIM; ++k)
            q[k] = query_at[k][place - chunk];
    }
    unsigned int system_at(int place) const { return BATCHED ? query_system[BATCHED ? place - chunk : 0] : 0u; }
    static constexpr bool strangers() { return false; }
    // Queries of a group, and sources, come in the same order: so those among them are found.
    void placed(int from, int to, unsigned int near) {
        this->pack_cutoffs(from, near);
        for (; side == 0 && own_place[next_own] < to; ++next_own)
            if (const int lane = own_place[next_own] - from; lane >= 0)
                own_number[next_own] = filled + __builtin_popcount(near & ((1u << lane) - 1));
    }
    int number_of(int place) const { return own_number[place - begin]; }
    void forget() {
        for (int k = 0; k < end - begin; ++k)
            own_number[k] = -1;
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
        return mask_of(square_of(origin, apart), this->farthest_by(node_radius + at), BelowOrAt{});
    }
    // Copies the sources of those nodes [from, to) of a level that are near a box, and of the system. Leaves that follow each other
    // are copied together.
    JFRNN_APART void descend(const Box& box, int level, int from, int to) {
        const int first = this->first[level];
        const int size = level > 0 ? size_of(level - 1) : 1;
        for (int node = from; node < to; node += LANES) {
            unsigned int near = near_nodes(box, first + node) & lanes_before(to - node);
            while (near) {
                const int skipped = __builtin_ctz(near), found = node + skipped;
                const int run = level > 0 ? 1 : __builtin_ctz(~(near >> skipped));
                near &= ~(((1u << run) - 1) << skipped);
                if (level > 0) {
                    const int low = system_from / size, high = (system_to - 1) / size + 1;
                    const int begins = found * FANOUT, ends = begins + FANOUT;
                    descend(box, level - 1, begins > low ? begins : low, ends < high ? ends : high);
                } else {
                    const int begins = found * LEAF, ends = begins + run * LEAF;
                    copy(box, begins > system_from ? begins : system_from, ends < system_to ? ends : system_to);
                }
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
    void copy_sources(const Box& box) {
        const int top = levels - 1, size = size_of(top);
        descend(box, top, system_from / size, (system_to - 1) / size + 1);
    }
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

    JFRNN_APART void serve_chunk(int place, int chunk_end) {
        const int finite_end = chunk_end < finite_places ? chunk_end : finite_places;
        read_queries(place, finite_end);
        bool known = false;
        while (place < finite_end) {
            if (!known || system_at(place) != system) {
                system = system_at(place);
                find_system();
                known = true;
            }
            const int stop = group_end(place, finite_end);
            serve(place, stop);
            place = stop;
        }
        for (; place < chunk_end; ++place)
            query().none(query_ids[place]);
    }
    void read_queries(int from, int to) {
        chunk = from;
        for (int place = from; place < to; ++place) {
            constexpr int AHEAD = 16;  // places
            const long long id = query_ids[place];
            __builtin_prefetch(this->queries + ROW * query_ids[place + AHEAD < to ? place + AHEAD : place]);
            real q[3];
            this->point_of(this->queries + ROW * id, q);
            for (int k = 0; k < DIM; ++k)
                query_at[k][place - from] = q[k];
            query_reach[place - from] = this->reach_there[place];
            if constexpr (BATCHED)
                query_system[place - from] = system_of(this->queries + ROW * id);
        }
    }
    // A cube of a power of two, or half or a quarter of one: axes are halved and doubled in the order of the curve.
    struct Cube {
        real cells[3];  // per length
        int axis;       // that is doubled next
        void grow() {
            cells[axis] /= 2;
            axis = axis == DIM - 1 ? 0 : axis + 1;
        }
        void shrink() {
            axis = axis == 0 ? DIM - 1 : axis - 1;
            cells[axis] *= 2;
        }
    };
    // Groups are the queries of a cube about as wide as their cutoff is, of a larger one where few are, a smaller one where many are.
    int group_end(int place, int last) const {
        const int most = place + MOST_TOGETHER < last ? place + MOST_TOGETHER : last;
        const real cells = real(Bits::power_of_two(Bits::BIAS - Bits::exponent(query_reach[place - chunk])));
        Cube cube{{cells, cells, cells}, 0};
        int stop = cube_end(cube, place, most);
        for (int k = 0; k < MOST_DOUBLED && stop - place < LEAST_TOGETHER && stop < most; ++k) {
            cube.grow();
            stop = cube_end(cube, place, most);
        }
        for (int k = 0; k < MOST_HALVED && stop - place == MOST_TOGETHER; ++k) {
            cube.shrink();
            stop = cube_end(cube, place, most);
        }
        return stop;
    }
    // The place behind the last query of those before `most` that are in the cube around that at `place`, in its system, and whose
    // cutoffs are of the same class.
    int cube_end(const Cube& cube, int place, int most) const {
        real cell[3];
        for (int k = 0; k < DIM; ++k)
            cell[k] = __builtin_elementwise_floor((query_at[k][place - chunk] - shared.grid.low[k]) * cube.cells[k]);
        int stop = place;
        for (int more = LANES; stop < most && more == LANES; stop += more) {
            const int at = stop - chunk;
            vec beside{};
            for (int k = 0; k < DIM; ++k) {
                const vec there = __builtin_elementwise_floor((lanes_from(query_at[k] + at) - shared.grid.low[k]) * cube.cells[k]);
                beside += there == cell[k] ? vec{} : vec{} + 1;
            }
            more = __builtin_ctz(~mask_of(beside, real(0.5), Below{}));
        }
        for (int s = place + 1; s < stop && s < most; ++s)
            if (system_at(s) != system || this->class_of(query_reach[s - chunk]) != this->class_of(query_reach[place - chunk]))
                return s;
        return stop < most ? stop : most;
    }
    void serve(int from, int to) {
        begin = from;
        end = to;
        Box box;
        position_of(from, box.low);
        position_of(from, box.high);
        for (int place = from; place < to; ++place) {
            real q[3];
            position_of(place, q);
            widen(box.low, box.high, q, q);
            own_place[place - from] = own ? this->place_of[query_ids[place]] : NOWHERE;
        }
        own_place[to - from] = NOWHERE;
        this->begin_group();
        next_own = filled = side = 0;
        fresh = true;
        forget();
        if (system_from < system_to) {
            if constexpr (PERIODIC)
                copy_images(box);
            else
                copy_sources(box);
        }
        flush(true);
    }
};
