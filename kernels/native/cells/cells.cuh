// How particles are sorted by cell on CUDA: seven or eight launches, in which every thread knows the same of the search.
#pragma once
#include "cells.h"
#include "excluded.h"
#include "scan.cuh"
#include "shares.h"
#include "tree.cuh"

struct SearchArguments {
    const real *positions, *queries, *cutoff;
    const int *excluded_starts, *excluded, *starts;
    const real *radii, *query_radii, *table_of_kinds;
    const int *kinds_of_sources, *kinds_of_queries;
    int *idx, *receivers, *count, *longest, *bits, *scratch;
    int n, m, own, table, capacity, closed, drop_self, of_queries, kinds;
};
struct Shared {
    Grid grid;
    int finite_queries;
    int behind[2];  // non-finite particles so far: sources, queries
    int tiles[2];   // tiles of the scan that have begun
    int crossing;   // blocks of queries that cross the box: the reach of one of them leaves it
    real unit;      // of the lattice on which all coordinates lie, or 0
    int scattered;  // blocks of queries that are scattered over rows of cells
    int longs;      // queries with longer cutoffs than cells are made for
    int long_ids[MOST_LONG], long_places[MOST_LONG];
};
struct alignas(4 * sizeof(real)) Place {
    real p[3];
    real id;
};  // id: the bits of an int
static_assert(sizeof(Shared) <= 4 * 64, "the head of a scratch");

// What a thread is: its number in its warp, the number of its warp in the block, the number of its block, and its number among all.
struct Thread {
    int lane, warp_in_block, block;
    long long thread, threads;
    JFRNN_MEMBER Thread()
        : lane(threadIdx.x & 31),
          warp_in_block(threadIdx.x >> 5),
          block(blockIdx.x),
          thread(thread_index()),
          threads((long long)gridDim.x * blockDim.x) {}
};

// The scratch of a search: `scratch_words` of `jfrnn.kernels.cells_cuda`, or `tree_cuda`, is the sum of its parts.
struct Scratch {
    Shared& shared;
    int* cursor;
    real* parts;
    Place* sorted;
    int* start;
    unsigned long long* tile_state;
    int *key, *slot, *order;
    int* query_start;
    unsigned long long* query_tile_state;
    int* query_order;
    int* crossing;                   // their numbers: nobody asks for keys and slots once particles are scattered
    int* crosses;                    // whether a block does
    int *scattered, *is_scattered;   // likewise, of blocks of eight queries or more: room enough for both beside the others
    unsigned int* leaves_near_long;  // marks of long queries (long.cuh), which stand there, too

    Node* nodes;  // of a tree, which takes the place of the cells

    JFRNN_MEMBER Scratch(int* scratch, int n, int m, int own, int table) : shared(*(Shared*)scratch), cursor(scratch + up(64)) {
        constexpr int WIDTH = DOUBLE ? 2 : 1;
        const int tile_count = (table + 1) / TILE + 1, longest = n > m ? n : m;
        parts = (real*)take(TREE ? 0 : PART * PARTS * WIDTH);
        sorted = (Place*)take(4 * WIDTH * (long long)n);
        if constexpr (TREE) {
            query_order = take(own ? 0 : m);
            nodes = (Node*)take(0);
            return;
        }
        start = take(table + 2);
        tile_state = (unsigned long long*)take(2 * tile_count);
        key = take(longest);
        slot = take(longest);
        order = take(n);
        query_start = own ? start : take(table + 2);
        query_tile_state = own ? tile_state : (unsigned long long*)take(2 * tile_count);
        query_order = own ? order : take(m);
        crossing = key;
        crosses = slot;
        scattered = key + m / 4;
        is_scattered = key + m / 2;
        leaves_near_long = (unsigned int*)slot;
    }
    JFRNN_FUNCTION long long up(long long words) { return (words + 15) & ~15ll; }
    JFRNN_MEMBER int* take(long long words) {
        int* here = cursor;
        cursor += up(words);
        return here;
    }
};

JFRNN_FUNCTION int id_of(real bits) { return DOUBLE ? (int)__double_as_longlong(bits) : __float_as_int(bits); }
JFRNN_FUNCTION real bits_as_real(int id) { return DOUBLE ? (real)__longlong_as_double(id) : (real)__int_as_float(id); }

