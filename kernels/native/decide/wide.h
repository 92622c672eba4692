// Pairs that working precision leaves open, decided in twice the precision or more, several at a time: `Exact::pair` on the CPU.
#pragma once
#include "exact.h"
#include "lanes.h"

constexpr int WIDE = LANES < 8 ? LANES : 8;  // numbers in twice the precision
typedef double doubles __attribute__((vector_size(WIDE * 8)));

struct Wide {
    double radius, doubly_inside, doubly_outside;
    real exact_radius;
    bool closed;
    Wide(real radius, bool closed)
        : radius(radius),
          doubly_inside(Exact::doubly_inside(radius)),
          doubly_outside(Exact::doubly_outside(radius)),
          exact_radius(radius),
          closed(closed) {}

    template <class Lanes>
    static unsigned int bits_of(Lanes lanes) {
        typedef bool wide_flags __attribute__((ext_vector_type(WIDE)));
        const wide_flags f = __builtin_convertvector(lanes, wide_flags);
        unsigned char bits;
        __builtin_memcpy(&bits, &f, 1);
        return bits & ((1u << WIDE) - 1);
    }
    static doubles size_of(doubles x) { return x < 0 ? -x : x; }
    static doubles two_sum(doubles a, doubles b, doubles& error) {
        const doubles s = a + b, bv = s - a;
        error = (a - (s - bv)) + (b - bv);
        return s;
    }
    static doubles product_error(doubles a, doubles b, doubles p) {
#if defined(__FMA__) || defined(__aarch64__)
        return __builtin_elementwise_fma(a, b, -p);
#else
        const doubles ca = 134217729.0 * a, cb = 134217729.0 * b;  // Veltkamp's split
        const doubles ah = ca - (ca - a), bh = cb - (cb - b);
        const doubles al = a - ah, bl = b - bh;
        return al * bl - (((p - ah * bh) - al * bh) - ah * bl);
#endif
    }

    // `Exact::sum_sign` for WIDE pairs at a time, in open space. Returns which are pairs; those whose sign is not proven stay `open`.
    unsigned int signs_decided(const double* q, const doubles* p, unsigned int& open) const {
        const double scale = Bits::unit_scale(exact_radius), r = radius * scale, r2 = r * r;
        const double smallest = Exact::smallest_plain(exact_radius), r2_error = Exact::product_error(r, r, r2);
        doubles high[3], low[3], square = doubles{};
        auto plain = square == 0;  // nothing overflows or underflows
        typedef decltype(plain) integers;
        for (int k = 0; k < DIM; ++k) {
            const doubles a = doubles{} + q[k], b = p[k];
            if constexpr (DOUBLE)
                plain &= ((a == 0) | (size_of(a) >= smallest)) & ((b == 0) | (size_of(b) >= smallest));
            high[k] = two_sum(b, -a, low[k]) * scale;
            low[k] *= scale;
            plain &= size_of(high[k]) < 1e6;
        }
        auto exact = plain & (r2_error == 0 ? plain : ~plain);  // nothing is rounded, as between the sites of many lattices
        for (int k = 0; k < DIM; ++k) {
            doubles error;
            exact &= (low[k] == 0) & (((integers)high[k] & 0x7ffffff) == 0);  // 26 bits: the square is exact
            square = two_sum(square, high[k] * high[k], error);
            exact &= error == 0;
        }
        if ((open & ~bits_of(exact)) == 0) {
            const unsigned int pairs = open & (closed ? bits_of(square <= r2) : bits_of(square < r2));
            open = 0;
            return pairs;
        }
        doubles rest;
        const doubles lead = sum_of_terms(high, low, r2, r2_error, rest);
        const unsigned int inside = bits_of(plain & (lead < -rest)), tie = bits_of(plain & (lead == 0) & (rest == 0));
        const unsigned int pairs = (inside | (closed ? tie : 0)) & open;
        open &= ~(inside | tie | bits_of(plain & (lead > rest)));
        return pairs;
    }
    // |high + low|^2 - r^2 by error-free sums of its terms; `rest` is how far it may be off.
    static doubles sum_of_terms(const doubles* high, const doubles* low, double r2, double r2_error, doubles& rest) {
        constexpr int TERMS = 3 * DIM + 2;
        doubles term[TERMS], slack = doubles{};
        term[0] = doubles{} - r2;
        term[1] = doubles{} - r2_error;
        for (int k = 0; k < DIM; ++k) {
            const doubles tail = 2 * high[k] * low[k];
            term[3 * k + 2] = high[k] * high[k];
            term[3 * k + 3] = product_error(high[k], high[k], term[3 * k + 2]);
            term[3 * k + 4] = tail;
            slack += size_of(tail) * 2.220446049250313e-16 + 2 * low[k] * low[k];
        }
        for (int pass = 0; pass < 3; ++pass) {
            doubles total = term[0];
            for (int t = 1; t < TERMS; ++t) {
                doubles error;
                total = two_sum(total, term[t], error);
                term[t - 1] = error;
            }
            term[TERMS - 1] = total;
        }
        rest = slack;
        for (int t = 0; t < TERMS - 1; ++t)
            rest += size_of(term[t]);
        rest *= 2;
        return term[TERMS - 1];
    }

    // The points in lanes from WIDE * h on.
    static void points_at(const vec* p, int h, doubles* points) {
        for (int k = 0; k < DIM; ++k) {
            typedef real reals __attribute__((vector_size(WIDE * sizeof(real))));
            reals part;
            __builtin_memcpy(&part, (const real*)&p[k] + WIDE * h, sizeof part);
            points[k] = __builtin_convertvector(part, doubles);
        }
    }
    // Which of the points in lanes are surely pairs, by squares in float64; others stay `open` or are none. This may be computed while
    // denormals are flushed, unless cutoffs are SCALED: what that takes of coordinates, 2^-126 at most, is far below what the bounds allow.
    JFRNN_INLINE unsigned int sure(const real* q, const vec* p, unsigned int& open) const {
        if constexpr (DOUBLE)
            return 0;
        unsigned int pairs = 0, left = 0;
        for (int h = 0; h < LANES / WIDE; ++h) {
            const unsigned int here = open >> WIDE * h & ((1u << WIDE) - 1);
            doubles points[3], square = doubles{};
            points_at(p, h, points);
            for (int k = 0; k < DIM; ++k)
                square += (points[k] - (double)q[k]) * (points[k] - (double)q[k]);
            const unsigned int found = bits_of(square < doubly_inside) & here;
            pairs |= found << WIDE * h;
            left |= (here & ~found & bits_of(square <= doubly_outside)) << WIDE * h;
        }
        open = left;
        return pairs;
    }

    // Which of the points in lanes are pairs; a few stay `open`, others are none. This is a call of its own: nothing of it may be
    // computed while denormals are flushed.
    JFRNN_APART unsigned int decided(const real* q, const vec* p, unsigned int& open) const {
        unsigned int pairs = sure(q, p, open), left = 0;
        double origin[3];
        for (int k = 0; k < DIM; ++k)
            origin[k] = (double)q[k];
        for (int h = 0; h < LANES / WIDE; ++h) {
            unsigned int here = open >> WIDE * h & ((1u << WIDE) - 1);
            doubles points[3];
            points_at(p, h, points);
            if (here)
                pairs |= signs_decided(origin, points, here) << WIDE * h;
            left |= here << WIDE * h;
        }
        open = left;
        return pairs;
    }
};
