// Rows of neighbors, or their counts, where cutoffs differ from particle to particle.
#pragma once
#include "levels.cuh"
#include "row_places.h"

struct LevelRowArguments {
    const real *positions, *queries, *axes, *radii;
    const int *ids, *keys, *top, *table, *header;
    const real *cutoff, *query_axes, *query_radii;
    const int *query_ids, *query_top, *places, *excluded_starts, *excluded;
    const real* table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries, *starts;
    int *idx, *receivers, *count, *info;
    int n, m, capacity, own_queries, closed, drop_self, later_only, kinds;
};
struct LevelRows : Levels<LevelRows> {
    const int* starts;
    int *idx, *receivers, *counts;
    int capacity;
    struct State {
        long long begin;
        int room, found;  // neighbors
    };

    JFRNN_INLINE explicit LevelRows(const LevelRowArguments& a)
        : Levels({a.positions, a.queries, a.axes, a.radii, a.ids, a.keys, a.top, a.table, a.header, a.cutoff, a.query_axes,
                     a.query_radii, a.query_ids, a.query_top, a.places, a.info, a.n, a.m, a.own_queries, a.closed, a.drop_self,
                     a.later_only},
              a),
          starts(a.starts),
          idx(a.idx),
          receivers(a.receivers),
          counts(a.count),
          capacity(a.capacity) {}

    JFRNN_INLINE State begin_query(const One& one) {
        return State{row_begin(starts, one.id, capacity), row_room(starts, one.id, capacity), 0};
    }
    JFRNN_INLINE void pair(State& state, const One& one, int other, int, int image) {
        if (LIST && state.found < state.room)
            write_slot(idx, receivers, state.begin + state.found, PERIODIC == 2 ? other + n * image : other, one.id);
        ++state.found;
    }
    JFRNN_INLINE void end_query(const State& state, const One& one) {
        if constexpr (LIST)
            for (int s = state.found; s < state.room; ++s)
                idx[state.begin + s] = fill_value;
        counts[one.id] = state.found;
        longest = state.found > longest ? state.found : longest;
    }
};
