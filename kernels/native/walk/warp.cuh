// What the lanes of a warp share while they serve a group of queries, and the instructions that read and write it.
#pragma once
#include "cells.cuh"
#include "pair_cutoffs.h"

constexpr bool HELD = LIST || SUMS;  // pairs are held as bits until many can be written, or evaluated, together
constexpr int BLOCKS = 22;           // of 32 candidates, whose pairs are held
constexpr int LISTED = 32;           // neighbors of a query that are written at once
constexpr int FETCHED = 2;           // candidates that a lane fetches at a time
constexpr bool MATRIX = !DOUBLE && (!VARY || RULE == TABLE);  // queries meet candidates on tensor cores, else one by one
constexpr int OF_CUTOFFS = BANDED ? 2 : VARY ? 1 : 0;         // numbers that are known of a candidate where cutoffs VARY
constexpr int LEAVES = 256;                                   // of a tree, that are written down at a time
constexpr int RING = 128;  // candidates that wait: fewer than a block, and what is fetched twice, rounded up

// The box around a group. The last numbers are what is near, squared, and twice the coarse band.
struct alignas(16) Box {
    real center[4], half[4];
};
// Candidates of a row of cells: the number at which they end, and what leads from the number of a candidate to its place.
struct Run {
    int end, shift;
};
struct alignas(16) Warp {
    union {
        // A ring of candidates near the box: columns of a matrix, pairs of halves, or coordinates, and what says their cutoffs.
        real candidates[(MATRIX ? 4 : DIM) + OF_CUTOFFS][RING + 8];
        // Per query, while rows are written: addresses of the ids that are next, two in a word; the stride is odd, for the banks.
        unsigned int lists[SUMS ? 1 : 32][LISTED / 2 + 3];
    };
    alignas(16) int candidate_ids[HELD ? 4 : RING];
    alignas(16) int ids[HELD ? 32 * (BLOCKS + FETCHED) : 1];  // of all candidates since pairs were last settled
    unsigned int hits[HELD ? BLOCKS + 1 : 1][32];             // per block of candidates and query: one bit per candidate
    unsigned int written[LIST ? 32 : 1];  // per query: neighbors that stand in its row, a multiple of four, plus those left over
    int left[LIST ? 3 : 1][32];           // the ids of those left over
    Excluded::OfAny excluded_by_any;
    Excluded::Kept excluded[EXCLUDING ? 32 : 1];  // what queries exclude
    Box box;
    Run runs[33];
    int run_images[CROSSING ? 33 : 1];  // the codes of their images, and what leads from home to these
    real run_moved[CROSSING ? 33 : 1][3];
    int shifts[CROSSING ? 32 : 1];  // of images, where these have so few codes: a byte for each axis
    int leaves[TREE ? LEAVES : 1], leaf_images[TREE && CROSSING ? LEAVES : 1];  // of a tree, those near the queries
};
// What every warp reads of the search; here it takes no registers.
struct Known {
    Grid grid;
    int finite_queries, longs;
    int longest_before;  // the longest row that other warps had found when this one began
    real site, between;  // the unit of a lattice, and the square, in such units, between those of pairs and of others; or 0
};
JFRNN_FUNCTION Warp& shared_warp() {
    __shared__ Warp warp;
    return warp;
}
JFRNN_FUNCTION Known& shared_known() {
    __shared__ Known known;
    return known;
}

JFRNN_FUNCTION unsigned int shared_address(const void* p) { return (unsigned int)__cvta_generic_to_shared(p); }
JFRNN_FUNCTION int load_word(unsigned int at) {
    int word;
    asm volatile("ld.shared.u32 %0, [%1];" : "=r"(word) : "r"(at) : "memory");
    return word;
}
// Loads an id while nothing is written to where ids stand: the compiler may move it.
JFRNN_FUNCTION int load_id(unsigned int at) {
    int id;
    asm("ld.shared.u32 %0, [%1];" : "=r"(id) : "r"(at));
    return id;
}
// Stores a word by a predicate: for lanes without anything to store this costs less than a branch around it.
JFRNN_FUNCTION void store_if(bool is_stored, unsigned int to, unsigned int word) {
    asm volatile("{.reg .pred is; setp.ne.u32 is, %0, 0; @is st.shared.u32 [%1], %2;}"
        :
        : "r"((unsigned int)is_stored), "r"(to), "r"(word)
        : "memory");
}
