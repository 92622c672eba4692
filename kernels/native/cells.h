// --- part: cells

auto cells_per_length = [&](int axis) -> real {  // along a periodic axis: a whole number per period
    const real cells = real(axis == 0 ? REACH_X : REACH);
    if constexpr (!PERIODIC)
        return cells / radius;
    const real count = cells / lattice.reach(axis);
    const bool periodic = lattice.periodic(axis);
    constexpr real MOST = real(1 << 22);
    return !periodic ? count : count < 1 ? real(1) : count < MOST ? real((int)count) : MOST;
};
const real inverse_edge[3] = {cells_per_length(0), cells_per_length(1), DIM == 3 ? cells_per_length(2) : real(1)};
// how far a neighbor may be along an axis, and where a point is along it
auto reach_along = [&](int axis) -> real { return PERIODIC ? lattice.reach(axis) : radius; };
auto coordinate = [&](int axis, const real* p) -> real {
    if constexpr (PERIODIC)
        return lattice.along(axis, p);
    else
        return p[axis];
};
int periodic_axes = 0;  // a bit each
for (int axis = 0; PERIODIC && axis < DIM; ++axis)
    periodic_axes |= lattice.periodic(axis) << axis;
auto is_periodic = [&](int axis) -> bool { return PERIODIC && (periodic_axes >> axis & 1); };
auto cell_scale = [&](int axis) -> real {
    return axis == 0 ? inverse_edge[0] : !PERIODIC || axis == 1 ? inverse_edge[1] : inverse_edge[2];
};
auto cell_of = [&](int axis, real x) -> real {  // a whole float, monotone in x
#if defined(__CUDA_ARCH__)
    if constexpr (DOUBLE)
        return floor(__dmul_rn(x, cell_scale(axis)));
    else
        return floorf(__fmul_rn(x, cell_scale(axis)));
#else
    return DOUBLE ? real(__builtin_floor(x * inverse_edge[axis])) : real(__builtin_floorf(x * inverse_edge[axis]));
#endif
};
// The exponent of a float's lowest bit: it is a multiple of 2 to that. Zero is a multiple of everything.
auto lowest_bit = [](real x) -> int {
    const int e = Bits::exponent(x);
    const unsigned long long lead = e ? 1ull << Bits::MANTISSA : 0;
    const unsigned long long mantissa = (Bits::of(x) & ((1ull << Bits::MANTISSA) - 1)) | lead;
#if defined(__CUDA_ARCH__)
    const int zeros = (DOUBLE ? __ffsll((long long)mantissa) : __ffs((int)mantissa)) - 1;
#else
    const int zeros = mantissa ? __builtin_ctzll(mantissa) : -1;
#endif
    return zeros < 0 ? 1 << 20 : (e > 1 ? e : 1) - Bits::BIAS - Bits::MANTISSA + zeros;
};
// Do all coordinates lie on a lattice of which the cutoff is a moderate multiple, crystals and the usual start of an SPH run? Then
// squared distances near the cutoff are whole numbers of squared units, computed without any rounding, and working precision
// decides ties as well. `lowest` is the lowest bit of all coordinates, as they were given, `highest` their largest exponent, which
// matters where they are moved by lattice vectors: all sums must be exact. Returns the unit, or 0.
constexpr int UNITS = DOUBLE ? 24 : 10;  // bits of the cutoff in units; its square has twice as many, less than a float has
auto lattice_unit = [&](int lowest, int highest) -> real {
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
};
// the end of a stencil may be infinite, though no particle is: the largest float instead
auto in_range = [](real x) -> real {
    constexpr real MOST = DOUBLE ? real(1.7976931348623157e308) : real(3.4028234663852886e38f);
    return x < -MOST ? -MOST : x > MOST ? MOST : x;
};
// number of a cell, monotone, consecutive for cells that touch: the integer itself, or the bits of floats too large for that
auto cell_number = [&](real cell) -> whole {
    constexpr real WHOLE = DOUBLE ? real(9007199254740992.0) : real(16777216.0f);
    const real magnitude = cell < 0 ? -cell : cell;
    const whole beyond = (whole)(Bits::of(magnitude) - Bits::of(WHOLE)) + (whole)WHOLE;
    const whole number = magnitude < WHOLE ? (whole)magnitude : beyond;
    return cell < 0 ? -number : number;
};

