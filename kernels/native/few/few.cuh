// Few particles on CUDA: one launch, in which every query meets all sources, and nothing is sorted.
//
// The warps of a block share the sources, and serve the same queries, as many as there are warps. First each lane holds four sources
// and meets one query after the other: one bit of each source says whether it may be a neighbor. Then a lane has a query, and the
// words of one of 32 shares of the sources, and decides. Shares are numbered as their sources are, so that rows are ascending, and the
// same in every run. In a box each source is met where its nearest image is; boxes whose vectors do not lie along the axes, or of which
// several images may be neighbors, have other kernels.
#pragma once
#include "exact.h"
#include "excluded.h"

constexpr unsigned int EVERY = 0xffffffffu;
constexpr int SHARES = 32, OF_WARP = SHARES / FEW_WARPS;  // of sources, and those of a warp
constexpr int FEW_THREADS = 32 * FEW_WARPS;               // of a block
constexpr int WORDS = FEW_MOST / (32 * SHARES);           // of 32 sources: most of them that a share has
constexpr int AT_ONCE = 4;                                // sources that a lane holds

struct FewArguments {
    const real *positions, *queries, *cutoff;
    const int *excluded_starts, *excluded;
    int n, m, closed, drop_self;
};

struct FewPairs : FewArguments, Space {
    struct alignas(DOUBLE ? 8 : 16) Point {
        real at[DOUBLE ? DIM : 4];
    };
    typedef unsigned int Bits32[FEW_THREADS];
    const int lane, warp;
    const int slot, query;  // of the query, in its block and in all
    const int words;        // of a share
    const int share;        // of this lane
    const bool is_query, later_only;
    real q[3];
    real sure_square, far_square;  // of distances, squared: what is closer surely is a neighbor, what is farther surely none
    real length[3];                // of the box along each axis, 0 where it is not periodic
    real around[3];                // its size, infinite where it is not periodic
    bool tight;                    // the cutoff is about half of a length: on which side the nearest image is may be in doubt
    bool is_finite;
    unsigned int system;

