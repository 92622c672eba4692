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


# Where space is periodic, the radius in the array `cutoff` is followed by the lattice: its vectors and the transform,
# row by row (3 x 3 each); origin, half the width of the stencil in units of the transform, images within reach (3 each); slack.
# Where it is skewed, its vectors as they were given follow, and which whole numbers of those the vectors are (3 x 3 each).
# Of a batch, the highest number of a system comes last.


def snippet(scalar: str, dim: int, *pieces: str, **constants: int) -> str:
    """Return a block of native code for a scalar type ("float" or "double"), a dimension and named integer constants.

    The function around it must have the argument `cutoff`, an array of one scalar, and what the pieces need. PERIODIC is 0 in an
    open space, 1 where the nearest image is the only one that can be a neighbor, 2 where images are told apart: `cutoff` then goes
    on with the numbers of the lattice, and a row of positions goes on with its packed turns (see `jfrnn._box`). Where vectors of it
    do not lie along the axes, it is given as two more, and the text finds SKEWED. BATCHED is 1 where a row ends with the number of
    its system (see `jfrnn._batch`). Such integers are the bits of a float, or the value of a double. SUM is 1 where the cutoff of a
    pair is the sum of two numbers. SHIFTED is 0 where all pairs that are decided are those of points as they are, though space is
    periodic.
    """
    lines = [f"using real = {scalar};", f"using whole = {'long long' if scalar == 'double' else 'int'};"]
    lines += [f"constexpr int DIM = {dim};", f"constexpr bool DOUBLE = {int(scalar == 'double')};"]
    constants = {**_DEFAULTS, "SHIFTED": constants.get("PERIODIC", 0), **constants}
    constants["SKEWED"] = constants["PERIODIC"] > SKEWED
    constants |= {name: constants[name] - SKEWED for name in ("PERIODIC", "SHIFTED") if constants[name] > SKEWED}
    lines += [f"constexpr int {name} = {int(value)};" for name, value in constants.items()]
    return "\n".join(["", "{", _NO_CONTRACTION, *lines, _PORTABLE, *pieces, "}", ""])


