// Whether a particle and a triangle are closer than the cutoff; in 2D "triangles" are segments.
//
// `Shape::sure(p, corners, radius, scale)`: is the distance below the radius? 1: it is, 0: it is not, -1: float64 cannot tell.
// `Shape::near(p, corners, radius, scale, room)` can, with integers of 24-bit limbs, only as many as a number needs. p [DIM],
// corners [DIM][DIM]; room: ROOM ints, each STRIDE behind the last, so that threads beside each other use memory side by side. What
// is decided, and why it is right, stands in jfrnn/_triangles/exact.py and jfrnn/_triangles/integers.py.
#pragma once
#include "space.h"

struct Whole {  // an integer times a power of two: sum of limb(i) 2^(24 (low + i)), limbs in [-2^23, 2^23), the outermost not 0
    int* at;
    JFRNN_MEMBER int low() const { return at[0]; }
    JFRNN_MEMBER int count() const { return at[STRIDE]; }
    JFRNN_MEMBER int limb(int i) const { return at[STRIDE * (2 + i)]; }
    JFRNN_MEMBER int end() const { return low() + count(); }
    JFRNN_MEMBER int sign() const { return count() == 0 ? 0 : limb(count() - 1) < 0 ? -1 : 1; }
};
struct Writer {  // takes sums of limbs, the lowest first; carries, and leaves out zeros at either end
    int* at;
    int low, count;
    long long carry;
    JFRNN_MEMBER void put(long long sum) {
        sum += carry;
        carry = (sum + (1 << 23)) >> 24;
        const int rest = (int)(sum - carry * (1 << 24));
        if (count == 0 && rest == 0)
            ++low;
        else
            at[STRIDE * (2 + count++)] = rest;
    }
    JFRNN_MEMBER void close() {
        while (carry)
            put(0);
        while (count > 0 && at[STRIDE * (1 + count)] == 0)
            --count;
        at[0] = low;
        at[STRIDE] = count;
    }
};
struct Wholes {  // side by side
    int *at, degree;
    JFRNN_MEMBER Whole operator[](int i) const { return Whole{at + STRIDE * i * (2 + LIMBS * degree)}; }
    JFRNN_MEMBER Wholes operator+(int i) const { return Wholes{(*this)[i].at, degree}; }
};
struct Room {  // memory for products of so many numbers
    int* at;
    JFRNN_MEMBER Wholes take(int number, int degree) {
        const Wholes taken{at, degree};
        at += STRIDE * number * (2 + LIMBS * degree);
        return taken;
    }
};
struct Shape {
    JFRNN_CALL void read(Whole out, real x) {
        const unsigned long long bits = Bits::of(x), lead = Bits::exponent(x) > 0;
        const unsigned long long mantissa = (bits & ((1ull << Bits::MANTISSA) - 1)) | (lead << Bits::MANTISSA);
        const int e = Bits::exponent(x), place = (e > 1 ? e : 1) - 1, shift = place % 24;
        Writer writer{out.at, place / 24, 0, 0};
        for (int i = 0; i < 4; ++i) {
            const int down = 24 * i - shift;
            const long long word = (long long)((down >= 64 ? 0 : down >= 0 ? mantissa >> down : mantissa << -down) & 0xffffff);
            writer.put(Bits::negative(x) ? -word : word);
        }
        writer.close();
    }
    // a + times b into `spare`, which is then copied: out may be a or b
    JFRNN_CALL void add(Whole out, Whole a, Whole b, int times, Whole spare) {
        const int counta = a.count(), countb = b.count(), lowa = a.low(), lowb = b.low();
        const int enda = lowa + counta, endb = lowb + countb;
        const int first = counta == 0 ? lowb : countb == 0 || lowa < lowb ? lowa : lowb;
        const int end = counta == 0 ? endb : countb == 0 || enda > endb ? enda : endb;
        Writer writer{spare.at, first, 0, 0};
        for (int i = first; i < end; ++i) {
            const long long one = i >= lowa && i < enda ? a.limb(i - lowa) : 0;
            const long long two = i >= lowb && i < endb ? b.limb(i - lowb) : 0;
            writer.put(one + times * two);
        }
        writer.close();
        for (int i = 0; i < 2 + writer.count; ++i)
            out.at[STRIDE * i] = spare.at[STRIDE * i];
    }
    JFRNN_CALL void multiply(Whole out, Whole a, Whole b) {  // out is neither
        const int counta = a.count(), countb = b.count(), number = counta && countb ? counta + countb : 0;
        Writer writer{out.at, a.low() + b.low(), 0, 0};
        for (int k = 0; k < number; ++k) {
            long long sum = 0;
            for (int i = k < countb ? 0 : k - countb + 1; i < counta && i <= k; ++i)
                sum += (long long)a.limb(i) * b.limb(k - i);
            writer.put(sum);
        }
        writer.close();
    }
    JFRNN_FUNCTION void dot(Whole out, Wholes a, Wholes b, Wholes spare) {
        multiply(out, a[0], b[0]);
        for (int k = 1; k < DIM; ++k) {
            multiply(spare[1], a[k], b[k]);
            add(out, out, spare[1], 1, spare[0]);
        }
    }
    JFRNN_FUNCTION void cross(Wholes out, Wholes a, Wholes b, Wholes spare) {
        for (int k = 0; k < 3; ++k) {
            const int i = (k + 1) % 3, j = (k + 2) % 3;
            multiply(out[k], a[i], b[j]);
            multiply(spare[1], a[j], b[i]);
            add(out[k], out[k], spare[1], -1, spare[0]);
        }
    }

