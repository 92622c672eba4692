"""Cell search on CUDA: six launches, no host synchronization, nothing allocated beside the scratch that the caller gives.

bounds   lowest and highest coordinate per block; clears what the others count in
count    every block reduces those bounds to the grid; every particle counts itself in its cell
scan     counts to first places, in one pass (Merrill & Garland 2016, decoupled look-back)
scatter  indices into their cells, in the order in which they came
gather   positions into cell order, ranked by index within a cell: the same order in every run
query    a warp of 32 lanes serves a few neighboring queries: 32 candidates at a time, hits get their slots by a vote
"""

import functools
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._native import CELLS, EXACT, snippet, table_cells

BLOCK = 256
QUERY_BLOCK = 64
_PARTS = 256  # blocks of `bounds`; one thread of a block reads one part
_TILE = 2048  # cells that a block of `scan` takes
_HEADER_WORDS = 64
_SWEEP_BLOCKS = 2048  # blocks of the kernels that walk over all particles

_LAYOUT = r"""
struct Shared {
    Grid grid;
    int finite_queries;
    int behind[2];  // non-finite particles so far: sources, queries
    int tiles[2];  // tiles of the scan that have begun
};
constexpr int WIDTH = DOUBLE ? 2 : 1;
struct alignas(4 * sizeof(real)) Place { real p[3]; real id; };  // id: the bits of an int
const int tile_count = (table + 1) / TILE + 1;
auto up = [](long long words) { return (words + 15) & ~15ll; };
int* cursor = scratch.data;
auto take = [&](long long words) { int* here = cursor; cursor += up(words); return here; };
Shared& shared = *(Shared*)take(64);
real* parts = (real*)take(8 * PARTS * WIDTH);
Place* sorted = (Place*)take(4 * WIDTH * (long long)n);
int* start = take(table + 2);
unsigned long long* tile_state = (unsigned long long*)take(2 * tile_count);
const int longest = n > m ? n : m;
int* key = take(longest);
int* slot = take(longest);
int* order = take(n);
int* query_start = own ? start : take(table + 2);
unsigned long long* query_tile_state = own ? tile_state : (unsigned long long*)take(2 * tile_count);
int* query_order = own ? order : take(m);
const int lane = threadIdx.x & 31, warp_in_block = threadIdx.x >> 5;
// Warp spreads more than 65535 blocks over y and z
const int block = (blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x;
const long long thread = (long long)block * blockDim.x + threadIdx.x;
const long long threads = (long long)gridDim.z * gridDim.y * gridDim.x * blockDim.x;
constexpr unsigned int ALL = 0xffffffffu;
auto id_of = [](real bits) -> int { return DOUBLE ? (int)__double_as_longlong(bits) : __float_as_int(bits); };
auto bits_as_real = [](int id) -> real { return DOUBLE ? (real)__longlong_as_double(id) : (real)__int_as_float(id); };
const real INF = DOUBLE ? (real)__longlong_as_double(0x7ff0000000000000ll) : (real)__int_as_float(0x7f800000);
const real NOWHERE = DOUBLE ? (real)__longlong_as_double(0x7ff8000000000000ll) : (real)__int_as_float(0x7fc00000);
auto finite_point = [&](const real* p) {
    bool finite = true;
    for (int k = 0; k < DIM; ++k)
        finite = finite && Bits::finite(p[k]);
    return finite;
};
"""


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool, table: int | None = None) -> int:
    """Return the int32 words of scratch that the kernels need; `width` is 1 for float32 and 2 for float64."""
    del dim
    table = table_cells(sources) if table is None else table
    tiles = 2 * ((table + 1) // _TILE + 1)
    longest = max(sources, queries)
    parts = [_HEADER_WORDS, 8 * _PARTS * width, 4 * width * sources, table + 2, tiles, longest, longest, sources]
    if not own:
        parts += [table + 2, tiles, queries]
    return sum((words + 15) // 16 * 16 for words in parts)


_BOUNDS = r"""
real low[3], high[3];
for (int k = 0; k < DIM; ++k) {
    low[k] = INF;
    high[k] = -INF;
}
int finite = 0;
for (long long i = thread; i < n; i += threads) {
    real p[3];
    for (int k = 0; k < DIM; ++k)
        p[k] = positions.data[DIM * i + k];
    if (!finite_point(p))
        continue;
    ++finite;
    for (int k = 0; k < DIM; ++k) {
        low[k] = p[k] < low[k] ? p[k] : low[k];
        high[k] = p[k] > high[k] ? p[k] : high[k];
    }
}
__shared__ real lows[3][8], highs[3][8];
__shared__ int finites[8];
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
    for (int k = 0; k < DIM; ++k) {
        lows[k][warp_in_block] = low[k];
        highs[k][warp_in_block] = high[k];
    }
}
__syncthreads();
if (threadIdx.x == 0) {
    real* part = parts + 8 * block;
    for (int w = 1; w < 8; ++w) {
        finite += finites[w];
        for (int k = 0; k < DIM; ++k) {
            low[k] = lows[k][w] < low[k] ? lows[k][w] : low[k];
            high[k] = highs[k][w] > high[k] ? highs[k][w] : high[k];
        }
    }
    for (int k = 0; k < DIM; ++k) {
        part[k] = low[k];
        part[3 + k] = high[k];
    }
    part[6] = bits_as_real(finite);
}
for (long long c = thread; c < table + 2; c += threads) {
    start[c] = 0;
    query_start[c] = 0;
}
for (long long t = thread; t < tile_count; t += threads) {
    tile_state[t] = 0;
    query_tile_state[t] = 0;
}
if (thread == 0) {
    shared.behind[0] = shared.behind[1] = shared.tiles[0] = shared.tiles[1] = 0;
    info.data[0] = info.data[1] = 0;
}
"""

_COUNT = r"""
__shared__ real lows[3][8], highs[3][8];
__shared__ int finites[8];
__shared__ Grid grid;
{
    real low[3], high[3];
    const real* part = parts + 8 * threadIdx.x;
    int finite = id_of(part[6]);
    for (int k = 0; k < DIM; ++k) {
        low[k] = part[k];
        high[k] = part[3 + k];
    }
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
        for (int k = 0; k < DIM; ++k) {
            lows[k][warp_in_block] = low[k];
            highs[k][warp_in_block] = high[k];
        }
    }
    __syncthreads();
    if (threadIdx.x == 0) {
        for (int w = 1; w < 8; ++w) {
            finite += finites[w];
            for (int k = 0; k < DIM; ++k) {
                low[k] = lows[k][w] < low[k] ? lows[k][w] : low[k];
                high[k] = highs[k][w] > high[k] ? highs[k][w] : high[k];
            }
        }
        if (finite == 0)
            for (int k = 0; k < DIM; ++k)
                low[k] = high[k] = 0;
        lay_out(grid, low, high, table);
        grid.finite = finite;
        if (block == 0) {
            shared.grid = grid;
            if (finite < n)
                atomicOr(&info.data[1], 2);
        }
    }
    __syncthreads();
}
// the sources are counted first, then, in a second launch, the queries
const int size = of_queries ? m : n;
const real* points = of_queries ? queries.data : positions.data;
int* counts = of_queries ? query_start : start;
for (long long i = thread; i < size; i += threads) {
    real p[3];
    for (int k = 0; k < DIM; ++k)
        p[k] = points[DIM * i + k];
    const bool finite = finite_point(p);
    const int cell = finite ? cell_key(grid, p) : -1;
    key[i] = cell;
    slot[i] = atomicAdd(finite ? counts + cell : &shared.behind[of_queries], 1);
    if (!finite && of_queries)
        atomicOr(&info.data[1], 2);
}
"""

_SCAN = r"""
__shared__ int sums[8];
__shared__ int tile_shared, before_shared;
unsigned long long volatile* state = of_queries ? query_tile_state : tile_state;
int* counts = of_queries ? query_start : start;
if (threadIdx.x == 0)
    tile_shared = atomicAdd(&shared.tiles[of_queries], 1);
__syncthreads();
const int tile = tile_shared, cells = shared.grid.cells + 1;  // one more entry: the end of the last cell
if ((long long)tile * TILE < cells) {
    constexpr int EACH = TILE / 256;
    const long long first = (long long)tile * TILE + threadIdx.x * EACH;
    int value[EACH], total = 0;
    for (int e = 0; e < EACH; ++e) {
        value[e] = total;
        total += first + e < cells ? counts[first + e] : 0;
    }
    int inclusive = total;
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(ALL, inclusive, step);
        inclusive += lane >= step ? other : 0;
    }
    if (lane == 31)
        sums[warp_in_block] = inclusive;
    __syncthreads();
    int before = inclusive - total, tile_total = 0;
    for (int w = 0; w < 8; ++w) {
        before += w < warp_in_block ? sums[w] : 0;
        tile_total += sums[w];
    }
    if (threadIdx.x == 0)  // 1: the sum of this tile, 2: of all tiles up to it; one word, so that both arrive together
        state[tile] = ((tile == 0 ? 2ull : 1ull) << 32) | (unsigned int)tile_total;
    if (warp_in_block == 0) {
        int earlier = 0;
        for (int back = tile - 1; back >= 0; back -= 32) {
            const int seen = back - lane;
            unsigned long long word = seen >= 0 ? 0 : 2ull << 32;
            while (__any_sync(ALL, (word >> 32) == 0))
                word = (word >> 32) == 0 ? state[seen] : word;
            const unsigned int full = __ballot_sync(ALL, (word >> 32) == 2);
            const int until = full ? __ffs(full) - 1 : 31;
            int part = lane <= until ? (int)(word & 0xffffffffull) : 0;
            for (int step = 16; step > 0; step /= 2)
                part += __shfl_down_sync(ALL, part, step);
            earlier += __shfl_sync(ALL, part, 0);
            if (full)
                break;
        }
        if (lane == 0) {
            before_shared = earlier;
            if (tile > 0)
                state[tile] = (2ull << 32) | (unsigned int)(earlier + tile_total);
        }
    }
    __syncthreads();
    before += before_shared;
    for (int e = 0; e < EACH; ++e)
        if (first + e < cells)
            counts[first + e] = before + value[e];
}
"""

_SCATTER = r"""
const int size = of_queries ? m : n;
const int* first = of_queries ? query_start : start;
int* out = of_queries ? query_order : order;
const int finite = size - shared.behind[of_queries];
for (long long i = thread; i < size; i += threads)
    out[(key[i] >= 0 ? first[key[i]] : finite) + slot[i]] = (int)i;
if (thread == 0 && (own || of_queries))
    shared.finite_queries = finite;
"""

_GATHER = r"""
for (long long place = thread; place < n; place += threads) {
    const int i = order[place], cell = key[i];
    Place mine;
    for (int k = 0; k < DIM; ++k)
        mine.p[k] = positions.data[(long long)DIM * i + k];
    mine.id = bits_as_real(i);
    long long to = place;
    if (cell >= 0) {
        const int first = start[cell], end = start[cell + 1];
        int rank = 0;
        for (int other = first; other < end; ++other)
            rank += order[other] < i;
        to = first + rank;
    }
    sorted[to] = mine;
}
"""

_QUERY = r"""
constexpr int KEPT = 720, SLOTS = 184, EACH = DOUBLE ? 2 : 1;  // bytes of a neighbor
struct Warp {  // what a warp shares
    Place candidates[64];  // a ring of candidates within reach of the group's box
    int ids[LIST ? KEPT : 1];  // of all of them since the rows were last written
    // of each query, as numbers of candidates, in float32 modulo 256; an odd stride in words
    unsigned char neighbors[LIST ? 32 : 1][EACH * (SLOTS + 4 / EACH)];
    int shifts[32];  // per row of cells: what leads from a candidate's number to its place
};
__shared__ Warp warps[QUERY_BLOCK / 32];
Warp& warp = warps[warp_in_block];
const Grid grid = shared.grid;
const int finite_queries = shared.finite_queries;
const long long begin = (thread >> 5) * 32;
int place = begin < m ? (int)begin : m;
const int stop = m - place < 32 ? m : place + 32;
const unsigned int lanes_below = (1u << lane) - 1, lanes_until = (2u << lane) - 1;
const real square_radius = step_radius * step_radius, band = 8 * step_eps * square_radius;
const bool drops_self = own && drop_self;
auto load = [&](const Place* from) -> Place {
    if constexpr (DOUBLE) {
        const double2 a = __ldg((const double2*)from), b = __ldg((const double2*)from + 1);
        return Place{{(real)a.x, (real)a.y, (real)b.x}, (real)b.y};
    } else {
        const float4 a = __ldg((const float4*)from);
        return Place{{(real)a.x, (real)a.y, (real)a.z}, (real)a.w};
    }
};
auto load_query = [&](int at) -> Place {
    if (own)
        return load(sorted + at);
    Place q;
    const int i = query_order[at];
#pragma unroll
    for (int k = 0; k < DIM; ++k)
        q.p[k] = queries.data[(long long)DIM * i + k];
    q.id = bits_as_real(i);
    return q;
};
// |b - a|^2 - r^2 in working precision, fused or not: off by less than 5 eps r^2 wherever it is near zero (see jfrnn/_exact.py)
auto excess = [&](const real* a, const real* b) -> real {
    real sum = -square_radius;
#pragma unroll
    for (int k = 0; k < DIM; ++k) {
        real d = b[k] - a[k];
        if constexpr (SCALED)
            d *= step_scale;
        sum += d * d;
    }
    return sum;
};
auto magnitude = [](real x) -> real { return DOUBLE ? (real)fabs(x) : (real)fabsf(x); };
auto square_root = [](float x) {
    float y;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
};

while (place < stop) {
    // one query per lane; those that share a row of cells with the first form a group
    Place mine{{0, 0, 0}, 0};
    bool beside = place + lane < stop && place + lane < finite_queries;
    if (beside)
        mine = load_query(place + lane);
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
        const whole here = axis_cell(grid, a, mine.p[a]), there = __shfl_sync(ALL, here, 0);
        beside = beside && (ORDER != 0 || (a == 0 ? grid.dense || (here >= there && here - there < 2 * REACH_X) : here == there));
    }
    const int group = __ffs(~__ballot_sync(ALL, beside)) == 0 ? 32 : __ffs(~__ballot_sync(ALL, beside)) - 1;
    if (group == 0) {  // non-finite: an empty row
        const int id = id_of(load_query(place).id);
        if (LIST)
            for (int s = lane; s < capacity; s += 32)
                idx.data[(long long)id * capacity + s] = n;
        if (lane == 0)
            count.data[id] = 0;
        ++place;
        continue;
    }
    const int my_id = id_of(mine.id);
    real q[3];
    // lane 2a holds the group's lowest coordinate along axis a and the lowest cell in reach, lane 2a + 1 the highest
    real bound = 0, low[3] = {0, 0, 0}, high[3] = {0, 0, 0};
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
        q[a] = lane < group ? mine.p[a] : NOWHERE;
        low[a] = lane < group ? mine.p[a] : INF;
        high[a] = lane < group ? mine.p[a] : -INF;
        if constexpr (DOUBLE) {
#pragma unroll
            for (int step = 1; step < 32; step *= 2) {
                const real l = __shfl_xor_sync(ALL, low[a], step), h = __shfl_xor_sync(ALL, high[a], step);
                low[a] = l < low[a] ? l : low[a];
                high[a] = h > high[a] ? h : high[a];
            }
        } else {  // as integers of the same order, which one instruction reduces
            auto flip = [](int b) { return b ^ (b >> 31 & 0x7fffffff); };
            low[a] = __int_as_float(flip(__reduce_min_sync(ALL, flip(__float_as_int(low[a])))));
            high[a] = __int_as_float(flip(__reduce_max_sync(ALL, flip(__float_as_int(high[a])))));
        }
        bound = lane == 2 * a ? low[a] : lane == 2 * a + 1 ? high[a] : bound;
    }
    whole reached;
    {
        const real x = cell_of(lane / 2, lane % 2 ? bound + radius : bound - radius);
        if (grid.dense) {
            const int extent = lane < 2 ? grid.extent[0] : lane < 4 || DIM == 2 ? grid.extent[1] : grid.extent[2];
            const real from_low = x - (lane < 2 ? grid.low[0] : lane < 4 || DIM == 2 ? grid.low[1] : grid.low[2]);
            reached = from_low < 0 ? -1 : from_low < real(extent) ? (whole)from_low : (whole)extent;
            reached = lane % 2 ? (reached < extent ? reached : extent - 1) : (reached < 0 ? 0 : reached);
        } else
            reached = cell_number(x);
    }
    whole first[3] = {0, 0, 0}, last[3] = {0, 0, 0};
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
        first[a] = __shfl_sync(ALL, reached, 2 * a);
        last[a] = __shfl_sync(ALL, reached, 2 * a + 1);
    }
    const int length = (int)(last[0] - first[0]) + 1, wide = (int)(last[1] - first[1]) + 1;
    const int across = ORDER != 0 ? length : 1;  // on a curve, cells along x are no run
    const int rows = length > 0 && wide > 0 && last[2] >= first[2] ? across * wide * (int)(last[2] - first[2] + 1) : 0;
    // `kept` candidates so far, of which `tested` have met the queries; `found` neighbors stand in the rows already
    int found = 0, kept = 0, tested = 0;
    bool meets_itself = drops_self;  // the first candidates are the queries themselves: number = lane
    if (own) {
        if (lane < group) {
            warp.candidates[lane] = mine;
            if constexpr (LIST)
                warp.ids[lane] = my_id;
        }
        kept = group;
    }
    // shared memory as the hardware numbers it: a store and a step of its address under one predicate
    const unsigned int list_begin = (unsigned int)__cvta_generic_to_shared(warp.neighbors[LIST ? lane : 0]);
    unsigned int list_end = list_begin, marks = 0xffffffff;  // one byte each: neighbors among the first 256, 512, 768 candidates
    auto listed = [&] { return (int)(list_end - list_begin) / (LIST ? EACH : 1); };
    auto add = [&](real over, real limit, int number) {
        if constexpr (!LIST)
            list_end += over < limit;
        else if constexpr (DOUBLE)
            asm volatile("{.reg .pred p; setp.lt.f64 p, %2, %3; @p st.shared.u16 [%0], %1; @p add.u32 %0, %0, 2;}"
                         : "+r"(list_end) : "h"((short)number), "d"((double)over), "d"((double)limit) : "memory");
        else
            asm volatile("{.reg .pred p; setp.lt.f32 p, %2, %3; @p st.shared.u8 [%0], %1; @p add.u32 %0, %0, 1;}"
                         : "+r"(list_end) : "r"(number), "f"((float)over), "f"((float)limit) : "memory");
    };
    auto write_rows = [&](bool finished) {
        __syncwarp();
        const int added = listed();
        if constexpr (LIST) {
#pragma unroll 4
            for (int k = 0; k < group; ++k) {
                const int id = __shfl_sync(ALL, my_id, k), before = __shfl_sync(ALL, found, k), size = __shfl_sync(ALL, added, k);
                const unsigned int steps = __shfl_sync(ALL, marks, k);
                int* out = idx.data + (long long)id * capacity + before;
                const int room = capacity - before, writes = finished || room < size ? room : size;
                const unsigned int list = (unsigned int)__cvta_generic_to_shared(warp.neighbors[k]);
                auto neighbor = [&](int s, unsigned int number) {
                    number += 256 * ((s >= (steps & 255)) + (s >= (steps >> 8 & 255)) + (s >= (steps >> 16 & 255)));
                    return s < size ? warp.ids[s < size ? number : 0] : n;
                };
                if (!DOUBLE && ((capacity | before | writes) & 3) == 0) {  // four slots per lane
                    for (int s = 4 * lane; s < writes; s += 128) {
                        unsigned int four = 0;
                        if (s < size)  // beyond the row's neighbors there may be no shared memory
                            asm volatile("ld.shared.u32 %0, [%1];" : "=r"(four) : "r"(list + s) : "memory");
                        *(int4*)(out + s) = make_int4(neighbor(s, four & 255), neighbor(s + 1, four >> 8 & 255),
                                                      neighbor(s + 2, four >> 16 & 255), neighbor(s + 3, four >> 24));
                    }
                } else
                    for (int s = lane; s < writes; s += 32) {
                        unsigned short number = 0;
                        if (DOUBLE && s < size)
                            asm volatile("ld.shared.u16 %0, [%1];" : "=h"(number) : "r"(list + 2 * s) : "memory");
                        else if (s < size)
                            asm volatile("ld.shared.u8 %0, [%1];" : "=h"(number) : "r"(list + s) : "memory");
                        out[s] = DOUBLE ? (s < size ? warp.ids[number] : n) : neighbor(s, number);
                    }
            }
        }
        found += added;
        list_end = list_begin;
        marks = 0xffffffff;
        __syncwarp();
    };
    for (int base = 0; base < rows; base += 32) {
        // each lane finds one row of cells
        int from = 0, size = 0;
        const int row = base + lane, line = row / across, level = line / wide;
        const whole y = first[1] + (line - level * wide), z = first[2] + level;
        if (grid.dense) {
            if (row < rows) {
                whole x0 = first[0], x1 = last[0];
                if (TRIM && ORDER == 0) {  // only the chord of the sphere, widened by more than rounding can take from it
                    float free = 1.0f;
#pragma unroll
                    for (int a = 1; a < DIM; ++a) {
                        const real edge = radius * (real(1) / REACH);
                        const real below = (grid.low[a] + real(a == 1 ? y : z)) * edge, above = below + edge;
                        const real gap = below - high[a] > low[a] - above ? below - high[a] : low[a] - above;
                        const real safe = (gap - 16 * step_eps * (magnitude(below) + edge)) * (real(1) / radius);
                        const float part = safe > 0 ? (float)safe : 0.0f;
                        free -= part * part;
                    }
                    const real reach = radius * real(square_root(fmaxf(free, 0.0f) + 1e-5f) * 1.000001f);
                    const whole a = axis_cell(grid, 0, low[0] - reach), b = axis_cell(grid, 0, high[0] + reach);
                    x0 = a > x0 ? a : x0;
                    x1 = free < -1e-5f ? x0 - 1 : b < x1 ? b : x1;
                }
                if (ORDER != 0) {
                    const int s = curve(grid, (unsigned int)(x0 + row % across), (unsigned int)y, (unsigned int)z);
                    from = start[s];
                    size = start[s + 1] - from;
                } else if (x1 >= x0) {
                    const int s = row_start(grid, y, z);
                    from = start[s + x0];
                    size = start[s + x1 + 1] - from;
                }
            }
        } else {
            const int begins = ring(row_start(grid, y, z) + ring(first[0], grid.cells), grid.cells);
            int front = 0, back = 0;  // entries that an earlier row has too
            auto overlap = [&](int other) {
                const int behind = begins - other < 0 ? begins - other + grid.cells : begins - other, ahead = grid.cells - behind;
                if (behind < length)
                    front = length - behind > front ? length - behind : front;
                else if (ahead < length)
                    back = length - ahead > back ? length - ahead : back;
            };
            for (int r = 0; r < base; ++r)
                overlap(ring(row_start(grid, first[1] + r % wide, first[2] + r / wide) + ring(first[0], grid.cells), grid.cells));
            const int here = rows - base < 32 ? rows - base : 32;
#pragma unroll 1
            for (int r = 0; r < here; ++r) {
                const int other = __shfl_sync(ALL, begins, r);
                if (r < lane)
                    overlap(other);
            }
            const int entries = length - front - back;
            if (row < rows && entries > 0) {
                const int s = begins + front >= grid.cells ? begins + front - grid.cells : begins + front, e = s + entries;
                from = start[s];
                size = e <= grid.cells ? start[e] - from : grid.finite - from + start[e - grid.cells];
            }
        }
        int end = size;
#pragma unroll
        for (int step = 1; step < 32; step *= 2) {
            const int other = __shfl_up_sync(ALL, end, step);
            end += lane >= step ? other : 0;
        }
        const int total = __shfl_sync(ALL, end, 31);
        const unsigned int occupied = __ballot_sync(ALL, size > 0);
        __syncwarp();
        if (size > 0)
            warp.shifts[__popc(occupied & lanes_below)] = from - (end - size);
        __syncwarp();

        int rows_done = 0;
        const bool last_rows = base + 32 >= rows;
        int next_at = -1;
        Place next{{0, 0, 0}, 0};
        auto fetch = [&](int c0) {
            const int ends_at = size > 0 ? end - c0 : 0;  // rows that end within these 32 candidates, one bit each
            const unsigned int ends = __reduce_or_sync(ALL, ends_at > 0 && ends_at < 32 ? 1u << ends_at : 0);
            const int r = rows_done + __popc(ends & lanes_until);
            rows_done += __popc(ends) + __any_sync(ALL, ends_at == 32);
            next_at = -1;
            if (c0 + lane < total) {
                next_at = c0 + lane + warp.shifts[r];
                if (!grid.dense && next_at >= grid.finite)
                    next_at -= grid.finite;  // the ring of cells closes
                next = load(sorted + next_at);
            }
        };
        if (total > 0)
            fetch(0);
        bool draining = false;  // the rows are full: test what is kept, write them, go on
        int c0 = 0;
#pragma unroll 1
        while (c0 < total || draining || (last_rows && tested < kept)) {
            const int at = next_at;
            const Place candidate = next;
            bool near = !draining && c0 < total && at >= 0;
            if (!draining) {
                c0 += 32;
                if (c0 < total)
                    fetch(c0);
            }
            real square = 0;
#pragma unroll
            for (int a = 0; a < DIM; ++a) {
                const real x = candidate.p[a], under = low[a] - x, over = x - high[a];
                real gap = under > over ? under : over;
                gap = gap > 0 ? gap : 0;
                if constexpr (SCALED)
                    gap *= step_scale;
                square += gap * gap;
            }
            near = near && square <= square_radius + band && !(own && at >= place && at < place + group);
            const unsigned int all_near = __ballot_sync(ALL, near);
            if (near) {
                const int number = kept + __popc(all_near & lanes_below);
                warp.candidates[number % 64] = candidate;
                if constexpr (LIST)
                    warp.ids[number] = id_of(candidate.id);
            }
            kept += __popc(all_near);
            const bool rest = draining || (last_rows && c0 >= total);
            if (kept - tested < 32 && !(rest && tested < kept)) {
                if (draining) {
                    write_rows(false);
                    kept = tested = 0;
                    draining = false;
                }
                continue;
            }
            if (kept - tested + lane < 32)
                warp.candidates[(kept + lane) % 64] = Place{{NOWHERE, NOWHERE, NOWHERE}, 0};
            __syncwarp();
            const Place* block = warp.candidates + tested % 64;
            real tightest = INF;
            auto allowed = [&](const Place& other) { return !LATER || id_of(other.id) >= my_id + drop_self; };
            auto test = [&](int j) -> real {
                const Place other = block[j];
                const real over = excess(q, other.p);
                if constexpr (EXACTLY)
                    tightest = DOUBLE ? (real)fmin(tightest, magnitude(over)) : (real)fminf(tightest, magnitude(over));
                return allowed(other) ? over : INF;
            };
            if (meets_itself) {
#pragma unroll 8
                for (int j = 0; j < 32; ++j) {
                    const real over = test(j);
                    add(j == lane && lane < group ? INF : over, -band, j);
                }
                meets_itself = false;
            } else {
#pragma unroll
                for (int j = 0; j < 32; j += AHEAD) {  // loads first: the hardware does not move them across stores either
                    real over[AHEAD];
#pragma unroll
                    for (int e = 0; e < AHEAD; ++e)
                        over[e] = test(j + e);
#pragma unroll
                    for (int e = 0; e < AHEAD; ++e)
                        add(over[e], -band, tested + j + e);
                }
            }
            if (EXACTLY && __any_sync(ALL, tightest <= band)) {
                unsigned int open = 0;
#pragma unroll 4
                for (int j = 0; j < 32; ++j) {
                    const Place other = block[j];
                    open |= magnitude(excess(q, other.p)) <= band && allowed(other) ? 1u << j : 0;
                }
                for (; open; open &= open - 1) {
                    const int j = __ffs(open) - 1;
                    add(exact_pair(q, block[j].p) ? -1 : 1, 0, tested + j);
                }
            }
            tested += 32;
            if (LIST && tested % 256 == 0)
                marks ^= (255 ^ listed()) << (tested / 256 - 1) * 8;
            __syncwarp();
            // one more block and what is kept besides must still fit
            if (LIST && (kept > KEPT - 64 || __any_sync(ALL, listed() > SLOTS - 64)))
                draining = c0 < total || !last_rows || tested < kept;
        }
        __syncwarp();
    }
    write_rows(true);
    if (lane < group)
        count.data[my_id] = found;
    const int longest_row = __reduce_max_sync(ALL, lane < group ? found : 0);
    if (lane == 0 && longest_row > *(volatile int*)&info.data[0]) {
        atomicMax(&info.data[0], longest_row);
        if (LIST && longest_row > capacity)
            atomicOr(&info.data[1], 1);
    }
    place += group;
}
"""


class Launch(NamedTuple):
    """A kernel, its threads in all and per block, and its last argument: whether it works on the queries."""

    kernel: wp.Kernel
    threads: int
    block: int
    of_queries: bool


class Kernels(NamedTuple):
    """The kernels of a variant, all with the same arguments."""

    bounds: wp.Kernel
    count: wp.Kernel
    scan: wp.Kernel
    scatter: wp.Kernel
    gather: wp.Kernel
    query: wp.Kernel

    def launches(self, n: int, m: int, own: bool, table: int | None = None) -> list[Launch]:
        """Return what is launched, in order, for n sources and m queries."""
        tiles = ((table_cells(n) if table is None else table) + 1) // _TILE + 1
        launches = [Launch(self.bounds, _PARTS * BLOCK, BLOCK, False)]
        for of_queries in (False,) if own else (False, True):
            size = m if of_queries else n
            sweep = min(-(-size // BLOCK), _SWEEP_BLOCKS) * BLOCK
            launches += [
                Launch(self.count, sweep, BLOCK, of_queries),
                Launch(self.scan, tiles * BLOCK, BLOCK, of_queries),
                Launch(self.scatter, sweep, BLOCK, of_queries),
            ]
            if not of_queries:
                launches.append(Launch(self.gather, sweep, BLOCK, False))
        return [*launches, Launch(self.query, -(-m // QUERY_BLOCK) * QUERY_BLOCK, QUERY_BLOCK, False)]

    def load(self, device: wp.DeviceLike) -> None:
        """Compile and load what a launch needs: nothing is left to do while a CUDA graph is recorded."""
        wp.load_module(self.bounds.module, device=device, block_dim=BLOCK)
        wp.load_module(self.query.module, device=device, block_dim=QUERY_BLOCK)


@functools.cache
def cell_kernels(
    dim: int,
    double: bool,
    scaled: bool,
    lists: bool,
    later: bool = False,
    exact: bool = True,
    reach: int = 1,
    reach_x: int = 4,
    trim: bool = True,
    blocks: int | None = None,
    ahead: int = 8,
    order: int = 0,
) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts, half lists or whole.

    The rest is there to be measured. exact=False lets the working precision decide alone (`|d|^2 < r^2 (1 - 8 eps)`); `reach` is
    the number of cell edges in a cutoff along y and z, `reach_x` along x; `trim` cuts rows of cells to the chord of the sphere;
    `blocks` per multiprocessor bound the registers; `ahead` is the number of candidates that are loaded before they are tested;
    `order` of the cells: 0 row-major, 1 Morton, 2 Hilbert.
    """
    blocks = blocks or (10 if lists else 12)  # registers against occupancy, measured on an H200
    kind = f"{dim}d_{'f64' if double else 'f32'}_r{reach}x{reach_x}{('', '_morton', '_hilbert')[order]}"
    variant = f"{kind}{'_scaled' * scaled}{'_list' * lists}{'_later' * later}{'' if exact else '_inexact'}{'_whole' * (not trim)}"
    variant += f"_b{blocks}_a{ahead}"
    grid = {"REACH": reach, "REACH_X": reach_x, "ORDER": order, "PARTS": _PARTS, "TILE": _TILE}
    query = {"SCALED": scaled, "LIST": lists, "LATER": later, "EXACTLY": exact, "TRIM": trim, "AHEAD": ahead}
    query |= {"QUERY_BLOCK": QUERY_BLOCK, **grid}
    return Kernels(
        _kernel(f"bounds_{kind}", kind, dim, double, BLOCK, 1, grid, _BOUNDS),
        _kernel(f"count_{kind}", kind, dim, double, BLOCK, 1, grid, _COUNT),
        _kernel(f"scan_{kind}", kind, dim, double, BLOCK, 1, grid, _SCAN),
        _kernel(f"scatter_{kind}", kind, dim, double, BLOCK, 1, grid, _SCATTER),
        _kernel(f"gather_{kind}", kind, dim, double, BLOCK, 1, grid, _GATHER),
        _kernel(f"query_{variant}", variant, dim, double, QUERY_BLOCK, blocks, query, EXACT, _QUERY),
    )


_made: dict[str, wp.Kernel] = {}


def _kernel(
    name: str, module_name: str, dim: int, double: bool, block: int, blocks: int, constants: dict[str, int], *pieces: str
) -> wp.Kernel:
    if name in _made:
        return _made[name]
    scalar = wp.float64 if double else wp.float32
    points = wp.array2d(dtype=scalar)
    reals, ints, rows = wp.array(dtype=scalar), wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)

    def native(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, of_queries: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"{name}_native"
    function = wp.func_native(snippet("double" if double else "float", dim, CELLS, _LAYOUT, *pieces, **constants))(native)

    def kernel(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, of_queries: int,
    ):  # fmt: skip
        function(
            positions, queries, cutoff, idx, count, info, scratch, n, m, own, table, capacity, closed, drop_self, of_queries
        )  # fmt: skip

    module = wp.get_module(f"jfrnn.kernels.cells_cuda.{module_name}")
    wp.set_module_options({"enable_backward": False, "max_unroll": 1}, module)
    _made[name] = wp.kernel(kernel, name=name, module=module, grid_stride=False, launch_bounds=(block, blocks))
    return _made[name]
