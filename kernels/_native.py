"""The native text that every Warp kernel shares: where a pair is decided, which cell a coordinate is in, where scratch lies.

Each piece is C++17 for a function body, for Clang on the CPU and for NVRTC on CUDA alike; `snippet` joins them. Warp gives snippets
no way to call each other, so they share text, which the compiler inlines; and it defines `int` and `float` as macros with an
argument, hence the casts in C's style. `real` is the scalar type of the positions, `DIM` their dimension.

Why no pair is ever outside the cells that are searched: `cell_of` is a monotone function of the coordinate (a rounded product, a
floor, a clamp: each is monotone), and so is rounding. A source within the cutoff r of a query q has x between q - r and q + r; x is
a float, hence also between fl(q - r) and fl(q + r); its cell is therefore between theirs. This needs no bound on rounding errors,
holds far from the origin, and whatever the compiler contracts, as long as every use of `cell_of` is the same code.
"""

CELLS_PER_PARTICLE = 4  # size of the cell table; 16 B per particle
SMALLEST_TABLE = 4096


def snippet(scalar: str, dim: int, *pieces: str, **constants: int) -> str:
    """Return a block of native code for a scalar type ("float" or "double"), a dimension and named integer constants.

    The function around it must have the argument `cutoff`, an array of one scalar, and what the pieces need.
    """
    lines = [f"using real = {scalar};", f"using whole = {'long long' if scalar == 'double' else 'int'};"]
    lines += [f"constexpr int DIM = {dim};", f"constexpr bool DOUBLE = {int(scalar == 'double')};"]
    lines += [f"constexpr int {name} = {int(value)};" for name, value in constants.items()]
    return "\n".join(["", "{", _NO_CONTRACTION, *lines, _PORTABLE, *pieces, "}", ""])


def table_cells(sources: int) -> int:
    """Return the number of cells in the table for a number of sources."""
    return min(max(SMALLEST_TABLE, CELLS_PER_PARTICLE * sources), 2**30)


# Arithmetic that no compiler contracts or flushes, and bits of floats.
_NO_CONTRACTION = """
#if !defined(__CUDA_ARCH__)
#pragma clang fp contract(off)
#endif
"""
_PORTABLE = r"""
const real radius = cutoff.data[0];
#if defined(__CUDA_ARCH__)
auto add = [](double a, double b) { return __dadd_rn(a, b); };
auto mul = [](double a, double b) { return __dmul_rn(a, b); };
auto product_error = [](double a, double b, double p) { return __fma_rn(a, b, -p); };
#else
auto add = [](double a, double b) { return a + b; };
auto mul = [](double a, double b) { return a * b; };
auto product_error = [](double a, double b, double p) {
#if defined(__FMA__) || defined(__aarch64__)
    return __builtin_fma(a, b, -p);
#else
    const double ca = 134217729.0 * a, cb = 134217729.0 * b;  // Veltkamp's split
    const double ah = ca - (ca - a), bh = cb - (cb - b);
    const double al = a - ah, bl = b - bh;
    return al * bl - (((p - ah * bh) - al * bh) - ah * bl);
#endif
};
#endif
auto bits_of = [](real x) -> unsigned long long {
    if constexpr (DOUBLE) {
        unsigned long long b;
        memcpy(&b, &x, 8);
        return b;
    } else {
        unsigned int b;
        memcpy(&b, &x, 4);
        return b;
    }
};
auto is_finite = [&](real x) { return ((bits_of(x) >> (DOUBLE ? 52 : 23)) & (DOUBLE ? 0x7ff : 0xff)) != (DOUBLE ? 0x7ff : 0xff); };
"""

