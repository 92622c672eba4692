// How sources are sorted along a curve on the CPU, and the tree of boxes around them, where cutoffs differ.
//
// Sources that follow each other along a Morton curve are near each other. LEAF of them make a leaf, FANOUT leaves a node above, and
// so on: a node is a box, and the largest cutoff in it. Where many sources share the finest cell of the curve, as those of a cluster
// do whose domain is large, they are sorted along a curve of their own, again and again: no scene is too sparse, nor too dense. Cells
// are powers of two wide, and each curve has its cells in those of the one before: what lies in a cube of such a width stands together.
#pragma once
#include "cells_cpu.h"
#include "lanes.h"
#include "pair_cutoffs.h"

constexpr int LEVELS = 12;                     // of nodes, at most
constexpr int CURVE_BITS = DIM == 3 ? 7 : 11;  // of a coordinate along a curve
constexpr int DIGIT = 11, DIGITS = 1 << DIGIT;
constexpr int KEY_DIGITS = 2;

// The scratch of a search, whether by cells or in a tree: `jfrnn.kernels.tree_cpu.scratch_words` is the sum of its parts.
struct TreeScratch : Scratch {
    real* radii_there;  // cutoffs of sources, in their order
    int* kinds_there;   // and species
    int* place_of;      // where a source stands
    real* reach_there;  // of queries, in their order: cutoffs, which say how wide a group may be
    real *node_low[3], *node_high[3], *node_radius;
    int levels, first[LEVELS + 1], nodes[LEVELS + 1];  // of each level: its first node, and how many there are

    TreeScratch(int* scratch, int n, int m, int, int table) : Scratch(scratch, n, m, 0, table) {
        constexpr int WIDTH = DOUBLE ? 2 : 1;
        int total = 0;
        levels = 0;
        for (int count = (n + LEAF - 1) / LEAF;; count = (count + FANOUT - 1) / FANOUT) {
            first[levels] = total;
            nodes[levels++] = count;
            total += (count + FANOUT - 1) / FANOUT * FANOUT;
            if (count <= FANOUT || levels == LEVELS)
                break;
        }
        radii_there = (real*)take(WIDTH * (long long)(n + LANES));
        kinds_there = take(n + LANES);
        place_of = take(n);
        reach_there = (real*)take(WIDTH * (long long)m);
        for (int k = 0; k < DIM; ++k) {
            node_low[k] = (real*)take(WIDTH * (long long)(total + LANES));
            node_high[k] = (real*)take(WIDTH * (long long)(total + LANES));
        }
        node_radius = (real*)take(WIDTH * (long long)(total + LANES));
    }
    // The exponent of a cutoff, and the first bits behind the leading one.
    static int class_of(real r) { return (int)(Bits::of(r) >> (Bits::MANTISSA - CLASS_BITS)); }
};

struct TreeSortArguments : SortArguments {
    const real *radii, *query_radii;
    const int* kinds_of_sources;

    // How wide a group around a query of an id may be: its cutoff, or what is known of it.
    real reach_of(int id) const { return RULE != SCATTER ? query_radii[id] : own ? radii[id] : cutoff[0]; }
};

struct TreePlaces : TreeSortArguments, SystemCells, TreeScratch {
    explicit TreePlaces(const TreeSortArguments& given)
        : TreeSortArguments(given),
          SystemCells(given.cutoff, given.grids, false),
          TreeScratch(given.scratch, given.n, given.m, given.own, given.table) {}

