// How queries come to the sources that may be near: by cells. Where cutoffs differ, `cutoff_walk_cpu.h` takes the place of this file.
#pragma once
#include "cell_walk_cpu.h"

template <template <template <class> class> class Queries, class Arguments>
void walk(const Arguments& given) {
    Queries<CellWalk>(given).run();
}
