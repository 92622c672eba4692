// Search with a cutoff per particle on CUDA: queries one by one, one per thread. (On the CPU, `tree_walk_cpu.h` does this.)
//
// `header` holds the cells of the table along each axis (4), whether there is a table, and how many groups are in use. `cutoff`
// holds the largest cutoff and the lattice, then the largest of each group, and along each axis: the width of a top cell, how many
// of those units a cutoff of 1 reaches, and what is added to that (3 each). Where space is periodic, `axes` and `query_axes` are
// wrapped, and `positions` and `queries` hold what was given, with turns. Of a batch, the last axis of `top` is the system.
//
// What becomes of the pairs is said by the struct that derives from `Levels`, by these members:
//   State                  what is known of a query, a variable of its own, which stays in registers
//   begin_query(one)       a query begins: returns its state
//   pair(state, one, other, place, image)  the source `other` at `place` is a pair, in an image
//   end_query(state, one)  comes after its last pair
#pragma once
#include "excluded.h"
#include "lane_count.h"
#include "pair_cutoffs.h"

constexpr int TOP = DIM + BATCHED;  // axes of top cells
using Key = unsigned long long;     // a group, then the Morton key within a top cell; `keys` holds its words, the lower one first

struct LevelArguments {
    const real *positions, *queries, *axes, *radii;
    const int *ids, *keys, *top, *table, *header;
    const real *cutoff, *query_axes, *query_radii;
    const int *query_ids, *query_top, *places;
    int* info;
    int n, m, own_queries, closed, drop_self, later_only;
};

// What says who pairs with whom: exclusions (excluded.h), and of a table the cutoffs of `kinds` species with each other, row by row,
// -1 where they are no neighbors, and whose species is which. Where nobody asks for that, a thread holds none of it.
template <bool USED>
struct Pairing {
    const int *excluded_starts, *excluded;
    const real* table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    int kinds;
    template <class Arguments>
    JFRNN_INLINE explicit Pairing(const Arguments& a)
        : excluded_starts(a.excluded_starts),
          excluded(a.excluded),
          table_of_kinds(a.table_of_kinds),
          kinds_of_sources(a.kinds_of_sources),
          kinds_of_queries(a.kinds_of_queries),
          kinds(a.kinds) {}
    JFRNN_INLINE Excluded excluded_from(int query) const { return Excluded(excluded_starts, excluded, query); }
    // The cutoffs of the species of the query at a place.
    JFRNN_INLINE const real* row_of(int at) const {
        return RULE == TABLE ? table_of_kinds + (long long)kinds * kinds_of_queries[at] : nullptr;
    }
    JFRNN_INLINE real cutoff_in(const real* row, int place) const { return row[kinds_of_sources[place]]; }
};
template <>
struct Pairing<false> {
    template <class Arguments>
    JFRNN_INLINE explicit Pairing(const Arguments&) {}
    JFRNN_INLINE Excluded excluded_from(int query) const { return Excluded(nullptr, nullptr, query); }
    JFRNN_INLINE const real* row_of(int) const { return nullptr; }
    JFRNN_INLINE real cutoff_in(const real*, int) const { return 0; }
};

// A query: its place, its number, where it is, its cutoff, and the image that it meets, in lattice vectors.
struct One {
    int at, id;
    real q[3], own;
    int shift[3];
};

template <class Query>
struct Levels : LevelArguments, Pairing<EXCLUDING || RULE == TABLE>, Space {
    const int* extent;
    bool dense;
    int groups;
    const real *largest, *width, *scale, *margin;
    long long stride;
    real unit, slack;             // slack: by which distances of images may be wrong
    int codes, home, fill_value;  // of images
    int longest;

    template <class Arguments>
    JFRNN_INLINE Levels(const LevelArguments& given, const Arguments& all)
        : LevelArguments(given),
          Pairing<EXCLUDING || RULE == TABLE>(all),
          Space(given.cutoff),
          extent(header),
          dense(header[4] != 0),
          groups(header[5]),
          largest(cutoff + LATTICE_END),
          width(largest + GROUPS),
          scale(width + 3),
          margin(scale + 3),
          stride(n + PADDING),
          unit(real(Bits::unit_scale(radius))),
          slack(PERIODIC ? 2 * lattice.slack() * unit : real(0)),
          codes(1),
          longest(0) {
        for (int k = 0; PERIODIC && k < DIM; ++k)
            codes *= 2 * lattice.images(k) + 1;
        home = (codes - 1) / 2;
        fill_value = PERIODIC == 2 ? n * codes : n;
    }
    JFRNN_INLINE Query& query() { return *(Query*)this; }