SKEWED = 2
SPACES = ("", "_nearest", "_images", "_nearest_skewed", "_images_skewed")  # in names of variants
_DEFAULTS = {"ORDER": 0, "PERIODIC": 0, "BATCHED": 0, "SUM": 0}


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
#define JFRNN_FUNCTION static __device__ __forceinline__
#define JFRNN_MEMBER __device__ __forceinline__
#define JFRNN_CALL static __device__ __noinline__
#else
#define JFRNN_FUNCTION static
#define JFRNN_MEMBER
#define JFRNN_CALL static __attribute__((noinline))
#endif
constexpr int ROW = DIM + (PERIODIC ? 1 : 0) + BATCHED;  // numbers per particle
constexpr int LATTICE_END = PERIODIC ? (SKEWED ? 47 : 29) : 1;  // numbers in `cutoff`, but for the last one of a batch
struct Bits {  // of floats
    enum { MANTISSA = DOUBLE ? 52 : 23, EXPONENTS = DOUBLE ? 0x7ff : 0xff, BIAS = DOUBLE ? 1023 : 127 };
    JFRNN_FUNCTION unsigned long long of(real x) {
        if constexpr (DOUBLE) {
            unsigned long long b;
            memcpy(&b, &x, 8);
            return b;
        } else {
            unsigned int b;
            memcpy(&b, &x, 4);
            return b;
        }
    }
    JFRNN_FUNCTION int exponent(real x) { return (int)(of(x) >> MANTISSA) & EXPONENTS; }
    JFRNN_FUNCTION bool finite(real x) { return exponent(x) != EXPONENTS; }
    JFRNN_FUNCTION bool negative(real x) { return of(x) >> (DOUBLE ? 63 : 31) & 1; }
    JFRNN_FUNCTION real not_finite() {
        const unsigned long long b = (unsigned long long)EXPONENTS << MANTISSA;
        real x;
        memcpy(&x, &b, sizeof(real));
        return x;
    }
    JFRNN_FUNCTION double power_of_two(int e) {
        const unsigned long long b = (unsigned long long)(e + 1023) << 52;
        double x;
        memcpy(&x, &b, 8);
        return x;
    }
    // power of two that brings r into [1, 4) and is itself a normal float
    JFRNN_FUNCTION double unit_scale(real r) {
        const int e = exponent(r) - BIAS, largest = BIAS - 1;
        return power_of_two(e > largest ? -largest : -e);
    }
};
auto finite_point = [](const real* p) {
    bool finite = true;
    for (int k = 0; k < DIM; ++k)
        finite = finite && Bits::finite(p[k]);
    return finite;
};
auto unsigned_of = [](real x) -> unsigned int {
    unsigned int bits;
    if constexpr (DOUBLE) bits = (unsigned int)x;
    else memcpy(&bits, &x, 4);
    return bits;
};
auto system_of = [&](const real* row) -> unsigned int { return BATCHED ? unsigned_of(row[ROW - 1]) : 0u; };
struct Lattice {
    enum { NONE = 512 | 512 << 10 | (DIM == 3 ? 512 << 20 : 0) };  // packed turns of what lies in the cell
    const real* numbers;
    JFRNN_MEMBER real vector(int l, int k) const { return numbers[1 + 3 * l + k]; }
    // the vectors that the caller gave, in which pairs are decided, and how many of each there are in vector l
    JFRNN_MEMBER real given(int l, int k) const { return numbers[(SKEWED ? 29 : 1) + 3 * l + k]; }
    JFRNN_MEMBER int number(int l, int k) const { return SKEWED ? (int)numbers[38 + 3 * l + k] : l == k; }
    JFRNN_MEMBER real transform(int k, int axis) const { return numbers[10 + 3 * k + axis]; }
    JFRNN_MEMBER real origin(int k) const { return numbers[19 + k]; }
    JFRNN_MEMBER real reach(int axis) const { return numbers[22 + axis]; }
    JFRNN_MEMBER int images(int axis) const { return (int)numbers[25 + axis]; }
    JFRNN_MEMBER real slack() const { return numbers[28]; }
    JFRNN_MEMBER bool periodic(int axis) const { return images(axis) > 0; }
    // uncontracted, so that a coordinate is the same wherever it is computed
#if defined(__CUDA_ARCH__)
    JFRNN_FUNCTION real add(real a, real b) {
        if constexpr (DOUBLE) return __dadd_rn(a, b);
        else return __fadd_rn(a, b);
    }
    JFRNN_FUNCTION real mul(real a, real b) {
        if constexpr (DOUBLE) return __dmul_rn(a, b);
        else return __fmul_rn(a, b);
    }
#else
    JFRNN_FUNCTION real add(real a, real b) { return a + b; }
    JFRNN_FUNCTION real mul(real a, real b) { return a * b; }
#endif
    // turns of a row: how many lattice vectors lie between the cell and the particle
    JFRNN_FUNCTION int packed_turns(real last) {
        int packed;
        if constexpr (DOUBLE) packed = (int)last;
        else memcpy(&packed, &last, 4);
        return packed;
    }
    JFRNN_FUNCTION int turn(real last, int axis) { return ((packed_turns(last) >> (10 * axis)) & 1023) - 512; }
    // component k of S·A
    JFRNN_MEMBER real translation(int sx, int sy, int sz, int k) const {
        if constexpr (!SKEWED)  // its vectors lie along the axes, and what others would add is 0
            return mul(real(k == 0 ? sx : k == 1 ? sy : sz), vector(k, k));
        real sum = mul(real(sx), vector(0, k));
        sum = add(sum, mul(real(sy), vector(1, k)));
        return DIM == 3 ? add(sum, mul(real(sz), vector(2, k))) : sum;
    }
    // a row of positions brought into the cell; one that is too far away for that is not finite
    JFRNN_MEMBER void wrap(const real* numbers, real* p) const {
        struct alignas(ROW % 4 ? sizeof(real) : 16) Row { real numbers[ROW]; };  // loaded at once, if it can be
        const Row loaded = *(const Row*)numbers;
        const real* row = loaded.numbers;
        if (packed_turns(row[DIM]) == NONE) {  // as nearly everywhere
            for (int k = 0; k < DIM; ++k)
                p[k] = row[k];
            return;
        }
        const int t[3] = {turn(row[DIM], 0), turn(row[DIM], 1), DIM == 3 ? turn(row[DIM], 2) : 0};
        for (int k = 0; k < DIM; ++k)
            p[k] = t[0] | t[1] | t[2] ? add(row[k], -translation(t[0], t[1], t[2], k)) : row[k];
        if (Bits::negative(row[DIM]))
            p[0] = Bits::not_finite();
    }
    // coordinate of a wrapped point along an axis of cells: a fraction where that is periodic, else a length
    JFRNN_MEMBER real along(int axis, const real* p) const {
        real sum = mul(add(p[axis], -origin(axis)), transform(axis, axis));
        if constexpr (SKEWED) {
            sum = mul(add(p[0], -origin(0)), transform(0, axis));
            for (int k = 1; k < DIM; ++k)
                sum = add(sum, mul(add(p[k], -origin(k)), transform(k, axis)));
        }
        if (!periodic(axis))
            return sum;
        return sum < 0 ? real(0) : sum > 1 ? real(1) : sum;
    }
};
#if defined(__CUDA_ARCH__)
const Lattice lattice{cutoff.data};
#else
real numbers[LATTICE_END];  // not the caller's: nothing that is written may change them
for (int k = 0; PERIODIC && k < LATTICE_END; ++k)
    numbers[k] = cutoff.data[k];
