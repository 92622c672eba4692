// --- part: sort_values

for (;;) {
    const int chunk = __atomic_fetch_add(&shared.next_sorted, 1, __ATOMIC_RELAXED);
    if ((long long)chunk * CHUNK >= n)
        break;
    const int begin = chunk * CHUNK, end = n - begin < CHUNK ? n : begin + CHUNK;
    const long long width = others.shape[1];
    for (int place = begin; place < end; ++place)
        for (int c = 0; c < width; ++c)
            columns.data[(long long)c * n + place] = others.data[width * ids[place] + c];
}
// --- part: add

typedef Math::NUMBER_LANES number;
auto lanes_of = [](unsigned int bits) -> Math::flag {
    Math::flag lanes;
    __builtin_memcpy(&lanes, &bits, sizeof lanes);
    return lanes;
};
auto bits_of = [](const real& x) {
    whole bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
};
auto two_sum = [](auto& sum, auto& error, auto x) {  // Knuth 1969
    const auto s = sum + x, b = s - sum;
    error = error + ((sum - (s - b)) + (x - b));
    sum = s;
};
auto add_lanes = [&](number sum, number error, real& total, real& carried) {  // always in the same order
    real s[LANES], e[LANES];
    memcpy(s, &sum, sizeof s);
    memcpy(e, &error, sizeof e);
    for (int size = LANES / 2; size > 0; size /= 2)
        for (int l = 0; l < size; ++l)
            if constexpr (COMPENSATED) {
                two_sum(s[l], e[l], s[l + size]);
                e[l] += e[l + size];
            } else
                s[l] += s[l + size];
    if constexpr (COMPENSATED) {
        two_sum(total, carried, s[0]);
        carried += e[0];
    } else
        total += s[0];
};
real total[TOTALS + 1], total_carried[TOTALS + 1];
for (int t = 0; t <= TOTALS; ++t)
    total[t] = total_carried[t] = 0;
// --- part: candidates

alignas(64) real column[OTHERS + STEPS + 1][CANDIDATES + LANES];
memset(column, 0, sizeof column);
memset(candidate, 0, sizeof candidate);
memset(doubtful, 0, sizeof doubtful);
alignas(64) real near_points[3][CANDIDATES + LANES];  // packed
alignas(64) real near_column[OTHERS + STEPS + 1][CANDIDATES + LANES];
// --- part: take_larger

auto take_larger = [](number x, Math::i32 source, Math::i32 code, Math::flag among, number& best, Math::i32& of, Math::i32& at) {
    const Math::flag is_nan = Math::ne(x, x), was_nan = Math::ne(best, best);
    const Math::flag larger = Math::either(Math::gt(x, best), Math::both(is_nan, Math::inverse(was_nan)));
    const Math::flag same = Math::either(Math::eq(x, best), Math::both(is_nan, was_nan));
    const Math::flag first = Math::either(Math::lt(source, of), Math::both(Math::eq(source, of), Math::lt(code, at)));
    const Math::flag taken = Math::both(among, Math::either(larger, Math::both(same, first)));
    best = Math::select(taken, x, best);
    of = Math::select(taken, source, of);
    at = Math::select(taken, code, at);
};
auto integer_at = [&](long long at) -> int { return Lattice::packed_turns(errors.data[at]); };
auto put_integer = [&](long long at, int x) {
    if constexpr (DOUBLE)
        errors.data[at] = x;
    else
        memcpy(errors.data + at, &x, 4);
};
// --- part: keep_largest

auto keep_largest = [&](number best, Math::i32 of, Math::i32 code, long long at, bool fresh) {
    real x = fresh ? -Bits::not_finite() : sums.data[at];
    int source = fresh ? n : integer_at(2 * at), image_of_it = fresh ? 0 : integer_at(2 * at + 1);
    for (int l = 0; l < LANES; ++l) {
        const bool same = x == best[l] || (x != x && best[l] != best[l]);
        const bool first = of[l] < source || (of[l] == source && code[l] < image_of_it);
        if (!(best[l] > x || (best[l] != best[l] && x == x) || (same && first)))
            continue;
        x = best[l];
        source = of[l];
        image_of_it = code[l];
    }
    sums.data[at] = x;
    put_integer(2 * at, source);
    put_integer(2 * at + 1, image_of_it);
};
// --- part: copy

            for (int c = 0; c < OTHERS; ++c)
                pack(lanes_from(columns.data + (long long)c * n + from), column[c] + filled, near);
// --- part: copy_step

            {
                const vec turns = lanes_from(columns.data + (long long)OTHERS * n + from);
                vec steps;
                for (int l = 0; l < LANES; ++l)
                    steps[l] = real(shift[$axis] - Lattice::turn(turns[l], $axis));
                pack(steps, column[OTHERS + $c] + filled, near);
            }
// --- part: no_sum

            for (int r = 0; r < ROW_SUMS; ++r)
                sums.data[(long long)id * ROW_SUMS + r] = 0;
// --- part: no_extreme

            for (int r = 0; r < ROW_SUMS; ++r)
                put_integer(2 * ((long long)id * ROW_SUMS + r), n);
// --- part: chunk_done

    for (int t = 0; t < TOTALS; ++t) {
        totals.data[(2ll * chunk) * TOTALS + t] = total[t];
        totals.data[(2ll * chunk + 1) * TOTALS + t] = total_carried[t];
        total[t] = total_carried[t] = 0;
    }
// --- part: in_place

    for (int b = 0, v = 0; b < filled; b += LANES, ++v) {
        const Points points = candidates_at(b);
        const vec square = square_of(q, points.p);
        const unsigned int hit = mask_of(square, inside, Below{});
        unsure[v] = hit ^ mask_of(square, outside, BelowOrAt{});
        $skip
        const Math::flag real_lanes = lanes_of(hit);
        $in_place
    }
    const int doubts = collect_doubtful(filled);
    for (int b = 0; b < doubts; b += LANES) {
        const Points points = doubtful_at(b);
        $keep
        const unsigned int hit = decided(q, id, points, doubtful + b, lanes_before(doubts - b));
        $flush
        const Math::flag real_lanes = lanes_of(hit);
        $of_doubtful
    }
// --- part: packed

    int held = 0;
    for (int b = 0; b < filled; b += LANES) {
        const Points points = candidates_at(b);
        const unsigned int near = mask_of(square_of(q, points.p), outside, BelowOrAt{});
        for (int k = 0; k < DIM; ++k)
            pack(points.p[k], near_points[k] + held, near);
        for (int c = 0; c < OTHERS + STEPS; ++c)
            pack(*(const number*)(column[c] + b), near_column[c] + held, near);
        if constexpr (PERIODIC || SUMS == 2)
            pack(first_numbers + b, doubtful + held, near);
        held += __builtin_popcount(near);
    }
    for (int b = 0; b < held; b += LANES) {
        Points points;
        for (int k = 0; k < DIM; ++k)
            points.p[k] = *(const vec*)(near_points[k] + b);
        const unsigned int there = lanes_before(held - b);
        unsigned int hit = mask_of(square_of(q, points.p), inside, Below{}) & there;
        if (const unsigned int open = there & ~hit) {
            $keep
            hit |= decided(q, id, points, doubtful + b, open);
            $flush
        }
        const Math::flag real_lanes = lanes_of(hit);
        $of_packed
    }