    // Is a source a pair of a query, given its number, where it is, its image, and its place?
    JFRNN_INLINE bool exactly(const One& one, const real* of_kinds, int source, const real* p, int image, int place) const {
        const real own = one.own, other = RULE == GATHER || RULE == TABLE ? real(0) : radii[place];
        const real first = RULE == TABLE ? this->cutoff_in(of_kinds, place) : SUM ? own / 2 : PairCutoffs::of_pair(own, other);
        const real more = SUM ? other / 2 : real(0);
        if constexpr (PERIODIC) {
            const real *a = queries + (long long)ROW * one.id, *b = positions + (long long)ROW * source;
            return exact_image(lattice, a, b, image, first, more, closed);
        }
        return exact_pair(one.q, p, first, more, closed);
    }
    // The number of a top cell in the table.
    JFRNN_INLINE int row_major(const int* cell) const {
        int index = cell[TOP - 1];
        for (int k = TOP - 2; k >= 0; --k)
            index = index * extent[k] + cell[k];
        return index;
    }
    // The first source whose top cell is not below this one; the last axis is compared first.
    JFRNN_INLINE int first_not_below(const int* cell) const {
        int low = 0, high = n;
        while (low < high) {
            const int middle = low + (high - low) / 2;
            bool below = false;
            for (int k = 0; k < TOP; ++k) {
                const int here = top[(long long)k * n + middle];
                below = here < cell[k] || (here == cell[k] && below);
            }
            if (below)
                low = middle + 1;
            else
                high = middle;
        }
        return low;
    }
    // The first source in [low, high) whose key is not below this one.
    JFRNN_INLINE int first_key_from(Key key, int low, int high) const {
        while (low < high) {
            const int middle = low + (high - low) / 2;
            if (((const Key*)keys)[middle] < key)
                low = middle + 1;
            else
                high = middle;
        }
        return low;
    }
    // Spreads bits: bit b goes to place DIM * b.
    JFRNN_FUNCTION Key spread(Key c) {
        if constexpr (DIM == 2) {
            c = (c | c << 16) & 0x0000ffff0000ffffull;
            c = (c | c << 8) & 0x00ff00ff00ff00ffull;
            c = (c | c << 4) & 0x0f0f0f0f0f0f0f0full;
            c = (c | c << 2) & 0x3333333333333333ull;
            return (c | c << 1) & 0x5555555555555555ull;
        }
        c = (c | c << 32) & 0x001f00000000ffffull;
        c = (c | c << 16) & 0x001f0000ff0000ffull;
        c = (c | c << 8) & 0x100f00f00f00f00full;
        c = (c | c << 4) & 0x10c30c30c30c30c3ull;
        return (c | c << 2) & 0x1249249249249249ull;
    }

    // How far the cells around a query reach: where images lie close, over many of the largest cells.
    JFRNN_INLINE int reach_of(int k, int level) const {
        return PERIODIC && level == 0 && lattice.images(k) > 1 ? lattice.images(k) : 1;
    }
    // Calls `use` for each cell around a query that holds sources of a group: with its run of them, and the code of their image.
    template <class Use>
    JFRNN_INLINE void each_run(int g, int at, int level, Use use) const {
        const int shift = HALVINGS - level, mask = (1 << level) - 1;
        const int reach[3] = {reach_of(0, level), reach_of(1, level), DIM == 3 ? reach_of(2, level) : 0};
        for (int z = -reach[2]; z <= reach[2]; ++z)
            for (int y = -reach[1]; y <= reach[1]; ++y)
                for (int x = -reach[0]; x <= reach[0]; ++x) {
                    const int steps[3] = {x, y, z};
                    int around[4] = {0, 0, 0, 0}, image = 0;
                    Key key = 0;
                    bool there = true;
                    for (int k = 0; k < DIM; ++k) {
                        const int fine = (places[(long long)k * m + at] >> shift) + steps[k];
                        around[k] = query_top[(long long)k * m + at] + (fine >> level);
                        key |= spread((Key)(fine & mask)) << k;
                        if constexpr (PERIODIC) {
                            const int most = lattice.images(k), e = extent[k];
                            const int turn = most == 0 ? 0 : around[k] >= 0 ? around[k] / e : -1 - (-1 - around[k]) / e;
                            around[k] -= turn * e;
                            image = image * (2 * most + 1) + turn + most;
                            there = there && turn >= -most && turn <= most;
                        }
                    }
                    if (!there)
                        continue;
                    if constexpr (BATCHED)
                        around[DIM] = query_top[(long long)DIM * m + at];
                    int from, to;
                    if (dense) {
                        from = table[row_major(around)];
                        to = table[row_major(around) + 1];
                    } else {
                        from = first_not_below(around);
                        ++around[0];
                        to = from < n ? first_not_below(around) : from;
                    }
                    if (from == to)
                        continue;
                    key = ((Key)g << (DIM * HALVINGS)) | (key << (DIM * shift));
                    from = first_key_from(key, from, to);
                    to = first_key_from(key + ((Key)1 << (DIM * shift)), from, to);
                    if (from < to)
                        use(from, to, image);
                }
    }
    // Is a source not surely too far from a query, and is it surely a pair?
    JFRNN_INLINE bool test(const real* q, real own, const real* of_kinds, int at, bool& sure) const {
        real square = 0, r = own;
        for (int k = 0; k < DIM; ++k) {
            const real d = (axes[k * stride + at] - q[k]) * unit;
            square += d * d;
        }
        if constexpr (RULE == TABLE)
            r = this->cutoff_in(of_kinds, at);
        else if constexpr (RULE != GATHER)
            r = PairCutoffs::of_pair(own, radii[at]);
        const auto bounds = PairCutoffs::bounds_of(r * unit, PERIODIC ? slack : real(0));
        sure = square < bounds.inside;
        return square <= bounds.outside;
    }

