// Rows of neighbors, or their counts, in systems with boxes of their own on CUDA.
#pragma once
#include "box_pairs.cuh"
#include "row_places.h"

struct BoxRowArguments : BoxArguments, RowsOut {};
struct BoxRows : BoxLanes<BoxRows>, RowsOut {
    int found;  // of the query if they are listed, by this lane if they are counted
    int room;   // of its row

    JFRNN_MEMBER explicit BoxRows(const BoxRowArguments& given) : BoxLanes(given), RowsOut(given), found(0), room(0) {}

    JFRNN_MEMBER void go_to(int turn) {
        BoxPairs::go_to(turn);
        room = LIST ? row_room(starts, query, capacity) : 0;
    }
    JFRNN_MEMBER void run() {
        walk();
        const int all = LIST ? found : sum_of(found);
        if (!is_query)
            return;
        for (int s = all + lane; LIST && s < room; s += LANES_PER_ROW)
            idx[row_begin(starts, query, capacity) + s] = fill_value();
        if (lane > 0)
            return;
        count[query] = all;
        if (all > *(volatile int*)longest)
            atomicMax(longest, all);
    }
    // Those that are neighbors go into the row, by their lanes.
    JFRNN_MEMBER void take(bool hit, int at, const BoxRun& run) {
        if constexpr (!LIST) {
            found += hit;
            return;
        }
        const unsigned int hits = of_query(__ballot_sync(EVERY, hit));
        const int slot = found + __popc(hits & ((1u << lane) - 1));
        if (hit && slot < room)
            write_slot(idx, receivers, row_begin(starts, query, capacity) + slot, name_of(ids[at], run.code), query);
        found += __popc(hits);
    }
};
