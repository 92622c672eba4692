// All pairs of one structure of atoms in float64, with their images: one thread, whatever the number of atoms, the cell and the cutoff.
//
// Atoms are brought into a cell of short lattice vectors and sorted into bins, of which those within reach are met, image by image.
// Bins are a grid of fractional coordinates along periodic axes and of lengths along open ones. What is computed of them is rounded;
// `margin` and `slack` bound by how much, and pairs within the slack of their cutoff are decided exactly.
#pragma once
#include "exact.h"

struct StructureArguments {
    const real *positions, *cell, *cutoffs;
    const int *periodic, *species;
    int *first, *second, *shifts;  // of pairs
    real *vectors, *distances;
    real* room_for_reals;  // 6 n
    int* room_for_ints;    // 9 n + 64
    whole* info;           // the number of pairs, and what is wrong with what was given
    int n, room, rule, kinds, with_self;
};

struct Structure : StructureArguments {
    enum Rule { ONE, RADII, TABLE };
    enum Wrong { NOT_FINITE = 1, TOO_FAR = 2, DEGENERATE = 4 };
    enum { BLOCK = 256, MOST_TURNS = 1 << 20, MOST_NUMBER = 1 << 24 };
    static constexpr double EPS = 2.220446049250313e-16, FARTHEST = 1e140;

    FloatControl floats;
    Lattice lattice;  // holds the vectors as they were given
    double given[3][3], vector[3][3], transform[3][3];
    long long number[3][3];  // short vectors in terms of the given ones
    double largest, width[3], margin[3], low[3], per_length[3];
    double slack;
    int bins[3];
    double *wrapped[3], *fraction[3];  // wrapped: in the order of bins; fractions: in that of atoms
    int *turns[3], *ids, *start, *place;
    long long found;

    explicit Structure(const StructureArguments& a) : StructureArguments(a), found(0) {
        for (int k = 0; k < 3; ++k) {
            wrapped[k] = (double*)room_for_reals + k * (long long)n;
            fraction[k] = (double*)room_for_reals + (3 + k) * (long long)n;
            turns[k] = room_for_ints + k * (long long)n;
            for (int l = 0; l < 3; ++l) {
                given[k][l] = periodic[k] ? cell[3 * k + l] : 0;
                lattice.numbers[Lattice::GIVEN + 3 * k + l] = real(given[k][l]);
                number[k][l] = k == l;
            }
        }
        ids = room_for_ints + 3 * (long long)n;
        place = ids + n;
        start = place + n;
    }

