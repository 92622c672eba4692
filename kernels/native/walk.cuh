// --- part: begin
struct Query : $kind {
    JFRNN_MEMBER explicit Query(const ${kind}Arguments& given) : $kind(given) {}
    JFRNN_MEMBER void run() {
// --- part: end
    }
};
// --- part: walk

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
        point_of(positions + (long long)ROW * source_of(id), p);
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
    between = site > 0 ? (real)square_between(radius, site, closed) : real(0);
    grid = shared.grid;
    finite_queries = shared.finite_queries;
    longest_before = SUMS ? 0 : *(volatile int*)&info[0];
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
    point_of(queries + (long long)ROW * i, q.p);
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
        beside = beside && (a == 0 ? grid.dense || (here >= there && here - there < 2 * REACH_X) : here == there);
    }
    unsigned int system = 0;
    if constexpr (BATCHED) {
        system = beside ? system_of(queries + (long long)ROW * id_of(mine.id)) : 0;
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
    int rows = 1;
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
        const int wide = cells_along(1), deep = cells_along(2), across = rows / (wide * deep);
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
                const int s = row_start(grid, y, z, system) + (int)first[0];
                from = start[s];
                size = length > 0 ? start[s + length] - from : 0;
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
                    near[k] = system_of(positions + (long long)ROW * source_named(id_of(candidates[k].id))) == system;
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
                        closest = min(closest, over);
                    }
                }
                if (__any_sync(ALL, (int)closest <= (int)upper_word(2 * band)))
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
                    if (over >= 0 && over <= 2 * band) {
                        if constexpr (inside)
                            hit = exact_pair(query.p, p, radius, 0, closed);
                        else {
                            const real* source = positions + (long long)ROW * source_named(id);
                            hit = exact_image(lattice, queries + (long long)ROW * my_id, source, image_of(id), radius, 0, closed);
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
// --- part: held_pairs

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
