"""Cell search on CUDA: six launches, no host synchronization, nothing allocated beside the scratch that the caller gives.

bounds   lowest and highest coordinate per block; clears what the others count in
count    every block reduces those bounds to the grid; every particle counts itself in its cell
scan     counts to first places, in one pass (Merrill & Garland 2016, decoupled look-back)
scatter  indices into their cells, in the order in which they came
gather   positions into cell order, ranked by index within a cell: the same order in every run
query    a warp serves up to 32 neighboring queries, one per lane: candidates within reach of their box meet all of them, 32 in a
         block; a neighbor is a bit, until the rows are written
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


# Bounds and numbers of finite points of all threads of a block, into those of its first thread.
_REDUCE = r"""
auto reduce_over_block = [&](real* low, real* high, int& finite) {
    __shared__ real lows[3][BLOCK / 32], highs[3][BLOCK / 32];
    __shared__ int finites[BLOCK / 32];
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
    if (threadIdx.x == 0)
        for (int w = 1; w < BLOCK / 32; ++w) {
            finite += finites[w];
            for (int k = 0; k < DIM; ++k) {
                low[k] = lows[k][w] < low[k] ? lows[k][w] : low[k];
                high[k] = highs[k][w] > high[k] ? highs[k][w] : high[k];
            }
        }
};
"""

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
    widen(low, high, p, p);
}
reduce_over_block(low, high, finite);
if (threadIdx.x == 0) {
    real* part = parts + 8 * block;
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
__shared__ Grid grid;
{
    real low[3], high[3];
    const real* part = parts + 8 * threadIdx.x;
    int finite = id_of(part[6]);
    for (int k = 0; k < DIM; ++k) {
        low[k] = part[k];
        high[k] = part[3 + k];
    }
    reduce_over_block(low, high, finite);
    if (threadIdx.x == 0) {
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
    constexpr int EACH = TILE / BLOCK;
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
const Grid grid = shared.grid;
for (long long place = thread; place < n; place += threads) {
    const int i = order[place];
    Place mine;
    for (int k = 0; k < DIM; ++k)
        mine.p[k] = positions.data[(long long)DIM * i + k];
    mine.id = bits_as_real(i);
    const int cell = finite_point(mine.p) ? cell_key(grid, mine.p) : -1;  // cheaper than to fetch key[i] from anywhere
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
constexpr int BLOCKS = 24;  // of candidates, whose neighbors are written together
constexpr int CHUNK = 32;  // neighbors of a query that are written at once
struct alignas(16) Box { real bound[8]; };  // lowest and highest in turn, per axis
struct alignas(16) Warp {  // what a warp shares
    real candidates[DIM][64];  // coordinates of a ring of candidates within reach of the group's box
    int candidate_ids[LATER ? 64 : 1];
    int ids[LIST ? 32 * (BLOCKS + 1) : 1];  // of all of them since the rows were last written, per block from the last to the first
    unsigned int hits[LIST ? BLOCKS : 1][32];  // per block of candidates and query: one bit per candidate, the first one leads
    int lists[LIST ? 32 : 1][CHUNK + 1];  // of each query: what is written next; an odd stride, for the banks
    Box box;  // of the group
    int shifts[32];  // per row of cells: what leads from a candidate's number to its place
};
__shared__ Warp warps[QUERY_BLOCK / 32];
Warp& warp = warps[warp_in_block];
const Grid grid = shared.grid;
const int finite_queries = shared.finite_queries;
const long long begin = (thread >> 5) * 32;
int place = begin < m ? (int)begin : m;
const int stop = m - place < 32 ? m : place + 32;
const unsigned int lanes_below = (1u << lane) - 1;
const real square_radius = step_radius * step_radius, band = 8 * step_eps * square_radius;
const real sure_square = square_radius - band;
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
// |b - a|^2 - r^2 + band in working precision, fused or not: off by less than 5 eps r^2 where it is near [0, 2 band], see
// jfrnn/_exact.py. Negative: surely closer than the cutoff. Its upper word has the sign and, if not negative, the order of all.
auto excess = [&](const real* a, const real* b) -> real {
    real sum = -sure_square;
#pragma unroll
    for (int k = 0; k < DIM; ++k) {
        real d = b[k] - a[k];
        if constexpr (SCALED)
            d *= step_scale;
        sum += d * d;
    }
    return sum;
};
auto upper_word = [](real x) -> unsigned int { return DOUBLE ? __double2hiint(x) : __float_as_uint((float)x); };
auto magnitude = [](real x) -> real { return DOUBLE ? (real)fabs(x) : (real)fabsf(x); };
auto larger = [](real a, real b) -> real {
    if constexpr (DOUBLE)
        return a > b ? a : b;
    else
        return fmaxf(a, b);
};
auto shared_address = [](const void* p) { return (unsigned int)__cvta_generic_to_shared(p); };
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
    // lane 2a holds the group's lowest coordinate along axis a and the lowest cell in reach, lane 2a + 1 the highest
    real bound = 0, low[3] = {0, 0, 0}, high[3] = {0, 0, 0};
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
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
    if (lane < 2 * DIM)
        warp.box.bound[lane] = bound;
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
    // since the rows were last written: `kept` candidates, of which `tested` have met the queries
    // of this query: `found` neighbors, of which `written` stand in its row and up to CHUNK wait in its list
    int found = 0, written = 0;
    unsigned int waiting = 0, kept = 0, tested = 0;
    auto keep = [&](const Place& candidate, unsigned int number) {
#pragma unroll
        for (int a = 0; a < DIM; ++a)
            warp.candidates[a][number % 64] = candidate.p[a];
        if constexpr (LATER)
            warp.candidate_ids[number % 64] = id_of(candidate.id);
        if constexpr (LIST)
            warp.ids[number ^ 31] = id_of(candidate.id);
    };
    bool meets_itself = drops_self;  // the first candidates are the queries themselves: number = lane
    if (own) {
        if (lane < group)
            keep(mine, lane);
        kept = group;
    }
    const bool in_quads = (capacity & 3) == 0;  // only then rows begin where 16 bytes may be stored at once
    int* const list = warp.lists[LIST ? lane : 0];
    auto write_rows = [&](bool finished) {
        __syncwarp();
        unsigned int hits = 0, word = shared_address(&warp.hits[0][lane]), id_word = shared_address(warp.ids) - 128;
        const unsigned int last_word = word + 4 * tested, list_begin = shared_address(list), list_end = list_begin + 4 * CHUNK;
        for (bool more = true; more;) {
            // every lane numbers its next neighbors, two at a time
            unsigned int list_at = list_begin + 4 * waiting;
            while (list_at < list_end && (hits || word != last_word))
                asm volatile("{.reg .pred empty, one, two; .reg .u32 bit, at, id, other_bit, other_at, other_id;"
                             "setp.eq.u32 empty, %0, 0;"  // the next word
                             "@empty ld.shared.u32 %0, [%1];"
                             "@empty add.u32 %1, %1, 128;"
                             "@empty add.u32 %2, %2, 128;"
                             "setp.ne.u32 one, %0, 0;"
                             "bfind.u32 bit, %0;"
                             "mad.lo.u32 at, bit, 4, %2;"
                             "@one ld.shared.u32 id, [at];"
                             "shl.b32 bit, 1, bit;"
                             "xor.b32 %0, %0, bit;"
                             "setp.ne.u32 two, %0, 0;"
                             "bfind.u32 other_bit, %0;"
                             "mad.lo.u32 other_at, other_bit, 4, %2;"
                             "@two ld.shared.u32 other_id, [other_at];"
                             "shl.b32 other_bit, 1, other_bit;"
                             "xor.b32 %0, %0, other_bit;"
                             "@one st.shared.u32 [%3], id;"
                             "@two st.shared.u32 [%3 + 4], other_id;"
                             "@one add.u32 %3, %3, 4;"
                             "@two add.u32 %3, %3, 4;}"
                             : "+r"(hits), "+r"(word), "+r"(id_word), "+r"(list_at) : : "memory");
            waiting = (list_at - list_begin) / 4;
            const bool writes = lane < group && (finished || waiting >= CHUNK);
            if (finished)
#pragma unroll 1
                for (; waiting < CHUNK; ++waiting)
                    list[waiting] = n;
            // eight lanes write what waits for one row
            const int before = writes ? written : capacity;
            const unsigned long long slot = (unsigned long long)my_id * capacity + before;
            __syncwarp();
#pragma unroll
            for (int k = 0; k < 32; k += 4) {
                const int row = k + lane / 8, first = lane % 8 * 4;
                const int room = capacity - __shfl_sync(ALL, before, row) - first;
                const unsigned long long row_slot = __shfl_sync(ALL, slot, row);
                if (room <= 0)
                    continue;
                int* const out = idx.data + row_slot + first;
                const int* const from = warp.lists[row] + first;
                const int4 four = make_int4(from[0], from[1], from[2], from[3]);
                if (in_quads) {
                    *(int4*)out = four;
                    continue;
                }
                out[0] = four.x;
                if (room > 1) out[1] = four.y;
                if (room > 2) out[2] = four.z;
                if (room > 3) out[3] = four.w;
            }
            __syncwarp();
            if (writes) {
                written += CHUNK;
                waiting -= CHUNK;
                list[0] = list[CHUNK];  // if there was one more
            }
            more = __any_sync(ALL, finished ? lane < group && written < capacity : hits || word != last_word);
        }
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

        int rows_done = 0, at = -1;
        const int wrap = grid.dense ? 0x7fffffff : grid.finite;  // where the ring of cells closes
        const bool last_rows = base + 32 >= rows;
        Place candidate{{0, 0, 0}, 0};
        auto fetch = [&](int c0) {
            // rows that end before one of these 32 candidates, a bit each: rows that are empty end with the one before
            unsigned int ended;
            asm("shl.b32 %0, 1, %1;" : "=r"(ended) : "r"(end - c0 - 1));  // 0 unless 0 < end - c0 <= 32
            ended = __reduce_or_sync(ALL, ended);
            at = -1;
            if (c0 + lane < total) {
                at = c0 + lane + warp.shifts[rows_done + __popc(ended & lanes_below)];
                at -= at >= wrap ? wrap : 0;
                candidate = load(sorted + at);
            }
            rows_done += __popc(ended);
        };
        if (total > 0)
            fetch(0);
        int c0 = 0;
#pragma unroll 1
        while (c0 < total || (last_rows && tested < kept)) {
            const Box box = *(const Box*)&warp.box;  // from there, since registers are few
            real square = 0;
#pragma unroll
            for (int a = 0; a < DIM; ++a) {
                const real x = candidate.p[a];
                real gap = larger(larger(box.bound[2 * a] - x, x - box.bound[2 * a + 1]), 0);
                if constexpr (SCALED)
                    gap *= step_scale;
                square += gap * gap;
            }
            const bool near = at >= 0 && square <= square_radius + band && (unsigned int)(at - place) >= (own ? group : 0);
            const unsigned int all_near = __ballot_sync(ALL, near);
            if (near)
                keep(candidate, kept + __popc(all_near & lanes_below));
            kept += __popc(all_near);
            c0 += 32;
            at = -1;
            if (c0 < total)
                fetch(c0);
            if (kept - tested < 32 && !(last_rows && c0 >= total && tested < kept))
                continue;
            __syncwarp();
            const unsigned int first_candidate = tested % 64;
            const unsigned int here = kept - tested < 32 ? kept - tested : 32;
            unsigned int hits = 0, closest = 0x7fffffff;
            auto allowed = [&](int j) { return !LATER || warp.candidate_ids[first_candidate + j] >= my_id + drop_self; };
            constexpr int ALONG = 16 / sizeof(real);  // candidates whose coordinate one load brings
#pragma unroll
            for (int j = 0; j < 32; j += ALONG) {
                struct alignas(16) Loaded { real x[ALONG]; } loaded[DIM];
#pragma unroll
                for (int a = 0; a < DIM; ++a)
                    loaded[a] = *(const Loaded*)(warp.candidates[a] + first_candidate + j);
#pragma unroll
                for (int e = 0; e < ALONG; ++e) {
                    real p[DIM];
#pragma unroll
                    for (int a = 0; a < DIM; ++a)
                        p[a] = loaded[a].x[e];
                    const unsigned int over = upper_word(allowed(j + e) ? excess(mine.p, p) : INF);
                    hits = __funnelshift_l(over, hits, 1);
                    if constexpr (EXACTLY)
                        closest = min(closest, over);
                }
            }
            unsigned int met = lane < group ? 0xffffffffu << (32 - here) : 0;  // candidates that are none are not met
            if (meets_itself)
                met &= ~(0x80000000u >> lane);
            meets_itself = false;
            hits &= met;
            if (EXACTLY && __any_sync(ALL, closest <= upper_word(2 * band))) {
                auto candidate = [&](int j, real* p) {
#pragma unroll
                    for (int a = 0; a < DIM; ++a)
                        p[a] = warp.candidates[a][first_candidate + j];
                };
                unsigned int open = 0;
#pragma unroll 4
                for (int j = 0; j < 32; ++j) {
                    real p[DIM];
                    candidate(j, p);
                    const real over = excess(mine.p, p);
                    open |= allowed(j) && over >= 0 && over <= 2 * band ? 0x80000000u >> j : 0;
                }
                for (open &= met; open;) {
                    const int j = __clz(open);
                    const unsigned int bit = 0x80000000u >> j;
                    open ^= bit;
                    real p[DIM];
                    candidate(j, p);
                    hits |= exact_pair(mine.p, p) ? bit : 0;
                }
            }
            found += __popc(hits);
            if constexpr (LIST)
                warp.hits[tested / 32][lane] = hits;
            tested += 32;
            __syncwarp();
            if (LIST && tested == 32 * BLOCKS) {
                write_rows(false);
                warp.ids[lane] = warp.ids[32 * BLOCKS + lane];  // of the few that are not tested yet
                kept = kept > tested ? kept - tested : 0;
                tested = 0;
            }
        }
        __syncwarp();
    }
    if constexpr (LIST)
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
    reach_x: int = 6,
    trim: bool = True,
    blocks: int | None = None,
    order: int = 0,
) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts, half lists or whole.

    The rest is there to be measured. exact=False lets the working precision decide alone (`|d|^2 < r^2 (1 - 8 eps)`); `reach` is
    the number of cell edges in a cutoff along y and z, `reach_x` along x; `trim` cuts rows of cells to the chord of the sphere;
    `blocks` per multiprocessor bound the registers; `order` of the cells: 0 row-major, 1 Morton, 2 Hilbert.
    """
    blocks = blocks or (8 if lists else 12)  # registers against occupancy, measured on an H200
    kind = f"{dim}d_{'f64' if double else 'f32'}_r{reach}x{reach_x}{('', '_morton', '_hilbert')[order]}"
    variant = f"{kind}{'_scaled' * scaled}{'_list' * lists}{'_later' * later}{'' if exact else '_inexact'}{'_whole' * (not trim)}"
    variant += f"_b{blocks}"
    grid = {"REACH": reach, "REACH_X": reach_x, "ORDER": order, "PARTS": _PARTS, "TILE": _TILE, "BLOCK": BLOCK}
    query = {"SCALED": scaled, "LIST": lists, "LATER": later, "EXACTLY": exact, "TRIM": trim}
    query |= {"QUERY_BLOCK": QUERY_BLOCK, **grid}
    return Kernels(
        _kernel(f"bounds_{kind}", kind, dim, double, BLOCK, 1, grid, _REDUCE, _BOUNDS),
        _kernel(f"count_{kind}", kind, dim, double, BLOCK, 1, grid, _REDUCE, _COUNT),
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
