// Where the rows of a list are, and how its slots are written.
//
// Each row has `capacity` slots. Those of a flat list (FLAT) follow each other without gaps, as long as each is: `starts` says where
// each begins and the last one ends, `capacity` is the number of slots of all. Behind these stands the row of each.
#pragma once
#include "constants.h"
#include "device.h"

JFRNN_FUNCTION int* row_begin(int* idx, const int* starts, int row, int capacity) {
    return idx + (FLAT ? (long long)starts[row] : LIST ? (long long)row * capacity : 0);
}
JFRNN_FUNCTION int row_room(const int* starts, int row, int capacity) { return FLAT ? starts[row + 1] - starts[row] : capacity; }
JFRNN_FUNCTION void write_slot(int* slot, int id, int row, int capacity) {
    *slot = id;
    if constexpr (FLAT)
        slot[(long long)capacity] = row;
}
