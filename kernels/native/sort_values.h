// Puts values of the sources into the order of cells, a column each, on the CPU: threads hand themselves chunks of places.
#pragma once
#include "cells_cpu.h"

struct SortValuesArguments {
    const real* others;
    real* columns;
    int* scratch;
    int n, m, own, table, width;
};
struct SortValues : SortValuesArguments {
    explicit SortValues(const SortValuesArguments& given) : SortValuesArguments(given) {}

    void run() {
        const Scratch in(scratch, n, m, own, table);
        each_chunk(in.shared.next_sorted, n, CHUNK, [&](int from, int to, int) {
            for (int place = from; place < to; ++place)
                for (int c = 0; c < width; ++c)
                    columns[(long long)c * n + place] = others[(long long)width * in.ids[place] + c];
        });
    }
};