    // Puts the sources at places [from, to) in order.
    void put_in_order(int from, int to) {
        for (int place = from; place < to; ++place) {
            constexpr int AHEAD = 16;  // places
            const int i = ids[place];
            __builtin_prefetch(positions + (long long)ROW * ids[place + AHEAD < to ? place + AHEAD : place]);
            real p[3];
            enter(system_of(positions + (long long)ROW * i));
            point_of(positions + (long long)ROW * i, p);
            for (int k = 0; k < DIM; ++k)
                axis[k][place] = p[k];
            if (!(shared.cells_for > 0))
                place_of[i] = place;
            if constexpr (RULE != GATHER)
                radii_there[place] = radii[i];
            if constexpr (RULE == TABLE)
                kinds_there[place] = kinds_of_sources[i];
        }
    }
    // Makes leaves around the sources at places [from, to); `from` is the first place of one.
    void make_leaves(int from, int to) {
        const int finite = shared.grid.finite;
        for (int leaf = from / LEAF; leaf * LEAF < to; ++leaf) {
            const int begins = leaf * LEAF, ends = begins + LEAF < finite ? begins + LEAF : finite;
            begin_node(leaf);
            for (int k = 0; k < DIM; ++k) {
                vec low = vec{} + __builtin_inff(), high = -low;
                for (int place = begins; place < ends; place += LANES) {  // those behind the last one are that, again
                    vec x = lanes_from(axis[k] + (place + LANES <= ends ? place : ends - LANES > begins ? ends - LANES : begins));
                    for (int l = ends - begins; l < LANES; ++l)
                        x[l] = x[0];
                    low = x < low ? x : low;
                    high = x > high ? x : high;
                }
                node_low[k][leaf] = __builtin_reduce_min(low);
                node_high[k][leaf] = __builtin_reduce_max(high);
            }
            for (int place = begins; RULE != GATHER && place < ends; ++place)
                node_radius[leaf] = radii_there[place] > node_radius[leaf] ? radii_there[place] : node_radius[leaf];
        }
    }
    // Makes the nodes above the leaves.
    void make_nodes() {
        end_level(0);
        for (int level = 1; level < levels; ++level) {
            for (int node = 0; node < nodes[level]; ++node) {
                const int at = first[level] + node, from = first[level - 1] + node * FANOUT;
                begin_node(at);
                for (int child = from; child < from + FANOUT; ++child) {
                    for (int k = 0; k < DIM; ++k) {
                        node_low[k][at] = node_low[k][child] < node_low[k][at] ? node_low[k][child] : node_low[k][at];
                        node_high[k][at] = node_high[k][child] > node_high[k][at] ? node_high[k][child] : node_high[k][at];
                    }
                    node_radius[at] = node_radius[child] > node_radius[at] ? node_radius[child] : node_radius[at];
                }
            }
            end_level(level);
        }
    }
    void begin_node(int at) {
        for (int k = 0; k < DIM; ++k) {
            node_low[k][at] = __builtin_inff();
            node_high[k][at] = -__builtin_inff();
        }
        node_radius[at] = 0;
    }
    // Nodes without sources fill the last FANOUT of a level.
    void end_level(int level) {
        for (int node = nodes[level]; node % FANOUT; ++node)
            begin_node(first[level] + node);
    }
    // Puts many sources in order. It is launched once per thread: threads hand themselves chunks of places, and the last one to end
    // makes the nodes above the leaves.
    void gather() {
        if (shared.cells_for > 0)
            return;
        each_chunk(shared.next_gathered, n, CHUNK, [&](int from, int to, int) {
            put_in_order(from, to);
            make_leaves(from, to);
            if (__atomic_add_fetch(&shared.gathered, to - from, __ATOMIC_ACQ_REL) == n)
                make_nodes();
        });
    }
};

// Sorts along curves. One thread reads every particle a few times; `refine` alone has several.
struct TreeSort : TreePlaces {
    int histogram[DIGITS];

    explicit TreeSort(const TreeSortArguments& given) : TreePlaces(given) {}

    // Sorts sources and queries; of many sources that are queries, too, those that share a cell are left to `refine` and `end`.
    void build() {
        const int finite = sort(positions, n, ids);
        shared.grid.finite = finite;
        if (!is_shared())
            end();
    }
    void end() {
        const int finite = shared.grid.finite;
        if (own) {
            for (int k = 0; k < n; ++k)
                query_ids[k] = ids[k];
            shared.finite_queries = finite;
        } else
            shared.finite_queries = sort(queries, m, query_ids);
        sort_by_reach(shared.finite_queries);
        *bits = finite < n || shared.finite_queries < m ? 2 : 0;
        if (n < MANY && m < MANY) {
            put_in_order(0, n);
            make_leaves(0, n);
            make_nodes();
        }
    }

    bool is_shared() const { return own && n >= MANY; }
    // Sorts those that share a cell, by several threads.
    void refine() {
        const int* const begins = counts;
        if (is_shared() && shared.scale > 0)
            each_chunk(shared.next_refined, n, CHUNK, [&](int, int, int chunk) {
                arrange_cells(positions, ids, begins[chunk], begins[chunk + 1], shared.corner, shared.scale);
            });
    }
    // Says with which cell each chunk of `refine` begins.
    void share(int finite, const double* corner, double scale) {
        for (int k = 0; k < DIM; ++k)
            shared.corner[k] = corner[k];
        shared.scale = scale;
        shared.next_refined = 0;
        for (int chunk = 0, place = 0; chunk <= (n - 1) / CHUNK + 1; ++chunk) {
            place = place > chunk * CHUNK ? place : chunk * CHUNK < finite ? chunk * CHUNK : finite;
            while (place > 0 && place < finite && key[place] == key[place - 1] && same_system(positions, ids, place - 1, place))
                ++place;
            counts[chunk] = place;
        }
    }

