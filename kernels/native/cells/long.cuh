// Queries whose cutoffs are longer than that by which cells are as wide, on CUDA: few, or the search would take a tree.
//
// Cells would not lead them to all that is near. So it is marked for each of them which leaves, 32 places that follow each other, hold
// anything near, a bit each, and a warp goes through what is marked (marked_runs.cuh).
#pragma once
#include "cells.cuh"
#include "pair_cutoffs.h"

struct LongQueries : Search {
    JFRNN_MEMBER explicit LongQueries(const SearchArguments& given) : Search(given) {}

    // Writes down which queries they are, and clears marks.
    JFRNN_MEMBER void find() {
        if (!has_long_queries())
            return;
        for (long long i = thread; i < m; i += threads)
            if (query_radii[i] > radius) {
                const int k = atomicAdd(&shared.longs, 1) % MOST_LONG;
                shared.long_ids[k] = (int)i;
                shared.long_places[k] = -1;  // where it is not finite, it has none
            }
        for (long long word = thread; word < words_of_long(MOST_LONG); word += threads)
            leaves_near_long[word] = 0;
    }
    // Marks leaves with anything near each of them, and finds their own places.
    JFRNN_MEMBER void mark() {
        if (!has_long_queries())
            return;
        __shared__ int ids[MOST_LONG];
        __shared__ real at[MOST_LONG][3], cutoffs[MOST_LONG], near_square[MOST_LONG];
        const int longs = shared.longs;
        if ((int)threadIdx.x < longs) {  // in the order of their ids: which block adds up whose pairs is the same in every run
            const int id = shared.long_ids[threadIdx.x];
            int k = 0;
            for (int other = 0; other < longs; ++other)
                k += shared.long_ids[other] < id;
            ids[k] = id;
            point_of(queries + (long long)ROW * id, at[k]);
            cutoffs[k] = query_radii[id];
            near_square[k] = PairCutoffs::outside_of(query_radii[id] * step_scale, real(0));
        }
        __syncthreads();
        for (long long first = thread - lane; first < n; first += threads) {
            const long long place = first + lane;
            const bool is_there = place < shared.grid.finite;
            const Place here = is_there ? sorted[place] : Place{{0, 0, 0}, 0};
            for (int k = 0; k < longs; ++k) {
                real square = 0;
                for (int a = 0; a < DIM; ++a) {
                    const real d = (here.p[a] - at[k][a]) * step_scale;
                    square += d * d;
                }
                bool is_near = is_there && square <= near_square[k];
                if (is_near && own && square == 0 && id_of(here.id) == ids[k])
                    shared.long_places[k] = (int)place;
                if (!DOUBLE && is_near)  // far away, floats tell few points apart
                    is_near = is_within(here.p, at[k], cutoffs[k]);
                if (__any_sync(ALL, is_near) && lane == 0)
                    atomicOr(&leaves_near_long[words_of_long(k) + first / 1024], 1u << (first / 32 & 31));
            }
        }
        for (long long place = thread; !own && place < shared.finite_queries; place += threads)
            for (int k = 0; k < longs; ++k)
                if (query_order[place] == ids[k])
                    shared.long_places[k] = (int)place;
    }
    // Is a point within a cutoff of another, or so close to that that float64 does not tell?
    JFRNN_FUNCTION bool is_within(const real* a, const real* b, real cutoff) {
        double square = 0;
        for (int k = 0; k < DIM; ++k)
            square += (double(b[k]) - double(a[k])) * (double(b[k]) - double(a[k]));
        return square <= double(cutoff) * double(cutoff) * (1 + 0x1p-40);
    }
};