    // the last word: signs of polynomials in integers
    JFRNN_CALL bool surely_near(const real* p, const real* corners, real radius, int* room) {
        Room left{room};  // how many numbers in 3D and in 2D, and products of how many coordinates: `_NUMBERS` in triangles.py
        const Wholes x = left.take(DIM == 3 ? 9 : 4, 1);
        const Wholes along = left.take(DIM == 3 ? 3 : 2, 1);
        const Wholes square = left.take(DIM == 3 ? 3 : 2, 2);
        const Wholes limit = left.take(DIM == 3 ? 1 : 1, 2);
        const Wholes side = left.take(DIM == 3 ? 9 : 0, 2);
        const Wholes normal = left.take(DIM == 3 ? 3 : 0, 2);
        const Wholes place = left.take(DIM == 3 ? 1 : 1, 3);
        const Wholes length = left.take(DIM == 3 ? 1 : 1, 4);
        const Wholes rest = left.take(DIM == 3 ? 1 : 1, 6);
        const Wholes other = left.take(DIM == 3 ? 1 : 1, 6);
        const Wholes spare = left.take(DIM == 3 ? 2 : 2, 6);
        const Whole none = spare[0];
        read(other[0], radius);
        multiply(limit[0], other[0], other[0]);
        for (int c = 0; c < DIM; ++c) {
            for (int k = 0; k < DIM; ++k) {
                read(x[DIM * c + k], corners[DIM * c + k]);
                read(other[0], p[k]);
                add(x[DIM * c + k], x[DIM * c + k], other[0], -1, none);
            }
            dot(square[c], x + DIM * c, x + DIM * c, spare);
            add(square[c], square[c], limit[0], -1, none);
            if (square[c].sign() < 0)
                return true;
        }
        for (int c = 0; c < (DIM == 3 ? 3 : 1); ++c) {
            for (int k = 0; k < DIM; ++k)
                add(along[k], x[DIM * ((c + 1) % DIM) + k], x[DIM * c + k], -1, none);
            dot(place[0], x + DIM * c, along, spare);  // -t
            if (place[0].sign() >= 0)
                continue;
            dot(length[0], along, along, spare);
            add(rest[0], length[0], place[0], 1, none);
            if (rest[0].sign() <= 0)
                continue;
            multiply(rest[0], square[c], length[0]);
            multiply(other[0], place[0], place[0]);
            add(rest[0], rest[0], other[0], -1, none);
            if (rest[0].sign() < 0)
                return true;
        }
        if constexpr (DIM == 3) {
            for (int c = 0; c < 3; ++c)
                cross(side + 3 * c, x + 3 * ((c + 1) % 3), x + 3 * ((c + 2) % 3), spare);
            for (int k = 0; k < 3; ++k) {
                add(normal[k], side[k], side[3 + k], 1, none);
                add(normal[k], normal[k], side[6 + k], 1, none);
            }
            for (int c = 0; c < 3; ++c) {
                dot(rest[0], side + 3 * c, normal, spare);
                if (rest[0].sign() <= 0)
                    return false;
            }
            dot(place[0], x, normal, spare);
            multiply(other[0], place[0], place[0]);
            dot(length[0], normal, normal, spare);
            multiply(rest[0], limit[0], length[0]);
            add(rest[0], other[0], rest[0], -1, none);
            return rest[0].sign() < 0;
        }
        return false;
    }

