// A list with a skin on CUDA, that is renewed where it is stale: whether it is, what a search is given then, and what is left behind.
//
// The lists of all steps stand in the same arrays: what is kept is written only where a list is stale. A periodic box stands along the
// axes, and a pair has one image in it. Of a box that has changed since, nothing is known but that.
#pragma once
#include "motion.h"

struct RenewArguments {
    const real* now;      // [n, DIM], read, as all that follows but for what is kept and scratch
    const real* limit;    // [1] the square of a motion below which a list holds
    const real* cutoffs;  // a row of LATTICE_END + 1 for each number of turns: what a search is given; whether it is enough
    const real *vectors, *origin;                    // [DIM] of the box
    const int* scratch;                              // of the search
    int *longest, *bits;                             // what the search has found
    real *reference, *kept_vectors, *kept_origin;    // kept: [n, DIM] and [DIM]
    int *status, *required, *rebuild_count, *order;  // kept: [1], and [n]
    real *positions, *cutoff;                        // scratch: [n, ROW] and [LATTICE_END], what the search is given
    int *stale, *parts;                              // scratch: [blocks] and [blocks, 2]
    const int* condition;                            // no address: of a graph that goes on if it is set (CONDITIONAL)
    int n, blocks;
};

struct Renew : RenewArguments {
    const Motion motion;

    JFRNN_MEMBER explicit Renew(const RenewArguments& given)
        : RenewArguments(given), motion{given.now, given.reference, given.limit, Near(given.cutoffs)} {}

    // Says for each block whether one of its points has moved too far, or may have by rounding.
    JFRNN_MEMBER void check() const {
        bool found = false;
        for (int k = 0; PERIODIC && k < DIM; ++k)
            found |= vectors[k] != kept_vectors[k] || origin[k] != kept_origin[k];
        for (long long i = thread_index(); i < n; i += (long long)blocks * BLOCK)
            found |= motion.has_moved(i);
        found = __syncthreads_or(found);
        if (threadIdx.x > 0)
            return;
        stale[blockIdx.x] = found;
        if constexpr (CONDITIONAL)
            if (found)
                cudaGraphSetConditional((unsigned long long)condition, 1);
    }
    // Writes down what the search is given of points, and which of them follow the one before at most a cutoff away.
    JFRNN_MEMBER void prepare() const {
        __shared__ int met, near;
        if (threadIdx.x == 0)
            met = near = 0;
        __syncthreads();
        int own_met = 0, own_near = 0;
        for (long long i = thread_index(); i < n; i += (long long)blocks * BLOCK) {
            real point[3], next[3];
            motion.take(i, point);
            for (int k = 0; k < DIM; ++k)
                reference[DIM * i + k] = point[k];
            if constexpr (PERIODIC)
                own_met |= motion.near.write_row(point, positions + ROW * i);
            if (ORDERED && i + 1 < n) {
                motion.take(i + 1, next);
                bool close = true;
                for (int k = 0; k < DIM; ++k)
                    close &= fabs(next[k] - point[k]) <= (PERIODIC ? cutoffs[0] : cutoff[0]);
                own_near += close;
            }
        }
        if (own_met)
            atomicOr(&met, own_met);
        if (ORDERED && own_near)
            atomicAdd(&near, own_near);
        __syncthreads();
        if (threadIdx.x == 0) {
            parts[2 * blockIdx.x] = met;
            parts[2 * blockIdx.x + 1] = near;
        }
    }
    // One block: adds up what all of them have met, and chooses what the search is given, which has found nothing yet.
    JFRNN_MEMBER void settle() const {
        __shared__ int met, near;
        if (threadIdx.x == 0)
            met = near = 0;
        __syncthreads();
        for (int k = threadIdx.x; k < blocks; k += BLOCK) {
            atomicOr(&met, parts[2 * k]);
            atomicAdd(&near, parts[2 * k + 1]);
        }
        __syncthreads();
        if constexpr (PERIODIC) {
            const real* row = cutoffs + row_of(met) * (LATTICE_END + 1);
            for (int k = threadIdx.x; k < LATTICE_END; k += BLOCK)
                cutoff[k] = row[k];
        }
        if (threadIdx.x == 0) {
            parts[0] = met;
            parts[1] = near;
            *longest = *bits = 0;
        }
        for (int k = threadIdx.x; PERIODIC && k < DIM; k += BLOCK) {
            kept_vectors[k] = vectors[k];
            kept_origin[k] = origin[k];
        }
    }
    // Leaves what the search has found, apart from rows.
    JFRNN_MEMBER void keep() const {
        const int met = parts[0];
        if constexpr (ORDERED)
            for (long long i = thread_index(); i < n; i += (long long)blocks * BLOCK)
                order[i] = parts[1] > n / 2 ? -1 : scratch[FIRST_PLACE + PLACE_WORDS * i + PLACE_WORD];
        if (blockIdx.x > 0 || threadIdx.x > 0)
            return;
        int found = *bits;
        if constexpr (PERIODIC) {
            found &= ~BIT_NOT_FINITE;
            found |= (met & MET_NOT_FINITE ? BIT_NOT_FINITE : 0) | (met & MET_TOO_FAR ? BIT_OUT_OF_RANGE : 0);
            found |= cutoffs[row_of(met) * (LATTICE_END + 1) + LATTICE_END] != 0 ? 0 : BIT_BOX_TOO_SMALL;
        }
        *status |= found;
        *required = *longest > *required ? *longest : *required;
        *rebuild_count += 1;
    }

private:
    // The row of `cutoffs` that holds for all turns that were met: of 0, and of powers of two less one.
    JFRNN_FUNCTION int row_of(int met) { return 32 - __clz(met & (MET_NOT_FINITE - 1)); }
};