const Lattice lattice{numbers};
#endif
// the point of a row of positions, wrapped where space is periodic
auto point_of = [&](const real* row, real* p) {
    if constexpr (PERIODIC)
        lattice.wrap(row, p);
    else
        for (int k = 0; k < DIM; ++k)
            p[k] = row[k];
};
// the bounding box [low, high] grows to hold the box [l, h]
auto widen = [](real* low, real* high, const real* l, const real* h) {
    for (int k = 0; k < DIM; ++k) {
        low[k] = l[k] < low[k] ? l[k] : low[k];
        high[k] = h[k] > high[k] ? h[k] : high[k];
    }
};
"""

# XLA's threads flush denormals to zero on the CPU: undo that while native code runs. In between, what users compute is flushed, as
# XLA does, and for its speed; what decides about pairs is kept.
KEEP = r"""
#if defined(__SSE__) && !defined(__CUDA_ARCH__)
__builtin_ia32_ldmxcsr(float_control & ~0x8040u);
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
asm volatile("msr fpcr, %0" : : "r"(float_control & ~(1ull << 24)));
#endif
"""
FLUSH = r"""
#if defined(__SSE__) && !defined(__CUDA_ARCH__)
__builtin_ia32_ldmxcsr(float_control | 0x8040u);
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
asm volatile("msr fpcr, %0" : : "r"(float_control | (1ull << 24)));
#endif
"""
ENTER = (
    r"""
