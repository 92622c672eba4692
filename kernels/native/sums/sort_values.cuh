// Puts values of the sources into the order of cells, a row each, on CUDA. Before these come rows of particles in a box, coordinates as
// they were given and turns, where these are read: if any particle has turns, or (READS_ROWS is 2) has turns that are not -1, 0 or 1.
// Otherwise coordinates in the cell stand for them.
#pragma once
#include "cells.cuh"

struct SumsArguments {
    const real *positions, *queries, *cutoff, *shared_values, *own_values, *others;
    const int *excluded_starts, *excluded;
    const real *radii, *query_radii, *table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    real *sums, *totals, *errors, *more, *values;
    int *bits, *scratch;
    int n, m, own, table, closed, drop_self, kinds;

    // The arguments of a search that writes nothing but scratch.
    JFRNN_MEMBER SearchArguments of_search() const {
        return {positions, queries, cutoff, excluded_starts, excluded, nullptr, radii, query_radii, table_of_kinds,
            kinds_of_sources, kinds_of_queries, nullptr, nullptr, nullptr, nullptr, bits, scratch, n, m, own, table, 0, closed,
            drop_self, 0, kinds};
    }
};

// How many numbers of `values` come before those that are sorted.
JFRNN_FUNCTION long long places_given(int n) { return READS_ROWS > 0 ? 4ll * n : 0; }
JFRNN_FUNCTION bool are_turned(Lattice::Argument lattice) { return READS_ROWS > 0 && lattice.most_turns() >= READS_ROWS; }

struct SortValues : Search {
    const real* others;
    real* values;
    JFRNN_MEMBER explicit SortValues(const SumsArguments& a)
        : Search(a.of_search()), others(a.others), values(a.values + places_given(a.n)) {}

    JFRNN_MEMBER void run() {
        if (are_turned(lattice))
            for (long long t = thread; t < n; t += threads) {
                const real* const row = positions + (long long)ROW * id_of(sorted[t].id);
                const Place given{{row[0], row[1], DIM == 3 ? row[2] : real(0)}, row[PERIODIC ? DIM : 0]};
                ((Place*)(values - places_given(n)))[t] = given;
            }
        if constexpr (COLUMNS > 0)
            sort_columns();
    }
    // Writes as much of a row at once as 16 bytes hold.
    JFRNN_MEMBER void sort_columns() {
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