# Where a pair is decided. Needs `radius` and `closed`. Step 1 belongs to the kernels: working precision against `inside` and
# `outside`, a band of 8 eps around r^2 (3 eps would do, see jfrnn/_exact.py). `exact_pair` answers for what falls into the band:
# in twice the precision (float32), then by error-free sums, then in integers as wide as the float format.
EXACT = r"""
const int radius_exponent = [&] {
    const int e = (int)(bits_of(radius) >> (DOUBLE ? 52 : 23)) - (DOUBLE ? 1023 : 127);
    return e;
}();
// power of two that brings r into [1, 4) and is itself a normal float
auto power_of_two = [](int e) -> double {
    const unsigned long long b = (unsigned long long)(e + 1023) << 52;
    double x;
    memcpy(&x, &b, 8);
    return x;
};
const double unit_scale = power_of_two(radius_exponent > (DOUBLE ? 1022 : 126) ? -(DOUBLE ? 1022 : 126) : -radius_exponent);
const real step_scale = SCALED ? real(unit_scale) : real(1);
const real step_radius = SCALED ? radius * step_scale : radius;
const real step_eps = DOUBLE ? real(2.220446049250313e-16) : real(1.1920929e-07f);
const real inside = step_radius * step_radius * (real(1) - 8 * step_eps);
const real outside = step_radius * step_radius * (real(1) + 8 * step_eps);

auto two_sum = [&](double a, double b, double& error) {  // Knuth 1969
    const double s = add(a, b);
    const double bv = add(s, -a);
    error = add(add(a, -add(s, -bv)), add(b, -bv));
    return s;
};

// sign of |b - a|^2 - r^2 by error-free transformations (Ogita, Rump & Oishi 2005, doi:10.1137/030601818); 2: not proven
auto sum_sign = [&](const real* a, const real* b) -> int {
    constexpr int TERMS = 3 * DIM + 2;
    double term[TERMS];
    double slack = 0;
    bool plain = true;
    const double r = mul(double(radius), unit_scale);
    const double r2 = mul(r, r);
    term[0] = -r2;
    term[1] = -product_error(r, r, r2);
    const double smallest = power_of_two(radius_exponent - 450 < -970 ? -970 : radius_exponent - 450);
    for (int k = 0; k < DIM; ++k) {
        const double ak = double(a[k]), bk = double(b[k]);
        if constexpr (DOUBLE)
            plain = plain && (ak == 0 || !(ak > -smallest && ak < smallest)) && (bk == 0 || !(bk > -smallest && bk < smallest));
        double low;
        double high = two_sum(bk, -ak, low);
        high = mul(high, unit_scale);
        low = mul(low, unit_scale);
        plain = plain && high > -1e6 && high < 1e6;  // beyond, two_sum may have overflowed
        const double square = mul(high, high), tail = mul(mul(2, high), low);
        term[3 * k + 2] = square;
        term[3 * k + 3] = product_error(high, high, square);
        term[3 * k + 4] = tail;
        slack = add(slack, add(mul(tail < 0 ? -tail : tail, 2.220446049250313e-16), mul(mul(2, low), low)));
    }
    if (!plain)
        return 2;
    for (int pass = 0; pass < 3; ++pass) {  // VecSum: the exact sum stays, most of it in the last term
        double total = term[0];
        for (int t = 1; t < TERMS; ++t) {
            double error;
            total = two_sum(total, term[t], error);
            term[t - 1] = error;
        }
        term[TERMS - 1] = total;
    }
    double rest = slack;
    for (int t = 0; t < TERMS - 1; ++t)
        rest = add(rest, term[t] < 0 ? -term[t] : term[t]);
    rest = mul(2, rest);  // twice: covers the rounding of this sum itself
    const double lead = term[TERMS - 1];
    if (lead > rest)
        return 1;
    if (lead < -rest)
        return -1;
    return lead == 0 && rest == 0 ? 0 : 2;
};

// sign of |b - a|^2 - r^2 in integers: limbs of 24 bits in units of the smallest denormal, only the few that are not zero
auto integer_sign = [&](const real* a, const real* b) -> int {
    constexpr int LIMBS = DOUBLE ? 4 : 2;  // limbs that one mantissa can touch
    constexpr int MANTISSA = DOUBLE ? 52 : 23, EXPONENTS = DOUBLE ? 0x7ff : 0xff;
    auto first_limb = [&](real x) {
        const int e = (int)(bits_of(x) >> MANTISSA) & EXPONENTS;
        return ((e > 1 ? e : 1) - 1) / 24;
    };
    auto limb = [&](real x, int i) -> long long {
        const unsigned long long bits = bits_of(x);
        const int e = (int)(bits >> MANTISSA) & EXPONENTS;
        const unsigned long long mantissa = (bits & ((1ull << MANTISSA) - 1)) | ((unsigned long long)(e > 0) << MANTISSA);
        const int shift = 24 * i - ((e > 1 ? e : 1) - 1);
        const unsigned long long word = shift <= -24 || shift >= 64 ? 0 : shift >= 0 ? mantissa >> shift : mantissa << -shift;
        const long long value = (long long)(word & 0xffffff);
        return (bits >> (DOUBLE ? 63 : 31)) & 1 ? -value : value;
    };
    int lowest = first_limb(radius), highest = lowest;
    for (int k = 0; k < DIM; ++k) {
        const int la = first_limb(a[k]), lb = first_limb(b[k]);
        lowest = la < lowest ? la : lowest;
        lowest = lb < lowest ? lb : lowest;
        highest = la > highest ? la : highest;
        highest = lb > highest ? lb : highest;
    }
    long long carry = 0, seen = 0;
    for (int t = 2 * lowest; t < 2 * (highest + LIMBS); ++t) {
        long long sum = carry;
        for (int k = 0; k < DIM; ++k) {
            const int la = first_limb(a[k]), lb = first_limb(b[k]);
            for (int s = 0; s < 2 * LIMBS; ++s) {
                const int i = s < LIMBS ? la + s : lb + s - LIMBS;
                if (s >= LIMBS && i >= la && i < la + LIMBS)
                    continue;  // this limb stood in the first half
                sum += (limb(b[k], i) - limb(a[k], i)) * (limb(b[k], t - i) - limb(a[k], t - i));
            }
        }
        for (int s = 0; s < LIMBS; ++s)
            sum -= limb(radius, first_limb(radius) + s) * limb(radius, t - first_limb(radius) - s);
        seen |= sum & 0xffffff;
        carry = sum >> 24;
    }
    return carry < 0 ? -1 : (seen | carry) != 0;
};

// the bounds of float32 pairs in float64: at most 5 of 16 units of 2^-53 are lost in a sum of squares
const double doubly_inside = double(radius) * double(radius) * (1 - 0x1p-49);
const double doubly_outside = double(radius) * double(radius) * (1 + 0x1p-49);

auto exact_pair = [&](const real* a, const real* b) -> bool {
    if constexpr (!DOUBLE) {
        double square = 0;
        for (int k = 0; k < DIM; ++k) {
            const double d = double(b[k]) - double(a[k]);
            square += d * d;
        }
        if (square < doubly_inside)
            return true;
        if (square > doubly_outside)
            return false;
    }
    int sign = sum_sign(a, b);
    if (sign == 2)
        sign = integer_sign(a, b);
    return sign < 0 || (sign == 0 && closed);
};
"""

