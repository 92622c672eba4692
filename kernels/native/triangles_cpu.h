// --- part: build

const double reach_of = double(radius) * (1 + 8 * (DOUBLE ? 0x1p-52 : 0x1p-23));
const double MOST = DOUBLE ? 0x1.fffffffffffffp1023 : 0x1.fffffep127;
const int finest = Bits::exponent(real(Bits::unit_scale(radius)));
auto within = [](double x, double most) -> double { return x < -most ? -most : x > most ? most : x; };

// does a direction keep the box [0, 1]^DIM around `cell`, widened by `reach`, apart from the triangle? all in units of a cell
auto apart = [&](const double* direction, const double (*x)[DIM], const int* cell, double reach) -> bool {
    double whole = 0, square = 0, most = 0, high = 0, low = 0;
    for (int k = 0; k < DIM; ++k) {
        whole += Shape::size_of(direction[k]);
        square += direction[k] * direction[k];
    }
    for (int c = 0; c < DIM; ++c) {
        double height = 0, doubt = 0;
        for (int k = 0; k < DIM; ++k) {
            const double part = direction[k] * (x[c][k] - (cell[k] + 0.5));
            height += part;
            doubt += Shape::size_of(part);
        }
        low = c == 0 || height < low ? height : low;
        high = c == 0 || height > high ? height : high;
        most = doubt > most ? doubt : most;
    }
    const double room = (0.5 * whole + reach * __builtin_sqrt(square)) * (1 + 0x1p-48) + 0x1p-48 * most;
    return whole > 0x1p-60 && room < 0x1p1000 && (low > room || high < -room);
};
// the buckets of a triangle at a level: their number, or -1 for too many cells
auto hold = [&](const real* corners, const double* low, const double* high, int level, int* buckets_of) -> int {
    const double scale = scale_of(level);
    int first[3] = {0, 0, 0}, last[3] = {0, 0, 0}, cell[3], held = 0, found = 0;
    double size = 1;
    for (int k = 0; k < DIM; ++k) {
        first[k] = cell_at(low[k], scale);
        last[k] = cell_at(high[k], scale);
        size *= double(last[k]) - double(first[k]) + 1;
    }
    if (size > LANES)
        return -1;
    double x[DIM][DIM], direction[10][DIM];
    for (int c = 0; c < DIM; ++c)
        for (int k = 0; k < DIM; ++k)
            x[c][k] = double(corners[DIM * c + k]) * scale;
    int directions = 1;
    if constexpr (DIM == 2) {
        direction[0][0] = -(x[1][1] - x[0][1]);
        direction[0][1] = x[1][0] - x[0][0];
    } else {
        double side[3][3];
        for (int c = 0; c < 3; ++c)
            for (int k = 0; k < 3; ++k)
                side[c][k] = x[(c + 1) % 3][k] - x[c][k];
        for (int k = 0; k < 3; ++k)
            direction[0][k] = side[0][(k + 1) % 3] * side[1][(k + 2) % 3] - side[0][(k + 2) % 3] * side[1][(k + 1) % 3];
        for (int c = 0; c < 3; ++c)
            for (int k = 0; k < 3; ++k, ++directions) {
                direction[directions][k] = 0;
                direction[directions][(k + 1) % 3] = -side[c][(k + 2) % 3];
                direction[directions][(k + 2) % 3] = side[c][(k + 1) % 3];
            }
    }
    for (cell[2] = first[2]; cell[2] <= last[2]; ++cell[2])
        for (cell[1] = first[1]; cell[1] <= last[1]; ++cell[1])
            for (cell[0] = first[0]; cell[0] <= last[0]; ++cell[0]) {
                bool free = false;
                for (int d = 0; d < directions && !free; ++d)
                    free = apart(direction[d], x, cell, reach_of * scale);
                if (free)
                    continue;
                if (++held > MOST_CELLS && level > 0)
                    return -1;
                const int bucket = bucket_of(level, cell, buckets);
                bool fresh = true;  // two cells may be hashed alike
                for (int i = 0; i < found; ++i)
                    fresh = fresh && buckets_of[i] != bucket;
                if (fresh)
                    buckets_of[found++] = bucket;
            }
    return found;
};

