// Where a pair is decided.
//
// Step 1 belongs to the kernels: working precision and a band around r^2 (band.h).
// `Exact::pair` answers for what falls into the band: in twice the precision (float32), then by error-free sums, then in integers as
// wide as the float format. It is a call, not inlined, so that what it needs is not held in registers elsewhere.
#pragma once
#include "space.h"

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
    JFRNN_FUNCTION int sum_sign(const real* a, const real* b, real radius, real more, const int* shift, Lattice::Argument lattice) {
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
            // Beyond, there are no pairs, and sums may overflow. How large this bound is does not matter: error-free sums hold at any
            // size, and what overflows leaves a NaN in `rest`, with which no comparison below is true: the answer is 2.
            plain = plain && size_of(high) < 1e6;
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
        const real* a, const real* b, real radius, real more, const int* shift, Lattice::Argument lattice) {
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
        const real* a, const real* b, real radius, real more, bool closed, const int* shift, Lattice::Argument lattice) {
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
JFRNN_FUNCTION double square_between(real radius, real unit, bool closed) {
    const double r = double(radius) / double(unit), square = r * r, error = Exact::product_error(r, r, square);
    double whole_part = double((long long)square);
    if (whole_part == square && error < 0)
        whole_part -= 1;
    const bool tie = whole_part == square && error == 0;
    return (tie && !closed ? whole_part - 1 : whole_part) + 0.5;
}
// Is the image of a source within the cutoff of a query? Both are rows of positions as they were given, `image` is the code of the
// image of wrapped points; the cutoff is `radius`, or the sum of `radius` and `more`.
JFRNN_FUNCTION bool exact_image(
    const Lattice& lattice, const real* query, const real* source, int image, real radius, real more, bool closed) {
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
}
// Is a point within the cutoff of another? Both are as they were given; the cutoff is `radius`, or the sum of `radius` and `more`.
JFRNN_FUNCTION bool exact_pair(const real* a, const real* b, real radius, real more, bool closed) {
    return Exact::pair(a[0], a[1], DIM == 3 ? a[DIM - 1] : 0, b[0], b[1], DIM == 3 ? b[DIM - 1] : 0, radius, more, closed);
}
