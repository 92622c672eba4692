"""Cell search on CUDA: seven or eight launches, no host synchronization, nothing allocated beside the scratch it is given.

bounds   lowest and highest coordinate per block
lay_out  every block reduces those bounds to the grid, and clears its part of what the others count in
count    every particle counts itself in its cell
scan     counts to first places, in one pass (Merrill & Garland 2016, decoupled look-back)
scatter  indices into their cells, in the order in which they came
gather   positions into cell order, ranked by index within a cell: the same order in every run
query    a warp serves up to 32 neighboring queries, one per lane: candidates within reach of their box meet all of them, 32 in a
         block, float32 on tensor cores first; a neighbor is a bit, until the rows are written. Those that are far from each other
         it serves one after the other: where queries are few, they are shared among more warps
crossing the same in a periodic box, for queries whose reach leaves it: images take registers, which the others have no use for
"""

import functools
from string import Template
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._load import load_module
from jfrnn.kernels._native import CELLS, EXACT, SPACES, snippet, table_cells

BLOCK = 256
QUERY_BLOCK = 32  # one warp: others need not wait for it to end
_PARTS = 256  # blocks of `bounds`; one thread of a block reads one part
_PART = 10  # numbers of a part
_TILE = 2048  # cells that a block of `scan` takes
# Among which few queries are shared, at most: 32 per multiprocessor of an H200; half and twice as many took longer there.
_WARPS = 4224
# what all kernels of a search must agree on
GRID = {"REACH": 1, "REACH_X": 6, "PARTS": _PARTS, "PART": _PART, "TILE": _TILE, "BLOCK": BLOCK, "WARPS": _WARPS}
_HEADER_WORDS = 64
_SWEEP_BLOCKS = 1056  # blocks of the kernels that walk over all particles
_CROSSING_BLOCKS = 8448  # blocks of the kernel for queries whose reach leaves a box: what is to do is known to the device only
_RESIDENT = 132  # blocks of those that walk over the cells: all at work at once
_GATHERING = (8, 6)  # blocks of `gather` that are at work at once per multiprocessor, in open space and in a box
# Beyond, Warp rounds the grid up to whole multiples, and threads that do not run count in a stride: what walks in strides would
# leave out what they should have done.
MOST_IN_STRIDES = 2**24

# What `share_bits` and `query_blocks` return.
SHARE = r"""
int share_bits = 5;
while (share_bits > 0 && ((m - 1) >> (share_bits - 1)) + 1 <= WARPS)
    --share_bits;
const int query_blocks = ((m - 1) >> share_bits) + 1;
"""

