// --- part: sums
struct SumsArguments {
    const real *positions, *queries, *cutoff, *shared_values, *own_values, *others;
    real *sums, *totals, *errors, *values;
    int *info, *scratch;
    int n, m, own, table, closed, drop_self;
};
// What a thread knows of a sum; of a search nothing is written but scratch.
struct Sums : Search {
    const real *shared_values, *own_values, *others;
    real *sums, *totals, *errors, *values;
    JFRNN_MEMBER explicit Sums(const SumsArguments& a)
        : Search({a.positions, a.queries, a.cutoff, nullptr, nullptr, a.info, a.scratch, a.n, a.m, a.own, a.table, 0, a.closed,
                  a.drop_self, 0}),
          shared_values(a.shared_values), own_values(a.own_values), others(a.others), sums(a.sums), totals(a.totals),
          errors(a.errors), values(a.values) {}

    // Puts what a term reads of the sources into the order of cells, a row each, 16 bytes at a time.
    JFRNN_MEMBER void sort_values() {
        constexpr int AT_ONCE = 16 / sizeof(real), CHUNK = ROW_LENGTH < AT_ONCE ? ROW_LENGTH : AT_ONCE, CHUNKS = ROW_LENGTH / CHUNK;
        struct alignas(CHUNK * sizeof(real)) Chunk { real at[CHUNK]; };  // what a thread writes at once
        for (long long t = thread; t < (long long)CHUNKS * n; t += threads) {
            const Place from = sorted[t / CHUNKS];
            const real* const row = others + (long long)OTHERS * id_of(from.id);
            Chunk chunk;
#pragma unroll
            for (int k = 0; k < CHUNK; ++k) {
                const int c = (int)(t % CHUNKS) * CHUNK + k, column = c - PLACED;
                const real along = c == 0 ? from.p[0] : c == 1 ? from.p[1] : from.p[2];
                chunk.at[k] = column < 0 ? along : column < OTHERS ? row[column] : real(0);
            }
            ((Chunk*)values)[t] = chunk;
        }
    }
};
// --- part: opened

const long long slot_of_totals = begin >> share_bits;
for (int t = lane; slot_of_totals < query_blocks && t < 2 * TOTALS; t += 32)
    totals[2 * TOTALS * slot_of_totals + t] = 0;
// --- part: no_sum

for (int r = lane; r < ROW_SUMS; r += 32)
    sums[(long long)id * ROW_SUMS + r] = 0;
// --- part: no_extreme

for (int r = lane; r < 2 * ROW_SUMS; r += 32)
    put_integer(2ll * ROW_SUMS * id + r, r % 2 ? 0 : n);
// --- part: add

auto two_sum = [](real& sum, real& error, real x) {  // Knuth 1969
    const real s = Lattice::add(sum, x), b = Lattice::add(s, -sum);
    error = Lattice::add(error, Lattice::add(Lattice::add(sum, -Lattice::add(s, -b)), Lattice::add(x, -b)));
    sum = s;
};
auto add = [&](real& sum, real& error, bool is_pair, real x) {
    if constexpr (COMPENSATED)
        two_sum(sum, error, is_pair ? x : real(0));
    else
        sum = is_pair ? sum + x : sum;
};
auto store = [&](long long at, real sum, real error, bool fresh, bool finished) {
    real all = fresh ? real(0) : sums[at], carried = fresh || !COMPENSATED ? real(0) : errors[at];
    add(all, carried, true, sum);
    carried += error;
    if (COMPENSATED && finished && Bits::finite(all))
        all += carried;
    if (COMPENSATED && !finished)
        errors[at] = carried;
    sums[at] = all;
};
auto add_total = [&](int t, real sum, real error) {  // of all lanes, always in the same order
    for (int step = 16; step > 0; step /= 2) {
        const real other = __shfl_down_sync(ALL, sum, step), other_error = __shfl_down_sync(ALL, error, step);
        two_sum(sum, error, other);
        error += other_error;
    }
    if (lane == 0) {
        real* const part = totals + 2 * TOTALS * slot_of_totals + t;
        two_sum(part[0], part[TOTALS], sum);
        part[TOTALS] += error;
    }
};
// --- part: keep_largest

int code_at_home = 1;
for (int k = 0; PERIODIC && k < DIM; ++k)
    code_at_home *= 2 * lattice.images(k) + 1;
