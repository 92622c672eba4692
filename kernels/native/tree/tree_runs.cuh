// The leaves of a tree within reach of a group, and the runs of candidates that they hold.
#pragma once
#include "marked_runs.cuh"

struct TreeRuns {
    int root, level, node;     // the node whose children are visited
    unsigned int left;         // of lane l: children of the node at the level l that are yet to be visited, a bit each
    int image, image_of_lane;  // whose leaves are visited, and the one of this lane
    unsigned int images;       // those of the lanes that are yet to be visited
    int taken, known;          // leaves of which candidates have been written down, of those that are known
    bool exhausted;            // no others are left to visit

    // Begins, and decides how many queries of the group walk together: all, if few leaves are near them. Else they are `loose`, as those
    // that follow are likely to be: as many as have the fewest leaves for each, by doubling.
    JFRNN_MEMBER TreeRuns(const PairSearch& search, Group& group, bool& loose) : root(TreeLevels::root(search.n)) {
        const int whole = group.size;
        if (!loose || whole == 1) {
            begin(search, group);
            collect(search, group);
            if (exhausted || whole == 1)
                return;
            loose = true;
        }
        set_size(search, group, 1);
        begin(search, group);
        collect(search, group);
        if (!exhausted)
            return;
        int size = 1;
        for (long long found = known; size < whole;) {
            const int more = 2 * size < whole ? 2 * size : whole;
            set_size(search, group, more);
            const long long here = count(search, group, (int)(found * more / size + 1));
            if (here * size >= found * more)
                break;
            found = here;
            size = more;
        }
        if (size != group.size)
            set_size(search, group, size);
        exhausted = true;  // the leaves of the first one are known
        if (size > 1) {
            begin(search, group);
            collect(search, group);
        }
    }
    JFRNN_FUNCTION void set_size(const PairSearch& search, Group& group, int size) {
        __syncwarp();
        group.size = size;
        group.enclose(search);
    }
    // Counts the leaves that are near a group, up to a number.
    JFRNN_MEMBER int count(const PairSearch& search, const Group& group, int most) {
        int found = 0;
        begin(search, group);
        for (unsigned int leaves = next(search, group); leaves && found < most; leaves = next(search, group))
            found += __popc(leaves);
        return found;
    }
    // Writes down leaves that are near, while there are any, and room.
    JFRNN_MEMBER void collect(const PairSearch& search, const Group& group) {
        Warp& warp = shared_warp();
        const int lane = search.lane;
        taken = known = 0;
        __syncwarp();
        while (known <= LEAVES - 32 && !exhausted) {
            const unsigned int leaves = next(search, group);
            if (leaves >> lane & 1) {
                const int number = known + __popc(leaves & ((1u << lane) - 1));
                warp.leaves[number] = 32 * node + lane;
                if constexpr (CROSSING)
                    warp.leaf_images[number] = image;
            }
            known += __popc(leaves);
            exhausted = leaves == 0;
        }
        __syncwarp();
    }
    JFRNN_MEMBER bool are_left() const { return !exhausted || taken < known; }
    // Writes down the candidates of the next up to 32 leaves as runs; returns how many there are.
    JFRNN_MEMBER int find(const PairSearch& search, const Group& group) {
        const Warp& warp = shared_warp();
        if (taken >= known)
            collect(search, group);
        const int number = taken + search.lane;
        taken += 32;
        const bool has_leaf = number < known;
        const int leaf = has_leaf ? warp.leaves[number] : 0, finite = shared_known().grid.finite - 32 * leaf;
        const int code = CROSSING && has_leaf ? warp.leaf_images[CROSSING ? number : 0] : search.home;
        return share_runs(search, 32 * leaf, !has_leaf ? 0 : finite < 32 ? finite : 32, code);
    }
    JFRNN_MEMBER void begin(const PairSearch& search, const Group& group) {
        image_of_lane = -32 + search.lane;
        images = 0;
        image = search.home;
        exhausted = false;
        climb_to_root();
        if constexpr (!CROSSING)
            visit(search, group);
    }
    JFRNN_MEMBER void climb_to_root() {
        level = root > 0 ? root : 1;  // a single leaf is the only child of a node that nobody needs
        node = 0;
        left = 0;
    }
    // Finds which children of the node are near the group.
    JFRNN_MEMBER void visit(const PairSearch& search, const Group& group) {
        const int child = 32 * node + search.lane;
        const bool is_there = child < TreeLevels::count(search.n, level - 1);
        const bool is_near = is_there && near(search, group, TreeLevels::begin(search.n, level - 1) + child, image);
        const unsigned int bits = __ballot_sync(ALL, is_near);
        left = search.lane == level ? bits : left;
    }
    JFRNN_FUNCTION bool near(const PairSearch& search, const Group& group, long long at, int image) {
        const Node here = search.nodes[at];
        real moved[3] = {0, 0, 0}, square = 0;
        if constexpr (CROSSING)
            search.translate(image, moved);
#pragma unroll
        for (int a = 0; a < DIM; ++a) {
            const real low = CROSSING ? Lattice::add(here.low[a], moved[a]) : here.low[a];
            const real high = CROSSING ? Lattice::add(here.high[a], moved[a]) : here.high[a];
            const real before = group.from_center(low, group.box.center[a]), behind = -group.from_center(high, group.box.center[a]);
            const real gap = larger((before > behind ? before : behind) - group.box.half[a], 0);
            square += gap * gap;
        }
        return square <= group.near_with(search, here.largest) && here.has(group.system);
    }
    // Goes on to the next node with leaves that are near; returns which ones are, a bit each, or 0 where no such node is left.
    JFRNN_MEMBER unsigned int next(const PairSearch& search, const Group& group) {
        while (true) {
            const unsigned int children = __shfl_sync(ALL, left, level);
            if (children && level == 1) {
                left = search.lane == 1 ? 0 : left;
                return children;
            }
            if (children) {
                left = search.lane == level ? children & (children - 1) : left;
                node = 32 * node + __ffs((int)children) - 1;
                --level;
                visit(search, group);
            } else if (level < root) {
                node /= 32;
                ++level;
            } else if (!enter_image(search, group))
                return 0;
        }
    }
    // Goes on to the next image in which anything is near, if there is one.
    JFRNN_MEMBER bool enter_image(const PairSearch& search, const Group& group) {
        if constexpr (CROSSING) {
            while (images == 0) {
                image_of_lane += 32;
                const bool is_there = image_of_lane < search.codes;
                if (!__any_sync(ALL, is_there))
                    return false;
                images = __ballot_sync(ALL, is_there && near(search, group, TreeLevels::begin(search.n, root), image_of_lane));
            }
            image = __shfl_sync(ALL, image_of_lane, __ffs((int)images) - 1);
            images &= images - 1;
            climb_to_root();
            visit(search, group);
        }
        return CROSSING;
    }
};

// Where the candidates of a group come from.
using Runs = Choice<TREE, TreeRuns, Choice<LONG, MarkedRuns, CellRuns>::Type>::Type;
