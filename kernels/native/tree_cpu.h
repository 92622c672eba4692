// How sources are sorted along a curve on the CPU, and the tree of boxes around them, where cutoffs differ.
//
// Sources that follow each other along a Morton curve are near each other. LEAF of them make a leaf, FANOUT leaves a node above, and
// so on: a node is a box, and the largest cutoff in it. Where many sources share the finest cell of the curve, as those of a cluster
// do whose domain is large, they are sorted along a curve of their own, again and again: no scene is too sparse, nor too dense.
#pragma once
#include "cells_cpu.h"
#include "lane_count.h"
#include "pair_cutoffs.h"

constexpr int LEVELS = 12;                      // of nodes, at most
constexpr int CURVE_BITS = DIM == 3 ? 10 : 16;  // of a coordinate along the curve
constexpr int DIGIT = 11, DIGITS = 1 << DIGIT;

// The scratch of a search: `jfrnn.kernels.tree_cpu.scratch_words` is the sum of its parts.
struct TreeScratch : Scratch {
    real* radii_there;  // cutoffs of sources, in their order
    int* kinds_there;   // and species
    real *node_low[3], *node_high[3], *node_radius;
    int *others, *order;                               // numbers, while they are sorted
    int levels, first[LEVELS + 1], nodes[LEVELS + 1];  // of each level: its first node, and how many there are

    TreeScratch(int* scratch, int n, int m, int, int) : Scratch(scratch, n, m, 0, 0) {
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
        for (int k = 0; k < DIM; ++k) {
            node_low[k] = (real*)take(WIDTH * (long long)(total + LANES));
            node_high[k] = (real*)take(WIDTH * (long long)(total + LANES));
        }
        node_radius = (real*)take(WIDTH * (long long)(total + LANES));
        others = take(n > m ? n : m);
        order = take(n > m ? n : m);
    }
};

struct TreeSortArguments {
    const real *positions, *queries, *cutoff, *radii, *query_radii;
    const int* kinds_of_sources;
    int *info, *scratch;
    int n, m, own;
};

// One thread, which reads every particle a few times.
struct TreeSort : TreeSortArguments, Cells, TreeScratch {
    int histogram[3][DIGITS];

    explicit TreeSort(const TreeSortArguments& given)
        : TreeSortArguments(given), Cells(given.cutoff, false), TreeScratch(given.scratch, given.n, given.m, 0, 0) {}