    // Sorts points by system, then along a curve; those that are not finite come last. Returns how many are finite.
    int sort(const real* points, int count, int* to) {
        int finite = 0, behind = count;
        for (int i = 0; i < count; ++i) {
            real p[3];
            point_of(points + (long long)ROW * i, p);
            if (finite_point(p))
                to[finite++] = i;
            else
                to[--behind] = i;
        }
        double low[3], high[3];
        const double widest = find_box(points, to, 0, finite, low, high);
        for (int k = 0; k < DIM; ++k)
            shared.grid.low[k] = finite ? real(2 * low[k]) : real(0);
        const double scale = widest > 0 ? Bits::power_of_two(CURVE_BITS - 1 - exponent_of(widest)) : 0;
        if (scale > 0 && scale < __builtin_inf())
            arrange(points, to, 0, finite, low, scale, true);
        else if (BATCHED)
            sort_by_system(points, to, 0, finite);
        return finite;
    }
    static int exponent_of(double x) {
        unsigned long long bits;
        memcpy(&bits, &x, 8);
        return (int)(bits >> 52 & 0x7ff) - 1023;
    }
    // The box around the points [from, to) of `at`, in halves of lengths: differences of floats may be infinite. Returns its width.
    double find_box(const real* points, const int* at, int from, int to, double* low, double* high) const {
        double widest = 0;
        for (int k = 0; k < DIM; ++k) {
            low[k] = __builtin_inf();
            high[k] = -__builtin_inf();
        }
        for (int i = from; i < to; ++i) {
            real p[3];
            point_of(points + (long long)ROW * at[i], p);
            for (int k = 0; k < DIM; ++k) {
                low[k] = 0.5 * p[k] < low[k] ? 0.5 * p[k] : low[k];
                high[k] = 0.5 * p[k] > high[k] ? 0.5 * p[k] : high[k];
            }
        }
        for (int k = 0; k < DIM; ++k)
            widest = high[k] - low[k] > widest ? high[k] - low[k] : widest;
        return widest;
    }
    // Sorts the points [from, to) of `at` along the curve through cells from a corner on, `scale` per length; then those in each cell.
    void arrange(const real* points, int* at, int from, int to, const double* corner, double scale, bool first) {
        const double most = (1 << CURVE_BITS) - 1;
        unsigned int* const keys = (unsigned int*)key;
        for (int i = from; i < to; ++i) {
            real p[3];
            point_of(points + (long long)ROW * at[i], p);
            unsigned int code = 0;
            for (int k = 0; k < DIM; ++k) {
                const double cell = (0.5 * p[k] - corner[k]) * scale;
                code |= spread((unsigned int)(cell < most ? cell > 0 ? cell : 0 : most)) << k;
            }
            keys[i] = code;
        }
        sort_by_key(at, from, to);
        if (BATCHED && first)
            sort_by_system(points, at, from, to);
        if (first && is_shared())
            share(to, corner, scale);
        else
            arrange_cells(points, at, from, to, corner, scale);
    }
    // Sorts the points [from, to) of `at` that share a cell; `key` tells which do.
    JFRNN_APART void arrange_cells(const real* points, int* at, int from, int to, const double* corner, double scale) {
        const unsigned int* const keys = (const unsigned int*)key;
        for (int begin = from, end; begin < to; begin = end) {
            for (end = begin + 1; end < to && keys[end] == keys[begin] && same_system(points, at, begin, end);)
                ++end;
            if (end - begin > 2 * LEAF)
                arrange_cell(points, at, begin, end, corner, scale);
        }
    }
    // Sorts the points of a cell along a curve through smaller ones, the widest that are not all in one.
    void arrange_cell(const real* points, int* at, int from, int to, const double* corner, double scale) {
        double low[3], high[3], inside[3];
        if (!(find_box(points, at, from, to, low, high) > 0))
            return;  // they are in one place
        for (int k = 0; k < DIM; ++k)
            inside[k] = corner[k];
        for (bool one = true; one;) {
            double begins[3];
            for (int k = 0; k < DIM; ++k) {
                begins[k] = __builtin_floor((low[k] - inside[k]) * scale);
                inside[k] += begins[k] / scale;
            }
            scale *= 1 << CURVE_BITS;
            if (!(scale < 0x1p900))
                return;
            for (int k = 0; k < DIM; ++k)
                one = one && __builtin_floor((low[k] - inside[k]) * scale) == __builtin_floor((high[k] - inside[k]) * scale);
        }
        arrange(points, at, from, to, inside, scale, false);
    }
    bool same_system(const real* points, const int* at, int a, int b) const {
        return !BATCHED || system_of(points + (long long)ROW * at[a]) == system_of(points + (long long)ROW * at[b]);
    }
    // Spreads bits: bit b goes to place DIM * b.
    static unsigned int spread(unsigned int x) {
        if constexpr (DIM == 3) {
            x = (x | x << 16) & 0x030000ff;
            x = (x | x << 8) & 0x0300f00f;
            x = (x | x << 4) & 0x030c30c3;
            return (x | x << 2) & 0x09249249;
        }
        x = (x | x << 8) & 0x00ff00ff;
        x = (x | x << 4) & 0x0f0f0f0f;
        x = (x | x << 2) & 0x33333333;
        return (x | x << 1) & 0x55555555;
    }

