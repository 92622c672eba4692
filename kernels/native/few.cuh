// Few particles on CUDA, in open space: one launch, in which every query meets all sources, and nothing is sorted.
//
// A warp serves one query. The warps of a block share tiles of sources, of which a lane meets one at a time. Sources come in ascending
// order, so that rows are ascending, and the same in every run.
#pragma once
#include "exact.h"

constexpr unsigned int EVERY = 0xffffffffu;
constexpr int AT_ONCE = 4;  // sources that a lane meets before it asks whether one of them is a neighbor

struct FewPairs : Space {
    const real *positions, *queries;
    const int n, closed, lane, query;
    const bool is_query, drop_self, later_only;
    real q[3];
    real sure_square, band;  // what is closer surely is a neighbor, squared; and how much farther it may be and still be one
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
          later_only(later_only) {
        const real* row = queries + (long long)ROW * (is_query ? query : 0);
        point_of(row, q);
        system = system_of(row);
        const real square = step_radius * step_radius;
        band = 16 * step_eps * square;
        sure_square = square - real(0.5) * band;
    }

    // Calls `meet(j, hit)` for 32 sources after the other, one per lane, unless none of them is a neighbor. All warps of a block call
    // this together. Returns whether the sources that this thread has loaded are finite.
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
                bool near = false;
#pragma unroll
                for (int c = 0; c < AT_ONCE; ++c) {
                    over[c] = excess(tile, begin + 32 * c + lane);
                    near = near || over[c] <= band;
                }
                if (!__any_sync(EVERY, near))
                    continue;
#pragma unroll
                for (int c = 0; c < AT_ONCE; ++c) {
                    const int s = begin + 32 * c + lane, j = first + s;
                    bool hit = over[c] <= band && !(drop_self && j == query) && !(later_only && j < query);
                    if constexpr (BATCHED)
                        hit = hit && systems[s] == system;
                    if (hit && over[c] >= 0)
                        hit = is_exact_pair(tile, s);
                    if (__any_sync(EVERY, hit))
                        meet(j, hit);
                }
            }
        }
        return finite;
    }
    // |p - q|^2 - r^2 and a band in working precision, as in `PairSearch`: negative where the source surely is a neighbor.
    JFRNN_MEMBER real excess(const real (*tile)[FEW_TILE], int s) const {
        real sum = -sure_square;
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const real d = tile[k][s] - q[k];
            sum += d * d;
        }
        return sum;
    }
    JFRNN_MEMBER bool is_exact_pair(const real (*tile)[FEW_TILE], int s) const {
        const real p[3] = {tile[0][s], tile[1][s], DIM == 3 ? tile[2][s] : real(0)};
        return exact_pair(q, p, radius, 0, closed);
    }
};
