// Rows of particles in a periodic box, as kernels of cells read them: points near the box, and their turns.
#pragma once
#include "near.h"

struct NearArguments {
    const real *points, *cutoff;  // [n, DIM], and the lattice
    real* rows;                   // written: [n, DIM + 1]
    int *met, *info;              // [2] 0 before, of which the bits say what was met of any (near.h); scratch of the CPU, of 0
    int n;
};

struct NearRow : NearArguments {
    struct alignas(DIM == 3 && !DOUBLE ? 16 : sizeof(real)) Row {
        real numbers[DIM + 1];
    };
    const Near near;

    JFRNN_MEMBER explicit NearRow(const NearArguments& given) : NearArguments(given), near(given.cutoff) {}
    JFRNN_MEMBER int write(long long i) const {
        real point[3];
        for (int k = 0; k < DIM; ++k)
            point[k] = points[DIM * i + k];
        near.bring(point);
        Row row;
        const int found = near.write_row(point, row.numbers);
        ((Row*)rows)[i] = row;
        return found;
    }
};
