// Which cell a coordinate is in: REACH cells fit into a cutoff along y and z, REACH_X along x.
//
// Why no pair is ever outside the cells that are searched: `cell_of` is a monotone function of the coordinate (a rounded product, a
// floor, a clamp: each is monotone), and so is rounding. A source within the cutoff r of a query q has x between q - r and q + r; x
// is a float, hence also between fl(q - r) and fl(q + r); its cell is therefore between theirs. This needs no bound on rounding
// errors, holds far from the origin, and whatever the compiler contracts, as long as every use of `cell_of` is the same code.
#pragma once
#include "space.h"

// The grid: `dense` boxes number their cells row-major, x fastest, systems slowest: systems share no cell. In a larger box a row of
// cells (all but x) starts at a hashed place of a ring of `cells` entries; x runs on from there. Rows that collide share entries:
// their particles are mere candidates, and may be of another system.
struct Grid {
    real low[3];    // lowest cell that holds a source
    int extent[3];  // cells per axis (dense)
    int cells;      // entries of the table in use
    int dense;
    int finite;  // sources with finite coordinates
    int more;    // whether sources lie outside of a dense box, in the cells of its border that are closest
};

// The exponent of a float's lowest bit: the float is a multiple of 2 to that. Zero is a multiple of everything.
JFRNN_FUNCTION int lowest_bit(real x) {
    const int e = Bits::exponent(x);
    const unsigned long long lead = e ? 1ull << Bits::MANTISSA : 0;
    const unsigned long long mantissa = (Bits::of(x) & ((1ull << Bits::MANTISSA) - 1)) | lead;
#if defined(__CUDA_ARCH__)
    const int zeros = (DOUBLE ? __ffsll((long long)mantissa) : __ffs((int)mantissa)) - 1;
#else
    const int zeros = mantissa ? __builtin_ctzll(mantissa) : -1;
#endif
    return zeros < 0 ? 1 << 20 : (e > 1 ? e : 1) - Bits::BIAS - Bits::MANTISSA + zeros;
}

struct Cells : Space {
    real inverse_edge[3];  // cells per length; along a periodic axis a whole number per period
    int periodic_axes;     // a bit each
    bool one_cell;         // sources are so few that they share one: all of them are candidates