for (int b = 0; b < buckets + 2; ++b)
    if (b <= buckets)
        start.data[b] = 0;
const int limit = DOUBLE ? 2048 : 256;
for (int l = 0; l < limit; ++l)
    levels.data[l] = 0;
for (int t = 0; t < f; ++t) {
    int* buckets_of = scratch.data + (long long)MOST_CELLS * t;
    level_of.data[t] = 0;
    buckets_of[0] = -1;
    if (!good.data[t])
        continue;
    const real* shape = corners.data + (long long)DIM * DIM * t;
    double low[DIM], high[DIM], farthest = 0, extent = 0;
    for (int k = 0; k < DIM; ++k) {
        low[k] = high[k] = double(shape[k]);
        for (int c = 1; c < DIM; ++c) {
            const double x = double(shape[DIM * c + k]);
            low[k] = x < low[k] ? x : low[k];
            high[k] = x > high[k] ? x : high[k];
        }
        low[k] = within(low[k] - reach_of, MOST);
        high[k] = within(high[k] + reach_of, MOST);
        const double far = -low[k] > high[k] ? -low[k] : high[k], wide = within(high[k] - low[k], MOST);
        farthest = far > farthest ? far : farthest;
        extent = wide > extent ? wide : extent;
    }
    // cells are numbered up to 2^22, and a box has no more than LANES along an axis
    int level = finest, bound = 2 * Bits::BIAS + 21 - Bits::exponent(real(farthest));
    level = bound < level ? bound : level;
    bound = 2 * Bits::BIAS + LANES_LOG2 - Bits::exponent(real(extent));
    level = bound < level ? bound : level;
    level = level < 0 ? 0 : level;
    int found = hold(shape, low, high, level, buckets_of);
    while (found < 0)
        found = hold(shape, low, high, --level, buckets_of);
    if (found < MOST_CELLS)
        buckets_of[found] = -1;
    level_of.data[t] = level;
    levels.data[level] = 1;
    for (int i = 0; i < found; ++i)
        ++start.data[buckets_of[i] + 1];
}
for (int b = 0; b < buckets; ++b)
    start.data[b + 1] += start.data[b];
const int filled = start.data[buckets];
for (long long e = filled; e < (long long)f * MOST_CELLS; ++e)
    triangles.data[e] = f;
for (int t = f - 1; t >= 0; --t)  // from the back: entries of a bucket end up in the order of triangles
    for (int i = 0; i < MOST_CELLS && scratch.data[(long long)MOST_CELLS * t + i] >= 0; ++i)
        triangles.data[--start.data[scratch.data[(long long)MOST_CELLS * t + i] + 1]] = t;
for (int b = 0; b < buckets; ++b)  // each start was moved to that of the bucket before
    start.data[b] = start.data[b + 1];
start.data[buckets] = filled;
int used = 0;
for (int l = limit - 1; l >= 0; --l)
    used += levels.data[l];
level_count.data[0] = used;
for (int l = 0, place = used; l < limit; ++l)  // the smallest cells, which have the highest level, come first
    if (levels.data[l])
        scratch.data[--place] = l;
for (int l = 0; l < limit; ++l)
    levels.data[l] = l < used ? scratch.data[l] : 0;
// --- part: lanes

#if defined(__AVX512F__) && defined(__AVX512VL__)
constexpr int WIDTH = DOUBLE ? 8 : 16;
#else
constexpr int WIDTH = DOUBLE ? 4 : 8;
#endif
typedef real vec __attribute__((vector_size(WIDTH * sizeof(real))));
typedef bool flags __attribute__((ext_vector_type(WIDTH)));
// --- part: many

auto bits_of = [](flags f) -> unsigned int {
    unsigned short bits = 0;
    __builtin_memcpy(&bits, &f, WIDTH == 16 ? 2 : 1);
    return bits & ((1u << WIDTH) - 1);
};
auto surely_near = [&](const real* p, const int* which, unsigned int& open) -> unsigned int {
    vec x[DIM][DIM];
    for (int c = 0; c < DIM; ++c)
        for (int k = 0; k < DIM; ++k) {
            for (int l = 0; l < WIDTH; ++l)
                x[c][k][l] = corners.data[(long long)DIM * DIM * which[l] + DIM * c + k];
            x[c][k] = (x[c][k] - p[k]) * unit;
        }
    mask near, far;
    bounded(x, near, far);
    const unsigned int yes = bits_of(__builtin_convertvector(near, flags));
    open = ~yes & ~bits_of(__builtin_convertvector(far, flags));
    return yes;
};
// --- part: query

