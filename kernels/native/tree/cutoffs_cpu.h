// Where sources stand on the CPU where cutoffs differ: in cells, if cutoffs are alike where particles are, else in a tree.
//
// Cells are those of a search with one cutoff, which is a typical one: what is nearer to a query than its own cutoff may lie in several
// of them. They are the faster, the less there is in the cells that a query meets beyond what is near; a tree takes twice as long for
// what is near, and hardly any time for what is not.
#pragma once
#include "tree_cpu.h"

constexpr int SAMPLES = 2048;  // queries that are asked how much they would meet
constexpr int MOST_NEAR = 64;  // cells beyond which it is not counted how much the near ones hold
constexpr int MOST_MET = 16;   // candidates for each pair, as an average, in cells

struct CutoffSort : TreeSortArguments {
    Sort cells;

    explicit CutoffSort(const TreeSortArguments& given) : TreeSortArguments(given), cells(given) {}

    void build() {
        Shared& shared = cells.shared;
        shared.next_chunk = shared.next_gathered = shared.next_sorted = shared.gathered = 0;
        shared.unit = shared.cells_for = 0;
        if (longest)
            *longest = 0;
        if constexpr (BOXES) {  // by cells that are wide enough for the largest cutoff of each system
            cells.build();
            shared.cells_for = 1;
            if (n < MANY)
                TreePlaces(*this).put_in_order(0, n);
            return;
        }
        cells.note_turns();
        if (!sort_by_cells())
            tree();
    }
    JFRNN_APART void tree() { TreeSort(*this).build(); }

    // Returns whether cells are as good as a tree; only then all is sorted by them.
    bool sort_by_cells() {
        const real typical = PERIODIC || !BY_OWN ? cells.radius : typical_cutoff();
        real low[3], high[3];
        if (!(typical > 0 && 2 * REACH_X / typical < __builtin_inff()))
            return false;
        cells.set_cutoff_of_cells(typical);
        if (cells.find_bounds(low, high) == 0)
            for (int k = 0; k < DIM; ++k)
                low[k] = high[k] = 0;
        Grid grid;
        cells.lay_out(grid, low, high, table);
        if (!grid.dense && !cells.one_cell && n > 0) {
            cells.narrow(low, high);
            cells.lay_out(grid, low, high, table);
        }
        if (!grid.dense)
            return false;
        cells.count_cells(grid, positions, n, cells.start);
        if (!cells.one_cell && !are_alike(grid, typical))
            return false;
        grid.finite = cells.put_in_cells(grid, positions, n, cells.start, cells.ids, false);
        Shared& shared = cells.shared;
        shared.cells_for = typical;
        shared.grid = grid;
        shared.finite_queries = grid.finite;
        if (!own)
            shared.finite_queries = cells.sort(grid, queries, m, cells.query_start, cells.query_ids, false);
        *bits = grid.finite < n || shared.finite_queries < m ? 2 : 0;
        if (n < MANY)
            TreePlaces(*this).put_in_order(0, n);
        return true;
    }
    real typical_cutoff() const {
        real r[SAMPLED];
        const int count = Sort::sample(m, r, [&](int i) { return query_radii[i]; });
        return count ? r[count * 15 / 16] : cells.radius;
    }
    // Do queries meet few sources in the cells that they look into, beyond those that are near? As many are in the cells beside that
    // of a query as there are in its own, it is supposed.
    bool are_alike(const Grid& grid, real typical) const {
        const int step = m / SAMPLES + 1;
        double met = 0, near = 0;
        for (int i = 0; i < m; i += step) {
            int cell = own ? cells.key[i] : -1;
            if (!own) {
                real p[3];
                cells.point_of(queries + (long long)ROW * i, p);
                cell = finite_point(p) ? cells.cell_key(grid, p, system_of(queries + (long long)ROW * i)) : -1;
            }
            if (cell < 0)
                continue;
            const double there = cells.start[cell + 2], r = reach_of(i) / (double)typical, reach = BY_OWN && !PERIODIC ? r : 1;
            double wide = 1, volume = DIM == 3 ? 4.19 : 3.14;
            for (int k = 0; k < DIM; ++k) {
                wide *= 1 + 2 * reach;
                volume *= r;
            }
            met += (wide < n ? wide : n) * there;
            near += (volume < MOST_NEAR ? volume : MOST_NEAR) * there;
        }
        return met <= MOST_MET * near;
    }
};
typedef TreeScratch SourcePlaces;
