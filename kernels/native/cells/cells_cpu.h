// How sources (and queries, if they are others) are sorted by cell on the CPU, and where things lie in the scratch meanwhile.
//
// One thread sorts few by counting. Many are sorted by all threads, in three steps, in each of which threads hand themselves parts:
// chunks of particles find their cells (`find_keys`), and go to buckets of cells that follow each other (`deal`); buckets, each of
// which fits into a cache, are sorted by counting (`settle`). The order is the same either way: particles of a cell keep theirs.
#pragma once
#include "cells.h"
#include "chunks.h"

constexpr int BUCKETS = 256;        // of cells, as in jfrnn/kernels/cells_cpu.py; one more is for particles that are not finite
constexpr int SAMPLED = 256;        // cutoffs, and coordinates, that tell what is typical
constexpr int MOST_OUTSIDE = 4096;  // sources outside of the box of cells, where a box of all would be too large

// Parts that threads have taken of each step of a sort, and how many chunks of particles have found their cells.
struct Hands {
    int finding, dealing, settling, found;
};
struct Shared {
    Grid grid;
    int finite_queries;
    int next_chunk;
    int next_gathered, next_sorted;  // chunks of sources that are put in order, and of their values
    int gathered;                    // sources that have been
    Hands hands[2];                  // for sources, and for queries
    int bucket_bits;                 // of a cell's number, below those of its bucket's
    int low_bit, minus_high;         // the lowest bit of all coordinates, and the largest exponent, negated
    int turned;                      // of a periodic box: 0 if all particles lie in its cell, 1 if in those beside it, else 2
    real unit;                       // of the lattice on which all coordinates lie, or 0
    int next_refined;                // chunks of places whose cells are sorted along curves of their own
    double corner[3], scale;         // of these cells: where the first one begins, and how many per length, 0: there are none
    real cells_for;                  // where cutoffs differ: that for which cells are wide, or 0: sources stand in a tree
};

// The scratch of a search: `jfrnn.kernels.cells_cpu.scratch_words` is the sum of its parts.
struct Scratch {
    Shared& shared;
    real* axis[3];           // coordinates of sources, in the order of cells
    int *ids, *start, *key;  // sources in the order of cells, first places of cells, cells of particles
    int* counts;             // of many particles: how many each chunk has for each bucket, then where the next one goes
    int *query_ids, *query_start;
    int *others, *order;  // keys and numbers, while queries are sorted
    int* cursor;

    Scratch(int* scratch, int n, int m, int own, int table) : shared(*(Shared*)scratch), cursor(scratch + up(64)) {
        constexpr int WIDTH = DOUBLE ? 2 : 1;
        for (int k = 0; k < DIM; ++k)
            axis[k] = (real*)take(WIDTH * (long long)n);
        ids = take(n);
        start = take(table + 2);
        const int most = n > m ? n : m;
        key = take(most);
        counts = take(most < MANY ? 0 : (BUCKETS + 1) * ((most + SORT_CHUNK - 1ll) / SORT_CHUNK));
        query_ids = own ? ids : take(m);
        query_start = own ? start : take(table + 2);
        others = own ? nullptr : take(most);
        order = own ? nullptr : take(most);
    }
    static long long up(long long words) { return (words + 15) & ~15ll; }
    int* take(long long words) {
        int* here = cursor;
        cursor += up(words);
        return here;
    }
};

// A system with a box of its own (BOXES): its grid, the highest coordinates of its sources, how many these are, and its first cell
// among those of all systems.
struct SystemGrid {
    Grid grid;
    real high[3];
    int sources, first_cell;
};
static_assert(sizeof(SystemGrid) <= 4 * (6 * (DOUBLE ? 2 : 1) + 10), "`grid_words` of jfrnn/kernels/cells_cpu.py");
static_assert(sizeof(Shared) <= 4 * 64, "the head of a scratch");
// The cells of one system at a time, where each has a box of its own. `cutoff` then holds numbers of each of them.
struct SystemCells : Cells {
    const real* const of_systems;
    SystemGrid* const grid_of;
    unsigned int here;  // the system whose cells these are