struct Shared { int next_chunk; };
Shared& shared = *(Shared*)info.data;
constexpr int MOST = 512;  // triangles whose boxes hold a particle that wait to be decided
int waiting[MOST + WIDTH], room[ROOM];
int longest = 0;
for (;;) {
    const long long begin = (long long)__atomic_fetch_add(&info.data[2], 1, __ATOMIC_RELAXED) * CHUNK;
    if (begin >= n)
        break;
    const long long end = begin + CHUNK < n ? begin + CHUNK : n;
    for (long long i = begin; i < end; ++i) {
        const real* p = positions.data + DIM * i;
        int* row = idx.data + (long long)capacity * i;
        int found = 0, number = 0;
        auto decide = [&]() {
            for (int l = 0; l < WIDTH; ++l)
                waiting[number + l] = waiting[0];
            for (int first = 0; first < number; first += WIDTH) {
                unsigned int open, near = surely_near(p, waiting + first, open);
                const unsigned int asked = number - first < WIDTH ? (1u << (number - first)) - 1 : (1u << WIDTH) - 1;
                for (open &= asked; open; open &= open - 1) {
                    const int l = __builtin_ctz(open);
                    if (Shape::near(p, corners.data + (long long)DIM * DIM * waiting[first + l], radius, scale, room))
                        near |= 1u << l;
                }
                for (near &= asked; near; near &= near - 1, ++found)
                    if (LIST && found < capacity)
                        row[found] = waiting[first + __builtin_ctz(near)];
            }
            number = 0;
        };
        auto inside = [&](int e) -> unsigned int {  // which of WIDTH boxes hold the particle, one bit each
            mask within = vec{} == vec{};
            for (int k = 0; k < DIM; ++k) {
                vec low, high;
                __builtin_memcpy(&low, boxes.data + (long long)stride * k + e, sizeof low);
                __builtin_memcpy(&high, boxes.data + (long long)stride * (DIM + k) + e, sizeof high);
                within &= (low <= p[k]) & (high >= p[k]);
            }
            return bits_of(__builtin_convertvector(within, flags));
        };
        if (finite_point(p)) {
            $candidates
        }
        if (number)
            decide();
        if constexpr (LIST)
            for (int s = found; s < capacity; ++s)
                row[s] = f;
        count.data[i] = found;
        longest = found > longest ? found : longest;
    }
}
int known = __atomic_load_n(&info.data[0], __ATOMIC_RELAXED);
while (known < longest && !__atomic_compare_exchange_n(&info.data[0], &known, longest, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
}
// --- part: in_cells

for (int l = 0; l < level_count.data[0]; ++l) {
    const int level = levels.data[l];
    const int bucket = bucket_at(p, level, buckets);
    const int last = start.data[bucket + 1];
    for (int e = start.data[bucket]; e < last; e += WIDTH)
        for (unsigned int hold = inside(e) & (last - e < WIDTH ? (1u << (last - e)) - 1 : ~0u); hold; hold &= hold - 1) {
            const int t = triangles.data[e + __builtin_ctz(hold)];
            waiting[number] = t;
            number += level_of.data[t] == level;
            if (number == MOST)
                decide();
        }
}
// --- part: in_tree

struct Siblings { int first, level; };
Siblings pending[PENDING];
int depth = 0;
pending[depth++] = Siblings{start.data[buckets - 1], buckets - 1};
while (depth > 0) {
    const Siblings here = pending[--depth];
    for (int part = 0; part < NODE; part += WIDTH)
        for (unsigned int hold = inside(here.first + part); hold; hold &= hold - 1) {
            const int e = here.first + part + __builtin_ctz(hold);
            if (here.level > 0) {
                const int level = here.level - 1;
                pending[depth++] = Siblings{start.data[level] + NODE * (e - start.data[level + 1]), level};
                continue;
            }
            waiting[number++] = triangles.data[e];
            if (number == MOST)
                decide();
        }
}