    void build() {
        shared.next_chunk = shared.next_gathered = shared.next_sorted = 0;
        shared.unit = 0;
        info[0] = 0;
        const int finite = sort(positions, n, ids);
        shared.grid.finite = finite;
        if (own) {
            for (int k = 0; k < n; ++k)
                query_ids[k] = ids[k];
            shared.finite_queries = finite;
        } else
            shared.finite_queries = sort(queries, m, query_ids);
        if constexpr (RULE != SCATTER)
            sort_by_radius(shared.finite_queries);
        info[1] = finite < n || shared.finite_queries < m ? 2 : 0;
        put_in_order();
        make_leaves(finite);
        for (int level = 1; level < levels; ++level)
            make_nodes(level);
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
        arrange(points, to, 0, finite, 0);
        return finite;
    }
    // Sorts the points [from, to) of `at` along a curve, which is as long as their box is wide.
    void arrange(const real* points, int* at, int from, int to, int depth) {
        double low[3], high[3], widest = 0;
        for (int k = 0; k < DIM; ++k) {
            low[k] = __builtin_inf();
            high[k] = -__builtin_inf();
        }
        for (int i = from; i < to; ++i) {
            real p[3];
            point_of(points + (long long)ROW * at[i], p);
            for (int k = 0; k < DIM; ++k) {
                low[k] = 0.5 * p[k] < low[k] ? 0.5 * p[k] : low[k];  // halved: differences of floats may be infinite
                high[k] = 0.5 * p[k] > high[k] ? 0.5 * p[k] : high[k];
            }
        }
        for (int k = 0; k < DIM; ++k)
            widest = high[k] - low[k] > widest ? high[k] - low[k] : widest;
        const double scale = (1 << CURVE_BITS) / widest;
        if (!(widest > 0 && scale < __builtin_inf() && depth < 64)) {  // they are in one place
            if constexpr (BATCHED)
                if (depth == 0)
                    sort_by_system(points, at, from, to);
            return;
        }
        unsigned int* const keys = (unsigned int*)key;
        for (int i = from; i < to; ++i) {
            real p[3];
            point_of(points + (long long)ROW * at[i], p);
            unsigned int code = 0;
            for (int k = 0; k < DIM; ++k) {
                const double cell = (0.5 * p[k] - low[k]) * scale;
                const unsigned int most = (1u << CURVE_BITS) - 1, c = (unsigned int)cell;
                code |= spread(c < most ? c : most) << k;
            }
            keys[i] = code;
        }
        sort_by_key(at, from, to);
        if constexpr (BATCHED)
            if (depth == 0)
                sort_by_system(points, at, from, to);
        for (int begin = from, end; begin < to; begin = end) {  // those that share a cell
            for (end = begin + 1; end < to && keys[end] == keys[begin] && same_system(points, at, begin, end);)
                ++end;
            if (end - begin > 2 * LEAF)
                arrange(points, at, begin, end, depth + 1);
        }
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
        memset(histogram, 0, sizeof histogram);
        for (int i = from; i < to; ++i)
            for (int d = 0; d < 3; ++d)
                ++histogram[d][keys[i] >> (DIGIT * d) & (DIGITS - 1)];
        unsigned int *read = keys, *write = (unsigned int*)others;
        int *ids_read = at, *ids_written = order;
        for (int d = 0; d < 3; ++d) {
            if (histogram[d][read[from] >> (DIGIT * d) & (DIGITS - 1)] == to - from)
                continue;
            for (int c = 0, place = from; c < DIGITS; ++c) {
                const int count = histogram[d][c];
                histogram[d][c] = place;
                place += count;
            }
            for (int i = from; i < to; ++i) {
                const int place = histogram[d][read[i] >> (DIGIT * d) & (DIGITS - 1)]++;
                write[place] = read[i];
                ids_written[place] = ids_read[i];
            }
            unsigned int* const swapped = read;
            read = write;
            write = swapped;
            int* const swapped_ids = ids_read;
            ids_read = ids_written;
            ids_written = swapped_ids;
        }
        if (read != keys)
            for (int i = from; i < to; ++i) {
                keys[i] = read[i];
                at[i] = ids_read[i];
            }
    }
    // Sorts [from, to) of `at` by numbers below DIGITS that `number_of` gives; what is equal stays in order, and so do the keys.
    template <class Number>
    void sort_by_number(int* at, int from, int to, Number number_of) {
        memset(histogram[0], 0, sizeof histogram[0]);
        for (int i = from; i < to; ++i)
            ++histogram[0][number_of(at[i])];
        if (from < to && histogram[0][number_of(at[from])] == to - from)
            return;
        for (int c = 0, place = from; c < DIGITS; ++c) {
            const int count = histogram[0][c];
            histogram[0][c] = place;
            place += count;
        }
        for (int i = from; i < to; ++i) {
            const int place = histogram[0][number_of(at[i])]++;
            order[place] = at[i];
            others[place] = key[i];
        }
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
    void sort_by_radius(int finite) {
        const int largest = class_of(radius);
        sort_by_number(query_ids, 0, finite, [&](int i) {
            const int below = largest - class_of(query_radii[i]);
            return below < 0 ? 0 : below < DIGITS ? below : DIGITS - 1;
        });
        if constexpr (BATCHED)
            sort_by_system(queries, query_ids, 0, finite);
    }
    // The exponent of a cutoff, and the first bits behind the leading one.
    static int class_of(real r) { return (int)(Bits::of(r) >> (Bits::MANTISSA - CLASS_BITS)); }

    void put_in_order() {
        for (int place = 0; place < n; ++place) {
            const int i = ids[place];
            real p[3];
            point_of(positions + (long long)ROW * i, p);
            for (int k = 0; k < DIM; ++k)
                axis[k][place] = p[k];
            if constexpr (RULE != GATHER)
                radii_there[place] = radii[i];
            if constexpr (RULE == TABLE)
                kinds_there[place] = kinds_of_sources[i];
        }
    }
    void make_leaves(int finite) {
        for (int leaf = 0; leaf < nodes[0]; ++leaf) {
            const int from = leaf * LEAF, to = from + LEAF < finite ? from + LEAF : finite;
            begin_node(leaf);
            for (int place = from; place < to; ++place)
                for (int k = 0; k < DIM; ++k) {
                    const real x = axis[k][place];
                    node_low[k][leaf] = x < node_low[k][leaf] ? x : node_low[k][leaf];
                    node_high[k][leaf] = x > node_high[k][leaf] ? x : node_high[k][leaf];
                }
            for (int place = from; RULE != GATHER && place < to; ++place)
                node_radius[leaf] = radii_there[place] > node_radius[leaf] ? radii_there[place] : node_radius[leaf];
        }
        end_level(0);
    }
    void make_nodes(int level) {
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
};
typedef TreeScratch SourcePlaces;
