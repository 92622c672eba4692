// Sums of all integers before each, in place, on CUDA: in one pass over tiles (Merrill & Garland 2016, decoupled look-back).
#pragma once
#include "constants.h"
#include "device.h"

// All blocks, of BLOCK threads, take tiles; `state` and `next_tile` are 0 before. No more blocks may be launched than run at once.
JFRNN_FUNCTION void scan_in_place(int* counts, int size, unsigned long long volatile* state, int* next_tile) {
    constexpr unsigned int EVERY = 0xffffffffu;
    constexpr int EACH = TILE / BLOCK;
    __shared__ int sums[BLOCK / 32];
    __shared__ int tile_shared, before_shared;
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    for (;;) {
        if (threadIdx.x == 0)
            tile_shared = atomicAdd(next_tile, 1);
        __syncthreads();
        const int tile = tile_shared;
        if ((long long)tile * TILE >= size)
            break;
        const long long first = (long long)tile * TILE + threadIdx.x * EACH;
        int value[EACH], total = 0;
        for (int e = 0; e < EACH; ++e) {
            value[e] = total;
            total += first + e < size ? counts[first + e] : 0;
        }
        int inclusive = total;
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(EVERY, inclusive, step);
            inclusive += lane >= step ? other : 0;
        }
        if (lane == 31)
            sums[warp] = inclusive;
        __syncthreads();
        int before = inclusive - total, tile_total = 0;
        for (int w = 0; w < BLOCK / 32; ++w) {
            before += w < warp ? sums[w] : 0;
            tile_total += sums[w];
        }
        if (threadIdx.x == 0)  // 1: the sum of this tile, 2: of all tiles up to it; one word, so that both arrive together
            state[tile] = ((tile == 0 ? 2ull : 1ull) << 32) | (unsigned int)tile_total;
        if (warp == 0) {
            int earlier = 0;
            for (int back = tile - 1; back >= 0; back -= 32) {
                const int seen = back - lane;
                unsigned long long word = seen >= 0 ? 0 : 2ull << 32;
                while (__any_sync(EVERY, (word >> 32) == 0))
                    word = (word >> 32) == 0 ? state[seen] : word;
                const unsigned int full = __ballot_sync(EVERY, (word >> 32) == 2);
                const int until = full ? __ffs(full) - 1 : 31;
                int part = lane <= until ? (int)(word & 0xffffffffull) : 0;
                for (int step = 16; step > 0; step /= 2)
                    part += __shfl_down_sync(EVERY, part, step);
                earlier += __shfl_sync(EVERY, part, 0);
                if (full)
                    break;
            }
            if (lane == 0) {
                before_shared = earlier;
                if (tile > 0)
                    state[tile] = (2ull << 32) | (unsigned int)(earlier + tile_total);
            }
        }
        __syncthreads();
        before += before_shared;
        for (int e = 0; e < EACH; ++e)
            if (first + e < size)
                counts[first + e] = before + value[e];
        __syncthreads();
    }
}