    JFRNN_MEMBER Cells(const real* cutoff, bool one_cell) : Space(cutoff), one_cell(one_cell) { measure_cells(); }
    // Finds out how wide cells are in the lattice that there is.
    JFRNN_MEMBER void measure_cells() {
        periodic_axes = 0;
        for (int axis = 0; axis < 3; ++axis)
            inverse_edge[axis] = axis < DIM ? cells_per_length(axis) : real(1);
        for (int axis = 0; PERIODIC && axis < DIM; ++axis)
            periodic_axes |= lattice.periodic(axis) << axis;
    }
    // Lets cells along axes that are open be as wide as if this were the cutoff.
    JFRNN_MEMBER void set_cutoff_of_cells(real cutoff) {
        for (int axis = 0; axis < DIM && !PERIODIC; ++axis)
            inverse_edge[axis] = real(axis == 0 ? REACH_X : REACH) / cutoff;
    }
    // Cells per length along an axis; along a periodic one they are a whole number per period.
    JFRNN_MEMBER real cells_per_length(int axis) const {
        const real cells = real(axis == 0 ? REACH_X : REACH);
        if constexpr (!PERIODIC)
            return cells / radius;
        const real count = cells / lattice.reach(axis);
        const bool periodic = lattice.periodic(axis);
        if (periodic && one_cell)
            return 1;
        constexpr real MOST = real(1 << 22);
        return !periodic ? count : count < 1 ? real(1) : count < MOST ? real((int)count) : MOST;
    }
    // How far a neighbor may be along an axis.
    JFRNN_MEMBER real reach_along(int axis) const { return PERIODIC ? lattice.reach(axis) : radius; }
    // Where a point is along an axis: a fraction of the box where that is periodic.
    JFRNN_MEMBER real coordinate(int axis, const real* p) const {
        if constexpr (PERIODIC)
            return lattice.along(axis, p);
        else
            return p[axis];
    }
    JFRNN_MEMBER bool is_periodic(int axis) const { return PERIODIC && (periodic_axes >> axis & 1); }
    JFRNN_MEMBER real cell_scale(int axis) const {
        return axis == 0 ? inverse_edge[0] : !PERIODIC || axis == 1 ? inverse_edge[1] : inverse_edge[2];
    }
    // The cell of a coordinate, as a whole float; it never decreases where x grows.
    JFRNN_MEMBER real cell_of(int axis, real x) const {
#if defined(__CUDA_ARCH__)
        if constexpr (DOUBLE)
            return floor(__dmul_rn(x, cell_scale(axis)));
        else
            return floorf(__fmul_rn(x, cell_scale(axis)));
#else
        return DOUBLE ? real(__builtin_floor(x * inverse_edge[axis])) : real(__builtin_floorf(x * inverse_edge[axis]));
#endif
    }
    // Do all coordinates lie on a lattice of which the cutoff is a moderate multiple, crystals and the usual start of an SPH run? Then
    // squared distances near the cutoff are whole numbers of squared units, computed without any rounding, and working precision
    // decides ties as well. `lowest` is the lowest bit of all coordinates, as they were given, `highest` their largest exponent, which
    // matters where they are moved by lattice vectors: all sums must be exact. Returns the unit, or 0.
    static constexpr int UNITS =
        DOUBLE ? 24 : 10;  // bits of the cutoff in units; its square has twice as many, less than a float has
    JFRNN_MEMBER real lattice_unit(int lowest, int highest) const {
        if (SKEWED)
            return 0;
        for (int k = 0; PERIODIC && k < DIM; ++k)
            if (is_periodic(k)) {
                const real v = lattice.vector(k, k), farthest = v * real(lattice.images(k) + 1);
                lowest = lowest_bit(v) < lowest ? lowest_bit(v) : lowest;
                highest = Bits::exponent(farthest) > highest ? Bits::exponent(farthest) : highest;
                highest = Bits::exponent(lattice.origin(k)) > highest ? Bits::exponent(lattice.origin(k)) : highest;
            }
        if (Bits::exponent(radius) - Bits::BIAS > lowest + UNITS)
            return 0;
        if (PERIODIC && highest - Bits::BIAS > lowest + Bits::MANTISSA - 3)
            return 0;
        const int finest = Bits::exponent(radius) - Bits::BIAS + 1;  // a coarser unit than the cutoff would gain nothing
        return real(Bits::power_of_two(lowest < finest ? lowest : finest));
    }
    // The end of a stencil may be infinite, though no particle is: then it becomes the largest float.
    JFRNN_FUNCTION real in_range(real x) {
        constexpr real MOST = DOUBLE ? real(1.7976931348623157e308) : real(3.4028234663852886e38f);
        return x < -MOST ? -MOST : x > MOST ? MOST : x;
    }
    // The number of a cell, monotone, and consecutive for cells that touch: the integer itself, or the bits of floats too large for it.
    JFRNN_FUNCTION whole cell_number(real cell) {
        constexpr real WHOLE = DOUBLE ? real(9007199254740992.0) : real(16777216.0f);
        const real magnitude = cell < 0 ? -cell : cell;
        const whole beyond = (whole)(Bits::of(magnitude) - Bits::of(WHOLE)) + (whole)WHOLE;
        const whole number = magnitude < WHOLE ? (whole)magnitude : beyond;
        return cell < 0 ? -number : number;
    }

