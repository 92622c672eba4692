// Puts values of the sources into the order of cells, a column each, on the CPU: threads hand themselves chunks of places. Behind them
// come coordinates and turns as rows of particles hold them, where these are read: if any particle has turns, or (`reads_rows` is 2)
// has turns that are not -1, 0 or 1. Otherwise coordinates in the order of cells stand for them.
#pragma once
#include "cells_cpu.h"

struct SortValuesArguments {
    const real *positions, *others;
    real* columns;
    int* scratch;
    int n, m, own, table, width, reads_rows, row_numbers;
};
struct SortValues : SortValuesArguments {
    explicit SortValues(const SortValuesArguments& given) : SortValuesArguments(given) {}

    void run() {
        const Scratch in(scratch, n, m, own, table);
        const int given = reads_rows && in.shared.turned >= reads_rows ? DIM + 1 : 0;
        each_chunk(in.shared.next_sorted, n, width + given ? CHUNK : n, [&](int from, int to, int) {
            for (int place = from; place < to; ++place)
                for (int c = 0; c < width; ++c)
                    columns[(long long)c * n + place] = others[(long long)width * in.ids[place] + c];
            for (int place = from; given && place < to; ++place) {
                const real* row = positions + (long long)row_numbers * in.ids[place];
                for (int c = 0; c < given; ++c)
                    columns[(long long)(width + c) * n + place] = row[c];
            }
        });
    }
};
