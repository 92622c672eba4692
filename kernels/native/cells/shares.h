// How few queries are shared among more warps: what `share_bits` and `query_blocks` of `jfrnn.kernels.cells_cuda` return.
#pragma once
#include "constants.h"
#include "device.h"

struct Shares {
    int share_bits, query_blocks;
    JFRNN_MEMBER explicit Shares(int m) : share_bits(5) {
        while (share_bits > 0 && ((m - 1) >> (share_bits - 1)) + 1 <= WARPS)
            --share_bits;
        query_blocks = ((m - 1) >> share_bits) + 1;
    }
};