    // Lets a query meet the sources of a run, of an image, from where it meets them at home.
    template <class State>
    JFRNN_INLINE void meet(
        State& state, const One& one, const Excluded& mine, int from, int to, int image, const real* from_where) {
        const real* const of_kinds = this->row_of(one.at);
        for (int c = from; c < to; ++c) {
            const bool itself = own_queries && c == one.at && image == home;  // its own neighbor, whatever its cutoff
            bool sure;
            if (!test(from_where, one.own, of_kinds, c, sure) && !itself)
                continue;
            const int other = ids[c];
            const bool earlier = other < one.id || (PERIODIC == 2 && other == one.id && image < home);
            if ((drop_self && itself) || (later_only && earlier))
                continue;
            bool pair = itself || sure;
            if (!pair) {
                real p[3];
                for (int k = 0; k < DIM; ++k)
                    p[k] = axes[k * stride + c];
                pair = exactly(one, of_kinds, other, p, image, c);
            }
            if (pair && !(EXCLUDING && mine.has(Excluded::id_of(other, image, n))))
                query().pair(state, one, other, c, image);
        }
    }

    // Lets the query at a place meet all its candidates, group by group; returns what is known of it then.
    JFRNN_INLINE auto serve(int at) {
        One one{at, query_ids[at], {0, 0, 0}, RULE == SCATTER ? real(0) : query_radii[at], {0, 0, 0}};
        for (int k = 0; k < DIM; ++k)
            one.q[k] = query_axes[(long long)k * m + at];
        const Excluded mine = this->excluded_from(one.id);
        typename Query::State state = query().begin_query(one);
        for (int g = 0; finite_point(one.q) && g < groups; ++g) {
            if (RULE != GATHER && largest[g] < 0)
                continue;
            const real reach = PairCutoffs::of_pair(one.own, largest[g]) * (1 + 8 * EPS);
            int level = 0;  // the finest one whose cells are wider than the reach
            for (bool fits = true; fits && level < HALVINGS; level += fits)
                for (int k = 0; k < DIM; ++k)
                    fits = fits && width[k] / real(2 << level) > reach * scale[k] + margin[k];
            if constexpr (PERIODIC) {
                each_run(g, at, level, [&](int from, int to, int image) {
                    int rest = image;
                    for (int k = DIM - 1; k >= 0; --k) {
                        const int each = 2 * lattice.images(k) + 1;
                        one.shift[k] = rest % each - lattice.images(k);
                        rest /= each;
                    }
                    real moved[3] = {0, 0, 0};  // the query goes to where it meets the image at home
                    for (int k = 0; k < DIM; ++k)
                        moved[k] = image == home
                                       ? one.q[k]
                                       : Lattice::add(one.q[k], -lattice.translation(one.shift[0], one.shift[1], one.shift[2], k));
                    meet(state, one, mine, from, to, image, moved);
                });
                continue;
            }
            each_run(g, at, level, [&](int from, int to, int) { meet(state, one, mine, from, to, home, one.q); });
        }
        query().end_query(state, one);
        return state;
    }

    JFRNN_INLINE void run() {
        const long long at = thread_index();
        if (at >= m)
            return;
        serve((int)at);
        if (longest > 0)
            atomicMax(&info[0], longest);
    }
};
