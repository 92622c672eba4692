// --- part: types

#if defined(__AVX512F__) && defined(__AVX512VL__)
constexpr int LANES = DOUBLE ? 8 : 16;
#else
constexpr int LANES = DOUBLE ? 4 : 8;
#endif
constexpr int ROWS = 64;
typedef real vec __attribute__((vector_size(LANES * sizeof(real))));
typedef int ints __attribute__((vector_size(LANES * 4)));
typedef int eight_ints __attribute__((vector_size(32)));
typedef bool flags __attribute__((ext_vector_type(LANES)));
alignas(64) real candidate[3][CANDIDATES + LANES];
alignas(64) int candidate_ids[CANDIDATES + LANES];
alignas(64) int row[CANDIDATES + LANES];
alignas(64) unsigned short unsure[CANDIDATES / LANES + LANES];  // one bit per candidate that step 1 leaves open
alignas(64) int doubtful[CANDIDATES + LANES];  // their numbers
alignas(64) int vectors_in_doubt[CANDIDATES / LANES + LANES];  // numbers of the vectors that have any
alignas(64) int candidate_images[PERIODIC ? CANDIDATES + LANES : 1];  // their codes
alignas(64) int candidate_order[PERIODIC == 2 ? CANDIDATES + LANES : 1];  // by source, then by image: behind, at home, ahead
const Grid grid = shared.grid;
const int places = m, finite_places = shared.finite_queries;

// --- part: scan
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
struct Points { vec p[3]; };
auto candidates_at = [&](int b) {
    Points points;
    for (int k = 0; k < DIM; ++k)
        points.p[k] = *(const vec*)(candidate[k] + b);
    return points;
};
auto square_of = [&](const real* q, const vec* p) -> vec {  // of the distance of points in lanes
    vec square;
    for (int k = 0; k < DIM; ++k) {
        vec d = p[k] - q[k];
        if constexpr (SCALED)
            d *= step_scale;
#if defined(__FMA__)
        if constexpr (SUMS)  // as a term computes it, too
            square = k == 0 ? d * d : square + d * d;
        else
            square = k == 0 ? d * d : __builtin_elementwise_fma(d, d, square);
#else
        square = k == 0 ? d * d : square + d * d;
#endif
    }
    return square;
};
// stores the lanes of a mask one after the other; up to LANES elements at `to` are overwritten
auto pack = [](auto from, auto* to, unsigned int mask) {
#if defined(__AVX512F__) && defined(__AVX512VL__)
    typedef int ints8 __attribute__((vector_size(32)));
    typedef int ints16 __attribute__((vector_size(64)));
    typedef double doubles8 __attribute__((vector_size(64)));
    if constexpr (sizeof(*to) == 8)
        from = (decltype(from))__builtin_ia32_compressdf512_mask((doubles8)from, doubles8{}, mask);
    else if constexpr (LANES == 8)
        from = (decltype(from))__builtin_ia32_compresssi256_mask((ints8)from, ints8{}, mask);
    else
        from = (decltype(from))__builtin_ia32_compresssi512_mask((ints16)from, ints16{}, mask);
    __builtin_memcpy(to, &from, sizeof from);
#else
    for (; mask; mask &= mask - 1)
        *to++ = from[__builtin_ctz(mask)];
#endif
};
// what `from` holds at the places `numbers`; instructions that gather take longer
auto gathered = [](const real* from, const int* numbers) -> vec {
    vec lanes;
    for (int l = 0; l < LANES; ++l)
        lanes[l] = from[numbers[l]];
    return lanes;
};
ints first_numbers;
for (int l = 0; l < LANES; ++l)
    first_numbers[l] = l;
