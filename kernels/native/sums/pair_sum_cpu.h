// Sums over pairs on the CPU: terms are evaluated where their pairs are found, 8 or 16 at a time.
#pragma once
#include "query_walk_cpu.h"
#include "reduction_cpu.h"

struct SumArguments : SearchArguments {
    const real *shared_values, *own_values, *columns;
    real *sums, *totals, *errors, *more;
};

// What the term reads of the sources stands in `columns`, in the order of cells; columns of the candidates lie beside their
// coordinates. In a periodic box positions as they are given, and turns, are read of rows of particles. Behind the other columns stand
// those of the sources, if any particle has turns. With the image of a candidate, turns make the lattice shift of the pair, a step
// along each axis.
template <template <class> class Way>
struct SumsBy : Way<SumsBy<Way>> {
    typedef Way<SumsBy<Way>> Base;
    using Base::axis, Base::filled, Base::floats, Base::image, Base::inside, Base::n, Base::others_mask, Base::outside;
    using Base::band_at, Base::band_of, Base::candidate, Base::candidate_ids, Base::candidate_images, Base::candidates_at;
    using Base::collect_doubtful, Base::decided, Base::doubtful, Base::doubtful_at, Base::excluded, Base::excluded_starts;
    using Base::queries, Base::several, Base::shared, Base::shift, Base::square_of, Base::sure, Base::sure_among, Base::sure_mask,
        Base::unsure, Base::wanted;
    static constexpr bool FLUSHED = !SCALED;  // where cutoffs are so small that they are scaled, so may be what decides
    alignas(64) real column[OTHERS + STEPS + 1][CANDIDATES + LANES];
    alignas(64) real near_points[PACKED ? 3 : 1][PACKED ? CANDIDATES + LANES : 1];
    alignas(64) real near_column[PACKED ? OTHERS + STEPS + 1 : 1][PACKED ? CANDIDATES + LANES : 1];
    const real *own_values, *columns;
    const Term term;
    Results results;

    explicit SumsBy(const SumArguments& a)
        : Base(a),
          own_values(a.own_values),
          columns(a.columns),
          term(a.shared_values),
          results(a.sums, a.totals, a.errors, a.n, a.more) {
        memset(column, 0, sizeof column);
        memset(candidate, 0, sizeof candidate);
        memset(doubtful, 0, sizeof doubtful);
    }

    void copied(int from, unsigned int near) {
        const bool at_home = this->at_home(), turned = this->turned();
        for (int c = 0; c < OTHERS; ++c)
            if (COLUMN_AXES[c] < 0)
                pack(lanes_from(columns + (long long)COLUMN_NUMBERS[c] * n + from), column[c] + filled, near);
            else if (!at_home)
                pack(lanes_from(given(COLUMN_AXES[c]) + from), column[c] + filled, near);
        for (int c = 0; c < STEPS && !at_home; ++c) {
            ints steps = ints{} + shift[STEP_AXES[c]];
            if (turned)
                steps -= Lattice::turns_of<ints>(vec(lanes_from(given(DIM) + from)), STEP_AXES[c]);
            pack(__builtin_convertvector(steps, vec), column[OTHERS + c] + filled, near);
        }
    }
    // Must turns be looked at, and positions as they were given?
    bool turned() const { return PERIODIC && READS_ROWS > 0 && shared.turned >= READS_ROWS; }
    // Are there no images among the candidates? Then no pair has a shift.
    bool at_home() const { return PERIODIC && !several && !turned(); }
    // Where the numbers k of the rows of the sources stand, in the order of cells.
    const real* given(int k) const { return turned() ? columns + (long long)(COLUMNS + k) * n : axis[k]; }
    void expect(int id) const {  // rows of queries stand anywhere
        if constexpr (OWN > 0)
            __builtin_prefetch(own_values + (long long)id * OWN);
        if (turned())
            __builtin_prefetch(queries + (long long)id * ROW);
    }
    void none(int id) { results.clear(id); }
    void chunk_done(int chunk) { results.store_totals(chunk); }
    void finish() {}

