// How queries come to the sources that may be near where cutoffs differ: by cells or by a tree, in which these have been sorted.
#pragma once
#include "cell_walk_cpu.h"
#include "tree_walk_cpu.h"

template <template <template <class> class> class Queries, template <class> class Way, class Arguments>
__attribute__((noinline)) void walk_along(const Arguments& given) {
    Queries<Way>(given).run();
}
template <template <template <class> class> class Queries, class Arguments>
void walk(const Arguments& given) {
    if constexpr (BOXES)
        walk_along<Queries, CellWalk>(given);
    else if (((const Shared*)given.scratch)->cells_for > 0)
        walk_along<Queries, CellWalk>(given);
    else
        walk_along<Queries, TreeWalk>(given);
}