LAYOUT = (
    SHARE
    + r"""
struct Shared {
    Grid grid;
    int finite_queries;
    int behind[2];  // non-finite particles so far: sources, queries
    int tiles[2];  // tiles of the scan that have begun
    int crossing;  // blocks of queries that cross the box: the reach of one of them leaves it
    float depth;  // how far a source from outside the box may be from its faces, in reaches: as far as they may be, queries cross
    real unit;  // of the lattice on which all coordinates lie, or 0
};
constexpr int WIDTH = DOUBLE ? 2 : 1;
struct alignas(4 * sizeof(real)) Place { real p[3]; real id; };  // id: the bits of an int
const int tile_count = (table + 1) / TILE + 1;
auto up = [](long long words) { return (words + 15) & ~15ll; };
int* cursor = scratch.data;
auto take = [&](long long words) { int* here = cursor; cursor += up(words); return here; };
Shared& shared = *(Shared*)take(64);
real* parts = (real*)take(PART * PARTS * WIDTH);
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
int* crossing = key;  // their numbers: nobody asks for keys and slots once particles are scattered
int* crosses = slot;  // whether a block does
const int lane = threadIdx.x & 31, warp_in_block = threadIdx.x >> 5;
// Warp spreads more than 65535 blocks over y and z
const int block = (blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x;
const long long thread = (long long)block * blockDim.x + threadIdx.x;
const long long threads = (long long)gridDim.z * gridDim.y * gridDim.x * blockDim.x;
constexpr unsigned int ALL = 0xffffffffu;
auto id_of = [](real bits) -> int { return DOUBLE ? (int)__double_as_longlong(bits) : __float_as_int(bits); };
auto bits_as_real = [](int id) -> real { return DOUBLE ? (real)__longlong_as_double(id) : (real)__int_as_float(id); };
// of a point that comes from outside the box: how far from the nearest face it is, in reaches, rounded up
auto depth_of = [&](const real* at) -> float {
    float depth = INFINITY;
    for (int k = 0; k < DIM; ++k)
        if (is_periodic(k))
            depth = fminf(depth, 1.0001f * (float)((at[k] < real(0.5) ? at[k] : 1 - at[k]) / reach_along(k)));
    return depth;
};
auto is_turned = [](const real* row) { return PERIODIC && Lattice::packed_turns(row[DIM]) != Lattice::NONE; };
const real INF = DOUBLE ? (real)__longlong_as_double(0x7ff0000000000000ll) : (real)__int_as_float(0x7f800000);
"""
)


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool, table: int | None = None) -> int:
    """Return the int32 words of scratch that the kernels need; `width` is 1 for float32 and 2 for float64."""
    del dim
    table = table_cells(sources) if table is None else table
    tiles = 2 * ((table + 1) // _TILE + 1)
    longest = max(sources, queries)
    parts = [_HEADER_WORDS, _PART * _PARTS * width, 4 * width * sources, table + 2, tiles, longest, longest, sources]
    if not own:
        parts += [table + 2, tiles, queries]
    return sum((words + 15) // 16 * 16 for words in parts)


# Bounds and numbers of finite points of all threads of a block, and which bits they have, into those of its first thread.
_REDUCE = r"""
auto reduce_over_block = [&](real* low, real* high, int& finite, float& depth, int& lowest, int& highest) {
    __shared__ real lows[3][BLOCK / 32], highs[3][BLOCK / 32];
    __shared__ int finites[BLOCK / 32];
    __shared__ float depths[BLOCK / 32];
    __shared__ int lowests[BLOCK / 32], highests[BLOCK / 32];
    lowest = __reduce_min_sync(ALL, lowest);
    highest = __reduce_max_sync(ALL, highest);
    for (int step = 16; step > 0; step /= 2) {
        finite += __shfl_down_sync(ALL, finite, step);
        if constexpr (PERIODIC)
            depth = fmaxf(depth, __shfl_down_sync(ALL, depth, step));
        for (int k = 0; k < DIM; ++k) {
            const real l = __shfl_down_sync(ALL, low[k], step), h = __shfl_down_sync(ALL, high[k], step);
            low[k] = l < low[k] ? l : low[k];
            high[k] = h > high[k] ? h : high[k];
        }
    }
    if (lane == 0) {
        finites[warp_in_block] = finite;
        depths[warp_in_block] = depth;
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
            depth = fmaxf(depth, depths[w]);
            lowest = lowests[w] < lowest ? lowests[w] : lowest;
            highest = highests[w] > highest ? highests[w] : highest;
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
int finite = 0, lowest = 1 << 20, highest = 0;
float depth = 0;
auto look_at_bits = [&](const real* row) {
#pragma unroll
    for (int k = 0; k < DIM; ++k) {
        const int low_bit = lowest_bit(row[k]), exponent = Bits::exponent(row[k]);
        lowest = low_bit < lowest ? low_bit : lowest;
        highest = exponent > highest ? exponent : highest;
    }
};
for (long long i = thread; !own && i < m; i += threads)
    if (finite_point(queries.data + ROW * i))
        look_at_bits(queries.data + ROW * i);
for (long long i = thread; i < n; i += threads) {
    real p[3], at[3];
    point_of(positions.data + ROW * i, p);
    if (!finite_point(p))
        continue;
    ++finite;
    look_at_bits(positions.data + ROW * i);
    for (int k = 0; k < DIM; ++k)
        at[k] = coordinate(k, p);
    widen(low, high, at, at);
    if (is_turned(positions.data + ROW * i))
        depth = fmaxf(depth, depth_of(at));
}
reduce_over_block(low, high, finite, depth, lowest, highest);
if (threadIdx.x == 0) {
    real* part = parts + PART * block;
    for (int k = 0; k < DIM; ++k) {
        part[k] = low[k];
        part[3 + k] = high[k];
    }
    part[6] = bits_as_real(finite);
    part[7] = depth;
    part[8] = bits_as_real(lowest);
    part[9] = bits_as_real(highest);
}
if (thread == 0) {
    shared.behind[0] = shared.behind[1] = shared.tiles[0] = shared.tiles[1] = shared.crossing = 0;
    info.data[0] = info.data[1] = 0;
}
"""

_LAY_OUT = r"""
__shared__ Grid grid;
real low[3], high[3];
const real* part = parts + PART * threadIdx.x;
int finite = id_of(part[6]), lowest = id_of(part[8]), highest = id_of(part[9]);
float depth = (float)part[7];
for (int k = 0; k < DIM; ++k) {
    low[k] = part[k];
    high[k] = part[3 + k];
}
reduce_over_block(low, high, finite, depth, lowest, highest);
if (threadIdx.x == 0) {
    if (finite == 0)
        for (int k = 0; k < DIM; ++k)
            low[k] = high[k] = 0;
    lay_out(grid, low, high, table);
    grid.finite = finite;
    if (block == 0) {
        shared.grid = grid;
        shared.depth = depth;
        shared.unit = lattice_unit(lowest, highest);
        if (finite < n)
            atomicOr(&info.data[1], 2);
    }
}
__syncthreads();
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
"""

_COUNT = r"""
const Grid grid = shared.grid;
// the sources are counted first, then, in a second launch, the queries
const int size = of_queries ? m : n;
const real* points = of_queries ? queries.data : positions.data;
int* counts = of_queries ? query_start : start;
for (long long i = thread; i < size; i += threads) {
    real p[3];
    point_of(points + ROW * i, p);
    const bool finite = finite_point(p);
    const int cell = finite ? cell_key(grid, p, system_of(points + ROW * i)) : -1;
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
const int cells = shared.grid.cells + 1;  // one more entry: the end of the last cell
for (;;) {
    if (threadIdx.x == 0)
        tile_shared = atomicAdd(&shared.tiles[of_queries], 1);
    __syncthreads();
    const int tile = tile_shared;
    if ((long long)tile * TILE >= cells)
        break;
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
    __syncthreads();
}
"""

_SCATTER = r"""
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
"""

_GATHER = r"""
const Grid grid = shared.grid;
real crossing_low[3], crossing_high[3];  // beyond, a query reaches out of the box, or may meet what comes from outside
for (int a = 0; a < DIM; ++a) {
    const real reach = reach_along(a) * (real(1.00001) + real(shared.depth));  // rounding does no harm
    crossing_low[a] = is_periodic(a) ? reach : -INF;
    crossing_high[a] = is_periodic(a) ? real(0.999999) - reach : INF;
}
auto mark = [&](const real* row, const real* p, long long place) {  // a query's block, if it crosses the box
    bool crosses_box = is_turned(row);
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
        const real x = coordinate(a, p);
        crosses_box = crosses_box || !(x > crossing_low[a] && x < crossing_high[a]);
    }
    // one lane for all of its warp that belong to the same block
    const int of_block = (int)(place >> share_bits);
    const unsigned int alike = __match_any_sync(__activemask(), crosses_box ? of_block : -1);
    if (crosses_box && (alike & ((1u << lane) - 1)) == 0 && crosses[of_block] == 0 && atomicExch(crosses + of_block, 1) == 0)
        crossing[atomicAdd(&shared.crossing, 1)] = of_block;
};
for (long long place = thread; of_queries && place < shared.finite_queries; place += threads) {
    real p[3];
    const real* row = queries.data + (long long)ROW * query_order[place];
    point_of(row, p);
    mark(row, p, place);
}
for (long long place = thread; !of_queries && place < n; place += threads) {
    const int i = order[place];
    Place mine;
    point_of(positions.data + (long long)ROW * i, mine.p);
    mine.id = bits_as_real(i);
    const unsigned int system = system_of(positions.data + (long long)ROW * i);
    const int cell = finite_point(mine.p) ? cell_key(grid, mine.p, system) : -1;  // cheaper than to fetch key[i] from anywhere
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
        mark(positions.data + (long long)ROW * i, mine.p, to);
}
"""

_WALK = Template(r"""
constexpr bool HELD = LIST || SUMS;  // pairs are held until many can be written, or evaluated, together
constexpr int BLOCKS = 22;  // of candidates, whose pairs are held
constexpr int CHUNK = 32;  // neighbors of a query that are written at once
constexpr int FETCHED = 2;  // candidates that a lane fetches at a time
constexpr int RING = 128;  // candidates: fewer than a block, what is fetched twice, rounded up
constexpr unsigned int ONES = 0x3c003c00;  // two halves
// Where space is periodic, a candidate's id tells its image, too: in the upper bits, or, where images are told apart in the list,
// as in the list. Moving a candidate is one text, so that it is in the same place whenever it is loaded.
constexpr int ID_BITS = 27;
// Inside, no row of cells leaves the box, and nothing that is near comes from outside of it: all are at home, nothing is moved.
constexpr bool inside = !CROSSING;
constexpr int IDS = (PERIODIC == 1 || SUMS) && inside ? 0 : PERIODIC;
int codes = 1, home = 0;
if constexpr (IDS) {
    for (int k = 0; k < DIM; ++k)
        codes *= 2 * lattice.images(k) + 1;
    home = (codes - 1) / 2;
}
const int fill_value = PERIODIC == 2 ? n * codes : n;
auto id_of_image = [&](int source, int code) -> int {
    const unsigned int upper = (unsigned int)(code ^ home) << ID_BITS;  // none at home
    return IDS == 0 ? source : IDS == 1 ? (int)((unsigned int)source | upper) : source + n * code;
};
auto source_of = [&](int id) -> int { return IDS == 0 ? id : IDS == 1 ? id & ((1 << ID_BITS) - 1) : id % n; };
auto image_of = [&](int id) -> int { return IDS == 1 ? (int)((unsigned int)id >> ID_BITS) ^ home : id / n; };
auto shift_of = [&](int code, int* shift) {
    for (int k = DIM - 1; k >= 0; --k) {
        const int each = 2 * lattice.images(k) + 1;
        shift[k] = code % each - lattice.images(k);
        code /= each;
    }
};
auto translate = [&](int code, real* moved) {
    int shift[3] = {0, 0, 0};
    shift_of(code, shift);
    for (int k = 0; k < DIM; ++k)
        moved[k] = lattice.translation(shift[0], shift[1], shift[2], k);
};
auto load = [&](const Place* from) -> Place {
    if constexpr (DOUBLE) {
        const double2 a = __ldg((const double2*)from), b = __ldg((const double2*)from + 1);
        return Place{{(real)a.x, (real)a.y, (real)b.x}, (real)b.y};
    } else {
        const float4 a = __ldg((const float4*)from);
        return Place{{(real)a.x, (real)a.y, (real)a.z}, (real)a.w};
    }
};
// An id names the image of a source; of what is summed the image of a place, which is where all that is known of it stands.
auto source_named = [&](int id) -> int { return SUMS ? id_of(load(sorted + source_of(id)).id) : source_of(id); };
auto load_image = [&](int id, real* p) {
    if constexpr (SUMS) {
        const Place here = load(sorted + source_of(id));
        for (int k = 0; k < DIM; ++k)
            p[k] = here.p[k];
    } else
        point_of(positions.data + (long long)ROW * source_of(id), p);
    if constexpr (!inside) {
        real moved[3];
        translate(image_of(id), moved);
        for (int k = 0; k < DIM; ++k)
            p[k] = Lattice::add(p[k], moved[k]);
    }
};
// what ids in ascending order say of a pair: by source, then, of one source, its images behind, at home, ahead
auto order_of = [&](int id) -> int {
    if constexpr (PERIODIC != 2)
        return source_of(id);
    const int code = image_of(id);
    return 3 * source_of(id) + (code > home) - (code < home);
};
auto first_after = [&](int my_id) -> int { return PERIODIC == 2 ? 3 * my_id + drop_self : my_id + drop_self; };
struct alignas(16) Box { real center[4], half[4]; };  // a group's; the last ones: what is near, squared, and twice the coarse band
struct Run { int end, shift; };  // candidates of a row of cells: where they end, what leads from a candidate's number to its place
struct alignas(16) Warp {  // what a warp shares
    union {
        // of a ring of candidates near the group's box: coordinates (float64) or columns of a matrix, pairs of halves (float32)
        real candidates[DOUBLE ? DIM : 4][RING + 8];
        // per query, while rows are written: addresses of the ids that are next, two in a word; the stride is odd, for the banks
        unsigned int lists[SUMS ? 1 : 32][CHUNK / 2 + 3];
    };
    int candidate_ids[LATER || !HELD ? RING : 1];
    int ids[HELD ? 32 * (BLOCKS + FETCHED) : 1];  // of all of them since pairs were last settled
    unsigned int hits[HELD ? BLOCKS + 1 : 1][32];  // per block of candidates and query: one bit per candidate
    unsigned int written[LIST ? 32 : 1];  // per query: neighbors that stand in its row, a multiple of four, plus those left over
    int left[LIST ? 3 : 1][32];  // of those, the ids
    Box box;  // of the group
    Run runs[33];
    int run_images[CROSSING ? 33 : 1];  // their codes, and what leads from home to them
    real run_moved[CROSSING ? 33 : 1][3];
};
__shared__ Warp warp;
__shared__ Grid grid;
__shared__ int finite_queries, longest_before;
__shared__ real site, between;  // the unit of a lattice, and the square, in such units, between those of pairs and of others; or 0
if (lane == 0) {
    site = SCALED ? real(0) : shared.unit;
    between = site > 0 ? (real)square_between(site) : real(0);
    grid = shared.grid;
    finite_queries = shared.finite_queries;
    longest_before = SUMS ? 0 : *(volatile int*)&info.data[0];
}
__syncwarp();
const unsigned int lanes_below = (1u << lane) - 1;
// differences of images may be off by more than rounding takes from a difference
const real off = CROSSING ? 2 * lattice.slack() * step_scale : real(0), outer_radius = step_radius + off;
const real inner_radius = step_radius > off ? step_radius - off : real(0), square_radius = step_radius * step_radius;
// where coordinates lie on a lattice nothing is in doubt, and bands are negative
const real sure_square = DOUBLE && between > 0 ? between * site * site
                                               : inner_radius * inner_radius - 8 * (1 + SHIFTED) * step_eps * square_radius;
const real beyond = outer_radius * outer_radius * (1 + 16 * step_eps) - sure_square;
const real band = DOUBLE && between > 0 ? real(-1) : CROSSING ? real(0.5) * beyond : 8 * step_eps * square_radius;
const bool drops_self = own && drop_self;
auto load_query = [&](int at) -> Place {
    if (own)
        return load(sorted + at);
    Place q;
    const int i = query_order[at];
    point_of(queries.data + (long long)ROW * i, q.p);
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
auto square_root = [](float x) {
    float y;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
};
auto shared_address = [](const void* p) { return (unsigned int)__cvta_generic_to_shared(p); };
auto load_word = [](unsigned int at) {
    int word;
    asm volatile("ld.shared.u32 %0, [%1];" : "=r"(word) : "r"(at) : "memory");
    return word;
};
// what lanes without anything to do skip by a predicate: it costs less than a branch around it
auto store_if = [](bool is_stored, unsigned int to, unsigned int word) {
    asm volatile("{.reg .pred is; setp.ne.u32 is, %0, 0; @is st.shared.u32 [%1], %2;}"
                 : : "r"((unsigned int)is_stored), "r"(to), "r"(word) : "memory");
};
auto load_if = [&](bool is_loaded, const Place* from, auto& to) {
    if constexpr (sizeof(to.id) == 8) {
        if (is_loaded)
            to = load(from);
    } else if constexpr (SUMS)  // not the id, which nobody asks for: its register would be given away, and who takes it would wait
        asm volatile("{.reg .pred is; setp.ne.u32 is, %3, 0; @is ld.global.nc.f32 %0, [%4];"
                     "@is ld.global.nc.f32 %1, [%4 + 4]; @is ld.global.nc.f32 %2, [%4 + 8];}"
                     : "+f"(to.p[0]), "+f"(to.p[1]), "+f"(to.p[2])
                     : "r"((unsigned int)is_loaded), "l"(__cvta_generic_to_global(from)));
    else
        asm volatile("{.reg .pred is; setp.ne.u32 is, %4, 0; @is ld.global.nc.v4.f32 {%0, %1, %2, %3}, [%5];}"
                     : "+f"(to.p[0]), "+f"(to.p[1]), "+f"(to.p[2]), "+f"(to.id)
                     : "r"((unsigned int)is_loaded), "l"(__cvta_generic_to_global(from)));
};
// factor * x as a sum of two halves: exact but for 2^-22 of it and what is too small for a half
auto halves = [](float x, float factor) -> unsigned int {
    const float high = __uint_as_float(__float_as_uint(x) & 0xffffe000u), low = x - high;
    unsigned int word;
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(word) : "f"(factor * low), "f"(factor * high));
    return word;
};
if (PERIODIC && !CROSSING && (block >= query_blocks || crosses[block]))
    return;
for (int turn = block; !CROSSING || turn < shared.crossing; turn += (int)(threads / 32)) {
const long long begin = (long long)(CROSSING ? crossing[turn] : turn) << share_bits;
int place = begin < m ? (int)begin : m;
const int share = 1 << share_bits, stop = m - place < share ? m : place + share;
$opened
while (place < stop) {
    // one query per lane; those that share a row of cells with the first form a group
    Place mine{{0, 0, 0}, 0};
    bool beside = place + lane < stop && place + lane < finite_queries;
    if (beside)
        mine = load_query(place + lane);
    real my_place[3];
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
        my_place[a] = coordinate(a, mine.p);
        const whole here = axis_cell(grid, a, my_place[a]), there = __shfl_sync(ALL, here, 0);
        beside = beside && (ORDER != 0 || (a == 0 ? grid.dense || (here >= there && here - there < 2 * REACH_X) : here == there));
    }
    unsigned int system = 0;
    if constexpr (BATCHED) {
        system = beside ? system_of(queries.data + (long long)ROW * id_of(mine.id)) : 0;
        const unsigned int of_first = __shfl_sync(ALL, system, 0);
        beside = beside && system == of_first;
        system = of_first;
    }
    const int group = __ffs(~__ballot_sync(ALL, beside)) == 0 ? 32 : __ffs(~__ballot_sync(ALL, beside)) - 1;
    if (group == 0) {  // non-finite: an empty row
        const int id = id_of(load_query(place).id);
        $none
        ++place;
        continue;
    }
    const int my_id = id_of(mine.id);
    auto reduce_over_group = [&](real x, real& low, real& high) {
        low = lane < group ? x : INF;
        high = lane < group ? x : -INF;
        if constexpr (DOUBLE) {
#pragma unroll
            for (int step = 1; step < 32; step *= 2) {
                const real l = __shfl_xor_sync(ALL, low, step), h = __shfl_xor_sync(ALL, high, step);
                low = l < low ? l : low;
                high = h > high ? h : high;
            }
        } else {  // as integers of the same order, which one instruction reduces
            auto flip = [](int b) { return b ^ (b >> 31 & 0x7fffffff); };
            low = __int_as_float(flip(__reduce_min_sync(ALL, flip(__float_as_int(low)))));
            high = __int_as_float(flip(__reduce_max_sync(ALL, flip(__float_as_int(high)))));
        }
    };
    // lane 2a holds the group's lowest coordinate along axis a and the lowest cell in reach, lane 2a + 1 the highest
    real bound = 0, low[3], high[3], center[3], square = 0;
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
        reduce_over_group(mine.p[a], low[a], high[a]);
        real lowest = low[a], highest = high[a];
        if constexpr (PERIODIC) {
            if constexpr (SKEWED)
                reduce_over_group(my_place[a], lowest, highest);
            else {  // in one order or the other
                const real begin = coordinate(a, low), end = coordinate(a, high);
                lowest = begin < end ? begin : end;
                highest = begin < end ? end : begin;
            }
        }
        bound = lane == 2 * a ? lowest : lane == 2 * a + 1 ? highest : bound;
        center[a] = real(0.5) * low[a] + real(0.5) * high[a];
        const real below = center[a] - low[a], above = high[a] - center[a], half = (below > above ? below : above) * step_scale;
        square += half * half;
    }
    // float32: everything near is closer to the center than 240 of the unit, a power of two, so that its square is a half, too
    real unit = 1, scale = step_scale;
    const float diagonal = 1.0001f * square_root((float)square);
    if constexpr (!DOUBLE) {
        constexpr float SMALLEST = 0x1p-126f;
        unit = __uint_as_float(__float_as_uint(__fdividef(240, diagonal + outer_radius)) & 0x7f800000u);
#pragma unroll
        for (int a = 0; a < DIM; ++a)
            unit = fabsf(center[a]) * step_scale * unit < 1e37f ? unit : 0;
        if (unit < SMALLEST) {  // coordinates that overflow otherwise: all pairs that are near are decided one by one
            unit = SMALLEST;
            scale = SCALED ? 1 : scale;
        }
    }
    const real group_radius = (SCALED ? radius * scale : radius) * unit;
    const real group_outer = CROSSING ? (radius + 2 * lattice.slack()) * (SCALED ? scale : real(1)) * unit : group_radius;
    const real near_square = group_outer * group_outer * (1 + 8 * step_eps) + (DOUBLE ? real(0) : real(1e-30));
    const float reach = fminf(diagonal * (float)unit + (float)group_outer, 240);
    float coarse_band = reach * reach * 2e-5f, coarse_square = 0;  // see meet
    const float square_unit = (float)(site * unit) * (float)(site * unit);
    const bool on_lattice = !DOUBLE && between > 0 && reach < 239 && coarse_band < 0.25f * square_unit;
    if (on_lattice) {
        coarse_square = (float)between * square_unit;
        coarse_band = -1;
    } else {
        if constexpr (CROSSING)
            coarse_band += 1.001f * (float)((group_outer - group_radius) * (group_outer + group_radius));
        coarse_square = (float)group_radius * (float)group_radius - coarse_band;
    }
    auto from_center = [&](real x, real center) -> real {
        const real y = SCALED ? x * scale : x;
        if constexpr (DOUBLE)
            return y - center;
        else
            return fmaf((float)y, (float)unit, -(float)center);
    };
    Box box;
    box.center[3] = near_square;
    box.half[3] = 2 * coarse_band;
#pragma unroll
    for (int a = 0; a < DIM; ++a) {
        box.center[a] = (SCALED ? center[a] * scale : center[a]) * unit;
        const real below = -from_center(low[a], box.center[a]), above = from_center(high[a], box.center[a]);
        box.half[a] = (below > above ? below : above) * (1 + 16 * step_eps);
    }
    if (lane == 0)
        warp.box = box;
    whole reached;
    {
        const int along = lane / 2 < DIM ? lane / 2 : 0;
        const real x = cell_of(along, in_range(lane % 2 ? bound + reach_along(along) : bound - reach_along(along)));
        if (is_periodic(along))  // numbered on beyond the ends
            reached = (whole)x;
        else if (grid.dense) {
            const int extent = lane < 2 ? grid.extent[0] : lane < 4 || DIM == 2 ? grid.extent[1] : grid.extent[2];
            const real from_low = x - (lane < 2 ? grid.low[0] : lane < 4 || DIM == 2 ? grid.low[1] : grid.low[2]);
            reached = from_low < 0 ? -1 : from_low < real(extent) ? (whole)from_low : (whole)extent;
            reached = lane % 2 ? (reached < extent ? reached : extent - 1) : (reached < 0 ? 0 : reached);
        } else
            reached = cell_number(x);
        if (lane >= 2 * DIM)
            reached = 0;
    }
    auto cells_along = [&](int a) { return (int)(__shfl_sync(ALL, reached, 2 * a + 1) - __shfl_sync(ALL, reached, 2 * a)) + 1; };
    int rows = ORDER != 0 ? cells_along(0) : 1;  // on a curve, cells along x are no run
    if (!inside && is_periodic(0))  // a row is cut where it enters another image
        rows = period_of(0, __shfl_sync(ALL, reached, 1)) - period_of(0, __shfl_sync(ALL, reached, 0)) + 1;
    if (cells_along(0) <= 0 || cells_along(1) <= 0 || cells_along(2) <= 0)
        rows = 0;
    rows *= cells_along(1) * cells_along(2);
    // the candidates of up to 32 rows of cells, as runs; returns how many
    auto find_runs = [&](int base) -> int {
        whole first[3];
#pragma unroll
        for (int a = 0; a < 3; ++a)
            first[a] = __shfl_sync(ALL, reached, 2 * a);
        const int wide = cells_along(1), deep = cells_along(2), across = ORDER != 0 ? cells_along(0) : rows / (wide * deep);
        int length = cells_along(0), from = 0, size = 0, image = home;
        const int row = base + lane, line = row / across, level = line / wide;
        whole y = first[1] + (line - level * wide), z = first[2] + level;
        struct Part { whole first, y, z; int length, image; };
        const int cells = length;
        const whole leftmost = first[0];
        auto part_of = [&](int row) -> Part {  // a row of cells, in its own image
            const int line = row / across, level = line / wide;
            whole cell[3] = {leftmost, first[1] + (line - level * wide), first[2] + level}, last = leftmost + cells - 1;
            int shift[3] = {0, 0, 0}, image = 0;
            if (is_periodic(0)) {
                const whole around = (whole)inverse_edge[0];
                shift[0] = period_of(0, leftmost) + row % across;
                cell[0] = leftmost - shift[0] * around;
                cell[0] = cell[0] < 0 ? 0 : cell[0];
                last -= shift[0] * around;
                last = last < around ? last : around - 1;
            }
#pragma unroll
            for (int a = 1; a < DIM; ++a)
                if (is_periodic(a)) {
                    shift[a] = period_of(a, cell[a]);
                    cell[a] -= shift[a] * (whole)inverse_edge[a];
                }
            bool within = true;  // rounded up, a group may reach an image that nobody can
#pragma unroll
            for (int a = 0; a < DIM; ++a) {
                const int most = lattice.images(a);
                within = within && shift[a] >= -most && shift[a] <= most;
                image = image * (2 * most + 1) + shift[a] + most;
            }
            if (!within)
                return Part{cell[0], cell[1], cell[2], 0, home};
            return Part{cell[0], cell[1], cell[2], (int)(last - cell[0]) + 1, image};
        };
        if constexpr (!inside) {
            const Part part = part_of(row < rows ? row : 0);
            first[0] = part.first;
            y = part.y;
            z = part.z;
            length = part.length;
            image = part.image;
        }
        if (grid.dense) {
            if (row < rows) {
                const int s = ORDER != 0 ? curve(grid, (unsigned int)(first[0] + row % across), (unsigned int)y, (unsigned int)z)
                                         : row_start(grid, y, z, system) + (int)first[0];
                from = start[s];
                size = length > 0 ? start[s + (ORDER != 0 ? 1 : length)] - from : 0;
            }
        } else {
            const int begins = ring(row_start(grid, y, z, system) + ring(first[0], grid.cells), grid.cells);
            int front = 0, back = 0;  // entries that an earlier row has too
            auto overlap = [&](int other) {
                const int behind = begins - other < 0 ? begins - other + grid.cells : begins - other, ahead = grid.cells - behind;
                if (behind < length)
                    front = length - behind > front ? length - behind : front;
                else if (ahead < length)
                    back = length - ahead > back ? length - ahead : back;
            };
            for (int r = 0; r < base; ++r)
                if constexpr (!inside) {
                    const Part part = part_of(r);
                    if (part.image == image)  // as long as this one
                        overlap(ring(row_start(grid, part.y, part.z, system) + ring(part.first, grid.cells), grid.cells));
                } else {
                    const int earlier = row_start(grid, first[1] + r % wide, first[2] + r / wide, system);
                    overlap(ring(earlier + ring(first[0], grid.cells), grid.cells));
                }
            const int here = rows - base < 32 ? rows - base : 32;
#pragma unroll 1
            for (int r = 0; r < here; ++r) {
                const int other = __shfl_sync(ALL, begins, r), other_image = CROSSING ? __shfl_sync(ALL, image, r) : 0;
                if (r < lane && other_image == image)
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
        const unsigned int occupied = __ballot_sync(ALL, size > 0);
        __syncwarp();
        if (size > 0) {
            const int number = __popc(occupied & lanes_below);
            warp.runs[number] = Run{end, from - (end - size)};
            if constexpr (!inside) {
                warp.run_images[number] = image;
                translate(image, warp.run_moved[number]);
            }
        }
        if (lane == 0)
            warp.runs[__popc(occupied)] = Run{0x7fffffff, 0};
        __syncwarp();
        return __shfl_sync(ALL, end, 31);
    };
    // since pairs were last settled: `kept` candidates, of which `tested` have met the queries
    int found = 0;  // neighbors of this query
    unsigned int kept = 0, tested = 0;
    if constexpr (LIST)
        warp.written[lane] = 0;
    auto keep = [&](bool is_near, const Place& candidate, const real* from_center, unsigned int number) {
        if constexpr (DOUBLE) {
            if (is_near)
#pragma unroll
                for (int a = 0; a < DIM; ++a)
                    warp.candidates[a][number % RING] = candidate.p[a];
        } else {
            const unsigned int column = shared_address(warp.candidates[0]) + 4 * (number % RING);
            float square = 0;
#pragma unroll
            for (int a = 0; a < 3; ++a) {
                const float x = a < DIM ? (float)from_center[a] : 0;
                square += x * x;
                store_if(is_near, column + (unsigned int)sizeof(warp.candidates[0]) * a, halves(x, 1));
            }
            store_if(is_near, column + (unsigned int)sizeof(warp.candidates[0]) * 3, halves(square, 1));
        }
        if constexpr (LATER || !HELD)
            store_if(is_near, shared_address(warp.candidate_ids) + 4 * (number % RING), (unsigned int)id_of(candidate.id));
        if constexpr (HELD)
            store_if(is_near, shared_address(warp.ids) + 4 * number, (unsigned int)id_of(candidate.id));
    };
    // queries as rows of matrices, see meet: those of a quad of lanes, whose lanes hold one column each
    unsigned int rows_high[4] = {0, 0, 0, 0}, rows_low[4] = {0, 0, 0, 0};
    real mine_from_center[3] = {0, 0, 0};
#pragma unroll
    for (int a = 0; a < DIM; ++a)
        mine_from_center[a] = lane < group ? from_center(mine.p[a], box.center[a]) : 0;
    if constexpr (!DOUBLE) {
        unsigned int words[2][4];
        float own_square = 0;
#pragma unroll
        for (int a = 0; a < 3; ++a) {
            const float x = (float)mine_from_center[a];
            own_square += x * x;
            const unsigned int word = halves(x, -2);
            words[0][a] = __byte_perm(word, 0, 0x1010);
            words[1][a] = __byte_perm(word, 0, 0x3232);
        }
        words[0][3] = ONES;
        words[1][3] = halves(own_square - coarse_square, 1);
        unsigned int* const columns = (unsigned int*)warp.candidates;
#pragma unroll
        for (int k = 0; k < 8; ++k)
            columns[33 * k + lane] = words[k / 4][k % 4];
        __syncwarp();
#pragma unroll
        for (int i = 0; i < 4; ++i) {
            rows_high[i] = columns[33 * (lane % 4) + (lane & 28) + i];
            rows_low[i] = columns[33 * (lane % 4 + 4) + (lane & 28) + i];
        }
        __syncwarp();
    }
    // float32: what most pairs are decided by. With a and b from the center, |b - a|^2 - r^2 + coarse_band is
    // -2 a.b + |b|^2 * 1 + 1 * (|a|^2 - r^2 + coarse_band): products of rows and columns, in which a number is two halves, high
    // and low. The tensor cores multiply them exactly and add in single precision at least, in whatever order, flushing or not
    // flushing halves that are denormal (PTX ISA, mma). Of reach^2, 16 sums of terms that add up to 6.5 lose less than 1.3e-5,
    // flushing (reach > 120, or it does not matter) less than 4e-6, splitting and scaling less than 2e-6: less than the band of
    // 2e-5. Negative: surely closer than the cutoff; beyond 2 coarse_band: surely not; between: decided one by one. On a lattice
    // squares are whole numbers of squared units, of which that band is less than a quarter, and the limit lies in the middle
    // between two of them: all signs are sure.
    // One bit per candidate of a block: the sum's bits, less `from`, are negative.
    auto meet = [&](unsigned int first_candidate, unsigned int from, unsigned int& closest) -> unsigned int {
        const uint4 loaded = *(const uint4*)(warp.candidates[DOUBLE ? 0 : lane % 4] + first_candidate + lane / 4 * 4);
        const unsigned int column[4] = {loaded.x, loaded.y, loaded.z, loaded.w};
        unsigned int nibbles[4][2] = {{0, 0}, {0, 0}, {0, 0}, {0, 0}};
#pragma unroll
        for (int j = 3; j >= 0; --j) {
            const unsigned int again = lane % 4 == 3 ? ONES : column[j];  // meets the low halves
#pragma unroll
            for (int half = 0; half < 2; ++half) {
                float sum[4];
                asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9},"
                             "{%10, %10, %10, %10};"
                             : "=f"(sum[0]), "=f"(sum[1]), "=f"(sum[2]), "=f"(sum[3])
                             : "r"(rows_high[2 * half]), "r"(rows_high[2 * half + 1]), "r"(rows_low[2 * half]),
                               "r"(rows_low[2 * half + 1]), "r"(column[j]), "r"(again), "f"(0.0f));
#pragma unroll
                for (int k = 0; k < 4; ++k) {
                    unsigned int& nibble = nibbles[2 * half + k / 2][k % 2];
                    nibble = __funnelshift_l(__float_as_uint(sum[k]) - from, nibble, 1);
                    closest = min(closest, __float_as_uint(sum[k]));
                }
            }
        }
        unsigned int bits = 0;
#pragma unroll
        for (int k = 0; k < 8; ++k)
            bits += nibbles[k / 2][k % 2] << 4 * k;
        // four bits of each of eight candidates become 32 of one query
        bits = __byte_perm(bits, __shfl_xor_sync(ALL, bits, 2), lane & 2 ? 0x3276 : 0x5410);
        return __byte_perm(bits, __shfl_xor_sync(ALL, bits, 1), lane & 1 ? 0x3715 : 0x6240);
    };
    bool meets_itself = drops_self;  // the first candidates are the queries themselves: number = lane
    if (own) {
        Place at_home = mine;
        if constexpr (PERIODIC == 2 || SUMS)
            at_home.id = bits_as_real(id_of_image(SUMS ? place + lane : my_id, home));
        keep(lane < group, at_home, mine_from_center, lane);
        kept = group;
    }
    unsigned int met_in = 0;  // blocks that have a neighbor of this query, a bit each
    $begun

    int base = 0, total = 0, fetched = 0;  // rows of cells, candidates of their runs, those that were fetched
    int run_end = 0, run_shift = 0;  // of what this lane fetches
    const Run* run = warp.runs;
    Place candidates[FETCHED];
    int runs_of[FETCHED];  // crossing: nothing may wait here for what is loaded, so that it is moved later
    auto fetch = [&]() {
#pragma unroll
        for (int k = 0; k < FETCHED; ++k) {
            const int number = fetched + 32 * k + lane;
            while (number >= run_end) {
                run_end = run->end;
                run_shift = run->shift;
                ++run;
            }
            int at = number + run_shift;
            if (!grid.dense && at >= grid.finite)  // the ring of cells closes
                at -= grid.finite;
            candidates[k].p[0] = INF;
            bool taken = number < total;  // those of the group stand in front
            if constexpr (inside)
                taken = taken && (unsigned int)(at - place) >= (own ? group : 0);
            else {
                runs_of[k] = taken ? (int)(run - warp.runs) - 1 : 0;  // what is not taken is infinite: moved by what is finite, too
                taken = taken && (warp.run_images[runs_of[k]] != home || (unsigned int)(at - place) >= (own ? group : 0));
            }
            load_if(taken, sorted + at, candidates[k]);
            if constexpr (SUMS)
                candidates[k].id = bits_as_real(at);
        }
    };
    // What is met goes on with, while something else needs the registers: a callee, who cannot use those that hold something across
    // the call, or what is done with many pairs at once. Few are left, so memory holds it.
    volatile unsigned int aside[4 * FETCHED + 8];
    auto put_aside = [&]() {
        if constexpr (!DOUBLE) {
#pragma unroll
            for (int k = 0; k < FETCHED; ++k) {
#pragma unroll
                for (int a = 0; a < DIM; ++a)
                    aside[4 * k + a] = __float_as_uint((float)candidates[k].p[a]);
                aside[4 * k + 3] = __float_as_uint((float)candidates[k].id);
            }
#pragma unroll
            for (int k = 0; k < 4; ++k) {
                aside[4 * FETCHED + k] = rows_high[k];
                aside[4 * FETCHED + 4 + k] = rows_low[k];
            }
        }
    };
    auto take_back = [&]() {
        if constexpr (!DOUBLE) {
#pragma unroll
            for (int k = 0; k < FETCHED; ++k) {
#pragma unroll
                for (int a = 0; a < DIM; ++a)
                    candidates[k].p[a] = __uint_as_float(aside[4 * k + a]);
                candidates[k].id = __uint_as_float(aside[4 * k + 3]);
            }
#pragma unroll
            for (int k = 0; k < 4; ++k) {
                rows_high[k] = aside[4 * FETCHED + k];
                rows_low[k] = aside[4 * FETCHED + 4 + k];
            }
        }
    };
    for (bool finished = false; !finished;) {
        if (fetched >= total && base < rows) {
            total = find_runs(base);
            base += 32;
            fetched = 0;
            run_end = 0;
            run = warp.runs;
            fetch();
        }
        if (fetched < total) {
            const Box box = *(const Box*)&warp.box;  // from there, since registers are few
            real p[FETCHED][3];
            bool near[FETCHED];
#pragma unroll
            for (int k = 0; k < FETCHED; ++k) {
                if constexpr (IDS) {
                    const int image = inside ? home : warp.run_images[runs_of[k]];
                    candidates[k].id = bits_as_real(id_of_image(id_of(candidates[k].id), image));
                }
                if constexpr (!inside)
#pragma unroll
                    for (int a = 0; a < DIM; ++a)
                        candidates[k].p[a] = Lattice::add(candidates[k].p[a], warp.run_moved[runs_of[k]][a]);
                real square = 0;
#pragma unroll
                for (int a = 0; a < DIM; ++a) {
                    p[k][a] = from_center(candidates[k].p[a], box.center[a]);
                    const real gap = larger(magnitude(p[k][a]) - box.half[a], 0);
                    square += gap * gap;
                }
                near[k] = square <= box.center[3];
                if (BATCHED && !grid.dense && near[k])
                    near[k] = system_of(positions.data + (long long)ROW * source_named(id_of(candidates[k].id))) == system;
            }
#pragma unroll
            for (int k = 0; k < FETCHED; ++k) {
                const unsigned int all_near = __ballot_sync(ALL, near[k]);
                keep(near[k], candidates[k], p[k], kept + __popc(all_near & lanes_below));
                kept += __popc(all_near);
            }
            fetched += 32 * FETCHED;
            if (fetched < total)
                fetch();
        }
        const bool last_ones = fetched >= total && base >= rows;
        __syncwarp();
        while ((!HELD || tested < 32 * BLOCKS) && kept >= tested + (last_ones ? 1 : 32)) {
            const unsigned int first_candidate = tested % RING;
            const unsigned int here = kept - tested < 32 ? kept - tested : 32;
            unsigned int met = lane < group ? ALL >> (32 - here) : 0;  // candidates that are none are not met
            if (meets_itself)
                met &= ~(1u << lane);
            meets_itself = false;
            if constexpr (LATER) {
                unsigned int earlier = 0;
#pragma unroll
                for (int j = 31; j >= 0; --j) {
                    const int later_by = order_of(warp.candidate_ids[first_candidate + j]) - first_after(my_id);
                    earlier = __funnelshift_l((unsigned int)later_by, earlier, 1);
                }
                met &= ~earlier;
            }
            unsigned int hits = 0, open = 0, closest = 0x7fffffff;
            if constexpr (!DOUBLE) {
                hits = meet(first_candidate, 0, closest);
                const unsigned int until = __float_as_uint((float)warp.box.half[3]);
                if (__any_sync(ALL, (int)closest <= (int)until))
                    open = meet(first_candidate, until + 1, closest) & ~hits;
            } else {
                constexpr int ALONG = 16 / sizeof(real);  // candidates whose coordinate one load brings
#pragma unroll
                for (int j = 32 - ALONG; j >= 0; j -= ALONG) {
                    struct alignas(16) Loaded { real x[ALONG]; } loaded[DIM];
#pragma unroll
                    for (int a = 0; a < DIM; ++a)
                        loaded[a] = *(const Loaded*)(warp.candidates[a] + first_candidate + j);
#pragma unroll
                    for (int e = ALONG - 1; e >= 0; --e) {
                        real p[DIM];
#pragma unroll
                        for (int a = 0; a < DIM; ++a)
                            p[a] = loaded[a].x[e];
                        const unsigned int over = upper_word(excess(mine.p, p));
                        hits = __funnelshift_l(over, hits, 1);
                        if constexpr (EXACTLY)
                            closest = min(closest, over);
                    }
                }
                if (EXACTLY && __any_sync(ALL, (int)closest <= (int)upper_word(2 * band)))
#pragma unroll 4
                    for (int j = 0; j < 32; ++j) {
                        real p[DIM];
#pragma unroll
                        for (int a = 0; a < DIM; ++a)
                            p[a] = warp.candidates[a][first_candidate + j];
                        const real over = excess(mine.p, p);
                        open |= over >= 0 && over <= 2 * band ? 1u << j : 0;
                    }
            }
            hits &= met;
            open &= met;
            if (__any_sync(ALL, open)) {
                put_aside();
                const Place query = DOUBLE || CROSSING ? mine : open ? load_query(place + lane) : Place{{0, 0, 0}, 0};
                for (; open; open &= open - 1) {
                    const int j = __ffs(open) - 1;
                    const int id = HELD ? warp.ids[tested + j] : warp.candidate_ids[first_candidate + j];
                    real p[3];
                    load_image(id, p);
                    const real over = excess(query.p, p);
                    bool hit = over < 0;
                    if (EXACTLY && over >= 0 && over <= 2 * band) {
                        if constexpr (inside)
                            hit = exact_pair(query.p, p);
                        else {
                            const real* source = positions.data + (long long)ROW * source_named(id);
                            hit = exact_image(queries.data + (long long)ROW * my_id, source, image_of(id));
                        }
                    }
                    hits |= hit ? 1u << j : 0;
                }
                take_back();
            }
            found += __popc(hits);
            if constexpr (HELD) {
                warp.hits[tested / 32][lane] = hits;
                met_in |= hits ? 1u << tested / 32 : 0;
            }
            tested += 32;
        }
        __syncwarp();
        finished = last_ones && tested >= kept;
        if constexpr (HELD)
            if (finished || tested == 32 * BLOCKS) {
                if (!finished)
                    put_aside();
                $settled
                if (finished)
                    break;
                take_back();
                kept = kept > tested ? kept - tested : 0;
                tested = 0;
                // the candidates that are not tested yet, again, since lists stood there
                Place left[FETCHED];
#pragma unroll
                for (int k = 0; k < FETCHED; ++k) {
                    const int id = warp.ids[32 * (BLOCKS + k) + lane];
                    left[k].id = bits_as_real(id);
                    if (32 * k + lane < kept)
                        load_image(id, left[k].p);
                }
                __syncwarp();
#pragma unroll
                for (int k = 0; k < FETCHED; ++k) {
                    real p[3];
#pragma unroll
                    for (int a = 0; a < DIM; ++a)
                        p[a] = from_center(left[k].p[a], warp.box.center[a]);
                    keep(32 * k + lane < kept, left[k], p, 32 * k + lane);
                }
            }
    }
    $done
    place += group;
    __syncwarp();
}
$closed
if (!CROSSING)
    break;
}
""")

# How a lane walks over the bits of its query, block by block that has any: `hits` are those of a block that are left, `ids` the
# address of the block's ids. Behind the last block stands one, `behind` as a bit, that is never left.
HELD_PAIRS = r"""
const unsigned int words = shared_address(&warp.hits[0][lane]), to_ids = shared_address(warp.ids) - words;
unsigned int hits = 0, ids = 0, next = 0, next_ids = 0;
auto advance = [&]() {  // to the next block, if nothing is left of this one; its bits are loaded ahead
    asm volatile("{.reg .pred empty; .reg .u32 below, bit;"
                 "setp.eq.u32 empty, %0, 0;"
                 "@empty mov.b32 %0, %1;"
                 "@empty mov.b32 %2, %3;"
                 "@empty sub.u32 below, %4, 1;"
                 "@empty lop3.b32 bit, below, %4, 0, 0x30;"
                 "@empty popc.b32 bit, bit;"
                 "@empty lop3.b32 %4, %4, below, %5, 0xea;"
                 "@empty mad.lo.u32 bit, bit, 128, %6;"
                 "@empty ld.shared.u32 %1, [bit];"
                 "@empty add.u32 %3, bit, %7;}"
                 : "+r"(hits), "+r"(next), "+r"(ids), "+r"(next_ids), "+r"(met_in)
                 : "r"(behind), "r"(words), "r"(to_ids) : "memory");
};
auto load_id = [](unsigned int at) {  // may be moved: nothing is written to where addresses lead
    int id;
    asm("ld.shared.u32 %0, [%1];" : "=r"(id) : "r"(at));
    return id;
};
"""

_WRITE_ROWS = (
    r"""
auto write_rows = [&](bool finished) {
    constexpr int TAKEN = 4;  // neighbors that a lane numbers at a time
    // behind the last block one of all n, which fill the rows up, or one that nobody has met
    const unsigned int behind = 1u << tested / 32;
    warp.hits[tested / 32][lane] = finished ? ALL : 0;
    if (finished)
        warp.ids[tested + lane] = fill_value;
    met_in |= behind;
    int written = (int)(warp.written[lane] & ~3u);
    unsigned int waiting = warp.written[lane] & 3;
    unsigned int* const list = warp.lists[lane];
    list[0] = shared_address(&warp.left[0][lane]) | shared_address(&warp.left[1][lane]) << 16;
#pragma unroll
    for (int k = 1; k < CHUNK / 2 + 2; ++k)  // what is read, whether it is written or not
        list[k] = shared_address(&warp.left[2][lane]) * 0x10001u;
    __syncwarp();
"""
    + HELD_PAIRS
    + r"""
    const unsigned int list_begin = shared_address(list), list_end = list_begin + 2 * CHUNK;
    const unsigned int last_ids = finished ? 1 : words + to_ids + 4 * tested;
    advance();
    for (bool more = true; more;) {
        // every lane numbers its next neighbors
        unsigned int list_at = list_begin + 2 * waiting;
        while (list_at < list_end && ids != last_ids) {
            advance();
            const unsigned int taken = __popc(hits) < TAKEN ? __popc(hits) : TAKEN;
#pragma unroll
            for (int k = 0; k < TAKEN; ++k) {
                const unsigned int below = hits - 1, address = ids + 4 * __popc(below & ~hits);
                hits &= below;
                asm volatile("st.shared.u16 [%0], %1;" : : "r"(list_at + 2 * k), "h"((unsigned short)address) : "memory");
            }
            list_at += 2 * taken;
        }
        waiting = (list_at - list_begin) / 2;
        // eight lanes write what waits for one row, and maybe more that will be written again
        const unsigned int ready = waiting >= CHUNK ? CHUNK : ids == last_ids ? waiting & ~3u : 0;
        const int before = lane < group && ready > 0 ? written : capacity;
        __syncwarp();
        auto row_of = [&](int k) { return k + lane / 8; };
        char* const column = (char*)(idx.data + lane % 8 * 4);
        const unsigned int row_bytes = 4u * (unsigned int)capacity;
        auto four_of = [&](int k) {
            const unsigned short* const from = (const unsigned short*)warp.lists[row_of(k)] + lane % 8 * 4;
            const int4 four = make_int4(load_id(from[0]), load_id(from[1]), load_id(from[2]), load_id(from[3]));
            if constexpr (IDS == 1)
                return make_int4(source_of(four.x), source_of(four.y), source_of(four.z), source_of(four.w));
            else
                return four;
        };
        auto out_of = [&](int k, int& room) {
            const unsigned int row_before = __shfl_sync(ALL, before, row_of(k)), row_id = __shfl_sync(ALL, my_id, row_of(k));
            room = capacity - lane % 8 * 4 - (int)row_before;
            return (int*)(column + (unsigned long long)row_id * row_bytes + (unsigned long long)row_before * 4);
        };
        if ((capacity & 3) == 0) {  // only then rows begin where 16 bytes may be stored at once
#pragma unroll
            for (int k = 0; k < 32; k += 4) {
                int room;
                int* const out = out_of(k, room);
                const int4 four = four_of(k);
                if (room > 0)
                    asm volatile("st.global.v4.s32 [%0], {%1, %2, %3, %4};"
                                 : : "l"(out), "r"(four.x), "r"(four.y), "r"(four.z), "r"(four.w) : "memory");
            }
        } else {
#pragma unroll 1
            for (int k = 0; k < 32; k += 4) {
                int room;
                int* const out = out_of(k, room);
                const int4 four = four_of(k);
                if (room > 0) out[0] = four.x;
                if (room > 1) out[1] = four.y;
                if (room > 2) out[2] = four.z;
                if (room > 3) out[3] = four.w;
            }
        }
        __syncwarp();
        written += ready;
        waiting -= ready;
        const unsigned int one = list[ready / 2], two = list[ready / 2 + 1];  // of up to three more
        list[0] = one;
        list[1] = two;
        more = __any_sync(ALL, finished ? lane < group && written < capacity : ids != last_ids);
    }
    if (!finished) {
        warp.written[lane] = (unsigned int)written | waiting;
        const int ids[3] = {load_word(list[0] & 0xffff), load_word(list[0] >> 16), load_word(list[1] & 0xffff)};
#pragma unroll
        for (int k = 0; k < 3; ++k)
            warp.left[k][lane] = ids[k];
    }
    met_in = 0;
};
"""
)

_NO_ROW = r"""
if (LIST)
    for (int s = lane; s < capacity; s += 32)
        idx.data[(long long)id * capacity + s] = fill_value;
if (lane == 0)
    count.data[id] = 0;
"""

_ROW_DONE = r"""
if (lane < group)
    count.data[my_id] = found;
const int longest_row = __reduce_max_sync(ALL, lane < group ? found : 0);
if (lane == 0 && longest_row > longest_before) {
    atomicMax(&info.data[0], longest_row);
    if (LIST && longest_row > capacity)
        atomicOr(&info.data[1], 1);
}
"""


def walk(*, opened: str = "", none: str, begun: str, settled: str, done: str = "", closed: str = "") -> str:
    """Return the text of a kernel in which a block of one warp serves its share of the queries, from `begin` on, in groups.

    Around it stand the pieces CELLS, LAYOUT and EXACT. Constants it needs: LIST, or SUMS, or neither, and the pairs are counted:
    `found`; LATER, EXACTLY, CROSSING. With SUMS candidates are images of places in `sorted`, not of sources.

    Args:
        opened: Comes before the queries from `place` to `stop`; they may be none.
        none: What is done with a query, `id`, that is not finite.
        begun: Of a group, of which `my_id`, its first `place` and its size, `group`, are known: defines what `settled` calls.
        settled: What is done with the pairs that are held: those of blocks of candidates below `tested`, whose ids stand in
            `warp.ids`, and bits in `warp.hits`; `met_in` says in which. `finished`: they are the last ones of the group.
        done: After the last ones.
        closed: After the last group.
    """
    return _WALK.substitute(opened=opened, none=none, begun=begun, settled=settled, done=done, closed=closed)


_ROWS = walk(none=_NO_ROW, begun=_WRITE_ROWS, settled="write_rows(finished);", done=_ROW_DONE)


class Launch(NamedTuple):
    """A kernel, its threads in all and per block, and its last argument: whether it works on the queries.

    One that may run `beside` the launch before it needs nothing that this one computes.
    """

    kernel: wp.Kernel
    threads: int
    block: int
    of_queries: bool
    beside: bool = False


class Kernels(NamedTuple):
    """The kernels of a variant, all with the same arguments."""

    bounds: wp.Kernel
    lay_out: wp.Kernel
    count: wp.Kernel
    scan: wp.Kernel
    scatter: wp.Kernel
    gather: wp.Kernel
    query: wp.Kernel
    crossing: wp.Kernel | None

    def launches(self, n: int, m: int, own: bool, table: int | None = None) -> list[Launch]:
        """Return what is launched, in order, for n sources and m queries."""
        return self.stages(n, m, own, table) + walks(self.query, self.crossing, m)

    def stages(self, n: int, m: int, own: bool, table: int | None = None) -> list[Launch]:
        """Return those that sort sources and queries by cell."""
        table = table_cells(n) if table is None else table
        tiles = min((table + 1) // _TILE + 1, _RESIDENT)
        clearing = min(-(-table // (8 * BLOCK)), _RESIDENT) * BLOCK
        launches = [Launch(self.bounds, _PARTS * BLOCK, BLOCK, False), Launch(self.lay_out, clearing, BLOCK, False)]
        for of_queries in (False,) if own else (False, True):
            size = m if of_queries else n
            sweep = min(-(-size // BLOCK), _SWEEP_BLOCKS) * BLOCK
            launches += [
                Launch(self.count, sweep, BLOCK, of_queries),
                Launch(self.scan, tiles * BLOCK, BLOCK, of_queries),
                Launch(self.scatter, sweep, BLOCK, of_queries),
            ]
            if not of_queries or self.crossing is not None:
                most = _RESIDENT * _GATHERING[self.crossing is not None]
                launches.append(Launch(self.gather, min(-(-size // BLOCK), most) * BLOCK, BLOCK, of_queries))
        return launches

    def load_stages(self, device: wp.DeviceLike) -> None:
        """Compile and load what sorts: nothing is left to do while a CUDA graph is recorded."""
        load_module(self.bounds.module, device, BLOCK)

    def load(self, device: wp.DeviceLike) -> None:
        """Compile and load all."""
        self.load_stages(device)
        load_walks(self.query, self.crossing, device)


def share_bits(m: int) -> int:
    """Return the binary logarithm of how many of m queries a warp serves: fewer than 32 while warps are few."""
    return next((bits for bits in range(5) if _shares(m, bits) <= GRID["WARPS"]), 5)


def query_blocks(m: int) -> int:
    """Return how many warps m queries are shared among."""
    return _shares(m, share_bits(m))


def _shares(m: int, bits: int) -> int:
    return -(-m >> bits)


def walks(query: wp.Kernel, crossing: wp.Kernel | None, m: int) -> list[Launch]:
    """Return the launches that walk over m queries: those whose reach leaves a periodic box have a kernel of their own."""
    threads = query_blocks(m) * QUERY_BLOCK
    if crossing is None:
        return [Launch(query, threads, QUERY_BLOCK, False)]
    first = Launch(crossing, min(threads, _CROSSING_BLOCKS * QUERY_BLOCK), QUERY_BLOCK, False)  # what takes longest
    return [first, Launch(query, threads, QUERY_BLOCK, False, beside=True)]


def load_walks(query: wp.Kernel, crossing: wp.Kernel | None, device: wp.DeviceLike) -> None:
    """Compile and load what walks over queries."""
    for kernel in (query, crossing):
        if kernel is not None:
            load_module(kernel.module, device, QUERY_BLOCK)


@functools.cache
def cell_kernels(
    dim: int,
    double: bool,
    scaled: bool,
    lists: bool,
    later: bool = False,
    exact: bool = True,
    reach: int = GRID["REACH"],
    reach_x: int = GRID["REACH_X"],
    blocks: int | None = None,
    order: int = 0,
    periodic: int = 0,
    batched: bool = False,
) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts, half lists or whole.

    The rest is there to be measured. exact=False lets the working precision decide alone (`|d|^2 < r^2 (1 - 8 eps)`); `reach` is
    the number of cell edges in a cutoff along y and z, `reach_x` along x; `blocks` per multiprocessor bound the registers; `order`
    of the cells: 0 row-major, 1 Morton, 2 Hilbert. `periodic` and `batched` are those of
    `jfrnn.kernels._native.snippet`.
    """
    blocks = blocks or (24 if not lists else 16 if double else 20)  # registers against occupancy, measured on an H200
    kind = f"{dim}d_{'f64' if double else 'f32'}_r{reach}x{reach_x}{('', '_morton', '_hilbert')[order]}"
    kind += SPACES[periodic] + "_batched" * batched
    variant = f"{kind}{'_scaled' * scaled}{'_list' * lists}{'_later' * later}{'' if exact else '_inexact'}"
    grid = {**GRID, "REACH": reach, "REACH_X": reach_x, "ORDER": order, "PERIODIC": periodic, "BATCHED": batched}
    query = {"SCALED": scaled, "LIST": lists, "SUMS": 0, "LATER": later, "EXACTLY": exact}
    query |= grid

    def query_kernel(name: str, crossing: bool = False) -> wp.Kernel:
        module, kind = f"{name}_{variant}_b{blocks}", {"CROSSING": crossing, "SHIFTED": periodic if crossing else 0}
        return _kernel(module, module, dim, double, QUERY_BLOCK, blocks, query | kind, EXACT, _ROWS)

    return Kernels(
        _kernel(f"bounds_{kind}", kind, dim, double, BLOCK, 1, grid, _REDUCE, _BOUNDS),
        _kernel(f"lay_out_{kind}", kind, dim, double, BLOCK, 1, grid, _REDUCE, _LAY_OUT),
        _kernel(f"count_{kind}", kind, dim, double, BLOCK, 1, grid, _COUNT),
        _kernel(f"scan_{kind}", kind, dim, double, BLOCK, 1, grid, _SCAN),
        _kernel(f"scatter_{kind}", kind, dim, double, BLOCK, 1, grid, _SCATTER),
        _kernel(f"gather_{kind}", kind, dim, double, BLOCK, _GATHERING[periodic > 0], grid, _GATHER),
        query_kernel("query"),
        query_kernel("crossing", crossing=True) if periodic else None,
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
    function = wp.func_native(snippet("double" if double else "float", dim, CELLS, LAYOUT, *pieces, **constants))(native)

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
