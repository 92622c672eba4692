// Sums over pairs in systems with boxes of their own: what kernels are given.
//
// `columns` has what a term reads of the sources, sorted as they are, `stride` numbers of each: OTHERS numbers, then for each of STEPS
// how many lattice vectors lie between the box and the source, along that axis.
#pragma once
#include "box_pairs.h"

struct BoxSumArguments {
    const real *positions, *queries, *boxes, *axes, *shared_values, *own_values, *columns;
    const int *systems, *ids, *cells, *start, *excluded_starts, *excluded;
    const real *radii, *query_radii, *table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    real *sums, *totals, *errors, *more;
    int* info;
    int n, m, stride, own, closed, drop_self, kinds;

    JFRNN_MEMBER BoxArguments of_search() const {
        return {positions, queries, boxes, axes, systems, ids, cells, start, excluded_starts, excluded, radii, query_radii,
            table_of_kinds, kinds_of_sources, kinds_of_queries, nullptr, nullptr, nullptr, nullptr, info, n, m, stride, own, 0,
            closed, drop_self, kinds};
    }
};