const real off = PERIODIC ? 2 * lattice.slack() * step_scale : real(0);  // by which distances of images may be wrong
const real inner = step_radius > off ? step_radius - off : real(0), outer = step_radius + off;
// 7 roundings of eps/2, 5 in a square and 2 in a bound (jfrnn/_exact.py); images are farther off
const real band = (PERIODIC ? 8 * (1 + PERIODIC) : 4) * step_eps;
const real between = !SCALED && shared.unit > 0 ? real(square_between(shared.unit)) * shared.unit * shared.unit : real(0);
const real inside = between > 0 ? between : inner * inner * (1 - band);
const real outside = between > 0 ? between : outer * outer * (1 + band);
const double doubly_inside = Exact::doubly_inside(radius), doubly_outside = Exact::doubly_outside(radius);
constexpr int WIDE = LANES < 8 ? LANES : 8;  // numbers in twice the precision
typedef double doubles __attribute__((vector_size(WIDE * 8)));
typedef bool wide_flags __attribute__((ext_vector_type(WIDE)));
auto bits_of_lanes = [](auto lanes) -> unsigned int {
    const wide_flags f = __builtin_convertvector(lanes, wide_flags);
    unsigned char bits;
    __builtin_memcpy(&bits, &f, 1);
    return bits & ((1u << WIDE) - 1);
};
// `Exact::sum_sign` for WIDE pairs at a time, in open space: those whose sign is not proven stay `open`
auto signs_decided = [&](const double* q, const doubles* p, unsigned int& open) -> unsigned int {
    const double scale = Bits::unit_scale(radius), r = (double)radius * scale, r2 = r * r;
    const double smallest = Exact::smallest_plain(radius);
    constexpr int TERMS = 3 * DIM + 2;
    auto size_of = [](doubles x) -> doubles { return x < 0 ? -x : x; };
    auto two_sum = [](doubles a, doubles b, doubles& error) -> doubles {
        const doubles s = a + b, bv = s - a;
        error = (a - (s - bv)) + (b - bv);
        return s;
    };
    auto product_error = [](doubles a, doubles b, doubles p) -> doubles {
#if defined(__FMA__) || defined(__aarch64__)
        return __builtin_elementwise_fma(a, b, -p);
#else
        const doubles ca = 134217729.0 * a, cb = 134217729.0 * b;
        const doubles ah = ca - (ca - a), bh = cb - (cb - b);
        const doubles al = a - ah, bl = b - bh;
        return al * bl - (((p - ah * bh) - al * bh) - ah * bl);
#endif
    };
    const double r2_error = Exact::product_error(r, r, r2);
    doubles high[3], low[3], square = doubles{};
    auto plain = square == 0;
    for (int k = 0; k < DIM; ++k) {
        const doubles a = doubles{} + q[k], b = p[k];
        if constexpr (DOUBLE)
            plain &= ((a == 0) | (size_of(a) >= smallest)) & ((b == 0) | (size_of(b) >= smallest));
        high[k] = two_sum(b, -a, low[k]) * scale;
        low[k] *= scale;
        plain &= size_of(high[k]) < 1e6;
    }
    auto exact = plain & (r2_error == 0 ? plain : ~plain);  // is nothing rounded, as between the sites of many lattices?
    for (int k = 0; k < DIM; ++k) {
        typedef decltype(plain) integers;
        doubles error;
        exact &= (low[k] == 0) & (((integers)high[k] & 0x7ffffff) == 0);  // 26 bits: the square is exact
        square = two_sum(square, high[k] * high[k], error);
        exact &= error == 0;
    }
    if ((open & ~bits_of_lanes(exact)) == 0) {
        const unsigned int pairs = open & (closed ? bits_of_lanes(square <= r2) : bits_of_lanes(square < r2));
        open = 0;
        return pairs;
    }
    doubles term[TERMS], slack = doubles{};
    term[0] = doubles{} - r2;
    term[1] = doubles{} - r2_error;
    for (int k = 0; k < DIM; ++k) {
        const doubles tail = 2 * high[k] * low[k];
        term[3 * k + 2] = high[k] * high[k];
        term[3 * k + 3] = product_error(high[k], high[k], term[3 * k + 2]);
        term[3 * k + 4] = tail;
        slack += size_of(tail) * 2.220446049250313e-16 + 2 * low[k] * low[k];
    }
    for (int pass = 0; pass < 3; ++pass) {
        doubles total = term[0];
        for (int t = 1; t < TERMS; ++t) {
            doubles error;
            total = two_sum(total, term[t], error);
            term[t - 1] = error;
        }
        term[TERMS - 1] = total;
    }
    doubles rest = slack;
    for (int t = 0; t < TERMS - 1; ++t)
        rest += size_of(term[t]);
    rest *= 2;
    const doubles lead = term[TERMS - 1];
    const unsigned int inside = bits_of_lanes(plain & (lead < -rest)), tie = bits_of_lanes(plain & (lead == 0) & (rest == 0));
    const unsigned int pairs = (inside | (closed ? tie : 0)) & open;
    open &= ~(inside | tie | bits_of_lanes(plain & (lead > rest)));
    return pairs;
};
// Which of the points in lanes are pairs, in twice the precision or more, WIDE at a time; few stay `open`, others are none.
// This is a call of its own: nothing of it may be computed while denormals are flushed.
auto wide_decided = [&](const real* q, const vec* p, unsigned int& open) __attribute__((noinline)) -> unsigned int {
    if constexpr (PERIODIC)
        return 0;
    unsigned int pairs = 0, left = 0;
    double origin[3];
    for (int k = 0; k < DIM; ++k)
        origin[k] = (double)q[k];
    for (int h = 0; h < LANES / WIDE; ++h) {
        unsigned int here = open >> WIDE * h & ((1u << WIDE) - 1), found = 0;
        doubles points[3];
        for (int k = 0; k < DIM; ++k) {
            typedef real reals __attribute__((vector_size(WIDE * sizeof(real))));
            reals part;
            __builtin_memcpy(&part, (const real*)&p[k] + WIDE * h, sizeof part);
            points[k] = __builtin_convertvector(part, doubles);
        }
        if constexpr (!DOUBLE) {
            doubles square = doubles{};
            for (int k = 0; k < DIM; ++k)
                square += (points[k] - origin[k]) * (points[k] - origin[k]);
            found = bits_of_lanes(square < doubly_inside) & here;
            here &= ~found & bits_of_lanes(square <= doubly_outside);
        }
        if (here)
            found |= signs_decided(origin, points, here);
        pairs |= found << WIDE * h;
        left |= here << WIDE * h;
    }
    open = left;
    return pairs;
};
// a candidate, where it is, and its number
auto exactly_decided = [&](const real* q, int own_id, const real* p, int number) -> bool {
    if constexpr (PERIODIC) {
        const int source = PERIODIC == 2 && !SUMS ? candidate_ids[number] % n : candidate_ids[number];
        const real* there = positions.data + (long long)ROW * source;
        return exact_image(queries.data + (long long)ROW * own_id, there, several ? candidate_images[number] : image);
    }
    return exact_pair(q, p);
};
// the numbers of what is unsure among `count` candidates, into `doubtful`; returns how many
auto collect_doubtful = [&](int count) -> int {
    const int vectors = (count + LANES - 1) / LANES;
    for (int e = vectors; e < vectors + LANES; ++e)
        unsure[e] = 0;
    int chosen = 0, doubts = 0;
    for (int v = 0; v < vectors; v += LANES) {  // loops of known length: what would be a branch per vector is hard to predict
        typedef unsigned short shorts __attribute__((vector_size(2 * LANES)));
        const shorts masks = *(const shorts*)(unsure + v);
        const flags some = __builtin_convertvector(masks != 0, flags);
        unsigned short bits = 0;
        __builtin_memcpy(&bits, &some, LANES == 16 ? 2 : 1);
        bits &= (1u << LANES) - 1;
        pack(first_numbers + v, vectors_in_doubt + chosen, bits);
        chosen += __builtin_popcount(bits);
    }
    for (int k = 0; k < chosen; ++k) {
        const int v = vectors_in_doubt[k];
        pack(first_numbers + v * LANES, doubtful + doubts, unsure[v]);
        doubts += __builtin_popcount(unsure[v]);
    }
    for (int e = 0; e < LANES; ++e)
        doubtful[doubts + e] = 0;
    return doubts;
};
auto lanes_before = [](int count) -> unsigned int { return count < LANES ? (1u << count) - 1 : (1u << LANES) - 1; };
auto doubtful_at = [&](int b) {
    Points points;
    for (int k = 0; k < DIM; ++k)
        points.p[k] = gathered(candidate[k], doubtful + b);
    return points;
};
// which of the points in lanes, of which some are `open`, are pairs; `numbers` are theirs among the candidates
auto decided = [&](const real* q, int own_id, const Points& points, const int* numbers, unsigned int open) -> unsigned int {
    unsigned int pairs = wide_decided(q, points.p, open);
    for (; open; open &= open - 1) {
        const int lane = __builtin_ctz(open);
        real p[3];
        for (int k = 0; k < DIM; ++k)
            p[k] = points.p[k][lane];
        pairs |= exactly_decided(q, own_id, p, numbers[lane]) ? 1u << lane : 0;
    }
    return pairs;
};
// candidates of one query among `count` copied ones: returns how many are pairs; LIST: their ids in `row`
auto scan = [&](const real* q, int own_id, int count, auto only_later) -> int {
    int hits = 0;
    auto later = [&](int b) -> unsigned int {
        return only_later.value ? later_mask(b, own_id) : ~0u;
    };
    for (int b = 0, v = 0; b < count; b += LANES, ++v) {
        const vec square = square_of(q, candidates_at(b).p);
        const unsigned int allowed = later(b);
        const unsigned int hit = mask_of(square, inside, Below{}) & allowed;
        unsure[v] = hit ^ (mask_of(square, outside, BelowOrAt{}) & allowed);
        if constexpr (LIST)
            pack(*(const ints*)(candidate_ids + b), row + hits, hit);
        hits += __builtin_popcount(hit);
    }
    const int doubts = collect_doubtful(count);
    for (int b = 0; b < doubts; b += LANES) {
        unsigned int pairs = decided(q, own_id, doubtful_at(b), doubtful + b, lanes_before(doubts - b));
        for (; pairs; pairs &= pairs - 1)
            row[hits++] = candidate_ids[doubtful[b + __builtin_ctz(pairs)]];
    }
    return hits;
};
struct All { enum { value = 0 }; };
struct Later { enum { value = 1 }; };