    void meet(const real* q, int id, bool fresh, bool finished) {
        if (this->at_home())
            meet_by<PERIODIC != 0>(q, id, fresh, finished);
        else
            meet_by<false>(q, id, fresh, finished);
    }
    // `decided` while a term is evaluated: denormals are kept for what float64 leaves open alone.
    unsigned int decided_between(const real* q, int id, const Points& points, const int* numbers, unsigned int open) const {
        unsigned int pairs = sure(q, points, open);
        if (open) {
            if constexpr (FLUSHED)
                floats.keep();
            pairs |= decided(q, id, points, numbers, open);
            if constexpr (FLUSHED)
                floats.flush();
        }
        return pairs;
    }
    // AT_HOME: coordinates that the term reads are those of the candidates, and all steps are 0.
    template <bool AT_HOME>
    void meet_by(const real* q, int id, bool fresh, bool finished) {
        const Term::Own own_part =
            term.own<AT_HOME>(own_values + (long long)id * OWN, q, turned() ? queries + (long long)id * ROW : nullptr);
        Reduction reduction(n);
        if constexpr (PACKED)
            meet_packed<AT_HOME>(q, id, own_part, reduction);
        else
            meet_in_place<AT_HOME>(q, id, own_part, reduction);
        reduction.store(results, id, fresh, finished, names());
    }
    template <bool AT_HOME>
    static constexpr bool has_column(int c) {
        return !AT_HOME || (c < OTHERS && COLUMN_AXES[c] < 0);
    }
    // What the columns of points hold, where those that there are come from `load`.
    template <bool AT_HOME, class Load>
    static auto columns_of(const Points& points, Load load) {
        return [&points, load](int c) -> number {
            return has_column<AT_HOME>(c) ? load(c) : c < OTHERS ? points.p[COLUMN_AXES[c] < 0 ? 0 : COLUMN_AXES[c]] : number{};
        };
    }
    // Evaluates the term for vectors of candidates as they are, under a mask; those in doubt follow.
    template <bool AT_HOME>
    void meet_in_place(const real* q, int id, const Term::Own& own_part, Reduction& reduction) {
        const Band<real> of_query{inside, outside};
        const int filled = this->filled;
        const Excluded mine = this->excluded_by(id);
        unsigned int any_unsure = 0;
        for (int b = 0, v = 0; b < filled; b += LANES, ++v) {
            const Points points = candidates_at(b);
            const vec square = square_of(q, points.p);
            const auto band = band_at(b, of_query);
            unsigned int allowed = others_mask(b);
            if constexpr (EXCLUDING)
                allowed = wanted(mine, b, allowed & (mask_of(square, band.outside, BelowOrAt{}) | sure_mask(b)));
            const unsigned int hit = (mask_of(square, band.inside, Below{}) | sure_mask(b)) & allowed;
            unsure[v] = ~hit & mask_of(square, band.outside, BelowOrAt{}) & allowed;
            any_unsure |= unsure[v];
            if (SKIPPED && hit == 0)
                continue;
            number summand[SUMMANDS];
            auto load = [&](int c) { return *(const number*)(column[c] + b); };
            term.evaluate<AT_HOME>(own_part, points.p, columns_of<AT_HOME>(points, load), summand);
            reduction.add(summand, flags_of(hit), b, names());
        }
        const int doubts = any_unsure ? collect_doubtful(filled) : 0;
        for (int b = 0; b < doubts; b += LANES) {
            const Points points = doubtful_at(b);
            const unsigned int hit = decided_between(q, id, points, doubtful + b, lanes_before(doubts - b));
            number summand[SUMMANDS];
            auto load = [&](int c) { return gathered(column[c], doubtful + b); };
            term.evaluate<AT_HOME>(own_part, points.p, columns_of<AT_HOME>(points, load), summand);
            reduction.add(summand, flags_of(hit), ~b, names());
        }
    }
    // Packs what is near first, so that the term is evaluated for hardly more than the pairs.
    template <bool AT_HOME>
    void meet_packed(const real* q, int id, const Term::Own& own_part, Reduction& reduction) {
        const Band<real> of_query{inside, outside};
        const int filled = this->filled;
        const ints numbers = first_numbers();
        const Excluded mine = this->excluded_by(id);
        int held = 0;
        for (int b = 0; b < filled; b += LANES) {
            const Points points = candidates_at(b);
            unsigned int near = mask_of(square_of(q, points.p), band_at(b, of_query).outside, BelowOrAt{}) | sure_mask(b);
            near &= others_mask(b);
            if constexpr (EXCLUDING)
                near = wanted(mine, b, near);
            for (int k = 0; k < DIM; ++k)
                pack(points.p[k], near_points[k] + held, near);
            for (int c = 0; c < OTHERS + STEPS; ++c)
                if (has_column<AT_HOME>(c))
                    pack(*(const number*)(column[c] + b), near_column[c] + held, near);
            if constexpr (PERIODIC || DIFFER || SUMS == 2)
                pack(numbers + b, doubtful + held, near);
            held += __builtin_popcount(near);
        }
        for (int b = 0; b < held; b += LANES) {
            Points points;
            for (int k = 0; k < DIM; ++k)
                points.p[k] = *(const vec*)(near_points[k] + b);
            const unsigned int there = lanes_before(held - b);
            unsigned int hit = mask_of(square_of(q, points.p), band_of(doubtful + b, of_query).inside, Below{}) & there;
            hit |= sure_among(doubtful + b, there);
            if (const unsigned int open = there & ~hit)
                hit |= decided_between(q, id, points, doubtful + b, open);
            number summand[SUMMANDS];
            auto load = [&](int c) { return *(const number*)(near_column[c] + b); };
            term.evaluate<AT_HOME>(own_part, points.p, columns_of<AT_HOME>(points, load), summand);
            reduction.add(summand, flags_of(hit), ~b, names());
        }
    }
    // Tells who a candidate is, and of which image: that of a lane behind the first of a vector, or behind a place in `doubtful`.
    auto names() const {
        return [this](int first, int lane, int& source, int& code) {
            const int number_of_it = first < 0 ? doubtful[~first + lane] : first + lane;
            source = candidate_ids[number_of_it];
            code = PERIODIC && several ? candidate_images[number_of_it] : image;
        };
    }
};
struct Sums {
    const SumArguments& given;
    explicit Sums(const SumArguments& given) : given(given) {}
    void run() { walk<SumsBy>(given); }
};
