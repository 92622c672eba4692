// The runs of candidates of a group: cells within its reach or, of a query with a longer cutoff than cells know, what is marked as near
// (long.cuh). With a block of queries goes the one of its number.
#pragma once
#include "runs.cuh"

struct MarkedRuns : CellRuns {
    bool is_marked;
    int first;             // of 32 words of marks
    unsigned int waiting;  // which of them have any, and are yet to be visited

    JFRNN_MEMBER MarkedRuns(const PairSearch& search, const Group& group, bool loose)
        : CellRuns(search, group, loose), is_marked(group.is_long), first(-32), waiting(0) {
        if (is_marked)
            go_on(search);
    }
    JFRNN_MEMBER void go_on(const PairSearch& search) {
        const int words = (search.n + 1023) / 1024;
        while (!waiting && first + 32 < words) {
            first += 32;
            const int word = first + search.lane;
            waiting = __ballot_sync(ALL, word < words && marks(search, word) != 0);
        }
    }
    JFRNN_MEMBER unsigned int marks(const PairSearch& search, int word) const {
        return search.leaves_near_long[search.words_of_long(search.served) + word];
    }
    JFRNN_MEMBER bool are_left() const { return is_marked ? waiting != 0 : CellRuns::are_left(); }
    JFRNN_MEMBER int find(const PairSearch& search, const Group& group) {
        if (!is_marked)
            return CellRuns::find(search, group);
        const int word = first + __ffs((int)waiting) - 1, leaf = 32 * word + search.lane,
                  left = shared_known().grid.finite - 32 * leaf;
        const int size = !(marks(search, word) >> search.lane & 1) ? 0 : left < 32 ? left : 32;
        const int number = share_runs(search, 32 * leaf, size, search.home);
        waiting &= waiting - 1;
        go_on(search);
        return number;
    }
};
