// Search with `wp.HashGrid`, which Warp's own header (`warp/native/hashgrid.h`) queries.
//
// On CUDA a thread serves a query, on the CPU they are served one after the other. `longest` and `bits` are 0 at first.
#pragma once
#include "band.h"
#include "row_places.h"
#include "warp_types.h"
#include "warp_hashgrid.h"

struct HashGridArguments : RowsOut {
    const real *positions, *queries, *cutoff;
    real* scratch;    // the points of which the grid is built, three numbers each
    const int* grid;  // what Warp calls its id
    int n, m, own, closed, drop_self;
    int cells_x, cells_y;  // of the grid, along two axes
};

struct HashGridSearch : HashGridArguments, Space {
    const Band<real> band;

    JFRNN_MEMBER explicit HashGridSearch(const HashGridArguments& given)
        : HashGridArguments(given), Space(given.cutoff), band(Bands::of_one(step_radius, real(0), Bands::ONE)) {}

    // Copies positions to where the grid is built of them. Those that are not finite are strewn over its cells.
    JFRNN_MEMBER void pack() {
        each(n, [&](int i) {
            const real* p = positions + (long long)DIM * i;
            const int cell[3] = {i % cells_x, i / cells_x % cells_y, i / cells_x / cells_y};
            const bool finite = finite_point(p);
            for (int k = 0; k < 3; ++k)
                scratch[3ll * i + k] = !finite ? radius * real(cell[k]) : k < DIM ? p[k] : real(0);
            if (!finite)
                tell(0, 2);
        });
    }
    // Fills the row of each query, or counts its neighbors alone.
    JFRNN_MEMBER void query() {
        each(m, [&](int k) {
            const int i = own ? wp::hash_grid_point_id((wp::uint64_t)grid, k) : k;  // neighboring threads read the same cells
            const real* q = queries + (long long)DIM * i;
            const bool finite = finite_point(q);
            const int found = finite ? meet_candidates(i, q) : 0;
            for (int slot = found; LIST && slot < row_room(starts, i, capacity); ++slot)
                idx[row_begin(starts, i, capacity) + slot] = n;
            count[i] = found;
            tell(found, (finite ? 0 : 2) | (LIST && !FLAT && found > capacity ? 1 : 0));
        });
    }
    // Writes down the neighbors of a query as far as its row goes, and returns how many there are.
    JFRNN_MEMBER int meet_candidates(int i, const real* q) const {
        const wp::vec_t<3, real> point = {{q[0], q[1], DIM == 3 ? q[DIM - 1] : real(0)}};
        wp::hash_grid_query_t<real> candidates = wp::hash_grid_query((wp::uint64_t)grid, point, radius);
        int found = 0;
        for (int j = 0; wp::hash_grid_query_next(candidates, j);) {
            if ((drop_self && j == i) || (later_only && j < i) || !is_pair(q, positions + (long long)DIM * j))
                continue;
            if (LIST && found < row_room(starts, i, capacity))
                write_slot(idx, receivers, row_begin(starts, i, capacity) + found, j, i);
            ++found;
        }
        return found;
    }
    // Decides in working precision, as `PairSearch` does, and where that leaves it open exactly.
    JFRNN_MEMBER bool is_pair(const real* q, const real* p) const {
        real square = 0;
        for (int k = 0; k < DIM; ++k) {
            real d = p[k] - q[k];
            if constexpr (SCALED)
                d *= step_scale;
            square += d * d;
        }
        return square < band.inside || (square <= band.outside && exact_pair(q, p, radius, 0, closed));
    }

#if defined(__CUDACC__)
    template <class Work>
    JFRNN_FUNCTION void each(int size, Work work) {
        const long long k = thread_index();
        if (k < size)
            work((int)k);
    }
    JFRNN_MEMBER void tell(int found, int state) const {
        if (found > *(volatile int*)longest)  // rarely true, and it spares an atomic operation
            atomicMax(longest, found);
        if (state)
            atomicOr(bits, state);
    }
#else
    template <class Work>
    static void each(int size, Work work) {
        for (int k = 0; k < size; ++k)
            work(k);
    }
    void tell(int found, int state) const {
        *longest = found > *longest ? found : *longest;
        *bits |= state;
    }
#endif
};
