// Sources that a query excludes, whatever their distance.
#pragma once
#include "constants.h"
#include "device.h"

// A row of `ids`, those of the query from `starts[query]` on, in ascending order; without EXCLUDING there are no rows. Where EXCLUDING is
// 2, an id names an image of a source: source + n * code. A short row has a filter, with a
// bit for each number modulo 64 that stands there: it tells most other sources apart without a look at the row.
struct Excluded {
    static constexpr int SHORT = 64, MOST_KEPT = 4, NOBODY = -1, MANY = -2;
    // A row of at most MOST_KEPT ids, or MANY and the filter of a longer one.
    struct alignas(16) Kept {
        int ids[MOST_KEPT];
        JFRNN_INLINE bool are_many() const { return ids[0] == MANY; }
        JFRNN_INLINE unsigned long long filter() const {
            return (unsigned int)ids[1] | (unsigned long long)(unsigned int)ids[2] << 32;
        }
        JFRNN_INLINE bool has(int id) const {
            bool found = false;
            for (int k = 0; k < MOST_KEPT; ++k)
                found |= ids[k] == id;
            return found;
        }
    };
    // The id of a source, of which there are n, in an image.
    JFRNN_FUNCTION int id_of(int source, int code, int n) { return EXCLUDING == 2 ? source + n * code : source; }
    const int *begin, *end;
    unsigned long long filter;
    JFRNN_INLINE Excluded(const int* starts, const int* ids, int query, unsigned long long filter)
        : begin(EXCLUDING ? ids + starts[query] : nullptr), end(EXCLUDING ? ids + starts[query + 1] : nullptr), filter(filter) {}
    JFRNN_INLINE Excluded(const int* starts, const int* ids, int query) : Excluded(starts, ids, query, 0) {
        filter = find_filter();
    }
    JFRNN_INLINE unsigned long long find_filter() const {
        if (end - begin > SHORT)
            return ~0ull;
        unsigned long long found = 0;
        for (const int* id = begin; id < end; ++id)
            found |= 1ull << (*id & 63);
        return found;
    }
    // Which ids stand in any of several rows, as far as their last digits tell.
    struct OfAny {
        static constexpr int WORDS = EXCLUDING ? 64 : 1;
        unsigned int bits[WORDS];
        JFRNN_FUNCTION int word_of(int id) { return id >> 5 & (WORDS - 1); }
        JFRNN_FUNCTION unsigned int bit_of(int id) { return 1u << (id & 31); }
        JFRNN_INLINE bool may_have(int id) const { return bits[word_of(id)] & bit_of(id); }
    };
    JFRNN_INLINE Kept kept() const {
        if (end - begin > MOST_KEPT) {
            const unsigned long long found = find_filter();
            return Kept{MANY, (int)(unsigned int)found, (int)(unsigned int)(found >> 32), NOBODY};
        }
        Kept kept;
        for (int k = 0; k < MOST_KEPT; ++k)
            kept.ids[k] = begin + k < end ? begin[k] : NOBODY;
        return kept;
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
