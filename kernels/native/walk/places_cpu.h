// Where the sources stand that queries meet: in the order of cells. Where cutoffs differ, `cutoffs_cpu.h` takes the place of this file.
#pragma once
#include "cells_cpu.h"

typedef Scratch SourcePlaces;
