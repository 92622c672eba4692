// How few queries are shared among more warps: what `share_bits` and `query_blocks` of `jfrnn.kernels.cells_cuda` return.
#pragma once
#include "constants.h"
#include "device.h"

struct Shares {
    // Where blocks of queries are few, those that are scattered (cells.cuh) may be served in parts, by a warp each.
    static constexpr int PART_BITS = 2, PART_OF_BLOCK = 1 << PART_BITS, MOST_PARTED = 64 * WARPS;
    int share_bits, query_blocks;
    bool may_part;
    JFRNN_MEMBER explicit Shares(int m) : share_bits(5) {
        while (share_bits > 0 && ((m - 1) >> (share_bits - 1)) + 1 <= WARPS)
            --share_bits;
        query_blocks = ((m - 1) >> share_bits) + 1;
        may_part = share_bits > PART_BITS && m <= MOST_PARTED;
    }
};