    SystemCells(const real* cutoff, int* grids, bool one_cell)
        : Cells(cutoff, one_cell && !BOXES), of_systems(cutoff), grid_of((SystemGrid*)grids), here(~0u) {}
    // Goes to the cells of a system. Returns whether it is another one.
    bool enter(unsigned int system) {
        if (!BOXES || system == here)
            return false;
        here = system;
        lattice = Lattice(of_systems + (LATTICE_END + 1ll) * system);
        measure_cells();
        for (int k = 0; k < DIM; ++k)  // where the cutoff is almost nothing, one cell is as good as many
            inverse_edge[k] = Bits::finite(inverse_edge[k]) ? inverse_edge[k] : real(0);
        return true;
    }
    int first_cell() const { return BOXES ? grid_of[here].first_cell : 0; }
};

struct Places : SystemCells, Scratch {
    template <class Arguments>
    explicit Places(const Arguments& a)
        : SystemCells(a.cutoff, a.grids, a.n <= FEW), Scratch(a.scratch, a.n, a.m, a.own, a.table) {}
    void put_coordinates(const real* points, int i, int place) {
        real p[3];
        enter(system_of(points + (long long)ROW * i));
        point_of(points + (long long)ROW * i, p);
        for (int k = 0; k < DIM; ++k)
            axis[k][place] = p[k];
    }
};

struct SortArguments {
    const real *positions, *queries, *cutoff;
    int *longest, *bits, *scratch, *grids;
    int n, m, own, table, of_queries;
};

// What is sorted: points, in rows; where their order and the first places of cells go, and keys and numbers of those that are dealt.
struct Sorted {
    const real* rows;
    int count;
    int *first, *order, *keys, *numbers;
    int stride;  // of both
    Hands& hands;
};

// `build` is of one thread, which sorts few. Of many it says where cells are, and `find_keys`, `deal` and `settle` follow.
struct Sort : SortArguments, Places {
    explicit Sort(const SortArguments& given) : SortArguments(given), Places(given) {}
    bool many() const { return n >= MANY || m >= MANY; }

    void build() {
        lay_out_cells();
        if (many())
            return;
        note_bits(positions, 0, n);
        if (!own)
            note_bits(queries, 0, m);
        find_unit();
        sort_few();
        put_in_order(0, n);
    }
    // Says where cells are.
    void lay_out_cells() {
        Grid grid;
        if constexpr (BOXES)
            lay_out_boxes(grid);
        else {
            real low[3], high[3];
            if (find_bounds(low, high) == 0)
                for (int k = 0; k < DIM; ++k)
                    low[k] = high[k] = 0;
            lay_out(grid, low, high, table);
            if (!grid.dense && !one_cell && n > 0)
                leave_out_few(grid, low, high);
        }
        begin(grid);
    }
    // Writes what is known before a sort, and zeros to what is counted.
    void begin(const Grid& grid) {
        *bits = 0;
        if (longest)  // of a sum there is none
            *longest = 0;
        note_turns();
        shared.next_chunk = shared.next_gathered = shared.next_sorted = shared.gathered = 0;
        shared.hands[0] = shared.hands[1] = Hands{};
        shared.low_bit = 1 << 20;
        shared.minus_high = 0;
        shared.grid = grid;
        shared.unit = 0;
        shared.scale = 0;
        shared.bucket_bits = 0;
        while (grid.cells > (long long)BUCKETS << shared.bucket_bits)
            ++shared.bucket_bits;
    }
    // Sorts sources and queries, where there are few.
    void sort_few() {
        Grid& grid = shared.grid;
        grid.finite = sort(grid, positions, n, start, ids);
        shared.finite_queries = own ? grid.finite : sort(grid, queries, m, query_start, query_ids);
        *bits = grid.finite < n || shared.finite_queries < m ? 2 : 0;
    }

    // Finds the bounds of all sources with finite coordinates, and returns how many these are. Where the whole box is periodic, the
    // cells are those of the box, wherever the particles are: then nothing is looked at.
    int find_bounds(real* low, real* high) const {
        for (int k = 0; k < DIM; ++k) {
            low[k] = __builtin_inff();
            high[k] = -__builtin_inff();
        }
        int finite = 0;
        const bool bounded = periodic_axes == (1 << DIM) - 1;
        for (int i = 0; i < n && !bounded; ++i) {
            real p[3], at[3];
            point_of(positions + (long long)ROW * i, p);
            if (!finite_point(p))
                continue;
            ++finite;
            for (int k = 0; k < DIM; ++k)
                at[k] = coordinate(k, p);
            widen(low, high, at, at);
        }
        return finite;
    }

