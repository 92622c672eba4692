// How queries come to the sources that may be near: by cells. Where cutoffs differ, `tree_walk_cpu.h` takes the place of this file.
#pragma once
#include "cell_walk_cpu.h"

template <class Query>
using QueryWalk = CellWalk<Query>;