    JFRNN_FUNCTION double size_of(double x) { return x < 0 ? -x : x; }
    JFRNN_FUNCTION double product(const double* a, const double* b) {
        const double sum = a[0] * b[0] + a[1] * b[1];
        return DIM == 3 ? sum + a[DIM - 1] * b[DIM - 1] : sum;
    }
    JFRNN_FUNCTION double sizes(const double* a, const double* b) {
        const double sum = size_of(a[0] * b[0]) + size_of(a[1] * b[1]);
        return DIM == 3 ? sum + size_of(a[DIM - 1] * b[DIM - 1]) : sum;
    }

    // bounds from either side, by a point of the shape and by a direction; `scale` is a power of two that brings r to about 1
    JFRNN_CALL int sure(const real* p, const real* corners, real radius, double scale) {
        constexpr double EPS = 0x1p-52;
        const double r = DOUBLE ? double(radius) * scale : double(radius);
        double x[DIM][DIM], foot[DIM], direction[DIM], weight[DIM], best = -1;
        for (int c = 0; c < DIM; ++c)
            for (int k = 0; k < DIM; ++k) {
                x[c][k] = double(corners[DIM * c + k]) - double(p[k]);
                if constexpr (DOUBLE)
                    x[c][k] *= scale;
            }
        for (int c = 0; c < DIM; ++c)  // as most that are near, where triangles are small
            if (product(x[c], x[c]) * (1 + 16 * EPS) < r * r)
                return 1;
        for (int c = 0; c < (DIM == 3 ? 3 : 1); ++c) {
            const int next = (c + 1) % DIM;
            double along[DIM], point[DIM];
            for (int k = 0; k < DIM; ++k)
                along[k] = x[next][k] - x[c][k];
            const double length = product(along, along);
            double t = length > 0 ? -product(x[c], along) / length : 0;
            t = t > 0 ? t < 1 ? t : 1 : 0;
            for (int k = 0; k < DIM; ++k)
                point[k] = x[c][k] + t * along[k];
            const double square = product(point, point);
            if (best < 0 || square < best) {
                best = square;
                for (int k = 0; k < DIM; ++k) {
                    foot[k] = direction[k] = point[k];
                    weight[k] = 0;
                }
                weight[c] = 1 - t;
                weight[next] = t;
            }
        }
        if constexpr (DIM == 3) {
            double side[3][3], normal[3], part[3];
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < 3; ++k) {
                    const double *a = x[(c + 1) % 3], *b = x[(c + 2) % 3];
                    side[c][k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
                }
            double d[2][3];
            for (int k = 0; k < 3; ++k) {
                d[0][k] = x[1][k] - x[0][k];
                d[1][k] = x[2][k] - x[0][k];
            }
            for (int k = 0; k < 3; ++k)
                normal[k] = d[0][(k + 1) % 3] * d[1][(k + 2) % 3] - d[0][(k + 2) % 3] * d[1][(k + 1) % 3];
            for (int c = 0; c < 3; ++c)
                part[c] = product(side[c], normal);
            if (part[0] > 0 && part[1] > 0 && part[2] > 0) {
                const double sum = part[0] + part[1] + part[2], toward = product(x[0], normal) < 0 ? -1 : 1;
                for (int k = 0; k < 3; ++k) {
                    weight[k] = part[k] / sum;
                    direction[k] = toward * normal[k];
                }
            }
        }
        double whole = 0, size = 0, square = 0;
        for (int k = 0; k < DIM; ++k) {
            double point = 0;
            for (int c = 0; c < DIM; ++c) {
                point += weight[c] * x[c][k];
                size += size_of(weight[c] * x[c][k]);
            }
            square += point * point;
            whole += weight[k];
        }
        const double reach = r * whole * (1 - 16 * EPS) - 8 * EPS * size;
        if (reach > 0 && square * (1 + 16 * EPS) < reach * reach)
            return 1;
        double largest = 0, least = 0;
        for (int k = 0; k < DIM; ++k)
            largest += size_of(direction[k]);
        for (int k = 0; k < DIM; ++k)
            direction[k] /= largest;
        for (int c = 0; c < DIM; ++c) {
            const double height = product(direction, x[c]) - 8 * EPS * sizes(direction, x[c]);
            if (!(height > 0))  // or no number
                return -1;
            least = c == 0 || height < least ? height : least;
        }
        return least > 0 && least * least > r * r * product(direction, direction) * (1 + 16 * EPS) ? 0 : -1;
    }
    JFRNN_FUNCTION bool near(const real* p, const real* corners, real radius, double scale, int* room) {
        const int known = sure(p, corners, radius, scale);
        return known < 0 ? surely_near(p, corners, radius, room) : known == 1;
    }
};