    JFRNN_FUNCTION int row_hash(long long y, long long z, unsigned int system, int cells) {
        unsigned long long h = (unsigned long long)y * 0x9e3779b97f4a7c15ull ^ (unsigned long long)z * 0xc2b2ae3d27d4eb4full;
        if constexpr (BATCHED)
            h ^= (system + 1) * 0x9fb21c651e98df25ull;
        h ^= h >> 32;
        h *= 0xd6e8feb86659fd93ull;
        h ^= h >> 32;
        h *= 0xd6e8feb86659fd93ull;
        h ^= h >> 32;
        return (int)(((h & 0xffffffffull) * (unsigned long long)cells) >> 32);
    }
    // The cell along one axis as an integer. Dense boxes count from the lowest cell, and what lies outside is clamped to one beyond.
    JFRNN_MEMBER whole axis_cell(const Grid& grid, int k, real x) const {
        const real cell = cell_of(k, x);
        if (is_periodic(k)) {  // from 0 on, whatever the box
            const real most = cell_scale(k) - 1;
            return cell < 0 ? 0 : cell < most ? (whole)cell : (whole)most;
        }
        if (!grid.dense)
            return cell_number(cell_of(k, in_range(x)));
        if (one_cell)
            return 0;
        const real from_low = cell - grid.low[k];
        return from_low < 0 ? -1 : from_low < real(grid.extent[k]) ? (whole)from_low : (whole)grid.extent[k];
    }
    // Cells of a periodic axis are numbered on beyond its ends: this is the period in which a cell lies.
    JFRNN_MEMBER int period_of(int axis, whole cell) const {
        const whole cells = (whole)cell_scale(axis);
        return (int)(cell >= 0 ? cell / cells : -1 - (-1 - cell) / cells);
    }
    // The entry of the table at which a row of cells starts; of a hashed row, the entry of its cell 0.
    JFRNN_FUNCTION int row_start(const Grid& grid, whole y, whole z, unsigned int system) {
        if constexpr (BATCHED && !BOXES)
            z += grid.dense ? (whole)system * (DIM == 3 ? grid.extent[2] : 1) : 0;
        return grid.dense ? (int)((z * grid.extent[1] + y) * grid.extent[0]) : row_hash(y, z, system, grid.cells);
    }
    // An entry of the ring of `cells` entries.
    JFRNN_FUNCTION int ring(whole x, int cells) {
        const whole r = x % cells;
        return (int)(r < 0 ? r + cells : r);
    }
    // The entry of the cell of a finite point; a point outside a dense box is sorted into its border. `row` becomes its row of cells.
    JFRNN_MEMBER int cell_key(const Grid& grid, const real* p, unsigned int system, int& row) const {
        whole cell[3] = {0, 0, 0};
        for (int k = 0; k < DIM; ++k) {
            const whole c = axis_cell(grid, k, coordinate(k, p)), end = grid.extent[k] - 1;
            cell[k] = !grid.dense ? c : c < 0 ? 0 : c > end ? end : c;
        }
        row = row_start(grid, cell[1], cell[2], system);
        return grid.dense ? row + (int)cell[0] : ring(row + ring(cell[0], grid.cells), grid.cells);
    }
    JFRNN_MEMBER int cell_key(const Grid& grid, const real* p, unsigned int system) const {
        int row;
        return cell_key(grid, p, system, row);
    }
    // Finds how many cells the box [low, high] of coordinates has, and whether a table of so many entries holds them.
    JFRNN_MEMBER void lay_out(Grid& grid, const real* low, const real* high, int table) const {
        double cells = BATCHED && !BOXES ? double(last_system) + 1 : 1;
        for (int k = 0; k < DIM; ++k) {
            grid.low[k] = is_periodic(k) ? real(0) : cell_of(k, low[k]);
            const double extent = is_periodic(k) ? double(inverse_edge[k]) : double(cell_of(k, high[k])) - double(grid.low[k]) + 1;
            cells = one_cell ? cells : extent <= table ? cells * extent : 2.0 * table;
            grid.extent[k] = extent <= table && !one_cell ? (int)extent : 1;
        }
        grid.dense = cells <= table;
        grid.more = 0;
        grid.cells = grid.dense ? (int)cells : table;
    }
};
