// Queries of a cell meet the sources of the cells around it, on the CPU, where all pairs have one cutoff, or cutoffs are alike.
#pragma once
#include "walk_cpu.h"

template <class Query>
struct CellWalk : Walk<Query> {
    typedef Walk<Query> Base;
    using Base::axis_cell, Base::begin, Base::cell_of, Base::coordinate, Base::copy, Base::end, Base::filled;
    using Base::drop_self, Base::lattice, Base::one_cell, Base::period_of, Base::position_of;
    using Base::finite_places, Base::flush, Base::fresh, Base::own, Base::image, Base::inverse_edge, Base::is_periodic;
    using Base::query, Base::query_ids, Base::reach_along, Base::ring, Base::row_start, Base::several, Base::shared;
    using Base::shift, Base::side, Base::system, Base::system_at;
    static constexpr int ROWS = 64;  // of cells around a cell
    Grid grid;
    int own_from, own_to, own_at;  // places of queries that are candidates, too, and the number of the first of them

    explicit CellWalk(const SearchArguments& given) : Base(given), grid(shared.grid), own_from(0), own_to(0), own_at(0) {
        if constexpr (!DIFFER)
            return;
        this->set_cutoff_of_cells(shared.cells_for);
        if (own)
            query_ids = this->ids;
    }
    bool strangers() const { return !BOXES && !grid.dense; }
    void go_to(unsigned int system) {
        Base::go_to(system);
        if constexpr (BOXES)
            grid = this->grid_of[system].grid;
    }
    int number_of(int place) const {
        return (DIFFER || drop_self) && place >= own_from && place < own_to ? own_at + place - own_from : -1;
    }
    void forget() { own_from = own_to = 0; }
    // Notes which queries stand among the sources at places [from, to), all of which are near.
    void placed(int from, int to, unsigned int near) {
        this->pack_cutoffs(from, near);
        const int low_place = from > begin ? from : begin, high_place = to < end ? to : end;
        if (!own || (PERIODIC && side != 0) || low_place >= high_place)
            return;
        if (own_from == own_to) {
            own_from = low_place;
            own_at = filled + __builtin_popcount(near & ((1u << (low_place - from)) - 1));
        }
        own_to = high_place;
    }

    // Copies all rows of cells from `first` to `last`, of one image. Rows of a hashed table may share entries: these are copied once.
    void copy_rows(const Box& box, const whole* first, const whole* last) {
        const Grid grid = this->grid;  // stays in registers, whatever is stored; and so do those below
        const int* const start = this->start + this->first_cell();
        const unsigned int system = this->system;
        const int length = (int)(last[0] - first[0] + 1);
        int seen[ROWS], rows = 0;
        for (whole z = first[2]; z <= last[2] && length > 0; ++z)
            for (whole y = first[1]; y <= last[1]; ++y) {
                if (grid.dense) {
                    const int row = row_start(grid, y, z, system);
                    copy(box, start[row + first[0]], start[row + last[0] + 1]);
                    continue;
                }
                const int begins = ring(row_start(grid, y, z, system) + ring(first[0], grid.cells), grid.cells);
                int front = 0, back = 0;  // entries shared with rows that were copied before
                for (int r = 0; r < rows; ++r) {
                    const int behind = ring(begins - seen[r], grid.cells), ahead = grid.cells - behind;
                    if (behind < length)
                        front = length - behind > front ? length - behind : front;
                    else if (ahead < length)
                        back = length - ahead > back ? length - ahead : back;
                }
                seen[rows++] = begins;
                const int size = length - front - back, from = ring(begins + front, grid.cells);
                if (size <= 0)
                    continue;
                if (from + size <= grid.cells)
                    copy(box, start[from], start[from + size]);
                else {
                    copy(box, start[from], start[grid.cells]);
                    copy(box, start[0], start[from + size - grid.cells]);
                }
            }
    }
    // Copies the cells from `first` to `last` of a periodic box, image by image.
    void copy_images(const Box& box, const whole* first, const whole* last) {
        several = false;
        for (int k = 0; k < DIM; ++k)
            several = several || (is_periodic(k) && (first[k] < 0 || last[k] >= (whole)inverse_edge[k]));
        int from[3] = {0, 0, 0}, to[3] = {0, 0, 0};
        for (int k = 0; several && k < DIM; ++k)
            if (is_periodic(k)) {
                const int most = lattice.images(k);  // rounded up, a query may reach an image that is beyond every cutoff
                from[k] = period_of(k, first[k]) < -most ? -most : period_of(k, first[k]);
                to[k] = period_of(k, last[k]) > most ? most : period_of(k, last[k]);
            }
        this->each_image(from, to, [&] { copy_image(box, first, last); });
    }
    void copy_image(const Box& box, const whole* first, const whole* last) {
        whole begins[3] = {0, 0, 0}, ends[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k) {
            const whole cells = (whole)inverse_edge[k], skipped = is_periodic(k) ? shift[k] * cells : 0;
            begins[k] = first[k] - skipped;
            ends[k] = last[k] - skipped;
            if (is_periodic(k)) {
                begins[k] = begins[k] < 0 ? 0 : begins[k];
                ends[k] = ends[k] < cells ? ends[k] : cells - 1;
            }
        }
        copy_rows(box, begins, ends);
    }