    JFRNN_MEMBER FewPairs(const FewArguments& a, bool later_only)
        : FewArguments(a),
          Space(a.cutoff),
          lane(threadIdx.x & 31),
          warp(threadIdx.x >> 5),
          slot(lane / OF_WARP),
          query(blockIdx.x * FEW_WARPS + slot),
          words((n - 1) / (32 * SHARES) + 1),
          share(warp * OF_WARP + lane % OF_WARP),
          is_query(query < m),
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
            around[k] = length[k] != 0 ? size_of(length[k]) : Bits::not_finite();
            tight = tight || (length[k] != 0 && outer > real(0.49) * size_of(length[k]));
        }
    }
    JFRNN_MEMBER const real* query_row() const { return queries + (long long)ROW * (is_query ? query : 0); }
    JFRNN_MEMBER int first_of(int word) const { return 32 * (share * words + word); }

    // The image of a source that is nearest to q along an axis; `other`: the next nearest one.
    JFRNN_MEMBER int nearest(int k, real q, real p, bool other = false) const {
        const real d = p - q, half = real(0.5) * size_of(length[k]);
        const int ahead = (d > 0) == (length[k] > 0) ? -1 : 1;
        return length[k] != 0 && (size_of(d) > half) != other ? ahead : 0;
    }
    // |p - q|^2 - square in working precision, negative for what is closer. In a box, the nearest image of p is the other way around
    // where that is shorter: along each axis this is off by no more than an image that is moved, for which `slack` allows.
    JFRNN_MEMBER real excess(const real* q, const real* p, real square) const {
        real sum = -square;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const real d = fabs(p[k] - q[k]), nearest = PERIODIC ? fmin(d, around[k] - d) : d;
            sum += nearest * nearest;
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
            code =
                code * (2 * lattice.images(k) + 1) + nearest(k, q[k], p[k], others >> k & 1) * (length[k] != 0) + lattice.images(k);
        return code;
    }
    // The whole number of lattice vectors along an axis by which an image is moved.
    JFRNN_MEMBER int shift_in(int code, int axis) const {
        for (int k = DIM - 1; PERIODIC && k > axis; --k)
            code /= 2 * lattice.images(k) + 1;
        return PERIODIC ? code % (2 * lattice.images(axis) + 1) - lattice.images(axis) : 0;
    }

    // Finds what may be neighbors: bits of the words of the share of this thread, in `near`. Returns whether the sources that this
    // thread has loaded are finite; `doubtful` becomes whether any of what its warp has found may be none.
    JFRNN_MEMBER bool find(Bits32* near, bool& doubtful) const {
        __shared__ Point all[FEW_WARPS];
        __shared__ unsigned int systems[BATCHED ? FEW_WARPS : 1];
        if (warp == 0 && lane % OF_WARP == 0) {
#pragma unroll
            for (int k = 0; k < DIM; ++k)
                all[slot].at[k] = q[k];
            if constexpr (BATCHED)
                systems[slot] = system;
        }
        __syncthreads();
        const real doubt = sure_square - far_square;  // what exceeds the far square by less surely is a neighbor
        bool finite = true, any_doubt = false;
        for (int begin = 0; begin < OF_WARP * words && (warp * OF_WARP * words + begin) * 32 < n; begin += AT_ONCE) {
            real p[AT_ONCE][3];
            unsigned int of_source[AT_ONCE];
#pragma unroll
            for (int i = 0; i < AT_ONCE; ++i)
                finite = load((warp * OF_WARP * words + begin + i) * 32 + lane, p[i], of_source[i]) && finite;
#pragma unroll 4
            for (int other = 0; other < FEW_WARPS; ++other) {
                const Point point = all[other];
#pragma unroll
                for (int i = 0; i < AT_ONCE; ++i) {
                    const real over = excess(point.at, p[i], far_square);
                    bool is_near = over < 0;
                    any_doubt |= is_near && !(over < doubt);
                    if constexpr (BATCHED)
                        is_near = is_near && of_source[i] == systems[other];
                    const unsigned int bits = __ballot_sync(EVERY, is_near);
                    const int word = begin + i, part = OF_WARP == 1 ? 0 : word / words;
                    if (lane == 0 && word < OF_WARP * words)
                        near[word - part * words][32 * warp + other * OF_WARP + part] = bits;
                }
            }
        }
        doubtful = __any_sync(EVERY, any_doubt);
        __syncwarp();
        for (int k = 0; k < words; ++k)
            near[k][threadIdx.x] = first_of(k) < n ? allowed(near[k][threadIdx.x], first_of(k)) : 0;
        return finite;
    }
    // Loads a source; behind the last one, and where it is not finite, it is near to nothing. Returns whether it is finite.
    JFRNN_MEMBER bool load(int j, real* p, unsigned int& of_source) const {
        p[0] = Bits::not_finite();
        p[1] = p[2] = 0;
        of_source = 0;
        if (j >= n)
            return true;
        const real* row = positions + (long long)ROW * j;
        point_of(row, p);
        of_source = system_of(row);
        return finite_point(p);
    }
    // Those bits of a word of sources that the query of this thread asks for.
    JFRNN_MEMBER unsigned int allowed(unsigned int bits, int first) const {
        const int own = query - first;
        if (drop_self && 0 <= own && own < 32)
            bits &= ~(1u << own);
        if (later_only && own > 0)
            bits = own < 32 ? bits >> own << own : 0;
        return is_query ? bits : 0;
    }
    // Calls `meet(j, p, code)` for all neighbors among the sources of this thread, in ascending order: source, where it is, image.
    // In `near` no others stay.
    template <class Meet>
    JFRNN_MEMBER void meet_all(Bits32* near, bool doubtful, Meet meet) const {
        const Excluded mine(excluded_starts, excluded, is_query ? query : 0);
        unsigned int rest = 0;
        for (int k = 0;;) {
            while (rest == 0 && k < words)
                rest = near[k++][threadIdx.x];
            if (rest == 0)
                return;
            const int bit = __ffs(rest) - 1, j = first_of(k - 1) + bit;
            rest &= rest - 1;
            real p[3];
            point_of(positions + (long long)ROW * j, p);
            int code = PERIODIC && (SUMS || EXCLUDING == 2) ? code_of(p) : 0;
            const bool near_enough = !doubtful || excess(q, p, sure_square) < 0 || is_exact_pair(p, j, code);
            if (near_enough && !(EXCLUDING && mine.has(Excluded::id_of(j, code, n))))
                meet(j, p, code);
            else
                near[k - 1][threadIdx.x] &= ~(1u << bit);
        }
    }
};
