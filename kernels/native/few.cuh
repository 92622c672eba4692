// Few particles on CUDA: one launch, in which every query meets all sources, and nothing is sorted.
//
// A block serves up to 32 queries, each by one lane of every warp, or where queries are few by `parts` lanes. Lanes that serve the same
// query share the sources, words of 32 that follow each other: all lanes with the same share read the same source at a time, and keep
// one bit of each. It takes a load, a difference and a product per axis, and a shift to meet 32 pairs. Shares are numbered as their
// sources are, so that rows are ascending, and the same in every run. In a box each source is met where its nearest image is; boxes
// whose vectors do not lie along the axes, or of which several images may be neighbors, have other kernels.
#pragma once
#include "exact.h"

constexpr int FEW_THREADS = 32 * FEW_WARPS, FEW_WORDS = FEW_MOST / FEW_THREADS;  // of a block, and most words of a share
constexpr int LOADED = 32;                                                       // words of sources that a block holds at a time

struct FewPairs : Space {
    struct alignas(DOUBLE ? 8 : 16) Point {
        real at[DOUBLE ? DIM : 4];
    };
    struct Tile {
        Point points[LOADED][33];  // what lanes of different shares read at once lies in different banks
        unsigned int systems[BATCHED ? LOADED : 1][33];
    };
    const real *positions, *queries;
    const int n, m, closed, parts, lane, warp;
    const int slot, query;  // of the query, in its block and in all
    const int words;        // of a share
    const int share;        // of this lane
    const bool is_query, drop_self, later_only;
    real q[3];
    real sure_square, far_square;  // of distances, squared: what is closer surely is a neighbor, what is farther surely none
    real length[3];                // of the box along each axis, 0 where it is not periodic
    bool tight;                    // the cutoff is about half of a length: on which side the nearest image is may be in doubt
    bool is_finite;
    unsigned int system;

    template <class Arguments>
    JFRNN_MEMBER FewPairs(const Arguments& a, bool later_only)
        : Space(a.cutoff),
          positions(a.positions),
          queries(a.queries),
          n(a.n),
          m(a.m),
          closed(a.closed),
          parts(a.parts),
          lane(threadIdx.x & 31),
          warp(threadIdx.x >> 5),
          slot(lane / parts),
          query(blockIdx.x * (32 / parts) + slot),
          words((n - 1) / (32 * shares()) + 1),
          share(warp * parts + lane % parts),
          is_query(query < m),
          drop_self(a.drop_self),
          later_only(later_only),
          tight(false) {
        const real* row = query_row();
        point_of(row, q);
        is_finite = finite_point(q);
        system = system_of(row);
        const real off = PERIODIC ? 2 * lattice.slack() : real(0);  // by which differences of images may be wrong
        const real inner = radius > off ? radius - off : real(0), outer = radius + off;
        sure_square = inner * inner - 8 * (1 + SHIFTED) * step_eps * radius * radius;
        far_square = outer * outer * (1 + 16 * step_eps);
        for (int k = 0; k < DIM; ++k) {
            length[k] = PERIODIC && lattice.periodic(k) ? lattice.vector(k, k) : real(0);
            tight = tight || (length[k] != 0 && outer > real(0.49) * size_of(length[k]));
        }
    }
    JFRNN_FUNCTION real size_of(real x) { return x < 0 ? -x : x; }
    JFRNN_MEMBER const real* query_row() const { return queries + (long long)ROW * (is_query ? query : 0); }
    JFRNN_MEMBER int shares() const { return parts == 1 ? FEW_WARPS : LOADED; }
    JFRNN_MEMBER int first_of(int word) const { return 32 * (share * words + word); }

