"""Cell search on the CPU: a serial counting sort, then queries on every core, 8 or 16 candidates at a time.

`build` sorts the sources (and the queries, if they are others) by cell. `gather` puts the coordinates of many sources into that
order: to read them from anywhere takes longer than all that `build` does. It and `query` are launched once per thread: the threads
hand themselves chunks of places from an atomic counter (see `jfrnn.kernels._walk_cpu`).
"""

import functools
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._native import CELLS, ENTER, EXACT, LEAVE, SPACES, snippet, table_cells
from jfrnn.kernels._walk_cpu import CHUNK, walk

_HEADER_WORDS = 64
MANY = 1 << 15  # sources from which several threads gather their coordinates
GRID = {"REACH": 1, "REACH_X": 2}  # finer cells along x alone: fewer candidates, but no more rows of cells that are copied

# Where things lie in the scratch: one text, so that `build` and `query` agree; `scratch_words` below is its sum.
LAYOUT = r"""
struct Shared {
    Grid grid;
    int finite_queries;
    int next_chunk;
    int next_gathered, next_sorted;  // chunks of sources whose coordinates and values are put in order
    real unit;  // of the lattice on which all coordinates lie, or 0
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
shared.next_gathered = shared.next_sorted = 0;
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
        if (with_axes && n < MANY) {
            real p[3];
            point_of(points + (long long)ROW * i, p);
            for (int k = 0; k < DIM; ++k)
                axis[k][place] = p[k];
        }
    }
    return count - outside;
};
// whatever lies on no lattice shows soon
int lowest = 1 << 20, highest = 0;
const int too_low = Bits::exponent(radius) - Bits::BIAS - UNITS;
auto look_for_lattice = [&](const real* points, int count) {
    for (int i = 0; i < count && lowest >= too_low; ++i) {
        const real* row = points + (long long)ROW * i;
        if (!finite_point(row))
            continue;
        for (int k = 0; k < DIM; ++k) {
            const int low_bit = lowest_bit(row[k]), exponent = Bits::exponent(row[k]);
            lowest = low_bit < lowest ? low_bit : lowest;
            highest = exponent > highest ? exponent : highest;
        }
    }
};
look_for_lattice(positions.data, n);
if (!own)
    look_for_lattice(queries.data, m);
shared.unit = lattice_unit(lowest, highest);
grid.finite = sort(positions.data, n, start, ids, true);
shared.grid = grid;
shared.finite_queries = own ? grid.finite : sort(queries.data, m, query_start, query_ids, false);
info.data[1] = grid.finite < n || shared.finite_queries < m ? 2 : 0;
"""

_GATHER = r"""
for (;;) {
    const int chunk = __atomic_fetch_add(&shared.next_gathered, 1, __ATOMIC_RELAXED);
    if ((long long)chunk * CHUNK >= n)
        break;
    const int begin = chunk * CHUNK, end = n - begin < CHUNK ? n : begin + CHUNK;
    for (int place = begin; place < end; ++place) {
        constexpr int AHEAD = 16;  // places, whose rows are on their way
        __builtin_prefetch(positions.data + (long long)ROW * ids[place + AHEAD < n ? place + AHEAD : place]);
        real p[3];
        point_of(positions.data + (long long)ROW * ids[place], p);
        for (int k = 0; k < DIM; ++k)
            axis[k][place] = p[k];
    }
}
"""

_BEGIN_ROWS = r"""
int longest = 0;
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

"""
_ADD_TO_ROW = r"""
            const int before = fresh ? 0 : count.data[id];
            if constexpr (LIST)
                write_row(id, before, hits, finished);
            count.data[id] = before + hits;
            longest = before + hits > longest ? before + hits : longest;
"""
_NO_ROW = r"""
            count.data[id] = 0;
            if constexpr (LIST)
                write_row(id, 0, 0, true);
"""
_END_ROWS = r"""
int known = __atomic_load_n(&info.data[0], __ATOMIC_RELAXED);
while (known < longest && !__atomic_compare_exchange_n(&info.data[0], &known, longest, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
}
if (LIST && longest > capacity)
    __atomic_fetch_or(&info.data[1], 1, __ATOMIC_RELAXED);
"""

_QUERY = walk(
    begin=_BEGIN_ROWS,
    meet="const int hits = later_only ? scan(q, id, filled, Later{}) : scan(q, id, filled, All{});",
    met=_ADD_TO_ROW,
    none=_NO_ROW,
    end=_END_ROWS,
)


class Kernels(NamedTuple):
    """The kernels of a variant, all launched with dim = 1: `gather`, for `MANY` sources, and `query` once per thread."""

    build: wp.Kernel
    gather: wp.Kernel
    query: wp.Kernel


@functools.cache
def cell_kernels(
    dim: int, double: bool, scaled: bool, lists: bool, periodic: int = 0, batched: bool = False, exact: bool = True
) -> Kernels:
    """Return the kernels for a dimension and dtype, for cutoffs that need scaling or not, for lists or counts alone.

    `periodic` and `batched` are those of `jfrnn.kernels._native.snippet`.

    With exact=False the working precision alone decides (`|d|^2 < r^2 (1 - 4 eps)`): only to measure what exactness costs.
    """
    scalar = wp.float64 if double else wp.float32
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_list' * lists}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}{'' if exact else '_inexact'}"
    options = {"SCALED": scaled, "LIST": lists, **GRID, "EXACTLY": exact, "PERIODIC": periodic}
    options |= {"BATCHED": batched, "SUMS": 0, "CHUNK": CHUNK, "MANY": MANY}
    options |= {"CANDIDATES": 1024 if double else 1536}  # what fits into a first-level cache beside a row
    points = wp.array2d(dtype=scalar)
    reals, ints, rows = wp.array(dtype=scalar), wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)

    def build_native(
        positions: points, queries: points, cutoff: reals, info: ints, scratch: ints, n: int, m: int, own: int, table: int
    ): ...

    def gather_native(positions: points, cutoff: reals, scratch: ints, n: int, m: int, own: int, table: int): ...

    def query_native(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, later_only: int,
    ): ...  # fmt: skip

    for native in (build_native, gather_native, query_native):
        native.__name__ = native.__qualname__ = f"{native.__name__}_{variant}"
    native_text = functools.partial(snippet, "double" if double else "float", dim, CELLS, LAYOUT, **options)
    build_function = wp.func_native(ENTER + native_text(_BUILD) + LEAVE)(build_native)
    gather_function = wp.func_native(ENTER + native_text(_GATHER) + LEAVE)(gather_native)
    query_function = wp.func_native(ENTER + native_text(EXACT, _QUERY) + LEAVE)(query_native)

    def build(positions: points, queries: points, cutoff: reals, info: ints, scratch: ints, n: int, m: int, own: int, table: int):
        build_function(positions, queries, cutoff, info, scratch, n, m, own, table)

    def gather(positions: points, cutoff: reals, scratch: ints, n: int, m: int, own: int, table: int):
        gather_function(positions, cutoff, scratch, n, m, own, table)

    def query(
        positions: points, queries: points, cutoff: reals, idx: rows, count: ints, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, capacity: int, closed: int, drop_self: int, later_only: int,
    ):  # fmt: skip
        query_function(
            positions, queries, cutoff, idx, count, info, scratch, n, m, own, table, capacity, closed, drop_self, later_only
        )

    module = wp.get_module(f"jfrnn.kernels.cells_cpu.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    return Kernels(*(wp.kernel(kernel, module=module) for kernel in (build, gather, query)))
