// Rows of neighbors, or their counts, of few particles on CUDA. `longest` and `bits` are 0 before.
#pragma once
#include "few.cuh"
#include "row_places.h"

struct FewRowsArguments : FewArguments, RowsOut {};

struct FewRows : FewRowsArguments {
    JFRNN_MEMBER explicit FewRows(const FewRowsArguments& given) : FewRowsArguments(given) {}

    JFRNN_MEMBER void run() {
        __shared__ FewPairs::Bits32 near[WORDS];
        __shared__ int counted[FEW_WARPS][SHARES + 1];
        const FewPairs pairs(*this, later_only);
        bool doubtful;
        const bool finite = pairs.find(near, doubtful);
        int found = 0;
        if (doubtful || EXCLUDING)
            pairs.meet_all(near, doubtful, [&](int, const real*, int) { ++found; });
        else
            for (int k = 0; k < pairs.words; ++k)
                found += __popc(near[k][threadIdx.x]);
        counted[pairs.slot][pairs.share] = found;
        const bool not_finite = __syncthreads_or(!finite || (pairs.is_query && !pairs.is_finite));
        // from here on a warp has the row of one query
        const int mine = counted[pairs.warp][pairs.lane], until = add_up(mine, pairs.lane), all = __shfl_sync(EVERY, until, 31);
        counted[pairs.warp][pairs.lane] = until - mine;
        if (pairs.lane == 0)
            counted[pairs.warp][SHARES] = all;
        const int id = blockIdx.x * FEW_WARPS + pairs.warp;
        if (pairs.lane == 0 && id < m)
            count[id] = all;
        for (int slot = all + pairs.lane; LIST && !FLAT && id < m && slot < capacity; slot += 32)
            idx[(long long)id * capacity + slot] = n;
        __syncthreads();
        if (LIST && found > 0)
            write(pairs, near, counted[pairs.slot][pairs.share]);
        if (pairs.warp == 0)
            tell(pairs.lane, pairs.lane < FEW_WARPS ? counted[pairs.lane % FEW_WARPS][SHARES] : 0, not_finite);
    }
    // The sum over this lane and those below.
    JFRNN_FUNCTION int add_up(int number, int lane) {
        for (int step = 1; step < 32; step *= 2) {
            const int below = __shfl_up_sync(EVERY, number, step);
            number += lane >= step ? below : 0;
        }
        return number;
    }
    JFRNN_MEMBER void write(const FewPairs& pairs, const FewPairs::Bits32* near, int slot) const {
        const long long begin = row_begin(starts, pairs.query, capacity);
        const int room = row_room(starts, pairs.query, capacity);
        for (int k = 0; k < pairs.words; ++k)
            for (unsigned int rest = near[k][threadIdx.x]; rest && slot < room; rest &= rest - 1)
                write_slot(idx, receivers, begin + slot++, pairs.first_of(k) + __ffs(rest) - 1, pairs.query);
    }
    // Adds what this block has met: the longest of its rows, `most` of a lane, and whether a particle is not finite.
    JFRNN_MEMBER void tell(int lane, int most, bool not_finite) const {
        for (int step = 16; step > 0; step /= 2) {
            const int other = __shfl_down_sync(EVERY, most, step);
            most = other > most ? other : most;
        }
        if (lane > 0)
            return;
        if (most > *(volatile int*)longest)
            atomicMax(longest, most);
        const int met = (not_finite ? 2 : 0) | (LIST && !FLAT && most > capacity ? 1 : 0);
        if (met)
            atomicOr(bits, met);
    }
};