    // Samples up to SAMPLED values, given by their numbers below `count`, and sorts them; NaN is left out. Returns how many there are.
    template <class Value>
    static int sample(int count, real* sampled, Value value_of) {
        int found = 0;
        for (int i = 0, step = (count - 1) / SAMPLED + 1; i < count; i += step) {
            const real value = value_of(i);
            int place = found;
            found += value == value;
            for (; value == value && place > 0 && sampled[place - 1] > value; --place)
                sampled[place] = sampled[place - 1];
            if (value == value)
                sampled[place] = value;
        }
        return found;
    }
    // Narrows the box around all sources, where a few lie far away from the others: these are sorted into cells of its border.
    void narrow(real* low, real* high) const {
        for (int k = 0; k < DIM; ++k) {
            real x[SAMPLED], p[3];
            const int count = sample(n, x, [&](int i) {
                point_of(positions + (long long)ROW * i, p);
                return finite_point(p) ? coordinate(k, p) : Bits::no_number();
            });
            const int few = count / 64;
            if (is_periodic(k) || few == 0)
                continue;
            const real first = x[few], last = x[count - 1 - few], beside = (last / 2 - first / 2) / 4;
            low[k] = first - beside > low[k] ? first - beside : low[k];
            high[k] = last + beside < high[k] ? last + beside : high[k];
        }
    }
    // Lays out a dense box without the few sources that are far from all others, if there is one: these are sorted into its border.
    void leave_out_few(Grid& grid, real* low, real* high) const {
        Grid smaller;
        narrow(low, high);
        lay_out(smaller, low, high, table);
        int outside = 0;
        for (int i = 0; smaller.dense && i < n; ++i) {
            real p[3];
            point_of(positions + (long long)ROW * i, p);
            bool is_outside = false;
            for (int k = 0; k < DIM && finite_point(p); ++k) {
                const whole cell = axis_cell(smaller, k, coordinate(k, p));
                is_outside |= cell < 0 || cell >= smaller.extent[k];
            }
            outside += is_outside;
        }
        if (!smaller.dense || outside > MOST_OUTSIDE || outside > n / 64)
            return;
        smaller.more = 1;
        grid = smaller;
    }

    // The table of a system has at least so many entries: rows of cells are no longer than half of that, and share entries at one end.
    static constexpr int ENTRIES = 16;  // as in jfrnn/kernels/cells_cpu.py
    // Lays out the cells of each system, whose box is its own: those of one follow those of the one before it.
    void lay_out_boxes(Grid& grid) {
        for (unsigned int s = 0; s <= last_system; ++s) {
            grid_of[s].sources = 0;
            for (int k = 0; k < DIM; ++k) {
                grid_of[s].grid.low[k] = __builtin_inff();
                grid_of[s].high[k] = -__builtin_inff();
            }
        }
        for (int i = 0; i < n; ++i) {
            const real* const row = positions + (long long)ROW * i;
            SystemGrid& of = grid_of[system_of(row)];
            real p[3], at[3];
            enter(system_of(row));
            point_of(row, p);
            if (!finite_point(p))
                continue;
            ++of.sources;
            for (int k = 0; k < DIM; ++k)
                at[k] = coordinate(k, p);
            widen(of.grid.low, of.high, at, at);
        }
        grid.cells = 0;
        grid.dense = 1;
        for (unsigned int s = 0; s <= last_system; ++s) {
            SystemGrid& of = grid_of[s];
            real low[3];
            enter(s);
            for (int k = 0; k < DIM; ++k) {
                low[k] = of.sources ? of.grid.low[k] : real(0);
                of.high[k] = of.sources ? of.high[k] : real(0);
            }
            lay_out(of.grid, low, of.high, ENTRIES + 4 * of.sources);
            of.first_cell = grid.cells;
            grid.cells += of.grid.cells;
        }
    }