struct Search : SearchArguments, Cells, Thread, Shares, Scratch {
    const real INF;
    JFRNN_MEMBER explicit Search(const SearchArguments& given)
        : SearchArguments(given),
          Cells(given.cutoff, false),
          Shares(given.m),
          Scratch(given.scratch, given.n, given.m, given.own, given.table),
          INF(DOUBLE ? (real)__longlong_as_double(0x7ff0000000000000ll) : (real)__int_as_float(0x7f800000)) {}

    // Are there queries with longer cutoffs than cells are made for? The number stands behind all others.
    JFRNN_MEMBER bool has_long_queries() const { return cutoff[LATTICE_END] > 0; }
    // Where the marks of the k-th of them begin.
    JFRNN_MEMBER long long words_of_long(int k) const { return k * ((n + 1023ll) / 1024); }

    // Reduces bounds, numbers of finite points and the bits that they have over all threads of a block, into those of its first thread.
    JFRNN_MEMBER void reduce_over_block(real* low, real* high, int& finite, int& lowest, int& highest) const {
        __shared__ real lows[3][BLOCK / 32], highs[3][BLOCK / 32];
        __shared__ int finites[BLOCK / 32];
        __shared__ int lowests[BLOCK / 32], highests[BLOCK / 32];
        lowest = __reduce_min_sync(ALL, lowest);
        highest = __reduce_max_sync(ALL, highest);
        for (int step = 16; step > 0; step /= 2) {
            finite += __shfl_down_sync(ALL, finite, step);
            for (int k = 0; k < DIM; ++k) {
                const real l = __shfl_down_sync(ALL, low[k], step), h = __shfl_down_sync(ALL, high[k], step);
                low[k] = l < low[k] ? l : low[k];
                high[k] = h > high[k] ? h : high[k];
            }
        }
        if (lane == 0) {
            finites[warp_in_block] = finite;
            lowests[warp_in_block] = lowest;
            highests[warp_in_block] = highest;
            for (int k = 0; k < DIM; ++k) {
                lows[k][warp_in_block] = low[k];
                highs[k][warp_in_block] = high[k];
            }
        }
        __syncthreads();
        if (threadIdx.x == 0)
            for (int w = 1; w < BLOCK / 32; ++w) {
                finite += finites[w];
                lowest = lowests[w] < lowest ? lowests[w] : lowest;
                highest = highests[w] > highest ? highests[w] : highest;
                for (int k = 0; k < DIM; ++k) {
                    low[k] = lows[k][w] < low[k] ? lows[k][w] : low[k];
                    high[k] = highs[k][w] > high[k] ? highs[k][w] : high[k];
                }
            }
    }

    // Finds the lowest bit and the largest exponent of coordinates.
    JFRNN_FUNCTION void look_at_bits(const real* row, int& lowest, int& highest) {
#pragma unroll
        for (int k = 0; k < DIM; ++k) {
            const int low_bit = lowest_bit(row[k]), exponent = Bits::exponent(row[k]);
            lowest = low_bit < lowest ? low_bit : lowest;
            highest = exponent > highest ? exponent : highest;
        }
    }

    // Finds the bounds of all sources with finite coordinates, per block.
    JFRNN_MEMBER void find_bounds() {
        real low[3], high[3];
        for (int k = 0; k < DIM; ++k) {
            low[k] = INF;
            high[k] = -INF;
        }
        int finite = 0, lowest = 1 << 20, highest = 0;
        for (long long i = thread; !own && i < m; i += threads)
            if (finite_point(queries + ROW * i))
                look_at_bits(queries + ROW * i, lowest, highest);
        for (long long i = thread; i < n; i += threads) {
            real p[3], at[3];
            point_of(positions + ROW * i, p);
            if (!finite_point(p))
                continue;
            ++finite;
            look_at_bits(positions + ROW * i, lowest, highest);
            for (int k = 0; k < DIM; ++k)
                at[k] = coordinate(k, p);
            widen(low, high, at, at);
        }
        reduce_over_block(low, high, finite, lowest, highest);
        if (threadIdx.x == 0) {
            real* part = parts + PART * block;
            for (int k = 0; k < DIM; ++k) {
                part[k] = low[k];
                part[3 + k] = high[k];
            }
            part[6] = bits_as_real(finite);
            part[7] = bits_as_real(lowest);
            part[8] = bits_as_real(highest);
        }
        if (thread == 0) {
            shared.behind[0] = shared.behind[1] = shared.tiles[0] = shared.tiles[1] = shared.crossing = shared.longs = 0;
            shared.scattered = 0;
            *bits = 0;
            if (longest)  // of a sum there is none
                *longest = 0;
        }
    }

