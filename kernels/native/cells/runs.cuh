// The cells within reach of a group, row by row, and the runs of candidates that they hold.
#pragma once
#include "group.cuh"

// A row of cells along x, from the cell `first` on, in its own image.
struct CellRow {
    whole first, y, z;
    int length, image;
};
// What a row of a hashed table shares with the rows before it, in entries at its front and at its back: their candidates come once.
struct Overlap {
    int begins, length, front, back;
    JFRNN_MEMBER void add(int other, int cells) {
        const int behind = begins - other < 0 ? begins - other + cells : begins - other, ahead = cells - behind;
        if (behind < length)
            front = length - behind > front ? length - behind : front;
        else if (ahead < length)
            back = length - ahead > back ? length - ahead : back;
    }
};

// a / b, of small numbers without a division of integers, which takes many instructions.
JFRNN_FUNCTION int quotient(int a, int b) {
    constexpr int SMALL = 1 << 20;  // a rounded quotient is off by less than 1 / 2b
    return a < SMALL ? (int)__fdividef((float)a + 0.5f, (float)b) : a / b;
}

// Numbers the candidates of all lanes, `size` of them from the place `from` on, and shares the runs; returns how many there are.
JFRNN_FUNCTION int share_runs(const PairSearch& search, int from, int size, int image) {
    Warp& warp = shared_warp();
    const int lane = search.lane;
    int end = size;
#pragma unroll
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(ALL, end, step);
        end += lane >= step ? other : 0;
    }
    const unsigned int occupied = __ballot_sync(ALL, size > 0);
    __syncwarp();
    if (size > 0) {
        const int number = __popc(occupied & ((1u << lane) - 1));
        warp.runs[number] = Run{end, from - (end - size)};
        if constexpr (!PairSearch::INSIDE) {
            warp.run_images[number] = image;
            search.translate(image, warp.run_moved[number]);
        }
    }
    if (lane == 0)
        warp.runs[__popc(occupied)] = Run{0x7fffffff, 0};
    __syncwarp();
    return __shfl_sync(ALL, end, 31);
}

struct CellRuns {
    whole reached;  // of lane 2a the lowest cell within reach along axis a, of lane 2a + 1 the highest
    int rows;       // of cells; a row is cut where it enters another image
    int base;       // rows of which candidates have been written down

    JFRNN_MEMBER CellRuns(const PairSearch& search, const Group& group, bool) : reached(find_end(search, group)), rows(1), base(0) {
        if (!PairSearch::INSIDE && search.is_periodic(0))
            rows = period(search, 0, __shfl_sync(ALL, reached, 1)) - period(search, 0, __shfl_sync(ALL, reached, 0)) + 1;
        if (cells_along(0) <= 0 || cells_along(1) <= 0 || cells_along(2) <= 0)
            rows = 0;
        rows *= cells_along(1) * cells_along(2);
    }
    JFRNN_FUNCTION whole find_end(const PairSearch& search, const Group& group) {
        const Grid& grid = shared_known().grid;
        const int lane = search.lane, along = lane / 2 < DIM ? lane / 2 : 0;
        const real reach = DIFFER && !PERIODIC ? group.largest : search.reach_along(along);
        const real x = search.cell_of(along, search.in_range(lane % 2 ? group.bound + reach : group.bound - reach));
        whole reached;
        if (search.is_periodic(along))  // numbered on beyond the ends
            reached = (whole)x;
        else if (grid.dense) {
            const int extent = lane < 2 ? grid.extent[0] : lane < 4 || DIM == 2 ? grid.extent[1] : grid.extent[2];
            const real from_low = x - (lane < 2 ? grid.low[0] : lane < 4 || DIM == 2 ? grid.low[1] : grid.low[2]);
            reached = from_low < 0 ? -1 : from_low < real(extent) ? (whole)from_low : (whole)extent;
            if (grid.more || lane % 2)
                reached = reached < extent ? reached : extent - 1;
            if (grid.more || lane % 2 == 0)
                reached = reached < 0 ? 0 : reached;
        } else
            reached = search.cell_number(x);
        return lane < 2 * DIM ? reached : 0;
    }
    // The period of a cell; where pairs have one image, it is this one or one beside.
    JFRNN_FUNCTION int period(const PairSearch& search, int a, whole cell) {
        if constexpr (PERIODIC == 1)
            return cell < 0 ? -1 : cell >= (whole)search.inverse_edge[a];
        else
            return search.period_of(a, cell);
    }
    JFRNN_MEMBER whole first_along(int a) const { return __shfl_sync(ALL, reached, 2 * a); }
    JFRNN_MEMBER int cells_along(int a) const { return (int)(__shfl_sync(ALL, reached, 2 * a + 1) - first_along(a)) + 1; }

