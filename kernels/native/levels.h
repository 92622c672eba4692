// --- part: query

#if defined(__CUDA_ARCH__)
constexpr int LANES = 1;
#else
constexpr int LANES = 16;
#endif
constexpr int GATHER = 0, SCATTER = 1, EITHER = 2, BOTH = 3;
const int* extent = header.data;
const bool dense = header.data[4] != 0;
const int groups = header.data[5];
const real* largest = cutoff.data + LATTICE_END;
const real* width = largest + GROUPS;
const real* scale = width + 3;
const real* margin = scale + 3;
const long long stride = n + PADDING;
const real unit = real(Bits::unit_scale(radius));
constexpr real EPS = DOUBLE ? real(2.220446049250313e-16) : real(1.1920929e-07f);
constexpr real LEAST = DOUBLE ? real(0x1p-459) : real(0x1p-40f);  // below, squares might underflow

// cutoff of a pair; a mean is rounded
auto of_pair = [](real own, real other) -> real {
    if constexpr (RULE == GATHER) return own;
    if constexpr (RULE == SCATTER) return other;
    if constexpr (RULE == EITHER) return own > other ? own : other;
    if constexpr (RULE == BOTH) return own < other ? own : other;
    return own / 2 + other / 2;
};
constexpr int TOP = DIM + BATCHED;  // axes of top cells
const real slack = PERIODIC ? 2 * lattice.slack() * unit : real(0);  // by which distances of images may be wrong
int codes = 1, home = 0;  // of images
for (int k = 0; PERIODIC && k < DIM; ++k)
    codes *= 2 * lattice.images(k) + 1;
home = (codes - 1) / 2;
const int fill_value = PERIODIC == 2 ? n * codes : n;
auto exactly = [&](int query, int source, const real* q, const real* p, int image, real own, real other) -> bool {
    const real first = SUM ? own / 2 : of_pair(own, other), more = SUM ? other / 2 : real(0);
    if constexpr (PERIODIC) {
        const real *a = queries.data + (long long)ROW * query, *b = positions.data + (long long)ROW * source;
        return exact_image_within(a, b, image, first, more);
    }
    return Exact::pair(q[0], q[1], DIM == 3 ? q[DIM - 1] : 0, p[0], p[1], DIM == 3 ? p[DIM - 1] : 0, first, more, closed);
};
auto row_major = [&](const int* cell) -> int {
    int index = cell[TOP - 1];
    for (int k = TOP - 2; k >= 0; --k)
        index = index * extent[k] + cell[k];
    return index;
};
// first source whose top cell is not below this one, the last axis compared first
auto first_not_below = [&](const int* cell) -> int {
    int low = 0, high = n;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        bool below = false;
        for (int k = 0; k < TOP; ++k) {
            const int here = top.data[(long long)k * n + middle];
            below = here < cell[k] || (here == cell[k] && below);
        }
        if (below)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
};
auto first_key_from = [&](unsigned int key, int low, int high) -> int {
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if ((unsigned int)keys.data[middle] < key)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
};
auto spread = [](unsigned int c) -> unsigned int {  // bit b goes to place DIM * b
    unsigned int result = 0;
    for (int b = 0; b < HALVINGS; ++b)
        result |= (c >> b & 1) << (DIM * b);
    return result;
};

// how far the cells around a query reach: where images lie close, over many of the largest cells
auto reach_of = [&](int k, int level) -> int {
    return PERIODIC && level == 0 && lattice.images(k) > 1 ? lattice.images(k) : 1;
};
// for each cell around a query that holds sources of a group: its run of them, and the code of their image
auto each_run = [&](int g, int at, int level, auto use) {
    const int shift = HALVINGS - level, mask = (1 << level) - 1;
    const int reach[3] = {reach_of(0, level), reach_of(1, level), DIM == 3 ? reach_of(2, level) : 0};
    for (int z = -reach[2]; z <= reach[2]; ++z)
        for (int y = -reach[1]; y <= reach[1]; ++y)
            for (int x = -reach[0]; x <= reach[0]; ++x) {
                const int steps[3] = {x, y, z};
                int around[4] = {0, 0, 0, 0}, image = 0;
                unsigned int key = 0;
                bool there = true;
                for (int k = 0; k < DIM; ++k) {
                    const int fine = (places.data[(long long)k * m + at] >> shift) + steps[k];
                    around[k] = query_top.data[(long long)k * m + at] + (fine >> level);
                    key |= spread((unsigned int)(fine & mask)) << k;
                    if constexpr (PERIODIC) {
                        const int most = lattice.images(k), e = extent[k];
                        const int turn = most == 0 ? 0 : around[k] >= 0 ? around[k] / e : -1 - (-1 - around[k]) / e;
                        around[k] -= turn * e;
                        image = image * (2 * most + 1) + turn + most;
                        there = there && turn >= -most && turn <= most;
                    }
                }
                if (!there)
                    continue;
                if constexpr (BATCHED)
                    around[DIM] = query_top.data[(long long)DIM * m + at];
                int from, to;
                if (dense) {
                    from = table.data[row_major(around)];
                    to = table.data[row_major(around) + 1];
                } else {
                    from = first_not_below(around);
                    ++around[0];
                    to = from < n ? first_not_below(around) : from;
                }
                if (from == to)
                    continue;
                key = ((unsigned int)g << (DIM * HALVINGS)) | (key << (DIM * shift));
                from = first_key_from(key, from, to);
                to = first_key_from(key + (1u << (DIM * shift)), from, to);
                if (from < to)
                    use(from, to, image);
            }
};