    // Sorts [from, to) of `at` by `key`, digit by digit; equal keys stay in order.
    void sort_by_key(int* at, int from, int to) {
        unsigned int* const keys = (unsigned int*)key;
        if (to - from <= 64) {
            for (int i = from + 1; i < to; ++i) {
                const unsigned int code = keys[i];
                const int id = at[i];
                int place = i;
                for (; place > from && keys[place - 1] > code; --place) {
                    keys[place] = keys[place - 1];
                    at[place] = at[place - 1];
                }
                keys[place] = code;
                at[place] = id;
            }
            return;
        }
        int *read = key, *write = others, *ids_read = at, *ids_written = order;
        for (int d = 0; d < KEY_DIGITS; ++d) {
            auto digit = [&](int i) { return (unsigned int)read[i] >> (DIGIT * d) & (DIGITS - 1); };
            if (!deal(ids_read, read, ids_written, write, from, to, digit))
                continue;
            int *const swapped = read, *const swapped_ids = ids_read;
            read = write;
            write = swapped;
            ids_read = ids_written;
            ids_written = swapped_ids;
        }
        if (read != key)
            take_back(at, from, to);
    }
    // Sorts [from, to) of `at` by numbers below DIGITS that `number_of` gives; what is equal stays in order, and so do the keys.
    template <class Number>
    void sort_by_number(int* at, int from, int to, Number number_of) {
        if (deal(at, key, order, others, from, to, [&](int i) { return number_of(at[i]); }))
            take_back(at, from, to);
    }
    // Writes ids and keys of the places [from, to) in the order of numbers below DIGITS, those of places; what is equal stays in order.
    // Returns false, and writes nothing, where all are equal.
    template <class Number>
    bool deal(const int* ids_read, const int* read, int* ids_written, int* write, int from, int to, Number number_of) {
        memset(histogram, 0, sizeof histogram);
        for (int i = from; i < to; ++i)
            ++histogram[number_of(i)];
        if (from == to || histogram[number_of(from)] == to - from)
            return false;
        for (int c = 0, place = from; c < DIGITS; ++c) {
            const int count = histogram[c];
            histogram[c] = place;
            place += count;
        }
        for (int i = from; i < to; ++i) {
            const int place = histogram[number_of(i)]++;
            ids_written[place] = ids_read[i];
            write[place] = read[i];
        }
        return true;
    }
    void take_back(int* at, int from, int to) {
        for (int i = from; i < to; ++i) {
            at[i] = order[i];
            key[i] = others[i];
        }
    }
    void sort_by_system(const real* points, int* at, int from, int to) {
        for (int shift = 0; shift < 32 && last_system >> shift; shift += DIGIT)
            sort_by_number(
                at, from, to, [&](int i) { return (int)(system_of(points + (long long)ROW * i) >> shift & (DIGITS - 1)); });
    }
    // Brings queries together whose cutoffs are alike: they meet the same sources.
    void sort_by_reach(int finite) {
        const int largest = class_of(radius);
        sort_by_number(query_ids, 0, finite, [&](int i) {
            const int below = largest - class_of(reach_of(i));
            return below < 0 ? 0 : below < DIGITS ? below : DIGITS - 1;
        });
        if constexpr (BATCHED)
            sort_by_system(queries, query_ids, 0, finite);
        for (int place = 0; place < finite; ++place)
            reach_there[place] = reach_of(query_ids[place]);
    }
};
