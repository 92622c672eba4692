// Few particles on CUDA: one launch, in which every query meets all sources, and nothing is sorted.
//
// A warp serves one query. The warps of a block share tiles of sources, of which a lane meets one at a time. Sources come in ascending
// order, so that rows are ascending, and the same in every run. In a box each source is met where its nearest image is; boxes whose
// vectors do not lie along the axes, or of which several images may be neighbors, have other kernels.
#pragma once
#include "exact.h"

constexpr unsigned int EVERY = 0xffffffffu;
constexpr int AT_ONCE = 4;  // sources that a lane meets before any of them is looked at again

struct FewPairs : Space {
    const real *positions, *queries;
    const int n, closed, lane, query;
    const bool is_query, drop_self, later_only;
    real q[3];
    real sure_square, band;  // what is closer surely is a neighbor, squared; and how much farther it may be and still be one
    real length[3];          // of the box along each axis, 0 where it is not periodic
    bool tight;              // the cutoff is about half of a length: on which side the nearest image is may be in doubt
    unsigned int system;

    template <class Arguments>
    JFRNN_MEMBER FewPairs(const Arguments& a, bool later_only)
        : Space(a.cutoff),
          positions(a.positions),
          queries(a.queries),
          n(a.n),
          closed(a.closed),
          lane(threadIdx.x & 31),
          query((int)(thread_index() >> 5)),
          is_query(query < a.m),
          drop_self(a.drop_self),
          later_only(later_only),
          tight(false) {
        const real* row = query_row();
        point_of(row, q);
        system = system_of(row);
        const real off = PERIODIC ? 2 * lattice.slack() : real(0);  // by which differences of images may be wrong
        const real inner = radius > off ? radius - off : real(0), outer = radius + off;
        sure_square = inner * inner - 8 * (1 + SHIFTED) * step_eps * radius * radius;
        band = outer * outer * (1 + 16 * step_eps) - sure_square;
        for (int k = 0; k < DIM; ++k) {
            length[k] = PERIODIC && lattice.periodic(k) ? lattice.vector(k, k) : real(0);
            tight = tight || (length[k] != 0 && outer > real(0.49) * size_of(length[k]));
        }
    }
    JFRNN_FUNCTION real size_of(real x) { return x < 0 ? -x : x; }
    JFRNN_MEMBER const real* query_row() const { return queries + (long long)ROW * (is_query ? query : 0); }

    // The image of a source that is nearest along an axis; `other`: the next nearest one.
    JFRNN_MEMBER int nearest(int k, real p, bool other = false) const {
        const real d = p - q[k], half = real(0.5) * size_of(length[k]);
        const int ahead = (d > 0) == (length[k] > 0) ? -1 : 1;
        return length[k] != 0 && (size_of(d) > half) != other ? ahead : 0;
    }
    JFRNN_MEMBER real moved(int k, real p, int image) const {
        return image == 0 ? p : Lattice::add(p, Lattice::mul(real(image), length[k]));
    }
    // |p - q|^2 - r^2 and a band in working precision, as in `PairSearch`: negative where the nearest image surely is a neighbor.
    JFRNN_MEMBER real excess(const real (*tile)[FEW_TILE], int s) const {
        real sum = -sure_square;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const real p = tile[k][s], d = (PERIODIC ? moved(k, p, nearest(k, p)) : p) - q[k];
            sum += d * d;
        }
        return sum;
    }
    // Decides exactly. `code` becomes that of the image that is a neighbor.
    JFRNN_MEMBER bool is_exact_pair(const real (*tile)[FEW_TILE], int s, int j, int& code) const {
        const real p[3] = {tile[0][s], tile[1][s], DIM == 3 ? tile[2][s] : real(0)};
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

    // Calls `meet(j, code, hits)` for 32 sources after the other, one per lane, unless none of them is a neighbor: source, image, and
    // which lanes have one. All warps of a block call this together. Returns whether the sources that this thread has loaded are
    // finite.
    template <class Meet>
    JFRNN_MEMBER bool meet_all(Meet meet) const {
        __shared__ real tile[3][FEW_TILE];
        __shared__ unsigned int systems[BATCHED ? FEW_TILE : 1];
        bool finite = true;
        for (int first = 0; first < n; first += FEW_TILE) {
            __syncthreads();
            for (int s = threadIdx.x; s < FEW_TILE; s += blockDim.x) {
                real p[3] = {Bits::not_finite(), 0, 0};
                if (first + s < n) {
                    const real* row = positions + (long long)ROW * (first + s);
                    point_of(row, p);
                    finite = finite && finite_point(p);
                    if constexpr (BATCHED)
                        systems[s] = system_of(row);
                }
#pragma unroll
                for (int k = 0; k < DIM; ++k)
                    tile[k][s] = p[k];
            }
            __syncthreads();
            const int size = n - first < FEW_TILE ? n - first : FEW_TILE;
            for (int begin = 0; is_query && begin < size; begin += 32 * AT_ONCE) {
                real over[AT_ONCE];
                unsigned int near[AT_ONCE];  // the same in all lanes: most often none is
#pragma unroll
                for (int c = 0; c < AT_ONCE; ++c) {
                    over[c] = excess(tile, begin + 32 * c + lane);
                    near[c] = __ballot_sync(EVERY, over[c] <= band);
                }
#pragma unroll
                for (int c = 0; c < AT_ONCE; ++c) {
                    if (near[c] == 0)
                        continue;
                    const int s = begin + 32 * c + lane, j = first + s;
                    bool hit = over[c] <= band && !(drop_self && j == query) && !(later_only && j < query);
                    if constexpr (BATCHED)
                        hit = hit && systems[s] == system;
                    int code = 0;
                    if (PERIODIC && SUMS && hit) {
                        const real p[3] = {tile[0][s], tile[1][s], DIM == 3 ? tile[2][s] : real(0)};
                        code = code_of(p);
                    }
                    if (hit && over[c] >= 0)
                        hit = is_exact_pair(tile, s, j, code);
                    if (const unsigned int hits = __ballot_sync(EVERY, hit))
                        meet(j, code, hits);
                }
            }
        }
        return finite;
    }
};
