// Which cell a coordinate is in, and which bucket a cell; a level is the biased exponent of the inverse edge of its cells.
#pragma once
#include "bits.h"

// Cells per length at a level.
JFRNN_FUNCTION double scale_of(int level) { return level == 0 ? 0.0 : Bits::power_of_two(level - Bits::BIAS); };
// The cell of a coordinate.
JFRNN_FUNCTION int cell_at(double x, double scale) {
    const double cell = floor(x * scale);
    return cell < -0x1p30 ? -(1 << 30) : cell > 0x1p30 ? 1 << 30 : (int)cell;
}
// The bucket of a cell.
JFRNN_FUNCTION int bucket_of(int level, const int* cell, int buckets) {
    unsigned int word = (unsigned int)level * 0x9e3779b1u;
    for (int k = 0; k < DIM; ++k) {
        word = (word ^ (unsigned int)cell[k]) * 0x85ebca6bu;
        word ^= word >> 15;
    }
    word *= 0xc2b2ae35u;
    return (int)((word ^ (word >> 16)) & (unsigned int)(buckets - 1));
}
// The bucket of the cell that a point is in.
JFRNN_FUNCTION int bucket_at(const real* p, int level, int buckets) {
    const double scale = scale_of(level);
    int cell[DIM];
    for (int k = 0; k < DIM; ++k)
        cell[k] = cell_at(double(p[k]), scale);
    return bucket_of(level, cell, buckets);
}
