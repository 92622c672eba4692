// Sources that a query excludes, whatever their distance.
#pragma once
#include "constants.h"
#include "device.h"

// A row of `ids`, those of the query from `starts[query]` on, in ascending order; without EXCLUDING there are no rows. Where EXCLUDING is
// 2, an id names an image of a source: source + n * code. A short row has a filter, with a
// bit for each number modulo 64 that stands there: it tells most other sources apart without a look at the row.
struct Excluded {
    static constexpr int SHORT = 64, MOST_KEPT = 4, NOBODY = -1, MANY = -2;
    // The id of a source, of which there are n, in an image.
    JFRNN_FUNCTION int id_of(int source, int code, int n) { return EXCLUDING == 2 ? source + n * code : source; }
    const int *begin, *end;
    unsigned long long filter;
    JFRNN_INLINE Excluded(const int* starts, const int* ids, int query, unsigned long long filter)
        : begin(EXCLUDING ? ids + starts[query] : nullptr), end(EXCLUDING ? ids + starts[query + 1] : nullptr), filter(filter) {}
    JFRNN_INLINE Excluded(const int* starts, const int* ids, int query) : Excluded(starts, ids, query, 0) {
        const bool is_short = end - begin <= SHORT;
        for (const int* id = begin; is_short && id < end; ++id)
            filter |= 1ull << (*id & 63);
        filter = is_short ? filter : ~0ull;
    }
    // Which ids stand in any of several rows, as far as their last digits tell.
    struct OfAny {
        static constexpr int WORDS = EXCLUDING ? 64 : 1;
        unsigned int bits[WORDS];
        JFRNN_FUNCTION int word_of(int id) { return id >> 5 & (WORDS - 1); }
        JFRNN_FUNCTION unsigned int bit_of(int id) { return 1u << (id & 31); }
        JFRNN_INLINE bool may_have(int id) const { return bits[word_of(id)] & bit_of(id); }
    };
    // Writes down the row where it holds at most MOST_KEPT ids, else MANY.
    JFRNN_INLINE void keep(int* ids) const {
        for (int k = 0; k < MOST_KEPT; ++k)
            ids[k] = end - begin > MOST_KEPT ? MANY : begin + k < end ? begin[k] : NOBODY;
    }
    // May a source stand in a row with a filter?
    JFRNN_FUNCTION bool may_stand(unsigned long long filter, int source) { return filter >> (source & 63) & 1; }
    JFRNN_INLINE bool has(int source) const {
        if (!may_stand(filter, source))
            return false;
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