// Runs of candidates of one group, around a cell: sorted, those that touch joined. Queries that follow each other often share them,
// so a thread of the CPU keeps them for each group, where there are no images.
struct Runs {
    int level;
    long long cell[4];  // of the query, at that level, and its system
    int count, begin[27], end[27];
};
#if defined(__CUDA_ARCH__)
Runs kept[1];
#else
Runs kept[GROUPS];
#endif
for (Runs& runs : kept)
    runs.level = -1;
auto find_runs = [&](Runs& runs, int g, int at, int level) {
    const int shift = HALVINGS - level;
    bool same = LANES > 1 && runs.level == level;
    for (int k = 0; k < TOP; ++k) {
        const long long first = query_top.data[(long long)k * m + at];
        const long long cell = k == DIM ? first : (first << level) + (places.data[(long long)k * m + at] >> shift);
        same = same && runs.cell[k] == cell;
        runs.cell[k] = cell;
    }
    if (same)
        return;
    runs.level = level;
    runs.count = 0;
    each_run(g, at, level, [&](int from, int to, int) {
        int place = runs.count++;
        for (; place > 0 && runs.begin[place - 1] > from; --place) {
            runs.begin[place] = runs.begin[place - 1];
            runs.end[place] = runs.end[place - 1];
        }
        runs.begin[place] = from;
        runs.end[place] = to;
    });
    int joined = 0;
    for (int r = 1; r < runs.count; ++r)
        if (runs.begin[r] == runs.end[joined])
            runs.end[joined] = runs.end[r];
        else {
            ++joined;
            runs.begin[joined] = runs.begin[r];
            runs.end[joined] = runs.end[r];
        }
    runs.count = runs.count ? joined + 1 : 0;
};

// Which of LANES sources from `first` on are not surely too far from a query, a bit each, and which of those are surely pairs.
#if defined(__CUDA_ARCH__)
auto lowest_bit = [](unsigned int) -> int { return 0; };
#else
typedef real lanes __attribute__((vector_size(LANES * sizeof(real))));
typedef bool flags __attribute__((ext_vector_type(LANES)));
auto lowest_bit = [](unsigned int bits) -> int { return __builtin_ctz(bits); };
#endif
auto test = [&](const real* q, real own, int first, unsigned int& sure) -> unsigned int {
#if defined(__CUDA_ARCH__)
    using lanes = real;
    auto load = [&](const real* from) -> lanes { return *from; };
    auto bits = [](bool is_so) -> unsigned int { return is_so; };
    auto choose = [](bool is_so, real yes, real no) -> real { return is_so ? yes : no; };
#else
    auto load = [&](const real* from) -> lanes {
        lanes x;
        __builtin_memcpy(&x, from, sizeof(x));
        return x;
    };
    auto bits = [](auto is_so) -> unsigned int {
        const flags f = __builtin_convertvector(is_so, flags);
        unsigned short b;
        __builtin_memcpy(&b, &f, 2);
        return b;
    };
    auto choose = [](auto is_so, lanes yes, lanes no) -> lanes { return is_so ? yes : no; };
#endif
    lanes square = lanes{};
    for (int k = 0; k < DIM; ++k) {
        const lanes d = (load(axes.data + k * stride + first) - q[k]) * unit;
        square += d * d;
    }
    lanes r = lanes{} + own;
    if constexpr (RULE != GATHER) {
        const lanes other = load(radii.data + first);
        if constexpr (RULE == SCATTER) r = other;
        else if constexpr (RULE == EITHER) r = choose(other > r, other, r);
        else if constexpr (RULE == BOTH) r = choose(other < r, other, r);
        else r = r / 2 + other / 2;
    }
    r *= unit;
    const lanes least = lanes{} + LEAST, inner = r - slack, outer = choose(r > least, r, least) + slack;
    sure = bits(square < inner * inner * (1 - 32 * EPS)) & bits(r > least) & bits(inner > lanes{});
    return bits(square <= outer * outer * (1 + 32 * EPS));
};