#if defined(__SSE__) && !defined(__CUDA_ARCH__)
const unsigned int float_control = __builtin_ia32_stmxcsr();
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
unsigned long long float_control;
asm volatile("mrs %0, fpcr" : "=r"(float_control));
#endif
"""
    + KEEP
)
LEAVE = r"""
#if defined(__SSE__) && !defined(__CUDA_ARCH__)
__builtin_ia32_ldmxcsr(float_control);
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
asm volatile("msr fpcr, %0" : : "r"(float_control));
#endif
"""

# Where a pair is decided. Step 1 belongs to the kernels: working precision and a band of 8 eps around r^2 (4 on the CPU, see
# jfrnn/_exact.py). `Exact::pair` answers for what falls into the band: in twice the precision (float32), then by error-free sums,
# then in integers as wide as the float format. It is a call, not inlined, so that what it needs is not held in registers elsewhere.
EXACT = r"""
const real step_scale = SCALED ? real(Bits::unit_scale(radius)) : real(1);
const real step_radius = SCALED ? radius * step_scale : radius;
const real step_eps = DOUBLE ? real(2.220446049250313e-16) : real(1.1920929e-07f);

struct Exact {
#if defined(__CUDA_ARCH__)
    JFRNN_FUNCTION double add(double a, double b) { return __dadd_rn(a, b); }
    JFRNN_FUNCTION double mul(double a, double b) { return __dmul_rn(a, b); }
    JFRNN_FUNCTION double product_error(double a, double b, double p) { return __fma_rn(a, b, -p); }
#else
    JFRNN_FUNCTION double add(double a, double b) { return a + b; }
    JFRNN_FUNCTION double mul(double a, double b) { return a * b; }
    JFRNN_FUNCTION double product_error(double a, double b, double p) {
#if defined(__FMA__) || defined(__aarch64__)
        return __builtin_fma(a, b, -p);
#else
        const double ca = 134217729.0 * a, cb = 134217729.0 * b;  // Veltkamp's split
        const double ah = ca - (ca - a), bh = cb - (cb - b);
        const double al = a - ah, bl = b - bh;
        return al * bl - (((p - ah * bh) - al * bh) - ah * bl);
#endif
    }
#endif
    JFRNN_FUNCTION double size_of(double x) { return x < 0 ? -x : x; }
    // has x at most 26 bits? Then its square is exact.
    JFRNN_FUNCTION bool is_narrow(double x) {
        unsigned long long bits;
        memcpy(&bits, &x, 8);
        return (bits & 0x7ffffff) == 0;
    }
    JFRNN_FUNCTION double two_sum(double a, double b, double& error) {  // Knuth 1969
        const double s = add(a, b);
        const double bv = add(s, -a);
        error = add(add(a, -add(s, -bv)), add(b, -bv));
        return s;
    }

    // size of the smallest coordinate with which products of differences do not underflow
    JFRNN_FUNCTION double smallest_plain(real larger) {
        const int exponent = Bits::exponent(larger) - Bits::BIAS;
        return Bits::power_of_two(exponent - 450 < -970 ? -970 : exponent - 450);
    }