    // The image of a source that is nearest along an axis; `other`: the next nearest one.
    JFRNN_MEMBER int nearest(int k, real p, bool other = false) const {
        const real d = p - q[k], half = real(0.5) * size_of(length[k]);
        const int ahead = (d > 0) == (length[k] > 0) ? -1 : 1;
        return length[k] != 0 && (size_of(d) > half) != other ? ahead : 0;
    }
    JFRNN_MEMBER real moved(int k, real p, int image) const {
        return image == 0 ? p : Lattice::add(p, Lattice::mul(real(image), length[k]));
    }
    // |p - q|^2 - square in working precision: negative for what is closer, and never for what is not finite.
    JFRNN_MEMBER real excess(const real* p, real square) const {
        real sum = -square;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const real d = (PERIODIC ? moved(k, p[k], nearest(k, p[k])) : p[k]) - q[k];
            sum += d * d;
        }
        return sum;
    }
    // Decides exactly. `code` becomes that of the image that is a neighbor.
    JFRNN_MEMBER bool is_exact_pair(const real* p, int j, int& code) const {
        if constexpr (!PERIODIC)
            return exact_pair(q, p, radius, 0, closed);
        for (int others = 0; others < (tight ? 1 << DIM : 1); ++others) {  // axes along which the next nearest one is asked for
            code = code_of(p, others);
            if (exact_image(lattice, query_row(), positions + (long long)ROW * j, code, radius, 0, closed))
                return true;
        }
        return false;
    }
    JFRNN_MEMBER int code_of(const real* p, int others = 0) const {
        int code = 0;
        for (int k = 0; PERIODIC && k < DIM; ++k)
            code = code * (2 * lattice.images(k) + 1) + nearest(k, p[k], others >> k & 1) * (length[k] != 0) + lattice.images(k);
        return code;
    }
    // The whole number of lattice vectors along an axis by which an image is moved.
    JFRNN_MEMBER int shift_in(int code, int axis) const {
        for (int k = DIM - 1; PERIODIC && k > axis; --k)
            code /= 2 * lattice.images(k) + 1;
        return PERIODIC ? code % (2 * lattice.images(axis) + 1) - lattice.images(axis) : 0;
    }

    // Finds what may be neighbors: for each word of the share of this thread, bits in `near`. Returns whether the sources that this
    // thread has loaded are finite.
    JFRNN_MEMBER bool find(unsigned int (*near)[FEW_THREADS]) const {
        __shared__ Tile tile;
        const int turns = parts == 1 ? LOADED / FEW_WARPS : 1, at_once = turns * parts;  // words of a share, and of a warp, at a time
        bool finite = true;
        for (int k = 0; k < words && share < shares(); k += turns) {
            __syncwarp();
#pragma unroll
            for (int i = 0; i < 4; ++i)
                if (i < at_once)
                    finite = load(tile, warp * at_once + i, 32 * ((warp * parts + i / turns) * words + k + i % turns)) && finite;
            __syncwarp();
            for (int turn = 0; turn < turns && k + turn < words; ++turn)
                near[k + turn][threadIdx.x] = bits_of(tile, warp * at_once + lane % parts * turns + turn, first_of(k + turn));
        }
        return finite;
    }
    // Loads a word of sources, one per lane; behind the last one they lie where nothing is near. Returns whether it is finite.
    JFRNN_MEMBER bool load(Tile& tile, int to, int first) const {
        real p[3] = {Bits::not_finite(), 0, 0};
        bool finite = true;
        if (first + lane < n) {
            const real* row = positions + (long long)ROW * (first + lane);
            point_of(row, p);
            finite = finite_point(p);
            if (!finite)
                p[0] = Bits::not_finite();
            if constexpr (BATCHED)
                tile.systems[to][lane] = system_of(row);
        }
#pragma unroll
        for (int k = 0; k < DIM; ++k)
            tile.points[to][lane].at[k] = finite || k == 0 ? p[k] : real(0);
        return finite;
    }
    // One bit of each source of a word: may it be a neighbor?
    JFRNN_MEMBER unsigned int bits_of(const Tile& tile, int from, int first) const {
        if (first >= n)
            return 0;
        unsigned int bits = 0;
#pragma unroll
        for (int s = 31; s >= 0; --s) {
            const Point point = tile.points[from][s];
            real over = excess(point.at, far_square);
            if constexpr (BATCHED)
                over = tile.systems[from][s] == system ? over : real(1);
            bits = bits << 1 | Bits::negative(over);
        }
        const int own = query - first;
        if (drop_self && 0 <= own && own < 32)
            bits &= ~(1u << own);
        if (later_only && own > 0)
            bits = own < 32 ? bits >> own << own : 0;
        return is_query && is_finite ? bits : 0;
    }
    // Calls `meet(j, p, code)` for all neighbors among the sources of this thread, in ascending order: source, where it is, image.
    // In `near` no others stay.
    template <class Meet>
    JFRNN_MEMBER void meet_all(unsigned int (*near)[FEW_THREADS], Meet meet) const {
        unsigned int rest = 0;
        for (int k = share < shares() ? 0 : words;;) {
            while (rest == 0 && k < words)
                rest = near[k++][threadIdx.x];
            if (rest == 0)
                return;
            const int bit = __ffs(rest) - 1, j = first_of(k - 1) + bit;
            rest &= rest - 1;
            real p[3];
            point_of(positions + (long long)ROW * j, p);
            int code = PERIODIC && SUMS ? code_of(p) : 0;
            if (excess(p, sure_square) < 0 || is_exact_pair(p, j, code))
                meet(j, p, code);
            else
                near[k - 1][threadIdx.x] &= ~(1u << bit);
        }
    }
};