    // Serves all queries of one cell: places [begin, end), whose coordinates along the axes are between low and high.
    void serve(int from, int to, const real* low, const real* high) {
        begin = from;
        end = to;
        system = system_at(begin);
        go_to(system);
        this->begin_group();
        whole first[3] = {0, 0, 0}, last[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k) {
            if (is_periodic(k)) {
                first[k] = (whole)cell_of(k, low[k] - reach_along(k));
                last[k] = (whole)cell_of(k, high[k] + reach_along(k));
                continue;
            }
            const real reach = DIFFER && BY_OWN && !PERIODIC ? this->group_radius : reach_along(k);
            first[k] = axis_cell(grid, k, low[k] - reach);
            last[k] = axis_cell(grid, k, high[k] + reach);
            if (grid.dense) {
                const whole most = grid.extent[k] - 1;
                first[k] = first[k] < 0 ? 0 : first[k];
                last[k] = last[k] > most ? most : last[k];
                if (DIFFER || grid.more) {  // sources beyond the grid are in the cells of its border
                    first[k] = first[k] > most ? most : first[k];
                    last[k] = last[k] < 0 ? 0 : last[k];
                }
            }
        }
        Box box;  // of the queries: a variable of its own, which stays in registers
        position_of(begin, box.low);
        position_of(begin, box.high);
        for (int place = begin + 1; place < end; ++place) {
            real q[3];
            position_of(place, q);
            widen(box.low, box.high, q, q);
        }
        filled = own_from = own_to = side = 0;
        fresh = true;
        if constexpr (PERIODIC)
            copy_images(box, first, last);
        else
            copy_rows(box, first, last);
        flush(true);
    }

    // Where the query at a place is along the axes, and its cell.
    void locate(int place, real* at, whole* cell) {
        real q[3];
        go_to(system_at(place));
        position_of(place, q);
        for (int k = 0; k < DIM; ++k) {
            at[k] = coordinate(k, q);
            cell[k] = axis_cell(grid, k, at[k]);
        }
        cell[DIM] = (whole)system_at(place);
    }
    static bool same_row(const whole* a, const whole* b) {
        bool same = true;
        for (int k = 1; k < DIM + BATCHED; ++k)
            same = same && a[k] == b[k];
        return same;
    }
    static bool same_cell(const whole* a, const whole* b) { return a[0] == b[0] && same_row(a, b); }
    // Serves the cells that begin among the places [place, chunk_end): a cell belongs to the chunk that holds its first place, but
    // where there is one cell alone, of which each chunk serves its own part. Cells of a row are served together until they hold
    // `TOGETHER` queries, since to copy candidates takes longer than to meet some that are farther away.
    JFRNN_APART void serve_chunk(int place, int chunk_end) {
        whole cell[4], other[4];
        real at[3];
        if (!one_cell && place > 0 && place < finite_places) {
            locate(place - 1, at, cell);
            for (; place < finite_places; ++place) {
                locate(place, at, other);
                if (!same_cell(cell, other))
                    break;
            }
        }
        if (place < finite_places)
            locate(place, at, other);
        while (place < chunk_end) {
            if (place >= finite_places) {
                query().none(query_ids[place++]);
                continue;
            }
            real low[3], high[3];  // `other` and `at` are those of the first place
            for (int k = 0; k < DIM; ++k)
                low[k] = high[k] = at[k];
            for (int k = 0; k < DIM + BATCHED; ++k)
                cell[k] = other[k];
            int stop = place + 1;
            for (const int end = one_cell && chunk_end < finite_places ? chunk_end : finite_places; stop < end; ++stop) {
                locate(stop, at, other);
                if (!same_cell(cell, other)) {
                    if (!grid.dense || stop - place >= TOGETHER || stop >= chunk_end || !same_row(cell, other))
                        break;
                    cell[0] = other[0];
                }
                widen(low, high, at, at);
            }
            serve(place, stop, low, high);
            place = stop;
        }
    }
};