    // sign of |b + S·A - a|^2 - r^2 by error-free transformations (Ogita, Rump & Oishi 2005, doi:10.1137/030601818); 2: not proven.
    // Where cutoffs are sums, r is that of `radius` and `more`, here and below.
    JFRNN_FUNCTION int sum_sign(const real* a, const real* b, real radius, real more, const int* shift, Lattice lattice) {
        constexpr int TERMS = 3 * DIM + 2 + SUM;
        double term[TERMS];
        double slack = 0;
        bool plain = true;
        const real larger = SUM && more > radius ? more : radius;
        const double scale = Bits::unit_scale(larger);
        const double smallest = smallest_plain(larger);
        double r = mul(double(radius), scale);
        if constexpr (SUM) {
            double rest;
            r = two_sum(r, mul(double(more), scale), rest);
            const double tail = mul(mul(-2, r), rest);
            term[TERMS - 1] = tail;
            slack = add(mul(size_of(tail), 2.220446049250313e-16), mul(mul(2, rest), rest));
            plain = (radius == 0 || !(double(radius) < smallest)) && (more == 0 || !(double(more) < smallest));
        }
        const double r2 = mul(r, r);
        term[0] = -r2;
        term[1] = -product_error(r, r, r2);
        double whole_square = 0;
        bool rounded = term[1] != 0 || slack != 0 || (SUM && term[TERMS - 1] != 0);  // else all may be exact, as on many lattices
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const double ak = double(a[k]), bk = double(b[k]);
            if constexpr (DOUBLE)
                plain = plain && (ak == 0 || !(size_of(ak) < smallest)) && (bk == 0 || !(size_of(bk) < smallest));
            double low;
            double high = two_sum(bk, -ak, low);
            if constexpr (SHIFTED) {
                double rest = 0;
                for (int l = 0; l < DIM; ++l) {
                    const double v = double(lattice.given(l, k)), s = double(shift[l]);
                    if constexpr (DOUBLE)
                        plain = plain && (v == 0 || !(size_of(v) < smallest));
                    const double p = mul(s, v);
                    double carried, one, other;
                    high = two_sum(high, p, carried);
                    low = two_sum(low, carried, one);
                    low = two_sum(low, product_error(s, v, p), other);
                    high = two_sum(high, low, carried);
                    low = carried;
                    rest = add(rest, add(size_of(one), size_of(other)));
                }
                rest = mul(rest, scale);
                slack = add(slack, mul(2, mul(rest, add(mul(2, size_of(mul(high, scale))), rest))));
            }
            high = mul(high, scale);
            low = mul(low, scale);
            plain = plain && size_of(high) < 1e6;  // beyond, two_sum may have overflowed
            const double square = mul(high, high), tail = mul(mul(2, high), low);
            double lost;
            whole_square = two_sum(whole_square, square, lost);
            rounded = rounded || low != 0 || lost != 0 || !is_narrow(high);
            term[3 * k + 2] = square;
            term[3 * k + 3] = product_error(high, high, square);
            term[3 * k + 4] = tail;
            slack = add(slack, add(mul(size_of(tail), 2.220446049250313e-16), mul(mul(2, low), low)));
        }
        if (!plain)
            return 2;
        if (!rounded && slack == 0)
            return whole_square < r2 ? -1 : whole_square > r2;
#pragma unroll
        for (int pass = 0; pass < 3; ++pass) {  // VecSum: the exact sum stays, most of it in the last term
            double total = term[0];
#pragma unroll
            for (int t = 1; t < TERMS; ++t) {
                double error;
                total = two_sum(total, term[t], error);
                term[t - 1] = error;
            }
            term[TERMS - 1] = total;
        }
        double rest = slack;
#pragma unroll
        for (int t = 0; t < TERMS - 1; ++t)
            rest = add(rest, size_of(term[t]));
        rest = mul(2, rest);  // twice: covers the rounding of this sum itself
        const double lead = term[TERMS - 1];
        return lead > rest ? 1 : lead < -rest ? -1 : lead == 0 && rest == 0 ? 0 : 2;
    }

    // limb i of a float: 24 bits of its integer in units of the smallest denormal
    JFRNN_FUNCTION int first_limb(real x) {
        const int e = Bits::exponent(x);
        return ((e > 1 ? e : 1) - 1) / 24;
    }
    JFRNN_FUNCTION long long limb(real x, int i) {
        const unsigned long long bits = Bits::of(x), lead = Bits::exponent(x) > 0;
        const unsigned long long mantissa = (bits & ((1ull << Bits::MANTISSA) - 1)) | (lead << Bits::MANTISSA);
        const int e = Bits::exponent(x), shift = 24 * i - ((e > 1 ? e : 1) - 1);
        const unsigned long long word = shift <= -24 || shift >= 64 ? 0 : shift >= 0 ? mantissa >> shift : mantissa << -shift;
        const long long value = (long long)(word & 0xffffff);
        return (bits >> (DOUBLE ? 63 : 31)) & 1 ? -value : value;
    }
    // sign of |b - a|^2 - r^2 in integers: only the few limbs that are not zero are multiplied
    JFRNN_CALL int integer_sign(real ax, real ay, real az, real bx, real by, real bz, real radius, real more) {
        constexpr int LIMBS = DOUBLE ? 4 : 2;  // that one mantissa can touch
        const int lr = first_limb(radius);
        int lowest = lr, highest = lr, lm = 0;
        if constexpr (SUM) {
            lm = first_limb(more);
            lowest = lm < lowest ? lm : lowest;
            highest = lm > highest ? lm : highest;
        }
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const int la = first_limb(k == 0 ? ax : k == 1 ? ay : az), lb = first_limb(k == 0 ? bx : k == 1 ? by : bz);
            lowest = la < lowest ? la : lowest;
            lowest = lb < lowest ? lb : lowest;
            highest = la > highest ? la : highest;
            highest = lb > highest ? lb : highest;
        }
        long long carry = 0, seen = 0;
        for (int t = 2 * lowest; t < 2 * (highest + LIMBS); ++t) {
            long long sum = carry;
            for (int k = 0; k < DIM; ++k) {
                const real a = k == 0 ? ax : k == 1 ? ay : az, b = k == 0 ? bx : k == 1 ? by : bz;
                const int la = first_limb(a), lb = first_limb(b);
                for (int s = 0; s < 2 * LIMBS; ++s) {
                    const int i = s < LIMBS ? la + s : lb + s - LIMBS;
                    if (s >= LIMBS && i >= la && i < la + LIMBS)
                        continue;  // this limb stood in the first half
                    sum += (limb(b, i) - limb(a, i)) * (limb(b, t - i) - limb(a, t - i));
                }
            }
            if constexpr (SUM)
                for (int s = 0; s < 2 * LIMBS; ++s) {
                    const int i = s < LIMBS ? lr + s : lm + s - LIMBS;
                    if (s < LIMBS || i < lr || i >= lr + LIMBS)
                        sum -= (limb(radius, i) + limb(more, i)) * (limb(radius, t - i) + limb(more, t - i));
                }
            else
                for (int s = 0; s < LIMBS; ++s)
                    sum -= limb(radius, lr + s) * limb(radius, t - lr - s);
            seen |= sum & 0xffffff;
            carry = sum >> 24;
        }
        return carry < 0 ? -1 : (seen | carry) != 0;
    }

    // the same with a lattice: the difference may fill all limbs
    JFRNN_CALL int integer_sign_of_image(
        const real* a, const real* b, real radius, real more, const int* shift, Lattice lattice) {
        constexpr int LIMBS = DOUBLE ? 4 : 2, ALL = DOUBLE ? 92 : 15;
        long long total[2 * ALL], part[ALL];
        for (int t = 0; t < 2 * ALL; ++t)
            total[t] = 0;
        auto put = [&](real x, long long times) {
            const int first = first_limb(x);
            for (int s = 0; s < LIMBS; ++s)
                part[first + s] += times * limb(x, first + s);
        };
        for (int k = 0; k < DIM; ++k) {
            for (int i = 0; i < ALL; ++i)
                part[i] = 0;
            put(b[k], 1);
            put(a[k], -1);
            for (int l = 0; l < DIM; ++l)
                put(lattice.given(l, k), shift[l]);
            int lowest = ALL, highest = 0;
            for (int i = 0; i < ALL; ++i) {  // carry into [-2^23, 2^23)
                if (i + 1 < ALL) {
                    const long long carry = (part[i] + (1 << 23)) >> 24;
                    part[i] -= carry << 24;
                    part[i + 1] += carry;
                }
                if (part[i]) {
                    lowest = i < lowest ? i : lowest;
                    highest = i;
                }
            }
            for (int i = lowest; i <= highest; ++i)
                for (int j = lowest; j <= highest; ++j)
                    total[i + j] += part[i] * part[j];
        }
        if constexpr (SUM) {
            for (int i = 0; i < ALL; ++i)
                part[i] = 0;
            put(radius, 1);
            put(more, 1);
            for (int i = 0; i < ALL; ++i)
                for (int j = 0; j < ALL && part[i]; ++j)
                    total[i + j] -= part[i] * part[j];
        } else {
            const int first = first_limb(radius);
            for (int i = first; i < first + LIMBS; ++i)
                for (int j = first; j < first + LIMBS; ++j)
                    total[i + j] -= limb(radius, i) * limb(radius, j);
        }
        long long carry = 0, seen = 0;
        for (int t = 0; t < 2 * ALL; ++t) {
            const long long sum = total[t] + carry;
            seen |= sum & 0xffffff;
            carry = sum >> 24;
        }
        return carry < 0 ? -1 : (seen | carry) != 0;
    }

    // does b + S·A lie within the cutoff of a? S are the whole numbers of given vectors that turns and image add up to
    JFRNN_CALL bool image_pair(
        const real* a, const real* b, real radius, real more, bool closed, const int* shift, Lattice lattice) {
        if constexpr (!DOUBLE) {
            double square = 0, doubt = 0;
            const double r = SUM ? double(radius) + double(more) : double(radius), r2 = r * r;
            for (int k = 0; k < DIM; ++k) {
                double d = double(b[k]) - double(a[k]), size = size_of(double(a[k])) + size_of(double(b[k]));
                for (int l = 0; l < DIM; ++l) {
                    const double p = double(shift[l]) * double(lattice.given(l, k));
                    d += p;
                    size += size_of(p);
                }
                const double e = size * 0x1p-50;
                square += d * d;
                doubt += e * (2 * size_of(d) + e);
            }
            doubt = 2 * doubt + 0x1p-49 * (r2 + square);
            if (square + doubt < r2)
                return true;
            if (square - doubt > r2)
                return false;
        }
        int sign = sum_sign(a, b, radius, more, shift, lattice);
        if (sign == 2)
            sign = integer_sign_of_image(a, b, radius, more, shift, lattice);
        return sign < 0 || (sign == 0 && closed);
    }

    // the bounds of float32 pairs in float64: at most 5 of 16 units of 2^-53 are lost in a sum of squares
    JFRNN_FUNCTION double doubly_inside(double radius) { return radius * radius * (1 - 0x1p-49); }
    JFRNN_FUNCTION double doubly_outside(double radius) { return radius * radius * (1 + 0x1p-49); }

    JFRNN_CALL bool pair(real ax, real ay, real az, real bx, real by, real bz, real radius, real more, bool closed) {
        const real a[3] = {ax, ay, az}, b[3] = {bx, by, bz};
        if constexpr (!DOUBLE) {
            double square = 0;
#pragma unroll
            for (int k = 0; k < DIM; ++k) {
                const double d = double(b[k]) - double(a[k]);
                square += d * d;
            }
            const double r = SUM ? double(radius) + double(more) : double(radius);
            if (square < doubly_inside(r))
                return true;
            if (square > doubly_outside(r))
                return false;
        }
        int sign = sum_sign(a, b, radius, more, nullptr, Lattice{});
        if (sign == 2)
            sign = integer_sign(ax, ay, az, bx, by, bz, radius, more);
        return sign < 0 || (sign == 0 && closed);
    }
};
// Where coordinates lie on a lattice: the square, in units, that separates those of pairs from all others, half a unit from both.
auto square_between = [&](real unit) -> double {
    const double r = double(radius) / double(unit), square = r * r, error = Exact::product_error(r, r, square);
    double whole_part = double((long long)square);
    if (whole_part == square && error < 0)
        whole_part -= 1;
    const bool tie = whole_part == square && error == 0;
    return (tie && !closed ? whole_part - 1 : whole_part) + 0.5;
};
// the image of a source that a query meets: rows of positions as they were given, the code of the image of wrapped points, and the
// cutoff, where it is a sum of two numbers
auto exact_image_within = [&](const real* query, const real* source, int image, real radius, real more) {
    int shift[3] = {0, 0, 0};
    for (int axis = DIM - 1; axis >= 0; --axis) {
        const int k = lattice.images(axis), codes = 2 * k + 1;
        shift[axis] = image % codes - k + Lattice::turn(query[DIM], axis) - Lattice::turn(source[DIM], axis);
        image /= codes;
    }
    if constexpr (SKEWED) {
        int sums[3] = {0, 0, 0};
        for (int l = 0; l < DIM; ++l)
            for (int k = 0; k < DIM; ++k)
                sums[k] += shift[l] * lattice.number(l, k);
        for (int k = 0; k < DIM; ++k)
            shift[k] = sums[k];
    }
    return Exact::image_pair(query, source, radius, more, closed, shift, lattice);
};
auto exact_image = [&](const real* query, const real* source, int image) {
    return exact_image_within(query, source, image, radius, 0);
};
auto exact_pair = [&](const real* a, const real* b) {
    return Exact::pair(a[0], a[1], DIM == 3 ? a[DIM - 1] : 0, b[0], b[1], DIM == 3 ? b[DIM - 1] : 0, radius, 0, closed);
};
"""

# Which cell a coordinate is in: REACH cells fit into a cutoff along y and z, REACH_X along x. Needs `radius`.
CELLS = r"""
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
// place of a cell on a space-filling curve, in boxes of 2^bits cells per axis: to be compared with row-major order
auto curve = [](const Grid& grid, unsigned int x, unsigned int y, unsigned int z) -> int {
    int bits = 1;
    for (int k = 0; k < DIM; ++k)
        while ((1 << bits) < grid.extent[k])
            ++bits;
    if (ORDER == 2) {  // Hilbert (Skilling 2004, doi:10.1063/1.1751381)
        unsigned int c[3] = {z, y, x};
        for (unsigned int q = 1u << (bits - 1); q > 1; q >>= 1)
            for (int k = 0; k < 3; ++k)
                if (c[k] & q)
                    c[0] ^= q - 1;
                else {
                    const unsigned int t = (c[0] ^ c[k]) & (q - 1);
                    c[0] ^= t;
                    c[k] ^= t;
                }
        c[1] ^= c[0];
        c[2] ^= c[1];
        unsigned int t = 0;
        for (unsigned int q = 1u << (bits - 1); q > 1; q >>= 1)
            t ^= c[2] & q ? q - 1 : 0;
        z = c[0] ^ t;
        y = c[1] ^ t;
        x = c[2] ^ t;
    }
    unsigned int key = 0;  // Morton: the bits of all axes in turn
    for (int b = 0; b < bits; ++b)
        key |= (x >> b & 1) << 3 * b | (y >> b & 1) << (3 * b + 1) | (z >> b & 1) << (3 * b + 2);
    return (int)key;
};
// of a finite point; one outside a dense box is sorted into its border
auto cell_key = [&](const Grid& grid, const real* p, unsigned int system) -> int {
    whole cell[3] = {0, 0, 0};
    for (int k = 0; k < DIM; ++k) {
        const whole c = axis_cell(grid, k, coordinate(k, p)), end = grid.extent[k] - 1;
        cell[k] = !grid.dense ? c : c < 0 ? 0 : c > end ? end : c;
    }
    if (ORDER != 0)
        return curve(grid, (unsigned int)cell[0], (unsigned int)cell[1], (unsigned int)cell[2]);
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
    if (ORDER != 0) {  // a cube of 2^bits cells per axis; the caller's table must hold it
        int side = 2;
        for (int k = 0; k < DIM; ++k)
            while (side < grid.extent[k])
                side *= 2;
        cells = double(side) * side * side;
    }
    grid.dense = cells <= table;
    grid.cells = grid.dense ? (int)cells : table;
};
"""
