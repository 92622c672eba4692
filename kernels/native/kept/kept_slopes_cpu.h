// What distances of a list give to the derivatives of positions, on the CPU.
//
// What a pair gives to j is added where j stands, so that nobody looks for the pair the other way round. Rows are taken in ROW_BLOCKS,
// each of which has sums of its own, in [n, 4] of `parts`: the result is the same whichever thread takes a block.
#pragma once
#include "kept_cpu.h"

struct KeptSlopes : KeptRows<KeptSlopes> {
    const real *distances, *slopes;
    real *parts, *sums;

    explicit KeptSlopes(const KeptSlopesArguments& a)
        : KeptRows(a, a.info), distances(a.distances), slopes(a.slopes), parts(a.parts), sums(a.sums) {}

    void run() {
        if constexpr (FLUSHED)
            floats.flush();
        each_chunk(next[0], ROW_BLOCKS, 1, [&](int block, int, int) {
            real* const part = parts + 4ll * n * block;
            memset(part, 0, sizeof(real) * 4 * n);
            for (int row = first_of(block); row < first_of(block + 1); ++row) {
                enter(row);
                serve(row, own_point(row), part);
            }
        });
    }
    int first_of(int block) const { return (int)((long long)m * block / ROW_BLOCKS); }
    // Adds what the pairs of a row give to it and to its neighbors. Distances below LEAST_DISTANCE, as of unused slots, give nothing.
    JFRNN_INLINE void serve(int row, const OwnPoint& own, real* part) const {
        const long long first = (long long)row * capacity;
        const int all = entries(row);
        Number sum[DIM] = {};
        // what neighbors of the next row have so far is on its way while those of this one are added to
        for (int k = 0; row + 1 < m && k < entries(row + 1); ++k)
            __builtin_prefetch(part + 4ll * idx[first + capacity + k], 1);
        walk(row, own, [&](const KeptSlots& some) {
            const int left = all - some.places, count = left < LANES ? left : LANES;
            Number distance{}, slope{}, along[4] = {}, ends[4];
            memcpy(&distance, distances + first + some.places, sizeof(real) * count);
            memcpy(&slope, slopes + first + some.places, sizeof(real) * count);
            const Math::flag apart = Math::ge(distance, Math::of(LEAST_DISTANCE));
            const Number reciprocal = real(1) / Math::select(apart, distance, Math::of(real(1)));
            for (int k = 0; k < DIM; ++k) {
                along[k] = Math::select(apart, slope * (some.verdict.vector[k] * reciprocal), Number{});
                sum[k] = sum[k] + along[k];
            }
            exchange(along[0], along[1], along[2], along[3], ends, __make_integer_seq<Lanes, int, LANES>{});
            for (int l = 0; l < count; ++l) {
                typedef real four __attribute__((vector_size(4 * sizeof(real))));
                four x, y;
                memcpy(&x, (const real*)&ends[l % 4] + l / 4 * 4, sizeof x);
                real* const to = part + 4ll * some.ids[l];
                memcpy(&y, to, sizeof y);
                y += x;
                memcpy(to, &y, sizeof y);
            }
        });
        for (int k = 0; k < DIM; ++k) {
            real total = 0;
            for (int l = 0; l < LANES; ++l)
                total += sum[k][l];
            part[4ll * row + k] -= total;
        }
    }
    void add() const {
        each_chunk(next[1], n, QUERY_CHUNK, [&](int from, int to, int) {
            for (int i = from; i < to; ++i)
                for (int k = 0; k < DIM; ++k) {
                    real total = 0;
                    for (int block = 0; block < ROW_BLOCKS; ++block)
                        total += parts[4ll * n * block + 4ll * i + k];
                    sums[(long long)DIM * i + k] = total;
                }
        });
    }
};