// The grid: `dense` boxes number their cells row-major, x fastest, systems slowest: systems share no cell. In a larger box a row of
// cells (all but x) starts at a hashed place of a ring of `cells` entries; x runs on from there. Rows that collide share entries:
// their particles are mere candidates, and may be of another system.
struct Grid {
    real low[3];  // lowest cell that holds a source
    int extent[3];  // cells per axis (dense)
    int cells;  // entries of the table in use
    int dense;
    int finite;  // sources with finite coordinates
};
auto row_hash = [](long long y, long long z, unsigned int system, int cells) -> int {
    unsigned long long h = (unsigned long long)y * 0x9e3779b97f4a7c15ull ^ (unsigned long long)z * 0xc2b2ae3d27d4eb4full;
    if constexpr (BATCHED)
        h ^= (system + 1) * 0x9fb21c651e98df25ull;
    h ^= h >> 32;
    h *= 0xd6e8feb86659fd93ull;
    h ^= h >> 32;
    h *= 0xd6e8feb86659fd93ull;
    h ^= h >> 32;
    return (int)(((h & 0xffffffffull) * (unsigned long long)cells) >> 32);
};
// cell along one axis as an integer: dense boxes count from the lowest cell, and everything outside is clamped to one cell beyond
auto axis_cell = [&](const Grid& grid, int k, real x) -> whole {
    const real cell = cell_of(k, x);
    if (is_periodic(k)) {  // from 0 on, whatever the box
        const real most = cell_scale(k) - 1;
        return cell < 0 ? 0 : cell < most ? (whole)cell : (whole)most;
    }
    if (!grid.dense)
        return cell_number(cell_of(k, in_range(x)));
    const real from_low = cell - grid.low[k];
    return from_low < 0 ? -1 : from_low < real(grid.extent[k]) ? (whole)from_low : (whole)grid.extent[k];
};
// cells of a periodic axis are numbered on beyond its ends: in which period a cell lies
auto period_of = [&](int axis, whole cell) -> int {
    const whole cells = (whole)cell_scale(axis);
    return (int)(cell >= 0 ? cell / cells : -1 - (-1 - cell) / cells);
};
auto row_start = [&](const Grid& grid, whole y, whole z, unsigned int system) -> int {
    if constexpr (BATCHED)
        z += grid.dense ? (whole)system * (DIM == 3 ? grid.extent[2] : 1) : 0;
    return grid.dense ? (int)((z * grid.extent[1] + y) * grid.extent[0]) : row_hash(y, z, system, grid.cells);
};
auto ring = [](whole x, int cells) -> int {
    const whole r = x % cells;
    return (int)(r < 0 ? r + cells : r);
};
// of a finite point; one outside a dense box is sorted into its border
auto cell_key = [&](const Grid& grid, const real* p, unsigned int system) -> int {
    whole cell[3] = {0, 0, 0};
    for (int k = 0; k < DIM; ++k) {
        const whole c = axis_cell(grid, k, coordinate(k, p)), end = grid.extent[k] - 1;
        cell[k] = !grid.dense ? c : c < 0 ? 0 : c > end ? end : c;
    }
    const int row = row_start(grid, cell[1], cell[2], system);
    return grid.dense ? row + (int)cell[0] : ring(row + ring(cell[0], grid.cells), grid.cells);
};
// number of cells of the box [low, high] of coordinates, and whether the table holds them
auto lay_out = [&](Grid& grid, const real* low, const real* high, int table) {
    double cells = BATCHED ? double(unsigned_of(cutoff.data[LATTICE_END])) + 1 : 1;
    for (int k = 0; k < DIM; ++k) {
        grid.low[k] = is_periodic(k) ? real(0) : cell_of(k, low[k]);
        const double extent = is_periodic(k) ? double(inverse_edge[k]) : double(cell_of(k, high[k])) - double(grid.low[k]) + 1;
        cells = extent <= table ? cells * extent : 2.0 * table;
        grid.extent[k] = extent <= table ? (int)extent : 1;
    }
    grid.dense = cells <= table;
    grid.cells = grid.dense ? (int)cells : table;
};