int longest = 0;
$begin
auto serve = [&](int at) {
    const int id = query_ids.data[at];
    real q[3] = {0, 0, 0};
    for (int k = 0; k < DIM; ++k)
        q[k] = query_axes.data[(long long)k * m + at];
    const real own = RULE == SCATTER ? real(0) : query_radii.data[at];
    int shift[3] = {0, 0, 0};  // of the image that is met, in lattice vectors
    $begin_query
    auto meet = [&](int from, int to, int image, const real* from_where) {
        for (int first = from; first < to; first += LANES) {
            unsigned int sure, near = test(from_where, own, first, sure);
            if (to - first < LANES)
                near &= (1u << (to - first)) - 1;
            for (; near; near &= near - 1) {
                const int e = LANES > 1 ? lowest_bit(near) : 0, c = first + e, other = ids.data[c];
                const bool itself = own_queries && c == at && image == home;
                const bool earlier = other < id || (PERIODIC == 2 && other == id && image < home);
                if ((drop_self && itself) || (later_only && earlier))
                    continue;
                bool pair = sure >> e & 1;
                if (!pair) {
                    real p[3];
                    for (int k = 0; k < DIM; ++k)
                        p[k] = axes.data[k * stride + c];
                    pair = exactly(id, other, q, p, image, own, RULE == GATHER ? real(0) : radii.data[c]);
                }
                if (!pair)
                    continue;
                $pair
            }
        }
    };
    for (int g = 0; finite_point(q) && g < groups; ++g) {
        if (RULE != GATHER && largest[g] < 0)
            continue;
        const real reach = of_pair(own, largest[g]) * (1 + 8 * EPS);
        int level = 0;  // the finest one whose cells are wider than the reach
        for (bool fits = true; fits && level < HALVINGS; level += fits)
            for (int k = 0; k < DIM; ++k)
                fits = fits && width[k] / real(2 << level) > reach * scale[k] + margin[k];
        if constexpr (PERIODIC) {
            each_run(g, at, level, [&](int from, int to, int image) {
                int rest = image;
                for (int k = DIM - 1; k >= 0; --k) {
                    const int each = 2 * lattice.images(k) + 1;
                    shift[k] = rest % each - lattice.images(k);
                    rest /= each;
                }
                real moved[3] = {0, 0, 0};  // the query goes to where it meets the image at home
                for (int k = 0; k < DIM; ++k)
                    moved[k] = image == home ? q[k] : Lattice::add(q[k], -lattice.translation(shift[0], shift[1], shift[2], k));
                meet(from, to, image, moved);
            });
            continue;
        }
        Runs& runs = kept[LANES > 1 ? g : 0];
        find_runs(runs, g, at, level);
        for (int r = 0; r < runs.count; ++r)
            meet(runs.begin[r], runs.end[r], home, q);
    }
    $end_query
};

#if defined(__CUDA_ARCH__)
const long long at = ((long long)(blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x) * blockDim.x + threadIdx.x;
if (at < m) {
    serve((int)at);
    if (longest > 0)
        atomicMax(&info.data[0], longest);
}
#else
for (;;) {
    const long long chunk = __atomic_fetch_add(&info.data[1], 1, __ATOMIC_RELAXED), begin = chunk * CHUNK;
    if (begin >= m)
        break;
    for (long long at = begin; at < begin + CHUNK && at < m; ++at)
        serve((int)at);
    $end_chunk
}
int known = __atomic_load_n(&info.data[0], __ATOMIC_RELAXED);
while (known < longest && !__atomic_compare_exchange_n(&info.data[0], &known, longest, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
}
#endif
// --- part: begin_row

    int* row = idx.data + (long long)id * capacity;
    int found = 0;
// --- part: add_to_row

                if (LIST && found < capacity)
                    row[found] = PERIODIC == 2 ? other + n * image : other;
                ++found;
// --- part: end_row

    if constexpr (LIST)
        for (int s = found; s < capacity; ++s)
            row[s] = fill_value;
    count.data[id] = found;
    longest = found > longest ? found : longest;
