// How the boxes of a tree are fitted around sources, on CUDA: leaves first, then level by level, a warp for each node.
#pragma once
#include "cells.cuh"
#include "pair_cutoffs.h"

// read: rows of particles [n, ROW], [m, ROW], numbers of the cutoff, cutoffs of sources [n], orders [n], [m]; written: bits, scratch
struct FitArguments {
    const real *positions, *queries, *cutoff, *radii;
    const int *source_order, *query_order;
    int *bits, *scratch;
    int n, m, own, level;

    JFRNN_MEMBER SearchArguments of_search() const {
        return {positions, queries, cutoff, nullptr, nullptr, nullptr, radii, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr,
            nullptr, nullptr, bits, scratch, n, m, own, 0, 0, 0, 0, 0, 0};
    }
};

struct FitTree : Search {
    const int *given_sources, *given_queries;
    const int level;

    JFRNN_MEMBER explicit FitTree(const FitArguments& a)
        : Search(a.of_search()), given_sources(a.source_order), given_queries(a.query_order), level(a.level) {}

    JFRNN_MEMBER void run() {
        for (long long at = thread; level == 0 && !own && at < m; at += threads)
            query_order[at] = given_queries[at];
        const int number = (int)(thread / 32);
        if (number >= TreeLevels::count(n, level))
            return;
        const int child = 32 * number + lane;
        Node node = level == 0 ? put_in_place(child) : load_child(child);
        for (int step = 1; step < 32; step *= 2) {
            Node other;
            for (int word = 0; word < (int)(sizeof(Node) / 4); ++word)
                ((int*)&other)[word] = __shfl_xor_sync(ALL, ((const int*)&node)[word], step);
            node.grow(other);
        }
        if (lane == 0)
            nodes[TreeLevels::begin(n, level) + number] = node;
    }
    // Nothing is in a box like this.
    JFRNN_MEMBER Node nothing() const {
        Node node;
        node.hold_none();
        for (int k = 0; k < 3; ++k) {
            node.low[k] = INF;
            node.high[k] = -INF;
        }
        node.largest = -1;
        return node;
    }
    JFRNN_MEMBER Node load_child(int child) const {
        return child < TreeLevels::count(n, level - 1) ? nodes[TreeLevels::begin(n, level - 1) + child] : nothing();
    }
    // Is there a source with finite coordinates at this place of the order?
    JFRNN_MEMBER bool is_finite(int place) const {
        return place < n && finite_point(positions + (long long)ROW * given_sources[place]);
    }
    // Puts a source in its place, and returns its box.
    JFRNN_MEMBER Node put_in_place(int place) const {
        Node node = nothing();
        if (thread == 0)
            shared.grid.dense = 1;
        if (place >= n)
            return node;
        const int i = given_sources[place];
        const real* const row = positions + (long long)ROW * i;
        Place mine;
        point_of(row, mine.p);
        mine.id = bits_as_real(i);
        sorted[place] = mine;
        if (!finite_point(row)) {
            atomicOr(bits, 2);
            return node;
        }
        if (!is_finite(place + 1))
            shared.grid.finite = place + 1;
        node.hold(system_of(row));
        for (int k = 0; k < DIM; ++k)
            node.low[k] = node.high[k] = mine.p[k];
        if constexpr (VARY && RULE != TABLE)
            node.largest = radii[i];
        return node;
    }
};