    // Lays out a dense box without the sources of few parts that are farthest away along each axis, if there is one. These are sorted
    // into the border, where they are mere candidates. `part` is that of this thread.
    JFRNN_MEMBER void leave_out_few(Grid& grid, const real* part) {
        __shared__ real ends[2][3][PARTS], low[3], high[3];
        for (int k = 0; k < DIM; ++k) {
            ends[0][k][threadIdx.x] = part[k];
            ends[1][k][threadIdx.x] = -part[3 + k];
        }
        __syncthreads();
        for (int side = 0; side < 2; ++side)
            for (int k = 0; k < DIM; ++k) {
                const real mine = ends[side][k][threadIdx.x];
                int before = 0;
                for (int p = 0; p < PARTS; ++p) {
                    const real other = ends[side][k][p];
                    before += other < mine || (other == mine && p < (int)threadIdx.x);
                }
                if (before == LEFT_OUT)
                    (side ? high : low)[k] = side ? -mine : mine;
            }
        __syncthreads();
        bool there_is = true;
        for (int k = 0; k < DIM; ++k)
            there_is = there_is && low[k] <= high[k] && high[k] < INF && low[k] > -INF;
        if (threadIdx.x == 0 && there_is) {
            Grid smaller;
            lay_out(smaller, low, high, table);
            if (smaller.dense) {
                smaller.finite = grid.finite;
                smaller.more = 1;
                grid = smaller;
                if (block == 0)
                    shared.grid = grid;
            }
        }
        __syncthreads();
    }
    // Lets every block reduce those bounds to the grid, and clear its part of what the others count in.
    JFRNN_MEMBER void lay_out_grid() {
        __shared__ Grid grid;
        real low[3], high[3];
        const real* part = parts + PART * threadIdx.x;
        int finite = id_of(part[6]), lowest = id_of(part[7]), highest = id_of(part[8]);
        for (int k = 0; k < DIM; ++k) {
            low[k] = part[k];
            high[k] = part[3 + k];
        }
        reduce_over_block(low, high, finite, lowest, highest);
        if (threadIdx.x == 0) {
            if (finite == 0)
                for (int k = 0; k < DIM; ++k)
                    low[k] = high[k] = 0;
            lay_out(grid, low, high, table);
            grid.finite = finite;
            if (block == 0) {
                shared.grid = grid;
                shared.unit = lattice_unit(lowest, highest);
                if (finite < n)
                    atomicOr(bits, 2);
            }
        }
        __syncthreads();
        if (!grid.dense)
            leave_out_few(grid, part);
        const int cells = grid.cells, tiles = (cells + 1) / TILE + 1;  // of the table, what is in use
        for (long long c = thread; c < cells + 2; c += threads) {
            start[c] = 0;
            if (!own)
                query_start[c] = 0;
        }
        for (long long t = thread; t < tiles; t += threads) {
            tile_state[t] = 0;
            if (!own)
                query_tile_state[t] = 0;
        }
    }

    // Counts every particle in its cell: the sources first, then, in a second launch, the queries.
    JFRNN_MEMBER void count_cells() {
        const Grid grid = shared.grid;
        const int size = of_queries ? m : n;
        const real* points = of_queries ? queries : positions;
        int* counts = of_queries ? query_start : start;
        for (long long i = thread; i < size; i += threads) {
            real p[3];
            point_of(points + ROW * i, p);
            const bool finite = finite_point(p);
            const int cell = finite ? cell_key(grid, p, system_of(points + ROW * i)) : -1;
            key[i] = cell;
            slot[i] = finite ? atomicAdd(counts + cell, 1) : place_behind();
        }
    }

    // Returns a place behind all cells, each time another one: lanes of a warp ask for theirs at once.
    JFRNN_MEMBER int place_behind() const {
        const unsigned int asking = __activemask();
        const int first = __ffs((int)asking) - 1;
        int from = 0;
        if (lane == first) {
            from = atomicAdd(&shared.behind[of_queries], __popc(asking));
            if (of_queries)
                atomicOr(bits, 2);
        }
        return __shfl_sync(asking, from, first) + __popc(asking & ((1u << lane) - 1));
    }

