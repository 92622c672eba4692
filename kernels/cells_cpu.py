"""Cell search on the CPU: a serial counting sort, then queries on every core, 8 or 16 candidates at a time.

`build` sorts the sources (and the queries, if they are others) by cell. `query` is launched once per thread: the threads hand
themselves chunks of places from an atomic counter. The sources around a cell are copied once into the first-level cache, as a
structure of arrays, and serve all queries of that cell.
"""

import functools
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._native import CELLS, ENTER, EXACT, LEAVE, snippet, table_cells

_HEADER_WORDS = 64

# Where things lie in the scratch: one text, so that `build` and `query` agree; `scratch_words` below is its sum.
_LAYOUT = r"""
struct Shared {
    Grid grid;
    int finite_queries;
    int next_chunk;
};
constexpr int WIDTH = DOUBLE ? 2 : 1;
auto up = [](long long words) { return (words + 15) & ~15ll; };
int* cursor = scratch.data;
auto take = [&](long long words) { int* here = cursor; cursor += up(words); return here; };
Shared& shared = *(Shared*)take(64);
real* axis[3];
for (int k = 0; k < DIM; ++k)
    axis[k] = (real*)take(WIDTH * (long long)n);
int* ids = take(n);
int* start = take(table + 2);
int* key = take(n > m ? n : m);
int* query_ids = own ? ids : take(m);
int* query_start = own ? start : take(table + 2);
"""


