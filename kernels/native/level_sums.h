// Sums over pairs where cutoffs differ from particle to particle: what kernels are given.
#pragma once
#include "levels.h"

struct LevelSumArguments {
    const real *positions, *queries, *axes, *radii;
    const int *ids, *keys, *top, *table, *header;
    const real *cutoff, *query_axes, *query_radii;
    const int *query_ids, *query_top, *places, *excluded_starts, *excluded;
    const real* table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    const real *shared_values, *own_values, *columns;
    real *sums, *totals, *errors;
    int* info;
    int n, m, own_queries, closed, drop_self, later_only, kinds;

    JFRNN_MEMBER LevelArguments of_search() const {
        return {positions, queries, axes, radii, ids, keys, top, table, header, cutoff, query_axes, query_radii, query_ids,
            query_top, places, info, n, m, own_queries, closed, drop_self, later_only};
    }
};
