// --- part: layout

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
// --- part: build

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
// --- part: gather

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
// --- part: begin_rows

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

// --- part: add_to_row

            const int before = fresh ? 0 : count.data[id];
            if constexpr (LIST)
                write_row(id, before, hits, finished);
            count.data[id] = before + hits;
            longest = before + hits > longest ? before + hits : longest;
// --- part: no_row

            count.data[id] = 0;
            if constexpr (LIST)
                write_row(id, 0, 0, true);
// --- part: end_rows

int known = __atomic_load_n(&info.data[0], __ATOMIC_RELAXED);
while (known < longest && !__atomic_compare_exchange_n(&info.data[0], &known, longest, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
}
if (LIST && longest > capacity)
    __atomic_fetch_or(&info.data[1], 1, __ATOMIC_RELAXED);
