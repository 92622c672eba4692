// Where the rows of a list are, and how its slots are written.
//
// Each row has `capacity` slots. Those of a flat list (FLAT) follow each other without gaps, as long as each is: `starts` says where
// each begins and the last one ends, and `receivers` gets the row of each slot.
#pragma once
#include "constants.h"
#include "device.h"

struct RowsOut {
    const int* starts;
    int *idx, *receivers, *count;  // the last one is of each row
    int *longest, *bits;           // of all rows: the length of the longest one, and bits of the status
    int capacity, later_only;
};

JFRNN_FUNCTION long long row_begin(const int* starts, int row, int capacity) {
    return FLAT ? (long long)starts[row] : (long long)row * capacity;
}
JFRNN_FUNCTION int row_room(const int* starts, int row, int capacity) { return FLAT ? starts[row + 1] - starts[row] : capacity; }
JFRNN_FUNCTION void write_slot(int* idx, int* receivers, long long slot, int id, int row) {
    idx[slot] = id;
    if constexpr (FLAT)
        receivers[slot] = row;
}
