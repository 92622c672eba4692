// How sources (and queries, if they are others) are sorted by cell on the CPU, and where things lie in the scratch meanwhile.
#pragma once
#include "cells.h"
#include "chunks.h"

constexpr int SAMPLED = 256;        // cutoffs, and coordinates, that tell what is typical
constexpr int MOST_OUTSIDE = 4096;  // sources outside of the box of cells, where a box of all would be too large

struct Shared {
    Grid grid;
    int finite_queries;
    int next_chunk;
    int next_gathered, next_sorted;  // chunks of sources whose coordinates and values are put in order
    int gathered;                    // sources that are
    int turned;                      // of a periodic box: 0 if all particles lie in its cell, 1 if in those beside it, else 2
    real unit;                       // of the lattice on which all coordinates lie, or 0
    real cells_for;                  // where cutoffs differ: that for which cells are wide, or 0: sources stand in a tree
};

// The scratch of a search: `jfrnn.kernels.cells_cpu.scratch_words` is the sum of its parts.
struct Scratch {
    Shared& shared;
    real* axis[3];           // coordinates of sources, in the order of cells
    int *ids, *start, *key;  // sources in the order of cells, first places of cells, cells of particles
    int *query_ids, *query_start;
    int* cursor;

    Scratch(int* scratch, int n, int m, int own, int table) : shared(*(Shared*)scratch), cursor(scratch + up(64)) {
        constexpr int WIDTH = DOUBLE ? 2 : 1;
        for (int k = 0; k < DIM; ++k)
            axis[k] = (real*)take(WIDTH * (long long)n);
        ids = take(n);
        start = take(table + 2);
        key = take(n > m ? n : m);
        query_ids = own ? ids : take(m);
        query_start = own ? start : take(table + 2);
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
    int n, m, own, table;
};

// Sorts by counting: `build` is of one thread, which reads every particle three times.
struct Sort : SortArguments, Places {
    explicit Sort(const SortArguments& given) : SortArguments(given), Places(given) {}

    void build() {
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
        shared.next_chunk = 0;
        shared.next_gathered = shared.next_sorted = 0;
        if (longest)  // of a sum there is none
            *longest = 0;
        note_turns();
        int lowest = 1 << 20, highest = 0;
        look_at_bits(positions, n, lowest, highest);
        if (!own)
            look_at_bits(queries, m, lowest, highest);
        shared.unit = BOXES ? real(0) : lattice_unit(lowest, highest);
        grid.finite = sort(grid, positions, n, start, ids, true);
        shared.grid = grid;
        shared.finite_queries = own ? grid.finite : sort(grid, queries, m, query_start, query_ids, false);
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

    // Finds the lowest bit and the largest exponent of all coordinates, as they were given; whatever lies on no lattice shows soon.
    void look_at_bits(const real* points, int count, int& lowest, int& highest) const {
        const int too_low = Bits::exponent(radius) - Bits::BIAS - UNITS;
        for (int i = 0; i < count && lowest >= too_low; ++i) {
            const real* row = points + (long long)ROW * i;
            if (!finite_point(row))
                continue;
            for (int k = 0; k < DIM; ++k) {
                const int low_bit = lowest_bit(row[k]), exponent = Bits::exponent(row[k]);
                lowest = low_bit < lowest ? low_bit : lowest;
                highest = exponent > highest ? exponent : highest;
            }
        }
    }

    // Sorts points by cell into `order`, with the first place of each cell in `first`; points that are not finite come last. Returns
    // how many are finite.
    int sort(const Grid& grid, const real* points, int count, int* first, int* order, bool with_axes) {
        count_cells(grid, points, count, first);
        return put_in_cells(grid, points, count, first, order, with_axes);
    }
    // Notes the cell of each point, and how many points each cell has two entries behind its own.
    void count_cells(const Grid& grid, const real* points, int count, int* first) {
        int* const key = this->key;  // stays in a register, whatever is stored
        for (int c = 0; c < grid.cells + 2; ++c)
            first[c] = 0;
        for (int i = 0; i < count; ++i) {
            real p[3];
            enter(system_of(points + (long long)ROW * i));
            point_of(points + (long long)ROW * i, p);
            const Grid& there = BOXES ? grid_of[here].grid : grid;
            const int cell = finite_point(p) ? first_cell() + cell_key(there, p, system_of(points + (long long)ROW * i)) : -1;
            key[i] = cell;
            if (cell >= 0)
                ++first[cell + 2];
        }
    }
    // Notes how far away from the cell any particle lies.
    void note_turns() {
        const real most = lattice.most_turns();
        shared.turned = most < 2 ? (int)most : 2;
    }
    // Coordinates of few sources are put in order at once, those of many by several threads (`gather`).
    int put_in_cells(const Grid& grid, const real* points, int count, int* first, int* order, bool with_axes) {
        const int* const key = this->key;
        const int cells = grid.cells;
        for (int c = 2; c < cells + 2; ++c)
            first[c] += first[c - 1];
        const int finite = first[cells + 1];
        for (int i = 0, behind = finite; i < count; ++i) {
            const int place = key[i] >= 0 ? first[key[i] + 1]++ : behind++;
            order[place] = i;
            if (with_axes && n < MANY)
                put_coordinates(points, i, place);
        }
        return finite;
    }
    // Puts coordinates of many sources into the order of cells. It is launched once per thread: threads hand themselves chunks of
    // places. Reading from anywhere is what takes time, so rows are fetched ahead.
    void gather() {
        each_chunk(shared.next_gathered, n, CHUNK, [&](int from, int to, int) {
            for (int place = from; place < to; ++place) {
                constexpr int AHEAD = 16;  // places
                __builtin_prefetch(positions + (long long)ROW * ids[place + AHEAD < n ? place + AHEAD : place]);
                put_coordinates(positions, ids[place], place);
            }
        });
    }
};
