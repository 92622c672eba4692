// A group of queries that walk together, one per lane, and the box around them.
#pragma once
#include "pair_search.cuh"

JFRNN_FUNCTION float square_root(float x) {
    float y;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}

struct Group {
    int place, size;  // the place of the first query, and how many there are; 0: the first one is not finite
    Place mine;       // the query of this lane
    int my_id;
    real my_place[3];  // along the axes of cells
    unsigned int system;
    bool is_long;         // cells do not know what is near
    real bound;           // of lane 2a the group's lowest coordinate along axis a, of lane 2a + 1 the highest
    real largest;         // where cutoffs differ: beyond, none of the queries has a neighbor
    real unit, scale;     // coordinates from the center are multiplied by both
    float coarse_square;  // that the sums of `Matrix` start from
    Box box;

    // Takes the queries from `place` on that share a row of cells with the first one, and a system, and are not too far from it; of a
    // tree, how many of them walk together is decided later (tree_runs.cuh).
    JFRNN_MEMBER Group(const PairSearch& search, int place, int stop)
        : place(place), mine{{0, 0, 0}, 0}, my_place{0, 0, 0}, system(0), is_long(false) {
        const Known& known = shared_known();
        const int lane = search.lane;
        bool beside = place + lane < stop && (TREE || place + lane < known.finite_queries);
        if (beside)
            mine = search.load_query(place + lane);
        if constexpr (TREE) {  // cutoffs of queries that walk together are alike
            beside = beside && finite_point(mine.p);
            const real own = beside && RULE != SCATTER ? search.query_radii[id_of(mine.id)] : real(0);
            const real first = __shfl_sync(ALL, own, 0);
            beside = beside && own <= 2 * first && first <= 2 * own;
        }
#pragma unroll
        for (int a = 0; a < DIM && !TREE; ++a) {
            my_place[a] = search.coordinate(a, mine.p);
            const whole here = search.axis_cell(known.grid, a, my_place[a]), there = __shfl_sync(ALL, here, 0);
            beside = beside && (a == 0 ? known.grid.dense || (here >= there && here - there < 2 * REACH_X) : here == there);
            if (a == 0 && known.grid.more)  // what lies outside of the box is far from what does not
                beside = beside && (here < 0) == (there < 0) && (here < known.grid.extent[0]) == (there < known.grid.extent[0]);
        }
        if (LONG && known.longs) {
            const bool mine_is = beside && search.is_long(search.query_radii[id_of(mine.id)]);
            is_long = __shfl_sync(ALL, mine_is, 0);
            beside = beside && mine_is == is_long;
        }
        if constexpr (BATCHED) {
            system = beside ? system_of(search.queries + (long long)ROW * id_of(mine.id)) : 0;
            const unsigned int of_first = __shfl_sync(ALL, system, 0);
            beside = beside && system == of_first;
            system = of_first;
        }
        size = __ffs(~__ballot_sync(ALL, beside)) == 0 ? 32 : __ffs(~__ballot_sync(ALL, beside)) - 1;
        my_id = id_of(mine.id);
    }
    // Finds the box around the queries, and the units in which candidates are compared with it.
    JFRNN_MEMBER void enclose(const PairSearch& search) {
        const int lane = search.lane;
        real low[3], high[3], center[3], square = 0;
        bound = 0;
#pragma unroll
        for (int a = 0; a < DIM; ++a) {
            real lowest, highest;
            find_ends(search, a, low, high, lowest, highest);
            bound = lane == 2 * a ? lowest : lane == 2 * a + 1 ? highest : bound;
            center[a] = real(0.5) * low[a] + real(0.5) * high[a];
            const real below = center[a] - low[a], above = high[a] - center[a];
            const real half = (below > above ? below : above) * search.step_scale;
            square += half * half;
        }
        const float diagonal = 1.0001f * square_root((float)square);
        if constexpr (DIFFER) {
            real lowest;
            reduce(search, search.upper, lowest, largest);
        }
        choose_unit(search, center, diagonal);
        set_limits(search, diagonal);
#pragma unroll
        for (int a = 0; a < DIM; ++a) {
            box.center[a] = (SCALED ? center[a] * scale : center[a]) * unit;
            const real below = -from_center(low[a], box.center[a]), above = from_center(high[a], box.center[a]);
            box.half[a] = (below > above ? below : above) * (1 + 16 * PairSearch::step_eps);
        }
        if (lane == 0)
            shared_warp().box = box;
    }
    JFRNN_MEMBER real from_center(real x, real center) const {
        const real y = SCALED ? x * scale : x;
        if constexpr (DOUBLE)
            return y - center;
        else
            return fmaf((float)y, (float)unit, -(float)center);
    }
    JFRNN_MEMBER void reduce(const PairSearch& search, real x, real& low, real& high) const {
        low = search.lane < size ? x : search.INF;
        high = search.lane < size ? x : -search.INF;
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
    }
    // Finds the lowest and the highest of the queries' coordinates, and of where they are along an axis of cells.
    JFRNN_MEMBER void find_ends(const PairSearch& search, int a, real* low, real* high, real& lowest, real& highest) const {
        reduce(search, mine.p[a], low[a], high[a]);
        lowest = low[a];
        highest = high[a];
        if constexpr (SKEWED)
            reduce(search, my_place[a], lowest, highest);
        else if constexpr (PERIODIC) {  // in one order or the other
            const real begin = search.coordinate(a, low), end = search.coordinate(a, high);
            lowest = begin < end ? begin : end;
            highest = begin < end ? end : begin;
        }
    }
    // Chooses the unit of float32: everything near is closer to the center than 240 of it, so that its square is a half, too.
    JFRNN_MEMBER void choose_unit(const PairSearch& search, const real* center, float diagonal) {
        unit = 1;
        scale = search.step_scale;
        if constexpr (!DOUBLE) {
            constexpr float SMALLEST = 0x1p-126f;
            const real outer = DIFFER && BY_OWN ? largest * search.step_scale + search.off() : search.outer_radius;
            unit = __uint_as_float(__float_as_uint(__fdividef(240, diagonal + (float)outer)) & 0x7f800000u);
#pragma unroll
            for (int a = 0; a < DIM; ++a)
                unit = fabsf(center[a]) * search.step_scale * unit < 1e37f ? unit : 0;
            if (unit < SMALLEST) {  // coordinates that overflow otherwise: all pairs that are near are decided one by one
                unit = SMALLEST;
                scale = SCALED ? 1 : scale;
            }
        }
    }
    // Returns the square, in units of the box, beyond which nothing is a neighbor by this one of cutoffs that differ.
    JFRNN_MEMBER real near_of(const PairSearch& search, real cutoff) const {
        const real off = PERIODIC ? 2 * search.lattice.slack() * scale : real(0);
        const real square = PairCutoffs::outside_of(cutoff * scale, off) * (1 + 16 * PairSearch::step_eps) * unit * unit;
        return square + (DOUBLE ? real(0) : real(1e-30));
    }
    // The same, of a source with this cutoff: of a tree, cells say nothing of it.
    JFRNN_MEMBER real near_with(const PairSearch& search, real other) const {
        if constexpr (TREE && !BY_OWN)
            return near_of(search, PairCutoffs::of_pair(largest, other));
        return box.center[3];
    }
    // Finds what is near the box, and the band in which the sums of `Matrix` leave pairs open.
    JFRNN_MEMBER void set_limits(const PairSearch& search, float diagonal) {
        const real radius = DIFFER && BY_OWN ? largest : search.radius,
                   between = search.SITED ? search.between : shared_known().between;
        const real group_radius = (SCALED ? radius * scale : radius) * unit;
        const real outer = PERIODIC ? (radius + 2 * search.lattice.slack()) * (SCALED ? scale : real(1)) * unit : group_radius;
        real near_square = outer * outer * (1 + 8 * PairSearch::step_eps) + (DOUBLE ? real(0) : real(1e-30));
        if constexpr (DIFFER)
            near_square = near_of(search, largest);
        const float reach = fminf(diagonal * (float)unit + (float)outer, 240);
        float coarse_band = reach * reach * (RULE == TABLE ? 3e-5f : 2e-5f);
        const float site = (float)(shared_known().site * (SCALED ? scale : real(1)) * unit), square_unit = site * site;
        const bool on_lattice = !DOUBLE && site > 0 && !is_long && reach < 239 && coarse_band < 0.25f * square_unit;
        if (on_lattice) {
            coarse_square = (float)between * square_unit;
            coarse_band = -1;
        } else {
            if constexpr (PERIODIC)
                coarse_band += 1.001f * (float)((outer - group_radius) * (outer + group_radius));
            const float mine = (float)(DIFFER ? search.upper * scale * unit : group_radius) * (search.few_kinds() ? 0 : 1);
            coarse_square = mine * mine - coarse_band;
        }
        box.center[3] = near_square;
        box.half[3] = 2 * coarse_band;
    }
};