    static double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
    static void cross(const double* a, const double* b, double* c) {
        for (int k = 0; k < 3; ++k)
            c[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
    }
    static void scale(double* a, double by) {
        for (int k = 0; k < 3; ++k)
            a[k] *= by;
    }
    JFRNN_APART void combine(int l) {  // a short vector from the given ones
        for (int k = 0; k < 3; ++k)
            vector[l][k] =
                double(number[l][0]) * given[0][k] + double(number[l][1]) * given[1][k] + double(number[l][2]) * given[2][k];
    }

    // Subtracts whole multiples of the other vectors from vector k where that makes it shorter (Semaev 2001).
    JFRNN_APART bool shorten(int k) {
        long long best[2] = {0, 0};
        const int a = (k + 1) % 3, b = (k + 2) % 3;
        double least = dot(vector[k], vector[k]) * (1 - 1e-9);
        auto attempt = [&](long long p, long long q) {
            if ((p && !periodic[a]) || (q && !periodic[b]))
                return;
            double x[3];
            for (int l = 0; l < 3; ++l)
                x[l] = vector[k][l] - double(p) * vector[a][l] - double(q) * vector[b][l];
            if (dot(x, x) < least) {
                least = dot(x, x);
                best[0] = p;
                best[1] = q;
            }
        };
        auto multiple = [&](int l) {
            const double times = dot(vector[k], vector[l]) / dot(vector[l], vector[l]);
            return times > -1e6 && times < 1e6 ? (long long)rint(times) : 0ll;
        };
        for (int p = -1; p <= 1; ++p)
            for (int q = -1; q <= 1; ++q)
                attempt(p, q);
        if (periodic[a])
            attempt(multiple(a), 0);
        if (periodic[b])
            attempt(0, multiple(b));
        if (!best[0] && !best[1])
            return false;
        long long now[3];
        for (int l = 0; l < 3; ++l) {
            now[l] = number[k][l] - best[0] * number[a][l] - best[1] * number[b][l];
            if (now[l] > MOST_NUMBER || now[l] < -MOST_NUMBER)
                return false;
        }
        for (int l = 0; l < 3; ++l)
            number[k][l] = now[l];
        combine(k);
        return true;
    }
    JFRNN_APART void reduce() {
        for (int k = 0; k < 3; ++k)
            combine(k);
        bool shorter = true;
        for (int round = 0; shorter && round < 1000; ++round) {
            shorter = false;
            for (int k = 0; k < 3; ++k)
                if (periodic[k] && shorten(k))
                    shorter = true;
        }
    }

    // Finds the inverse of the vectors, open axes being unit vectors at right angles to all others. False: they are dependent.
    JFRNN_APART bool invert() {
        double rows[3][3], size[3];
        int open[3], opens = 0, closed_axis = 0;
        for (int l = 0; l < 3; ++l) {
            size[l] = 1;
            if (!periodic[l]) {
                open[opens++] = l;
                continue;
            }
            closed_axis = l;
            double most = 0;
            for (int k = 0; k < 3; ++k)
                most = fabs(vector[l][k]) > most ? fabs(vector[l][k]) : most;
            if (!(most > 0))
                return false;
            for (int k = 0; k < 3; ++k)
                rows[l][k] = vector[l][k] / most;
            size[l] = sqrt(dot(rows[l], rows[l]));
            scale(rows[l], 1 / size[l]);
            size[l] *= most;
        }
        if (opens == 3) {
            for (int l = 0; l < 3; ++l)
                for (int k = 0; k < 3; ++k)
                    rows[l][k] = l == k;
        } else if (opens) {
            const double* one = rows[closed_axis];
            if (opens == 2) {  // an axis that is far from the periodic one, made orthogonal
                int least = 0;
                for (int k = 1; k < 3; ++k)
                    least = fabs(one[k]) < fabs(one[least]) ? k : least;
                double axis[3] = {0, 0, 0};
                axis[least] = 1;
                cross(one, axis, rows[open[1]]);
                scale(rows[open[1]], 1 / sqrt(dot(rows[open[1]], rows[open[1]])));
            }
            double* last = rows[open[0]];
            cross(rows[(open[0] + 1) % 3], rows[(open[0] + 2) % 3], last);
            const double length = sqrt(dot(last, last));
            if (!(length > 1e-12))
                return false;
            scale(last, 1 / length);
        }
        double columns[3][3];
        for (int l = 0; l < 3; ++l)
            cross(rows[(l + 1) % 3], rows[(l + 2) % 3], columns[l]);
        const double volume = dot(rows[0], columns[0]);
        if (!(fabs(volume) > 1e-13))
            return false;
        for (int l = 0; l < 3; ++l)
            for (int k = 0; k < 3; ++k)
                transform[k][l] = columns[l][k] / volume / size[l];
        for (int l = 0; l < 3; ++l)
            for (int k = 0; k < 3 && !periodic[l]; ++k)
                vector[l][k] = 0;
        return true;
    }

    double reach_of(int i) const {
        double most = largest;
        if (rule == RADII)
            most = (cutoffs[i] + largest / 2) * (1 + 4 * EPS);
        if (rule == TABLE) {
            most = 0;
            const real* row = cutoffs + (long long)kinds * species[i];
            for (int k = 0; k < kinds; ++k)
                most = row[k] > most ? row[k] : most;
        }
        return most;
    }
    JFRNN_APART void find_largest() {
        const long long count = rule == ONE ? 1 : rule == RADII ? n : (long long)kinds * kinds;
        largest = 0;
        for (long long k = 0; k < count; ++k)
            largest = cutoffs[k] > largest ? cutoffs[k] : largest;
        largest *= rule == RADII ? 2 : 1;
    }

    // Brings atoms into the cell, and bounds what rounding does to their coordinates, fractions and distances.
    JFRNN_APART int wrap() {
        double most_turns = 0, size[3] = {0, 0, 0};
        for (long long k = 0; k < 3ll * n; ++k)
            if (!Bits::finite(positions[k]))
                return NOT_FINITE;
        for (int i = 0; i < n; ++i) {
            const real* x = positions + 3ll * i;
            for (int k = 0; k < 3; ++k) {
                if (fabs(x[k]) > FARTHEST)
                    return TOO_FAR;
                double f = x[0] * transform[0][k] + x[1] * transform[1][k] + x[2] * transform[2][k];
                f = periodic[k] ? floor(f) : 0;
                if (!(fabs(f) <= MOST_TURNS))
                    return TOO_FAR;
                most_turns = fabs(f) > most_turns ? fabs(f) : most_turns;
                turns[k][i] = (int)f;
                size[k] = fabs(x[k]) > size[k] ? fabs(x[k]) : size[k];
            }
        }
        double spans[3], lengths[3], reach = 1;
        for (int k = 0; k < 3; ++k) {
            spans[k] = lengths[k] = width[k] = 0;
            for (int l = 0; l < 3; ++l) {
                spans[k] += fabs(vector[l][k]);
                for (int m = 0; m < 3; ++m)
                    lengths[k] += fabs(double(number[l][m]) * given[m][k]);
                width[k] += transform[l][k] * transform[l][k];
            }
            width[k] = sqrt(width[k]) * (1 + 16 * EPS);
            if (periodic[k])
                reach = largest * width[k] + 2 > reach ? largest * width[k] + 2 : reach;
        }
        if (!(reach < MOST_TURNS))
            return TOO_FAR;
        const double shifted = 2 * most_turns + reach + 2;
        slack = 0;
        for (int k = 0; k < 3; ++k) {
            size[k] += shifted * spans[k];
            const double error = 8 * EPS * (size[k] + shifted * lengths[k]);
            slack = error > slack ? error : slack;
        }
        for (int k = 0; k < 3; ++k) {
            double rounding = 0, residual = 0;
            for (int l = 0; l < 3; ++l) {
                rounding += (16 * EPS * size[l] + 2 * slack) * fabs(transform[l][k]);
                double sum = l == k && periodic[l] ? -1 : 0, sizes = 0;
                for (int m = 0; m < 3; ++m) {
                    sum += vector[l][m] * transform[m][k];
                    sizes += fabs(vector[l][m] * transform[m][k]);
                }
                residual += fabs(sum) + 8 * EPS * sizes;
            }
            margin[k] = 4 * (rounding + shifted * residual) + 16 * EPS;
        }
        double high[3];
        for (int k = 0; k < 3; ++k)
            low[k] = high[k] = 0;
        for (int i = 0; i < n; ++i) {
            const double t[3] = {double(turns[0][i]), double(turns[1][i]), double(turns[2][i])};
            double x[3];
            for (int k = 0; k < 3; ++k)
                x[k] = positions[3ll * i + k] - (t[0] * vector[0][k] + t[1] * vector[1][k] + t[2] * vector[2][k]);
            for (int k = 0; k < 3; ++k) {
                const double f = x[0] * transform[0][k] + x[1] * transform[1][k] + x[2] * transform[2][k];
                fraction[k][i] = f;
                if (i == 0)
                    low[k] = high[k] = f;
                low[k] = f < low[k] ? f : low[k];
                high[k] = f > high[k] ? f : high[k];
            }
        }
        choose_bins(high);
        return 0;
    }
    // Bins are half as wide as the reach, a quarter along the last axis, along which they follow each other.
    JFRNN_APART void choose_bins(const double* high) {
        double wanted[3], all = 1;
        for (int k = 0; k < 3; ++k) {
            const double extent = periodic[k] ? 1 : high[k] - low[k];
            const double reach = largest * width[k];
            wanted[k] = reach > 0 ? (k == 2 ? 4 : 2) * extent / reach : 1e6;
            wanted[k] = wanted[k] < 1 ? 1 : wanted[k] < 1e6 ? wanted[k] : 1e6;
            all *= wanted[k];
        }
        while (all > 2.0 * n + 8) {
            all = 1;
            for (int k = 0; k < 3; ++k) {
                wanted[k] = 0.8 * wanted[k] < 1 ? 1 : 0.8 * wanted[k];
                all *= wanted[k];
            }
        }
        for (int k = 0; k < 3; ++k) {
            bins[k] = (int)wanted[k];
            if (periodic[k])
                low[k] = 0;
            const double extent = periodic[k] ? 1 : high[k] - low[k];
            per_length[k] = extent > 0 ? bins[k] / extent : 0;
        }
    }
    int bin_along(int k, double f) const {
        const double b = floor((f - low[k]) * per_length[k]);
        return b < 0 ? 0 : b >= bins[k] ? bins[k] - 1 : (int)b;
    }
    JFRNN_APART void sort() {
        const int all = bins[0] * bins[1] * bins[2];
        for (int b = 0; b <= all + 1; ++b)
            start[b] = 0;
        for (int i = 0; i < n; ++i) {
            int at = 0;
            for (int k = 0; k < 3; ++k)
                at = at * bins[k] + bin_along(k, fraction[k][i]);
            place[i] = at;
            ++start[at + 2];
        }
        for (int b = 0; b < all; ++b)
            start[b + 2] += start[b + 1];
        for (int i = 0; i < n; ++i) {
            const int at = start[place[i] + 1]++;
            place[i] = at;
            ids[at] = i;
            const double t[3] = {double(turns[0][i]), double(turns[1][i]), double(turns[2][i])};
            for (int k = 0; k < 3; ++k)
                wrapped[k][at] = positions[3ll * i + k] - (t[0] * vector[0][k] + t[1] * vector[1][k] + t[2] * vector[2][k]);
        }
    }

    JFRNN_APART void write(int i, int j, const int* shift) {
        if (found < room) {
            if (first)
                first[found] = i;
            if (second)
                second[found] = j;
            double square = 0;
            for (int k = 0; k < 3; ++k) {
                const double away = double(positions[3ll * j + k]) - double(positions[3ll * i + k]);
                const double moved = shift[0] * given[0][k] + shift[1] * given[1][k] + shift[2] * given[2][k];
                if (shifts)
                    shifts[3 * found + k] = shift[k];
                if (vectors)
                    vectors[3 * found + k] = real(away + moved);
                square += (away + moved) * (away + moved);
            }
            if (distances)
                distances[found] = real(sqrt(square));
        }
        ++found;
    }
    // Decides about a candidate that is nearer than the reach, up to rounding.
    JFRNN_APART void decide(int i, int j, double square, const int* image) {
        real radius = cutoffs[0], more = 0;
        if (rule == RADII) {
            radius = cutoffs[i];
            more = cutoffs[j];
        } else if (rule == TABLE)
            radius = cutoffs[(long long)kinds * species[i] + species[j]];
        const double r = double(radius) + double(more), off = 2 * slack, inner = r > off ? r - off : 0;
        if (!(r > 0) || square > (r + off) * (r + off) * (1 + 16 * EPS))
            return;
        if (i == j && !image[0] && !image[1] && !image[2] && !with_self)
            return;
        int shift[3];
        long long of[3];
        for (int l = 0; l < 3; ++l)
            of[l] = (long long)image[l] - turns[l][j] + turns[l][i];
        for (int k = 0; k < 3; ++k) {
            const long long sum = of[0] * number[0][k] + of[1] * number[1][k] + of[2] * number[2][k];
            if (sum >= 1 << 30 || sum <= -(1 << 30)) {
                info[1] = TOO_FAR;
                return;
            }
            shift[k] = (int)sum;
        }
        if (square < inner * inner * (1 - 16 * EPS) ||
            Exact::image_pair(positions + 3ll * i, positions + 3ll * j, radius, more, false, shift, lattice))
            write(i, j, shift);
    }
    void meet(int i, const double* q, int from, int to, double outer, const int* image) {
        double squares[BLOCK];
        for (int begin = from; begin < to; begin += BLOCK) {
            const int count = to - begin < BLOCK ? to - begin : (int)BLOCK;
            for (int c = 0; c < count; ++c) {
                const double x = wrapped[0][begin + c] - q[0], y = wrapped[1][begin + c] - q[1], z = wrapped[2][begin + c] - q[2];
                squares[c] = x * x + y * y + z * z;
            }
            for (int c = 0; c < count; ++c)
                if (squares[c] <= outer)
                    decide(i, ids[begin + c], squares[c], image);
        }
    }
    static int whole_images(int bin, int all) { return bin >= 0 ? bin / all : -((all - 1 - bin) / all); }

    JFRNN_APART void serve(int i) {
        const double reach = reach_of(i);
        if (!(reach > 0))
            return;
        const double outer = (reach + 2 * slack) * (reach + 2 * slack) * (1 + 16 * EPS);
        int lower[3], upper[3], image[3];
        for (int k = 0; k < 3; ++k) {
            const double off = reach * width[k] + margin[k], f = fraction[k][i] - low[k];
            if (periodic[k]) {
                lower[k] = (int)floor((f - off) * per_length[k]);
                upper[k] = (int)floor((f + off) * per_length[k]);
            } else {
                lower[k] = bin_along(k, fraction[k][i] - off);
                upper[k] = bin_along(k, fraction[k][i] + off);
            }
        }
        const double own[3] = {wrapped[0][place[i]], wrapped[1][place[i]], wrapped[2][place[i]]};
        for (int bx = lower[0]; bx <= upper[0]; ++bx) {
            image[0] = whole_images(bx, bins[0]);
            for (int by = lower[1]; by <= upper[1]; ++by) {
                image[1] = whole_images(by, bins[1]);
                const int row = ((bx - image[0] * bins[0]) * bins[1] + by - image[1] * bins[1]) * bins[2];
                const int behind = whole_images(lower[2], bins[2]), ahead = whole_images(upper[2], bins[2]);
                for (image[2] = behind; image[2] <= ahead; ++image[2]) {
                    double q[3];
                    for (int k = 0; k < 3; ++k)
                        q[k] = own[k] - (image[0] * vector[0][k] + image[1] * vector[1][k] + image[2] * vector[2][k]);
                    const int from = image[2] == behind ? lower[2] - behind * bins[2] : 0;
                    const int last = image[2] == ahead ? upper[2] - ahead * bins[2] : bins[2] - 1;
                    meet(i, q, start[row + from], start[row + last + 1], outer, image);
                }
            }
        }
    }
    void run() {
        info[1] = 0;
        find_largest();
        reduce();
        info[1] = invert() ? wrap() : (int)DEGENERATE;
        if (!info[1]) {
            sort();
            for (int i = 0; i < n && !info[1]; ++i)
                serve(i);
        }
        info[0] = found;
    }
};
