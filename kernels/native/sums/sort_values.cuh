// Puts values of the sources into the order of cells, a row each, on CUDA.
#pragma once
#include "cells.cuh"

struct SumsArguments {
    const real *positions, *queries, *cutoff, *shared_values, *own_values, *others;
    const int *excluded_starts, *excluded;
    const real *radii, *query_radii, *table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    real *sums, *totals, *errors, *more, *values;
    int *info, *scratch;
    int n, m, own, table, closed, drop_self, kinds;

    // The arguments of a search that writes nothing but scratch.
    JFRNN_MEMBER SearchArguments of_search() const {
        return {positions, queries, cutoff, excluded_starts, excluded, nullptr, radii, query_radii, table_of_kinds,
            kinds_of_sources, kinds_of_queries, nullptr, nullptr, nullptr, info, scratch, n, m, own, table, 0, closed, drop_self, 0,
            kinds};
    }
};

struct SortValues : Search {
    const real* others;
    real* values;
    JFRNN_MEMBER explicit SortValues(const SumsArguments& a) : Search(a.of_search()), others(a.others), values(a.values) {}

    // Writes as much of a row at once as 16 bytes hold.
    JFRNN_MEMBER void run() {
        constexpr int COLUMNS = OTHERS + (STEPS > 0);  // turns stand behind the others
        constexpr int AT_ONCE = 16 / sizeof(real), EACH = ROW_LENGTH < AT_ONCE ? ROW_LENGTH : AT_ONCE, CHUNKS = ROW_LENGTH / EACH;
        struct alignas(EACH * sizeof(real)) Chunk {
            real at[EACH];
        };
        for (long long t = thread; t < (long long)CHUNKS * n; t += threads) {
            const Place from = sorted[t / CHUNKS];
            const real* const row = others + (long long)COLUMNS * id_of(from.id);
            Chunk chunk;
#pragma unroll
            for (int k = 0; k < EACH; ++k) {
                const int c = (int)(t % CHUNKS) * EACH + k, column = c - PLACED;
                const real along = c == 0 ? from.p[0] : c == 1 ? from.p[1] : from.p[2];
                chunk.at[k] = column < 0 ? along : column < COLUMNS ? row[column] : real(0);
            }
            ((Chunk*)values)[t] = chunk;
        }
    }
};