code_at_home /= 2;
auto keep_largest = [&](long long at, real best, int of, int code, bool fresh) {
    real x = fresh ? -INF : sums[at];
    int source = fresh ? n : integer_at(2 * at), image = fresh ? 0 : integer_at(2 * at + 1);
    take_larger(best, of, code, true, x, source, image);
    sums[at] = x;
    put_integer(2 * at, source);
    put_integer(2 * at + 1, image);
};
// --- part: load_row

struct Row { real at[ROW_LENGTH]; };
auto load_words = [](const void* from, auto* to) {
    unsigned int w[4];
    const size_t at = __cvta_generic_to_global(from);
    if constexpr (sizeof(*to) == 16)
        asm volatile("ld.global.nc.v4.b32 {%0, %1, %2, %3}, [%4];" : "=r"(w[0]), "=r"(w[1]), "=r"(w[2]), "=r"(w[3]) : "l"(at));
    else if constexpr (sizeof(*to) == 8)
        asm volatile("ld.global.nc.v2.b32 {%0, %1}, [%2];" : "=r"(w[0]), "=r"(w[1]) : "l"(at));
    else
        asm volatile("ld.global.nc.b32 %0, [%1];" : "=r"(w[0]) : "l"(at));
    memcpy(to, w, sizeof(*to));
};
auto load_id_now = [](unsigned int at) -> int {
    int id;
    asm volatile("ld.shared.u32 %0, [%1];" : "=r"(id) : "r"(at));
    return id;
};
auto load_row = [&](int place) -> Row {
    constexpr int TOGETHER = ROW_LENGTH * sizeof(real) < 16 ? ROW_LENGTH : 16 / sizeof(real);
    struct Part { real at[TOGETHER]; };
    Row row;
#pragma unroll
    for (int p = 0; p < ROW_LENGTH / TOGETHER; ++p) {
        Part part;
        load_words((const Part*)(values + (long long)ROW_LENGTH * place) + p, &part);
#pragma unroll
        for (int c = 0; c < TOGETHER; ++c)
            row.at[TOGETHER * p + c] = part.at[c];
    }
    return row;
};
auto load_place = [&](int place) -> Place {
    struct Part { real at[16 / sizeof(real)]; };
    Part parts[4 * sizeof(real) / 16];
#pragma unroll
    for (int p = 0; p < (int)(4 * sizeof(real) / 16); ++p)
        load_words((const Part*)(sorted + place) + p, parts + p);
    Place there;
    memcpy(&there, parts, sizeof there);
    return there;
};
// --- part: add_pairs

bool fresh = true;  // there are no sums of this group yet
auto add_pairs = [&](bool finished) {
    const unsigned int behind = 1u << tested / 32;  // the block behind the last one: nobody has met it
    warp.hits[tested / 32][lane] = 0;
    met_in |= behind;
    // a lane that has no pair left reads the id behind a block's, and nothing comes of it; but it must be a place
    if (lane < 2 && kept <= tested + 32 * lane)
        warp.ids[tested + 32 * lane] = 0;
    __syncwarp();
    const long long own_at = (long long)my_id * OWN, at = (long long)my_id * ROW_SUMS;
    $values
    $started
    $held_pairs
    // Several pairs at once, and what is read of the next ones meanwhile: it takes longer than what is done with it. Two sets take
    // turns, since to copy one would be to wait for it; and it is asked in between whether more is left, since the compiler puts
    // what is loaded off until it is used, but not beyond that question.
    struct Taken {
        bool pairs[TAKEN];
        $fields
    };
    auto take = [&](Taken& taken) {
        unsigned int at[TAKEN];
#pragma unroll
        for (int k = 0; k < TAKEN; ++k) {
            const unsigned int below = hits - 1;
            taken.pairs[k] = hits != 0;
            at[k] = ids + 4 * __popc(below & ~hits);
            hits &= below;
        }
        $loaded
        advance();
    };
    auto evaluate = [&](const Taken& now) {
#pragma unroll
        for (int k = 0; k < TAKEN; ++k) {
            const bool is_pair = now.pairs[k];
            $row
            $term
        }
    };
    advance();
    advance();
    Taken some, others;
    take(some);
    while (__any_sync(ALL, some.pairs[0])) {
        take(others);
        evaluate(some);
        if (!__any_sync(ALL, others.pairs[0]))
            break;
        take(some);
        evaluate(others);
    }
    $stored
    met_in = 0;
    fresh = false;
};
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
auto integer_at = [&](long long at) -> int { return Lattice::packed_turns(errors[at]); };
auto put_integer = [&](long long at, int x) {
    if constexpr (DOUBLE)
        errors[at] = x;
    else
        memcpy(errors + at, &x, 4);
};
