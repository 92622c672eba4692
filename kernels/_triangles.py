"""The native text of triangles: where a particle and a triangle are decided, and which cell a coordinate is in.

C++17 for a function body, for Clang on the CPU and for NVRTC on CUDA alike, joined by `jfrnn.kernels._native.snippet`; in 2D
"triangles" are segments. What is decided, and why it is right, stands in `jfrnn/_triangles_exact.py` and
`jfrnn/_triangles_integers.py`; which cells hold a triangle, in `jfrnn/_triangles_cells.py`. Here, step 1 works in float64, whatever
the positions are, and integers have limbs of 24 bits, only as many as a number needs.
"""

# `Shape::near(p, corners, radius)`: is the distance below the radius? p [DIM], corners [DIM][DIM].
DECIDE = r"""
struct Whole {  // an integer times a power of two: sum of limb[i] 2^(24 (low + i)), limbs in [-2^23, 2^23), the outermost not 0
    enum { MOST = 6 * (DOUBLE ? 90 : 14) };
    int low, count;
    int limb[MOST];
    JFRNN_MEMBER int sign() const { return count == 0 ? 0 : limb[count - 1] < 0 ? -1 : 1; }
    JFRNN_MEMBER void put(int first, const long long* sums, int number) {  // carry, and leave out zeros at either end
        long long carry = 0;
        low = first;
        count = 0;
        for (int i = 0; i < number || carry; ++i) {
            const long long sum = carry + (i < number ? sums[i] : 0);
            carry = (sum + (1 << 23)) >> 24;
            const int rest = (int)(sum - carry * (1 << 24));
            if (count == 0 && rest == 0) {
                ++low;
                continue;
            }
            limb[count++] = rest;
        }
        while (count > 0 && limb[count - 1] == 0)
            --count;
    }
    JFRNN_MEMBER void read(real x) {
        const unsigned long long bits = Bits::of(x), lead = Bits::exponent(x) > 0;
        const unsigned long long mantissa = (bits & ((1ull << Bits::MANTISSA) - 1)) | (lead << Bits::MANTISSA);
        const int e = Bits::exponent(x), place = (e > 1 ? e : 1) - 1, shift = place % 24;
        long long sums[4];
        for (int i = 0; i < 4; ++i) {
            const int down = 24 * i - shift;
            const long long word = (long long)((down >= 64 ? 0 : down >= 0 ? mantissa >> down : mantissa << -down) & 0xffffff);
            sums[i] = Bits::negative(x) ? -word : word;
        }
        put(place / 24, sums, 4);
    }
};
struct Shape {
    JFRNN_CALL void add(Whole& out, const Whole& a, const Whole& b, int times) {  // a + times b; out may be either
        long long sums[Whole::MOST];
        const int first = a.count == 0 ? b.low : b.count == 0 || a.low < b.low ? a.low : b.low;
        const int enda = a.low + a.count, endb = b.low + b.count;
        const int end = a.count == 0 ? endb : b.count == 0 || enda > endb ? enda : endb;
        for (int i = first; i < end; ++i) {
            const long long one = i >= a.low && i < enda ? a.limb[i - a.low] : 0;
            const long long two = i >= b.low && i < endb ? b.limb[i - b.low] : 0;
            sums[i - first] = one + times * two;
        }
        out.put(first, sums, end > first ? end - first : 0);
    }
    JFRNN_CALL void multiply(Whole& out, const Whole& a, const Whole& b) {
        long long sums[Whole::MOST];
        const int count = a.count && b.count ? a.count + b.count : 0;
        for (int i = 0; i < count; ++i)
            sums[i] = 0;
        for (int i = 0; i < a.count && count; ++i)
            for (int j = 0; j < b.count; ++j)
                sums[i + j] += (long long)a.limb[i] * b.limb[j];
        out.put(a.low + b.low, sums, count);
    }
    JFRNN_CALL void dot(Whole& out, const Whole* a, const Whole* b) {
        Whole part;
        multiply(out, a[0], b[0]);
        for (int k = 1; k < DIM; ++k) {
            multiply(part, a[k], b[k]);
            add(out, out, part, 1);
        }
    }
    JFRNN_CALL void cross(Whole* out, const Whole* a, const Whole* b) {
        Whole part;
        for (int k = 0; k < 3; ++k) {
            const int i = (k + 1) % 3, j = (k + 2) % 3;
            multiply(out[k], a[i], b[j]);
            multiply(part, a[j], b[i]);
            add(out[k], out[k], part, -1);
        }
    }

    // the last word: signs of polynomials in integers
    JFRNN_CALL bool surely_near(const real* p, const real* corners, real radius) {
        Whole x[DIM][DIM], along[DIM], square[DIM], limit, place, length, rest, other;
        other.read(radius);
        multiply(limit, other, other);
        for (int c = 0; c < DIM; ++c) {
            for (int k = 0; k < DIM; ++k) {
                x[c][k].read(corners[DIM * c + k]);
                other.read(p[k]);
                add(x[c][k], x[c][k], other, -1);
            }
            dot(square[c], x[c], x[c]);
            add(square[c], square[c], limit, -1);
            if (square[c].sign() < 0)
                return true;
        }
        for (int c = 0; c < (DIM == 3 ? 3 : 1); ++c) {
            for (int k = 0; k < DIM; ++k)
                add(along[k], x[(c + 1) % DIM][k], x[c][k], -1);
            dot(place, x[c], along);  // -t
            if (place.sign() >= 0)
                continue;
            dot(length, along, along);
            add(rest, length, place, 1);
            if (rest.sign() <= 0)
                continue;
            multiply(rest, square[c], length);
            multiply(other, place, place);
            add(rest, rest, other, -1);
            if (rest.sign() < 0)
                return true;
        }
        if constexpr (DIM == 3) {
            Whole side[3][3], normal[3];
            for (int c = 0; c < 3; ++c)
                cross(side[c], x[(c + 1) % 3], x[(c + 2) % 3]);
            for (int k = 0; k < 3; ++k) {
                add(normal[k], side[0][k], side[1][k], 1);
                add(normal[k], normal[k], side[2][k], 1);
            }
            for (int c = 0; c < 3; ++c) {
                dot(rest, side[c], normal);
                if (rest.sign() <= 0)
                    return false;
            }
            dot(place, x[0], normal);
            multiply(other, place, place);
            dot(length, normal, normal);
            multiply(rest, limit, length);
            add(rest, other, rest, -1);
            return rest.sign() < 0;
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
    JFRNN_FUNCTION bool near(const real* p, const real* corners, real radius, double scale) {
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
                return true;
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
            return true;
        double largest = 0, least = 0;
        for (int k = 0; k < DIM; ++k)
            largest += size_of(direction[k]);
        for (int k = 0; k < DIM; ++k)
            direction[k] /= largest;
        for (int c = 0; c < DIM; ++c) {
            const double height = product(direction, x[c]) - 8 * EPS * sizes(direction, x[c]);
            if (!(height > 0))  // or no number
                return surely_near(p, corners, radius);
            least = c == 0 || height < least ? height : least;
        }
        if (least > 0 && least * least > r * r * product(direction, direction) * (1 + 16 * EPS))
            return false;
        return surely_near(p, corners, radius);
    }
};
"""

# Which cell a coordinate is in, and which bucket a cell; a level is the biased exponent of the inverse edge of its cells.
LEVELS = r"""
auto scale_of = [](int level) -> double { return level == 0 ? 0.0 : Bits::power_of_two(level - Bits::BIAS); };
auto cell_at = [](double x, double scale) -> int {
    const double cell = __builtin_floor(x * scale);
    return cell < -0x1p30 ? -(1 << 30) : cell > 0x1p30 ? 1 << 30 : (int)cell;
};
auto bucket_of = [](int level, const int* cell, int buckets) -> int {
    unsigned int word = (unsigned int)level * 0x9e3779b1u;
    for (int k = 0; k < DIM; ++k) {
        word = (word ^ (unsigned int)cell[k]) * 0x85ebca6bu;
        word ^= word >> 15;
    }
    word *= 0xc2b2ae35u;
    return (int)((word ^ (word >> 16)) & (unsigned int)(buckets - 1));
};
"""