def scratch_words(sources: int, queries: int, dim: int, width: int, own: bool) -> int:
    """Return the int32 words of scratch that `build` and `query` need; `width` is 1 for float32 and 2 for float64."""
    table = table_cells(sources)
    parts = [_HEADER_WORDS, *[width * sources] * dim, sources, table + 2, max(sources, queries)]
    if not own:
        parts += [queries, table + 2]
    return sum((words + 15) // 16 * 16 for words in parts)


_BUILD = r"""
real low[3], high[3];
for (int k = 0; k < DIM; ++k) {
    low[k] = __builtin_inff();
    high[k] = -__builtin_inff();
}
int finite = 0;
const bool bounded = periodic_axes == (1 << DIM) - 1;  // the cells are those of the box, wherever the particles are
for (int i = 0; i < n && !bounded; ++i) {
    real p[3], at[3];
    point_of(positions.data + (long long)ROW * i, p);
    if (!finite_point(p))
        continue;
    ++finite;
    for (int k = 0; k < DIM; ++k)
        at[k] = coordinate(k, p);
    widen(low, high, at, at);
}
if (finite == 0)
    for (int k = 0; k < DIM; ++k)
        low[k] = high[k] = 0;
Grid grid;
lay_out(grid, low, high, table);
shared.next_chunk = 0;
info.data[0] = 0;

auto sort = [&](const real* points, int count, int* first, int* order, bool with_axes) {
    for (int c = 0; c < grid.cells + 2; ++c)
        first[c] = 0;
    int outside = 0;
    for (int i = 0; i < count; ++i) {
        real p[3];
        point_of(points + (long long)ROW * i, p);
        int cell = -1;
        if (finite_point(p))
            cell = cell_key(grid, p, system_of(points + (long long)ROW * i));
        else
            ++outside;
        key[i] = cell;
        if (cell >= 0)
            ++first[cell + 2];
    }
    for (int c = 2; c < grid.cells + 2; ++c)
        first[c] += first[c - 1];
    int behind = count - outside;
    for (int i = 0; i < count; ++i) {
        const int place = key[i] >= 0 ? first[key[i] + 1]++ : behind++;
        order[place] = i;
        if (with_axes) {
            real p[3];
            point_of(points + (long long)ROW * i, p);
            for (int k = 0; k < DIM; ++k)
                axis[k][place] = p[k];
        }
    }
    return count - outside;
};
grid.finite = sort(positions.data, n, start, ids, true);
shared.grid = grid;
shared.finite_queries = own ? grid.finite : sort(queries.data, m, query_start, query_ids, false);
info.data[1] = grid.finite < n || shared.finite_queries < m ? 2 : 0;
"""

_QUERY = r"""
#if defined(__AVX512F__) && defined(__AVX512VL__)
constexpr int LANES = DOUBLE ? 8 : 16;
#else
constexpr int LANES = DOUBLE ? 4 : 8;
#endif
constexpr int CANDIDATES = DOUBLE ? 1024 : 1536;  // what fits into a first-level cache beside a row
constexpr int ROWS = 64;
constexpr int CHUNK = 2048;
typedef real vec __attribute__((vector_size(LANES * sizeof(real))));
typedef int ints __attribute__((vector_size(LANES * 4)));
typedef int eight_ints __attribute__((vector_size(32)));
typedef bool flags __attribute__((ext_vector_type(LANES)));
alignas(64) real candidate[3][CANDIDATES + LANES];
alignas(64) int candidate_ids[CANDIDATES + LANES];
alignas(64) int row[CANDIDATES + LANES];
alignas(64) real doubtful[3][CANDIDATES + LANES];
alignas(64) unsigned short unsure[CANDIDATES / LANES + 4];  // one bit per candidate that step 1 leaves open
alignas(64) int doubtful_ids[CANDIDATES + LANES];
alignas(64) int candidate_images[PERIODIC ? CANDIDATES + LANES : 1];  // their codes
alignas(64) int doubtful_images[PERIODIC ? CANDIDATES + LANES : 1];
alignas(64) int candidate_order[PERIODIC == 2 ? CANDIDATES + LANES : 1];  // by source, then by image: behind, at home, ahead
const Grid grid = shared.grid;
const int places = m, finite_places = shared.finite_queries;
int longest = 0;

int image = 0;  // that candidates are copied from, its code
bool several = false;  // images among them: each says which one it is of
struct Below { enum { value = 17 }; };
struct BelowOrAt { enum { value = 18 }; };
auto mask_of = [](vec a, real bound, auto comparison) -> unsigned int {  // one bit per lane
#if defined(__AVX512F__) && defined(__AVX512VL__)
    typedef float floats __attribute__((vector_size(64)));
    typedef double doubles __attribute__((vector_size(64)));
    const vec bounds = vec{} + bound;
    if constexpr (DOUBLE)
        return (unsigned char)__builtin_ia32_cmppd512_mask((doubles)a, (doubles)bounds, comparison.value, -1, 4);
    else
        return (unsigned short)__builtin_ia32_cmpps512_mask((floats)a, (floats)bounds, comparison.value, -1, 4);
#else
    const auto lanes = comparison.value == 18 ? a <= bound : a < bound;
    const flags f = __builtin_convertvector(lanes, flags);
    unsigned char bits;
    __builtin_memcpy(&bits, &f, 1);
    return LANES == 4 ? bits & 15 : bits;
#endif
};
auto later_mask = [&](int b, int own_id) -> unsigned int {  // candidates whose id is above the query's, or its own id
    const ints ids = *(const ints*)((PERIODIC == 2 ? candidate_order : candidate_ids) + b);
    const int first = PERIODIC == 2 ? 3 * own_id + 1 + drop_self : own_id + drop_self;
    const flags f = __builtin_convertvector(ids >= first, flags);
    unsigned short bits = 0;
    __builtin_memcpy(&bits, &f, LANES == 16 ? 2 : 1);
    return bits;
};
auto square_of = [&](const real* q, int b) -> vec {
    vec square;
    for (int k = 0; k < DIM; ++k) {
        vec d = *(const vec*)(candidate[k] + b) - q[k];
        if constexpr (SCALED)
            d *= step_scale;
#if defined(__FMA__)
        square = k == 0 ? d * d : __builtin_elementwise_fma(d, d, square);
#else
        square = k == 0 ? d * d : square + d * d;
#endif
    }
    return square;
};
// stores the lanes of a mask one after the other; up to LANES elements at `to` are overwritten
auto pack = [&](const auto* from, auto* to, unsigned int mask) {
#if defined(__AVX512F__) && defined(__AVX512VL__)
    typedef int ints8 __attribute__((vector_size(32)));
    typedef int ints16 __attribute__((vector_size(64)));
    typedef double doubles8 __attribute__((vector_size(64)));
    if constexpr (sizeof(*from) == 8) {
        const doubles8 packed = __builtin_ia32_compressdf512_mask(*(const doubles8*)from, doubles8{}, mask);
        __builtin_memcpy(to, &packed, 64);
    } else if constexpr (LANES == 8) {
        const ints8 packed = __builtin_ia32_compresssi256_mask(*(const ints8*)from, ints8{}, mask);
        __builtin_memcpy(to, &packed, 32);
    } else {
        const ints16 packed = __builtin_ia32_compresssi512_mask(*(const ints16*)from, ints16{}, mask);
        __builtin_memcpy(to, &packed, 64);
    }
#else
    for (; mask; mask &= mask - 1)
        *to++ = from[__builtin_ctz(mask)];
#endif
};
const real off = PERIODIC ? 2 * lattice.slack() * step_scale : real(0);  // by which distances of images may be wrong
const real inner = step_radius > off ? step_radius - off : real(0), outer = step_radius + off;
const real band = 8 * (1 + PERIODIC) * step_eps, inside = inner * inner * (1 - band), outside = outer * outer * (1 + band);
const double doubly_inside = Exact::doubly_inside(radius), doubly_outside = Exact::doubly_outside(radius);
typedef float floats __attribute__((vector_size(32)));
typedef double doubles __attribute__((vector_size(64)));
typedef bool flags8 __attribute__((ext_vector_type(8)));
auto bits_of_lanes = [](auto lanes) -> unsigned int {
    const flags8 f = __builtin_convertvector(lanes, flags8);
    unsigned char bits;
    __builtin_memcpy(&bits, &f, 1);
    return bits;
};
// candidates of one query among `count` copied ones: how many are pairs, their ids in `row`
auto scan = [&](const real* q, int own_id, int count, auto only_later) -> int {
    int hits = 0;
    auto later = [&](int b) -> unsigned int {
        return only_later.value ? later_mask(b, own_id) : ~0u;
    };
    for (int b = 0, v = 0; b < count; b += LANES, ++v) {
        const vec square = square_of(q, b);
        const unsigned int allowed = later(b);
        const unsigned int hit = mask_of(square, inside, Below{}) & allowed;
        if constexpr (EXACTLY)
            unsure[v] = hit ^ (mask_of(square, outside, BelowOrAt{}) & allowed);
        if constexpr (LIST)
            pack(candidate_ids + b, row + hits, hit);
        hits += __builtin_popcount(hit);
    }
    if constexpr (!EXACTLY)
        return hits;
    const int vectors = (count + LANES - 1) / LANES;
    for (int e = vectors; e < vectors + 3; ++e)
        unsure[e] = 0;
    int doubts = 0;
    for (int v = 0; v < vectors; v += 4) {
        unsigned long long four;
        for (__builtin_memcpy(&four, unsure + v, 8); four;) {
            const int e = __builtin_ctzll(four) / 16, b = (v + e) * LANES;
            const unsigned int mask = (four >> (16 * e)) & 0xffff;
            four &= ~(0xffffull << (16 * e));
            if constexpr (PERIODIC) {
                if (several)
                    pack(candidate_images + b, doubtful_images + doubts, mask);
            } else
                for (int k = 0; k < DIM; ++k)
                    pack(candidate[k] + b, doubtful[k] + doubts, mask);
            pack(candidate_ids + b, doubtful_ids + doubts, mask);
            doubts += __builtin_popcount(mask);
        }
    }
    for (int b = 0; b < doubts; b += 8) {
        unsigned int left = doubts - b < 8 ? (1u << (doubts - b)) - 1 : 255;
        if constexpr (!DOUBLE && !PERIODIC) {  // in twice the precision, eight at a time
            doubles square;
            for (int k = 0; k < DIM; ++k) {
                const doubles d = __builtin_convertvector(*(const floats*)(doubtful[k] + b), doubles) - (double)q[k];
                square = k == 0 ? d * d : square + d * d;
            }
            unsigned int pairs = left & bits_of_lanes(square < doubly_inside);
            left &= ~pairs & bits_of_lanes(square <= doubly_outside);
            for (; pairs; pairs &= pairs - 1)
                row[hits++] = doubtful_ids[b + __builtin_ctz(pairs)];
        }
        for (; left; left &= left - 1) {
            const int c = b + __builtin_ctz(left);
            if constexpr (PERIODIC) {
                const int id = doubtful_ids[c];
                const real* source = positions.data + (long long)ROW * (PERIODIC == 2 ? id % n : id);
                if (exact_image(queries.data + (long long)ROW * own_id, source, several ? doubtful_images[c] : image))
                    row[hits++] = id;
                continue;
            }
            real p[3];
            for (int k = 0; k < DIM; ++k)
                p[k] = doubtful[k][c];
            if (exact_pair(q, p))
                row[hits++] = doubtful_ids[c];
        }
    }
    return hits;
};
struct All { enum { value = 0 }; };
struct Later { enum { value = 1 }; };

int codes = 1;  // of images
for (int k = 0; PERIODIC == 2 && k < DIM; ++k)
    codes *= 2 * lattice.images(k) + 1;
const int fill_value = n * codes;
// writes slots [from, until) of a row, from `row` while it lasts, then the fill value
auto write_row = [&](int id, int from, int hits, bool last) {
    int* out = idx.data + (long long)id * capacity;
    const int stop = from + hits < capacity ? from + hits : capacity;
    if (from == 0 && last && (capacity & 7) == 0 && ((unsigned long long)idx.data & 31) == 0) {
        const eight_ints filled_up = eight_ints{} + fill_value;
        int s = 0;
        for (; s + 8 <= stop; s += 8)
            __builtin_nontemporal_store(*(const eight_ints*)(row + s), (eight_ints*)(out + s));
        if (s < stop) {
            eight_ints mixed = *(const eight_ints*)(row + s);
            for (int e = 0; e < 8; ++e)
                mixed[e] = s + e < stop ? mixed[e] : fill_value;
            __builtin_nontemporal_store(mixed, (eight_ints*)(out + s));
            s += 8;
        }
        for (; s < capacity; s += 8)
            __builtin_nontemporal_store(filled_up, (eight_ints*)(out + s));
        return;
    }
    for (int s = from; s < stop; ++s)
        out[s] = row[s - from];
    if (last)
        for (int s = stop; s < capacity; ++s)
            out[s] = fill_value;
};

auto position_of = [&](int place, real* q) {
    if (own)
        for (int k = 0; k < DIM; ++k)
            q[k] = axis[k][place];
    else
        point_of(queries.data + (long long)ROW * query_ids[place], q);
};
auto system_at = [&](int place) { return BATCHED ? system_of(queries.data + (long long)ROW * query_ids[place]) : 0u; };
// where the query at a place is along the axes, and its cell
auto locate = [&](int place, real* at, whole* cell) {
    real q[3];
    position_of(place, q);
    for (int k = 0; k < DIM; ++k) {
        at[k] = coordinate(k, q);
        cell[k] = axis_cell(grid, k, at[k]);
    }
    cell[DIM] = (whole)system_at(place);
};

// all queries of one cell: places [begin, end), whose coordinates are between low and high
auto serve = [&](int begin, int end, const real* low, const real* high) {
    whole first[3] = {0, 0, 0}, last[3] = {0, 0, 0};
    for (int k = 0; k < DIM; ++k) {
        if (is_periodic(k)) {
            first[k] = (whole)cell_of(k, low[k] - reach_along(k));
            last[k] = (whole)cell_of(k, high[k] + reach_along(k));
            continue;
        }
        first[k] = axis_cell(grid, k, low[k] - reach_along(k));
        last[k] = axis_cell(grid, k, high[k] + reach_along(k));
        if (grid.dense) {
            first[k] = first[k] < 0 ? 0 : first[k];
            last[k] = last[k] >= grid.extent[k] ? grid.extent[k] - 1 : last[k];
        }
    }
    const unsigned int system = system_at(begin);
    int filled = 0, own_from = 0, own_to = 0, own_at = 0;
    bool fresh = true;
    auto flush = [&](bool finished) {
        for (int e = 0; e < LANES; ++e)
            for (int k = 0; k < DIM; ++k)
                candidate[k][filled + e] = __builtin_nanf("");
        for (int place = begin; place < end; ++place) {
            real q[3];
            position_of(place, q);
            const int id = query_ids[place];
            const int self = drop_self && place >= own_from && place < own_to ? own_at + place - own_from : -1;
            if (self >= 0)
                candidate[0][self] = __builtin_nanf("");
            const int before = fresh ? 0 : count.data[id];
            const int hits = later_only ? scan(q, id, filled, Later{}) : scan(q, id, filled, All{});
            if (self >= 0)
                candidate[0][self] = q[0];
            if constexpr (LIST)
                write_row(id, before, hits, finished);
            count.data[id] = before + hits;
            longest = before + hits > longest ? before + hits : longest;
        }
        fresh = false;
        filled = own_from = own_to = 0;
    };
    int side = 0;  // whether the image lies behind (-1), at home, or ahead
    real moved[3] = {0, 0, 0};
    auto copy = [&](int from, int to) {  // sources at places [from, to)
        while (from < to) {
            if (filled == CANDIDATES)
                flush(false);
            const int room = CANDIDATES - filled, size = to - from < room ? to - from : room;
            for (int k = 0; k < DIM; ++k)
                for (int s = 0; s < size; ++s)
                    candidate[k][filled + s] = PERIODIC ? axis[k][from + s] + moved[k] : axis[k][from + s];
            for (int s = 0; s < size; ++s)
                candidate_ids[filled + s] = PERIODIC == 2 ? ids[from + s] + n * image : ids[from + s];
            for (int s = 0; BATCHED && !grid.dense && s < size; ++s)
                if (system_of(positions.data + (long long)ROW * ids[from + s]) != system)
                    candidate[0][filled + s] = __builtin_nanf("");
            if (const int code = image; PERIODIC && several)
                for (int s = 0; s < size; ++s)
                    candidate_images[filled + s] = code;
            for (int s = 0; PERIODIC == 2 && s < size; ++s)
                candidate_order[filled + s] = 3 * ids[from + s] + 1 + side;
            const int low_place = from > begin ? from : begin, high_place = from + size < end ? from + size : end;
            if (own && side == 0 && low_place < high_place) {
                own_from = low_place;
                own_to = high_place;
                own_at = filled + low_place - from;
            }
            filled += size;
            from += size;
        }
    };
    auto walk = [&](const whole* first, const whole* last) {  // all rows of cells of one image
        const int length = (int)(last[0] - first[0] + 1);
        int seen[ROWS], rows = 0;
        for (whole z = first[2]; z <= last[2] && length > 0; ++z)
            for (whole y = first[1]; y <= last[1]; ++y) {
                if (grid.dense) {
                    const int row = row_start(grid, y, z, system);
                    copy(start[row + first[0]], start[row + last[0] + 1]);
                    continue;
                }
                const int begins = ring(row_start(grid, y, z, system) + ring(first[0], grid.cells), grid.cells);
                int front = 0, back = 0;  // entries shared with rows that were copied before
                for (int r = 0; r < rows; ++r) {
                    const int behind = ring(begins - seen[r], grid.cells), ahead = grid.cells - behind;
                    if (behind < length)
                        front = length - behind > front ? length - behind : front;
                    else if (ahead < length)
                        back = length - ahead > back ? length - ahead : back;
                }
                seen[rows++] = begins;
                const int size = length - front - back, from = ring(begins + front, grid.cells);
                if (size <= 0)
                    continue;
                if (from + size <= grid.cells)
                    copy(start[from], start[from + size]);
                else {
                    copy(start[from], start[grid.cells]);
                    copy(start[0], start[from + size - grid.cells]);
                }
            }
    };
    if constexpr (PERIODIC) {
        several = false;
        for (int k = 0; k < DIM; ++k)
            several = several || (is_periodic(k) && (first[k] < 0 || last[k] >= (whole)inverse_edge[k]));
        int from[3] = {0, 0, 0}, to[3] = {0, 0, 0};
        for (int k = 0; several && k < DIM; ++k)
            if (is_periodic(k)) {
                const int most = lattice.images(k);  // rounded up, a query may reach an image that nobody can
                from[k] = period_of(k, first[k]) < -most ? -most : period_of(k, first[k]);
                to[k] = period_of(k, last[k]) > most ? most : period_of(k, last[k]);
            }
        for (int x = from[0]; x <= to[0]; ++x)
            for (int y = from[1]; y <= to[1]; ++y)
                for (int z = from[2]; z <= to[2]; ++z) {
                    const int shift[3] = {x, y, z};
                    whole begins[3] = {0, 0, 0}, ends[3] = {0, 0, 0};
                    image = 0;
                    for (int k = 0; k < DIM; ++k) {
                        const whole cells = (whole)inverse_edge[k], skipped = is_periodic(k) ? shift[k] * cells : 0;
                        begins[k] = first[k] - skipped;
                        ends[k] = last[k] - skipped;
                        if (is_periodic(k)) {
                            begins[k] = begins[k] < 0 ? 0 : begins[k];
                            ends[k] = ends[k] < cells ? ends[k] : cells - 1;
                        }
                        moved[k] = lattice.translation(x, y, z, k);
                        image = image * (2 * lattice.images(k) + 1) + shift[k] + lattice.images(k);
                    }
                    const int lead = x ? x : y ? y : z;
                    side = (lead > 0) - (lead < 0);
                    walk(begins, ends);
                }
    } else
        walk(first, last);
    flush(true);
};

for (;;) {
    const int chunk = __atomic_fetch_add(&shared.next_chunk, 1, __ATOMIC_RELAXED);
    if ((long long)chunk * CHUNK >= places)
        break;
    int place = chunk * CHUNK;
    const int chunk_end = places - place < CHUNK ? places : place + CHUNK;
    whole cell[4], other[4];
    real at[3];
    auto same_cell = [&](const whole* a, const whole* b) {
        bool same = true;
        for (int k = 0; k < DIM + BATCHED; ++k)
            same = same && a[k] == b[k];
        return same;
    };
    if (place > 0 && place < finite_places) {  // a cell belongs to the chunk that holds its first place
        locate(place - 1, at, cell);
        for (; place < finite_places; ++place) {
            locate(place, at, other);
            if (!same_cell(cell, other))
                break;
        }
    }
    if (place < finite_places)
        locate(place, at, other);
    while (place < chunk_end) {
        if (place >= finite_places) {
            const int id = query_ids[place++];
            count.data[id] = 0;
            if constexpr (LIST)
                write_row(id, 0, 0, true);
            continue;
        }
        real low[3], high[3];  // `other` and `at` are those of the first place
        for (int k = 0; k < DIM; ++k)
            low[k] = high[k] = at[k];
        for (int k = 0; k < DIM + BATCHED; ++k)
            cell[k] = other[k];
        int end = place + 1;
        for (; end < finite_places; ++end) {
            locate(end, at, other);
            if (!same_cell(cell, other))
                break;
            widen(low, high, at, at);
        }
        serve(place, end, low, high);
        place = end;
    }
}
int known = __atomic_load_n(&info.data[0], __ATOMIC_RELAXED);
while (known < longest && !__atomic_compare_exchange_n(&info.data[0], &known, longest, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
}
if (LIST && longest > capacity)
    __atomic_fetch_or(&info.data[1], 1, __ATOMIC_RELAXED);
"""


class Kernels(NamedTuple):
    """The two kernels of a variant, both launched with dim = 1 (`query` once per thread)."""

    build: wp.Kernel
    query: wp.Kernel


@functools.cache
def cell_kernels(
    dim: int, double: bool, scaled: bool, lists: bool, periodic: int = 0, batched: bool = False, exact: bool = True
) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts alone.

    `periodic` and `batched` are those of `jfrnn.kernels._native.snippet`.

    With exact=False the working precision alone decides (`|d|^2 < r^2 (1 - 8 eps)`): only to measure what exactness costs.
    """
    scalar = wp.float64 if double else wp.float32
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_list' * lists}"
    variant += f"{('', '_nearest', '_images')[periodic]}{'_batched' * batched}{'' if exact else '_inexact'}"
    options = {"SCALED": scaled, "LIST": lists, "REACH": 1, "REACH_X": 1, "EXACTLY": exact, "PERIODIC": periodic}
    options |= {"BATCHED": batched}
    points = wp.array2d(dtype=scalar)
    reals, ints, rows = wp.array(dtype=scalar), wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)

    def build_native(
        positions: points, queries: points, cutoff: reals, info: ints, scratch: ints, n: int, m: int, own: int, table: int
    ): ...

    def query_native(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, later_only: int,
    ): ...  # fmt: skip

    for native in (build_native, query_native):
        native.__name__ = native.__qualname__ = f"{native.__name__}_{variant}"
    native_text = functools.partial(snippet, "double" if double else "float", dim, CELLS, _LAYOUT, **options)
    build_function = wp.func_native(ENTER + native_text(_BUILD) + LEAVE)(build_native)
    query_function = wp.func_native(ENTER + native_text(EXACT, _QUERY) + LEAVE)(query_native)

    def build(positions: points, queries: points, cutoff: reals, info: ints, scratch: ints, n: int, m: int, own: int, table: int):
        build_function(positions, queries, cutoff, info, scratch, n, m, own, table)

    def query(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, later_only: int,
    ):  # fmt: skip
        query_function(
            positions, queries, cutoff, idx, count, info, scratch, n, m, own, table, capacity, closed, drop_self, later_only
        )

    module = wp.get_module(f"jfrnn.kernels.cells_cpu.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    return Kernels(wp.kernel(build, module=module), wp.kernel(query, module=module))
