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
        if constexpr (BOXES) {  // by cells that are wide enough for the largest cutoff of each system
            cells.lay_out_cells();
            cells.shared.cells_for = 1;
        } else {
            Grid grid;
            cells.shared.cells_for = lay_out(grid);
            cells.begin(grid);
        }
        if (cells.many())
            return;
        if (in_cells())
            cells.sort_few();
        choose();
        if (in_cells())
            TreePlaces(*this).put_in_order(0, n);
    }
    // The steps in which several threads sort many, each launched once per thread.
    void find_keys() {
        if (in_cells())
            cells.find_keys();
    }
    void deal() {
        if (in_cells())
            cells.deal();
    }
    void settle() {
        TreePlaces places(*this);
        if (in_cells())
            cells.settle([&](int from, int to) { places.put_in_order(from, to); });
    }
    // Goes on with a tree where cells are worse, which is known once they are sorted.
    void choose() {
        if constexpr (BOXES)
            return;
        if (in_cells() && !cells.one_cell && !are_alike(cells.shared.cells_for))
            cells.shared.cells_for = 0;
        if (!in_cells())
            tree();
    }
    JFRNN_APART void tree() { TreeSort(*this).build(); }
    // What is left to do where many sources, which are the queries, stand in a tree: `refine` is launched once per thread, `end` once.
    void refine() {
        if (!in_cells())
            TreeSort(*this).refine();
    }
    void end() {
        if (!in_cells() && TreeSort(*this).is_shared())
            TreeSort(*this).end();
    }
    // Returns whether sources stand in cells, as far as is known, and lets them be as wide as was said.
    bool in_cells() {
        const real width = cells.shared.cells_for;
        if (width > 0)
            cells.set_cutoff_of_cells(width);
        return width > 0;
    }

    // Lays out cells. Returns the cutoff for which they are, 0 if there are too many.
    real lay_out(Grid& grid) {
        const real typical = PERIODIC || !BY_OWN ? cells.radius : typical_cutoff();
        real low[3], high[3];
        if (!(typical > 0 && 2 * REACH_X / typical < __builtin_inff())) {
            grid = Grid{};
            return 0;
        }
        cells.set_cutoff_of_cells(typical);
        if (cells.find_bounds(low, high) == 0)
            for (int k = 0; k < DIM; ++k)
                low[k] = high[k] = 0;
        cells.lay_out(grid, low, high, table);
        if (!grid.dense && !cells.one_cell && n > 0) {
            cells.narrow(low, high);
            cells.lay_out(grid, low, high, table);
        }
        return grid.dense ? typical : real(0);
    }
    real typical_cutoff() const {
        real r[SAMPLED];
        const int count = Sort::sample(m, r, [&](int i) { return query_radii[i]; });
        return count ? r[count * 15 / 16] : cells.radius;
    }
    // Do queries meet few sources in the cells that they look into, beyond those that are near? As many are in the cells beside that
    // of a query as there are in its own, it is supposed.
    bool are_alike(real typical) {
        const int step = m / SAMPLES + 1;
        double met = 0, near = 0;
        for (int i = 0; i < m; i += step) {
            const int cell = cells.key[i];  // of the query: sources were sorted before, if they are others
            if (cell < 0)
                continue;
            const double there = cells.start[cell + 1] - cells.start[cell], r = reach_of(i) / (double)typical,
                         reach = BY_OWN && !PERIODIC ? r : 1;
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