// --- part: walk
auto position_of = [&](int place, real* q) {
    if (own)
        for (int k = 0; k < DIM; ++k)
            q[k] = axis[k][place];
    else
        point_of(queries.data + (long long)ROW * query_ids[place], q);
};
// a vector of numbers; of sources, what stands behind the last of them may be read, too
auto lanes_from = [](const auto* from) {
    typedef __typeof__(*from + 0) element;
    element __attribute__((vector_size(LANES * sizeof(element)))) lanes;
    __builtin_memcpy(&lanes, from, sizeof lanes);
    return lanes;
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
    real lowest[3], highest[3];  // of the coordinates of the queries
    position_of(begin, lowest);
    position_of(begin, highest);
    for (int place = begin + 1; place < end; ++place) {
        real q[3];
        position_of(place, q);
        widen(lowest, highest, q, q);
    }
    const unsigned int system = system_at(begin);
    int filled = 0, own_from = 0, own_to = 0, own_at = 0;
    bool fresh = true;
    auto flush = [&](bool finished) __attribute__((noinline)) {
        for (int e = 0; e < LANES; ++e)
            for (int k = 0; k < DIM; ++k)
                candidate[k][filled + e] = __builtin_nanf("");
        $flush
        for (int place = begin; place < end; ++place) {
            real q[3];
            position_of(place, q);
            const int id = query_ids[place];
            const int self = drop_self && place >= own_from && place < own_to ? own_at + place - own_from : -1;
            if (self >= 0)
                candidate[0][self] = __builtin_nanf("");
            $meet
            if (self >= 0)
                candidate[0][self] = q[0];
            $met
        }
        $keep
        fresh = false;
        filled = own_from = own_to = 0;
    };
    int side = 0;  // whether the image lies behind (-1), at home, or ahead
    int shift[3] = {0, 0, 0};  // of the image, in lattice vectors
    real moved[3] = {0, 0, 0};
    // Copies those of the sources at places [from, to) that may be near one of the queries: others are too far from the box around
    // these. Rounding is monotone, so that no query is nearer to a source, by `square_of`, than the nearest point of the box is.
    auto copy = [&](int from, int to) {
        for (; from < to; from += LANES) {
            if (filled > CANDIDATES - LANES)
                flush(false);
            Points points;
            vec beside[3];
            const real origin[3] = {0, 0, 0};
            for (int k = 0; k < DIM; ++k) {
                points.p[k] = lanes_from(axis[k] + from);
                if constexpr (PERIODIC)
                    points.p[k] += moved[k];
                const vec least = points.p[k] > lowest[k] ? points.p[k] : vec{} + lowest[k];
                beside[k] = points.p[k] - (least < highest[k] ? least : vec{} + highest[k]);
            }
            unsigned int near = to - from < LANES ? (1u << (to - from)) - 1 : (1u << LANES) - 1;
            near &= mask_of(square_of(origin, beside), outside, BelowOrAt{});
            const ints numbers = lanes_from(ids + from);
            for (int l = 0; BATCHED && !grid.dense && l < LANES && from + l < to; ++l)
                if (system_of(positions.data + (long long)ROW * numbers[l]) != system)
                    near &= ~(1u << l);
            for (int k = 0; k < DIM; ++k)
                pack(points.p[k], candidate[k] + filled, near);
            if constexpr (SUMS != 1 || PERIODIC)
                pack(numbers + (PERIODIC == 2 && !SUMS ? n * image : 0), candidate_ids + filled, near);
            if constexpr (PERIODIC) {
                const ints codes = ints{} + image;
                __builtin_memcpy(candidate_images + filled, &codes, sizeof codes);
            }
            if constexpr (PERIODIC == 2)
                pack(3 * numbers + (1 + side), candidate_order + filled, near);
            $copied
            const int low_place = from > begin ? from : begin, stop = from + LANES < to ? from + LANES : to;
            const int high_place = stop < end ? stop : end;
            if (own && side == 0 && low_place < high_place) {  // all of these are near
                if (own_from == own_to) {
                    own_from = low_place;
                    own_at = filled + __builtin_popcount(near & ((1u << (low_place - from)) - 1));
                }
                own_to = high_place;
            }
            filled += __builtin_popcount(near);
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
                    shift[0] = x;
                    shift[1] = y;
                    shift[2] = z;
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
            $none
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
    $chunk_done
}
