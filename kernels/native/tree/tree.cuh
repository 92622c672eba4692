// A tree of boxes over sources that follow each other along a curve, on CUDA: where cutoffs differ widely, it takes the place of cells.
//
// A leaf holds 32 sources that come one after the other, a node 32 nodes of the level below (leaves are level 0). So the tree needs no
// addresses: children of the node k are 32 k to 32 k + 31, a lane each. The root stands alone at the highest level. Sources without
// finite coordinates come last, and are in no box.
#pragma once
#include "space.h"

// The systems of what is in a box, from the first to the last.
template <bool>
struct Systems {
    unsigned int first, last;
    JFRNN_MEMBER void hold_none() {
        first = ~0u;
        last = 0;
    }
    JFRNN_MEMBER void hold(unsigned int system) { first = last = system; }
    JFRNN_MEMBER void grow(const Systems& other) {
        first = other.first < first ? other.first : first;
        last = other.last > last ? other.last : last;
    }
    JFRNN_MEMBER bool has(unsigned int system) const { return first <= system && system <= last; }
};
template <>
struct Systems<false> {
    JFRNN_MEMBER void hold_none() {}
    JFRNN_MEMBER void hold(unsigned int) {}
    JFRNN_MEMBER void grow(const Systems&) {}
    JFRNN_MEMBER bool has(unsigned int) const { return true; }
};

// The box of a node, and the largest cutoff of the sources in it.
struct alignas(16) Node : Systems<BATCHED> {
    real low[3], largest, high[3];

    JFRNN_MEMBER void grow(const Node& other) {
        Systems<BATCHED>::grow(other);
        widen(low, high, other.low, other.high);
        largest = other.largest > largest ? other.largest : largest;
    }
};

// How many nodes each level has, and where they begin.
struct TreeLevels {
    JFRNN_FUNCTION int count(int sources, int level) { return (int)(((sources - 1ll) >> 5 * (level + 1)) + 1); }
    JFRNN_FUNCTION int root(int sources) {
        int level = 0;
        while (count(sources, level) > 1)
            ++level;
        return level;
    }
    JFRNN_FUNCTION long long begin(int sources, int level) {
        long long before = 0;
        for (int below = 0; below < level; ++below)
            before += count(sources, below);
        return before;
    }
};