    // Turns counts into first places; one more entry is the end of the last cell.
    JFRNN_MEMBER void scan_counts() {
        scan_in_place(of_queries ? query_start : start, shared.grid.cells + 1, of_queries ? query_tile_state : tile_state,
            &shared.tiles[of_queries]);
    }

    // Puts particles into their cells, in the order in which they came.
    JFRNN_MEMBER void scatter_ids() {
        const int size = of_queries ? m : n;
        const int* first = of_queries ? query_start : start;
        int* out = of_queries ? query_order : order;
        const int finite = size - shared.behind[of_queries];
        for (long long i = thread; i < size; i += threads) {
            out[(key[i] >= 0 ? first[key[i]] : finite) + slot[i]] = (int)i;
            if constexpr (PERIODIC)
                slot[i] = 0;  // of `crosses`, from now on
        }
        if (thread == 0 && (own || of_queries))
            shared.finite_queries = finite;
    }

    // Marks blocks whose queries are scattered over rows of cells, as they are on a surface: there groups are small, and one warp would
    // take as long for them as for many. `row` is that of a place, whichever of its cell stands there; places of a warp follow each
    // other.
    JFRNN_MEMBER void mark_scattered(int row, long long place) {
        const long long left = n - (place - lane);
        const unsigned int here = left < 32 ? (1u << (int)left) - 1 : ALL;
        const int before = __shfl_up_sync(here, row, 1), size = 1 << share_bits;
        const unsigned int begins = __ballot_sync(here, row != before);
        if (lane % size > 0)
            return;
        const int groups = 1 + __popc(begins >> lane & (size < 32 ? (1u << size) - 1 : ALL) & ~1u);
        const bool found = groups * PART_OF_BLOCK > size;
        is_scattered[place >> share_bits] = found;
        if (found)
            scattered[atomicAdd(&shared.scattered, 1)] = (int)(place >> share_bits);
    }
    // Puts positions into the order of cells, ranked by index within a cell: the same order in every run.
    JFRNN_MEMBER void gather_places() {
        const Grid grid = shared.grid;
        real crossing_low[3], crossing_high[3];  // beyond, a query reaches out of the box
        for (int a = 0; a < DIM; ++a) {
            const real reach = reach_along(a) * real(1.00001);  // rounding does no harm
            crossing_low[a] = is_periodic(a) ? reach : -INF;
            crossing_high[a] = is_periodic(a) ? real(0.999999) - reach : INF;
        }
        auto mark = [&](const real* p, long long place) {  // a query's block, if it crosses the box
            bool crosses_box = false;
#pragma unroll
            for (int a = 0; a < DIM; ++a) {
                const real x = coordinate(a, p);
                crosses_box = crosses_box || !(x > crossing_low[a] && x < crossing_high[a]);
            }
            // one lane for all of its warp that belong to the same block
            const int of_block = (int)(place >> share_bits);
            const unsigned int alike = __match_any_sync(__activemask(), crosses_box ? of_block : -1);
            if (crosses_box && (alike & ((1u << lane) - 1)) == 0 && crosses[of_block] == 0 &&
                atomicExch(crosses + of_block, 1) == 0)
                crossing[atomicAdd(&shared.crossing, 1)] = of_block;
        };
        for (long long place = thread; of_queries && place < shared.finite_queries; place += threads) {
            real p[3];
            point_of(queries + (long long)ROW * query_order[place], p);
            mark(p, place);
        }
        for (long long place = thread; !of_queries && place < n; place += threads) {
            const int i = order[place];
            Place mine;
            point_of(positions + (long long)ROW * i, mine.p);
            mine.id = bits_as_real(i);
            const unsigned int system = system_of(positions + (long long)ROW * i);
            int row = -1;
            const bool finite = finite_point(mine.p);
            const int cell = finite ? cell_key(grid, mine.p, system, row) : -1;  // cheaper than to fetch key[i] from anywhere
            if (own && may_part)
                mark_scattered(row, place);
            long long to = place;
            if (cell >= 0) {
                const int first = start[cell], end = start[cell + 1];
                int rank = 0;
                for (int other = first; other < end; ++other)
                    rank += order[other] < i;
                to = first + rank;
            }
            sorted[to] = mine;
            if (PERIODIC && own && cell >= 0)
                mark(mine.p, to);
        }
    }
};