    // Notes the lowest bit and the largest exponent of the coordinates of [from, to), as they were given. Whatever lies on no lattice
    // shows soon: then no more are looked at, by any thread; nor are any where there is more than one cutoff, or lattice.
    static constexpr bool MAY_HAVE_UNIT = !DIFFER && !BOXES;
    JFRNN_APART void note_bits(const real* points, int from, int to) {
        if constexpr (!MAY_HAVE_UNIT)
            return;
        int lowest = __atomic_load_n(&shared.low_bit, __ATOMIC_RELAXED), highest = 0;
        const int too_low = Bits::exponent(radius) - Bits::BIAS - UNITS;
        for (int i = from; i < to && lowest >= too_low; ++i) {
            const real* row = points + (long long)ROW * i;
            if (!finite_point(row))
                continue;
            for (int k = 0; k < DIM; ++k) {
                const int low_bit = lowest_bit(row[k]), exponent = Bits::exponent(row[k]);
                lowest = low_bit < lowest ? low_bit : lowest;
                highest = exponent > highest ? exponent : highest;
            }
        }
        lower(shared.low_bit, lowest);
        lower(shared.minus_high, -highest);
    }
    static void lower(int& least, int value) {
        int there = __atomic_load_n(&least, __ATOMIC_RELAXED);
        while (value < there && !__atomic_compare_exchange_n(&least, &there, value, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
    }
    void find_unit() { shared.unit = MAY_HAVE_UNIT ? lattice_unit(shared.low_bit, -shared.minus_high) : real(0); }

    // The cell of a point, -1 if it is not finite.
    int key_of(const Grid& grid, const real* row) {
        real p[3];
        enter(system_of(row));
        point_of(row, p);
        const Grid& there = BOXES ? grid_of[here].grid : grid;
        return finite_point(p) ? first_cell() + cell_key(there, p, system_of(row)) : -1;
    }
    // Finds the keys of the points [from, to).
    JFRNN_APART void find_keys_of(const Grid& given, const real* points, int from, int to) {
        const Grid grid = given;  // stays in registers, whatever is stored, and so does `key`
        int* const key = this->key;
        for (int i = from; i < to; ++i)
            key[i] = key_of(grid, points + (long long)ROW * i);
    }
    // Sorts few points by cell into `order`, with the first place of each cell in `first`; points that are not finite come last. Returns
    // how many are finite.
    int sort(const Grid& grid, const real* points, int count, int* first, int* order) {
        int* const key = this->key;  // stays in a register, whatever is stored
        const int cells = grid.cells;
        for (int c = 0; c < cells + 2; ++c)
            first[c] = 0;
        find_keys_of(grid, points, 0, count);
        for (int i = 0; i < count; ++i)
            if (key[i] >= 0)
                ++first[key[i] + 2];
        for (int c = 2; c < cells + 2; ++c)
            first[c] += first[c - 1];
        const int finite = first[cells + 1];
        for (int i = 0, behind = finite; i < count; ++i)
            order[key[i] >= 0 ? first[key[i] + 1]++ : behind++] = i;
        return finite;
    }
    // Notes how far away from the cell any particle lies.
    void note_turns() {
        const real most = lattice.most_turns();
        shared.turned = most < 2 ? (int)most : 2;
    }

    // --- many, by several threads: each step is launched once per thread ---

    // What is sorted, sources or queries. While sources are dealt, their keys and numbers lie where their coordinates will.
    Sorted sorted() {
        if (of_queries)
            return {queries, m, query_start, query_ids, others, order, 1, shared.hands[1]};
        return {positions, n, start, ids, (int*)axis[0], (int*)axis[1], DOUBLE ? 2 : 1, shared.hands[0]};
    }
    int bucket_of(int key) const { return key < 0 ? BUCKETS : key >> shared.bucket_bits; }
    static int chunks(int count) { return count ? (count - 1) / SORT_CHUNK + 1 : 1; }

    void find_keys() {
        const Sorted points = sorted();
        const int count = points.count ? points.count : 1;  // where there are no points, an empty chunk is counted, too
        each_chunk(points.hands.finding, count, SORT_CHUNK, [&](int from, int to, int chunk) {
            int* const counts = this->counts + (BUCKETS + 1) * chunk;
            to = to < points.count ? to : points.count;
            for (int b = 0; b <= BUCKETS; ++b)
                counts[b] = 0;
            find_keys_of(shared.grid, points.rows, from, to);
            for (int i = from; i < to; ++i)
                ++counts[bucket_of(key[i])];
            note_bits(points.rows, from, to);
            if (__atomic_add_fetch(&points.hands.found, 1, __ATOMIC_ACQ_REL) == chunks(points.count))
                add_up(points);
        });
    }
    // Finds where the first point goes that each chunk has for each bucket, and what is known once all have been looked at.
    void add_up(const Sorted& points) {
        int next[BUCKETS + 1] = {}, *const end = counts + (BUCKETS + 1) * chunks(points.count);
        for (int* of = counts; of < end; of += BUCKETS + 1)
            for (int b = 0; b <= BUCKETS; ++b)
                next[b] += of[b];
        for (int b = 0, place = 0; b <= BUCKETS; ++b) {
            const int there = next[b];
            next[b] = place;
            place += there;
        }
        const int finite = next[BUCKETS];
        for (int* of = counts; of < end; of += BUCKETS + 1)
            for (int b = 0; b <= BUCKETS; ++b) {
                const int there = of[b];
                of[b] = next[b];
                next[b] += there;
            }
        points.first[shared.grid.cells] = finite;
        if (!of_queries)
            shared.grid.finite = finite;
        if (of_queries || own)
            shared.finite_queries = finite;
        if (finite < points.count)
            *bits = 2;
        find_unit();
    }
    void deal() {
        const Sorted points = sorted();
        each_chunk(points.hands.dealing, points.count, SORT_CHUNK, [&](int from, int to, int chunk) {
            int* const next = counts + (BUCKETS + 1) * chunk;
            for (int i = from; i < to; ++i) {
                const long long place = next[bucket_of(key[i])]++;
                points.keys[points.stride * place] = key[i];
                points.numbers[points.stride * place] = i;
            }
        });
    }
    void settle() {
        settle([&](int from, int to) { put_in_order(from, to); });
    }
    // Puts the coordinates of the sources at the places [from, to) there.
    JFRNN_APART void put_in_order(int from, int to) {
        for (int place = from; place < to; ++place) {
            constexpr int AHEAD = 16;  // places: reading from anywhere is what takes time
            __builtin_prefetch(positions + (long long)ROW * ids[place + AHEAD < to ? place + AHEAD : place]);
            put_coordinates(positions, ids[place], place);
        }
    }
    // Sorts buckets; `put` puts what is known of the sources at places [from, to) in order.
    template <class Put>
    void settle(Put put) {
        const Sorted points = sorted();
        const int* const ends = counts + (BUCKETS + 1) * (chunks(points.count) - 1);
        each_chunk(points.hands.settling, BUCKETS + 1, 1, [&](int bucket, int, int) {
            const int from = bucket ? ends[bucket - 1] : 0, to = ends[bucket];
            settle_bucket(points, bucket, from, to);
            if (!of_queries)
                put(from, to);
        });
    }
    void settle_bucket(const Sorted& points, int bucket, int from, int to) {
        const long long stride = points.stride, cells = shared.grid.cells, begins = (long long)bucket << shared.bucket_bits;
        const long long ends = begins + (1ll << shared.bucket_bits) < cells ? begins + (1ll << shared.bucket_bits) : cells;
        int *const first = points.first, *const order = points.order;
        if (bucket == BUCKETS) {
            for (int place = from; place < to; ++place)
                order[place] = points.numbers[stride * place];
            return;
        }
        for (long long c = begins; c < ends; ++c)
            first[c] = 0;
        for (int place = from; place < to; ++place)
            ++first[points.keys[stride * place]];
        for (long long c = begins, place = from; c < ends; ++c)
            first[c] = (int)(place += first[c]);
        for (int place = to - 1; place >= from; --place)  // the last first, so that points of a cell keep their order
            order[--first[points.keys[stride * place]]] = points.numbers[stride * place];
    }
};