# Which cell a coordinate is in. Needs `radius`.
CELLS = r"""
const real inverse_edge = real(REACH) / radius;
auto cell_of = [&](real x) -> real {  // a whole float, monotone in x
#if defined(__CUDA_ARCH__)
    if constexpr (DOUBLE)
        return floor(__dmul_rn(x, inverse_edge));
    else
        return floorf(__fmul_rn(x, inverse_edge));
#else
    return DOUBLE ? real(__builtin_floor(x * inverse_edge)) : real(__builtin_floorf(x * inverse_edge));
#endif
};
// number of a cell, monotone, consecutive for cells that touch: the integer itself, or the bits of floats too large for that
auto cell_number = [&](real cell) -> whole {
    constexpr real WHOLE = DOUBLE ? real(9007199254740992.0) : real(16777216.0f);
    const real magnitude = cell < 0 ? -cell : cell;
    const whole beyond = (whole)(bits_of(magnitude) - bits_of(WHOLE)) + (whole)WHOLE;
    const whole number = magnitude < WHOLE ? (whole)magnitude : beyond;
    return cell < 0 ? -number : number;
};

// The grid: `dense` boxes number their cells row-major, x fastest. In a larger box a row of cells (all but x) starts at a hashed
// place of a ring of `cells` entries; x runs on from there. Rows that collide share entries: their particles are mere candidates.
struct Grid {
    real low[3];  // lowest cell that holds a source
    int extent[3];  // cells per axis (dense)
    int cells;  // entries of the table in use
    int dense;
    int finite;  // sources with finite coordinates
};
auto row_hash = [](long long y, long long z, int cells) -> int {
    unsigned long long h = (unsigned long long)y * 0x9e3779b97f4a7c15ull ^ (unsigned long long)z * 0xc2b2ae3d27d4eb4full;
    h ^= h >> 32;
    h *= 0xd6e8feb86659fd93ull;
    h ^= h >> 32;
    h *= 0xd6e8feb86659fd93ull;
    h ^= h >> 32;
    return (int)(((h & 0xffffffffull) * (unsigned long long)cells) >> 32);
};
// cell along one axis as an integer: dense boxes count from the lowest cell, and everything outside is clamped to one cell beyond
auto axis_cell = [&](const Grid& grid, int k, real x) -> whole {
    const real cell = cell_of(x);
    if (!grid.dense)
        return cell_number(cell);
    const real from_low = cell - grid.low[k];
    return from_low < 0 ? -1 : from_low < real(grid.extent[k]) ? (whole)from_low : (whole)grid.extent[k];
};
auto row_start = [&](const Grid& grid, whole y, whole z) -> int {
    return grid.dense ? (int)((z * grid.extent[1] + y) * grid.extent[0]) : row_hash(y, z, grid.cells);
};
auto ring = [](whole x, int cells) -> int {
    const whole r = x % cells;
    return (int)(r < 0 ? r + cells : r);
};
auto cell_key = [&](const Grid& grid, const real* p) -> int {  // a finite point; one outside a dense box is sorted into its border
    whole cell[3] = {0, 0, 0};
    for (int k = 0; k < DIM; ++k) {
        const whole c = axis_cell(grid, k, p[k]), end = grid.extent[k] - 1;
        cell[k] = !grid.dense ? c : c < 0 ? 0 : c > end ? end : c;
    }
    const int row = row_start(grid, cell[1], cell[2]);
    return grid.dense ? row + (int)cell[0] : ring(row + ring(cell[0], grid.cells), grid.cells);
};
// number of cells of a box of doubles [low, high] of cells, and whether the table holds them
auto lay_out = [&](Grid& grid, const real* low, const real* high, int table) {
    double cells = 1;
    for (int k = 0; k < DIM; ++k) {
        grid.low[k] = cell_of(low[k]);
        const double extent = double(cell_of(high[k])) - double(grid.low[k]) + 1;
        cells = extent <= table ? cells * extent : 2.0 * table;
        grid.extent[k] = extent <= table ? (int)extent : 1;
    }
    grid.dense = cells <= table;
    grid.cells = grid.dense ? (int)cells : table;
};
"""