    JFRNN_MEMBER bool are_left() const { return base < rows; }
    // Writes down the candidates of the next up to 32 rows of cells as runs; returns how many there are.
    JFRNN_MEMBER int find(const PairSearch& search, const Group& group) {
        const int number = find_from(search, group.system);
        base += 32;
        return number;
    }
    JFRNN_MEMBER int find_from(const PairSearch& search, unsigned int system) const {
        const Grid& grid = shared_known().grid;
        const int lane = search.lane;
        whole first[3];
#pragma unroll
        for (int a = 0; a < 3; ++a)
            first[a] = first_along(a);
        const int wide = cells_along(1), deep = cells_along(2), length = cells_along(0), row = base + lane;
        const int across = PairSearch::INSIDE ? 1 : quotient(rows, wide * deep);
        auto row_at = [&](int row) {
            const int line = PairSearch::INSIDE ? row : quotient(row, across), level = quotient(line, wide);
            const whole y = first[1] + (line - level * wide), z = first[2] + level;
            if constexpr (PairSearch::INSIDE)
                return CellRow{first[0], y, z, length, search.home};
            else
                return cut_row(search, first[0], y, z, row - line * across, length);
        };
        const CellRow mine = row_at(PairSearch::INSIDE || row < rows ? row : 0);
        int from = 0, size = 0;
        if (grid.dense) {
            if (row < rows) {
                const int s = search.row_start(grid, mine.y, mine.z, system) + (int)mine.first;
                from = search.start[s];
                size = mine.length > 0 ? search.start[s + mine.length] - from : 0;
            }
        } else {
            auto entry_of = [&](const CellRow& row) {
                return search.ring(search.row_start(grid, row.y, row.z, system) + search.ring(row.first, grid.cells), grid.cells);
            };
            Overlap overlap{entry_of(mine), mine.length, 0, 0};
            for (int r = 0; r < base; ++r) {
                const CellRow earlier = row_at(r);
                if (PairSearch::INSIDE || earlier.image == mine.image)  // as long as this one
                    overlap.add(entry_of(earlier), grid.cells);
            }
            overlap_with_lanes(overlap, grid.cells, lane, mine.image, rows - base < 32 ? rows - base : 32);
            const int entries = mine.length - overlap.front - overlap.back, begins = overlap.begins + overlap.front;
            if (row < rows && entries > 0) {
                const int s = begins >= grid.cells ? begins - grid.cells : begins, e = s + entries;
                from = search.start[s];
                size = e <= grid.cells ? search.start[e] - from : grid.finite - from + search.start[e - grid.cells];
            }
        }
        return share_runs(search, from, size, mine.image);
    }
    // Finds a row of cells in its own image; it has none where rounding has reached for an image that is beyond every cutoff.
    JFRNN_FUNCTION CellRow cut_row(const PairSearch& search, whole x, whole y, whole z, int part, int length) {
        whole cell[3] = {x, y, z}, last = x + length - 1;
        int shift[3] = {0, 0, 0}, image = 0;
        bool within = true;
        if (search.is_periodic(0)) {
            const whole around = (whole)search.inverse_edge[0];
            shift[0] = period(search, 0, x) + part;
            cell[0] = x - shift[0] * around;
            cell[0] = cell[0] < 0 ? 0 : cell[0];
            last -= shift[0] * around;
            last = last < around ? last : around - 1;
        }
#pragma unroll
        for (int a = 1; a < DIM; ++a)
            if (search.is_periodic(a)) {
                const whole around = (whole)search.inverse_edge[a];
                shift[a] = period(search, a, cell[a]);
                cell[a] -= shift[a] * around;
                within = within && cell[a] >= 0 && cell[a] < around;
            }
#pragma unroll
        for (int a = 0; a < DIM; ++a) {
            const int most = search.lattice.images(a);
            within = within && shift[a] >= -most && shift[a] <= most;
            image = image * (2 * most + 1) + shift[a] + most;
        }
        if (!within)
            return CellRow{0, 0, 0, 0, search.home};  // a cell there is
        return CellRow{cell[0], cell[1], cell[2], (int)(last - cell[0]) + 1, image};
    }
    // Finds what the row of this lane shares with those of the lanes before it.
    JFRNN_FUNCTION void overlap_with_lanes(Overlap& overlap, int cells, int lane, int image, int here) {
#pragma unroll 1
        for (int r = 0; r < here; ++r) {
            const int other = __shfl_sync(ALL, overlap.begins, r), other_image = CROSSING ? __shfl_sync(ALL, image, r) : 0;
            if (r < lane && (!CROSSING || other_image == image))
                overlap.add(other, cells);
        }
    }
};
