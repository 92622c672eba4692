// How a lane walks over the pairs of its query that are held as bits, block by block that has any.
#pragma once
#include "candidates.cuh"

struct HeldPairs {
    unsigned int hits, ids;            // of the block that is walked over: bits that are left, and the address of its ids
    unsigned int next_hits, next_ids;  // those of the next one: its bits are loaded ahead
    unsigned int met_in;               // blocks that are left, a bit each
    const unsigned int behind;         // the bit of a block behind the last one, that is never left
    const unsigned int words, to_ids;  // where the bits of this query are, and what leads from there to the ids

    JFRNN_MEMBER HeldPairs(const Pairs& pairs, int lane)
        : hits(0),
          ids(0),
          next_hits(0),
          next_ids(0),
          met_in(pairs.met_in | last_block(pairs)),
          behind(last_block(pairs)),
          words(shared_address(&shared_warp().hits[0][lane])),
          to_ids(shared_address(shared_warp().ids) - words) {}
    JFRNN_FUNCTION unsigned int last_block(const Pairs& pairs) { return 1u << pairs.tested / 32; }
    // Goes on to the next block, if nothing is left of this one.
    JFRNN_MEMBER void advance() {
        asm volatile(
            "{.reg .pred empty; .reg .u32 below, bit;"
            "setp.eq.u32 empty, %0, 0;"
            "@empty mov.b32 %0, %1;"
            "@empty mov.b32 %2, %3;"
            "@empty sub.u32 below, %4, 1;"
            "@empty lop3.b32 bit, below, %4, 0, 0x30;"
            "@empty popc.b32 bit, bit;"
            "@empty lop3.b32 %4, %4, below, %5, 0xea;"
            "@empty mad.lo.u32 bit, bit, 128, %6;"
            "@empty ld.shared.u32 %1, [bit];"
            "@empty add.u32 %3, bit, %7;}"
            : "+r"(hits), "+r"(next_hits), "+r"(ids), "+r"(next_ids), "+r"(met_in)
            : "r"(behind), "r"(words), "r"(to_ids)
            : "memory");
    }
    // Takes a pair, if one is left of this block; returns the address of its id.
    JFRNN_MEMBER unsigned int take() {
        const unsigned int below = hits - 1, address = ids + 4 * __popc(below & ~hits);
        hits &= below;
        return address;
    }
};
