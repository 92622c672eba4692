// Sources that a query excludes, whatever their distance.
#pragma once
#include "constants.h"
#include "device.h"

// A row of `ids`, those of the query from `starts[query]` on, in ascending order; without EXCLUDING there are no rows.
struct Excluded {
    const int *begin, *end;
    JFRNN_INLINE Excluded(const int* starts, const int* ids, int query)
        : begin(EXCLUDING ? ids + starts[query] : nullptr), end(EXCLUDING ? ids + starts[query + 1] : nullptr) {}
    JFRNN_INLINE bool has(int source) const {
        const int *low = begin, *high = end;
        while (low < high) {
            const int* const middle = low + (high - low) / 2;
            if (*middle < source)
                low = middle + 1;
            else
                high = middle;
        }
        return low < end && *low == source;
    }
};
