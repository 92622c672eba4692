// Which slots of a list that is kept hold a pair now: one text for a slot, on CUDA, and for LANES of them, on the CPU.
//
// Rows of the list have OWN_LENGTH numbers: coordinates as they are, then turns along each axis (PERIODIC == 2), then the cutoff of i
// (DIFFER). Sources have LENGTH: coordinates, OTHERS numbers that a term reads, turns and the cutoff of j. OWN_ROWS: rows are the
// sources, whose numbers are theirs, too; no cutoffs differ. `cutoff` holds the largest cutoff, the lattice, and the largest number of
// a shift. BOXES: it has such numbers for each of several systems, of which `systems` says to which a row belongs. `steps` are the
// shifts of image codes, or a 0 where there are none, and behind them the cutoffs of pairs of species behind how many there are, -1
// for those that are no neighbors; in place of cutoffs then stand the first place of the row of i, and the species of j. REVERSED:
// rows are those of the sources of the list, whose slots are `lengths` many in `slots` from `starts` on, and j is who has such a slot.
// ORDERED: threads take rows as `order` has them, so that rows that are taken together read the same sources, or as they come where it
// holds -1. APART: a particle's pair with itself, without a shift, is left out. ITSELF: it is a pair, whatever the cutoff.
// Unused slots hold n. Source n stands behind all others, and its numbers are NaN, so that unused slots never pass the test.
#pragma once
#include "codes.h"
#include "math.h"
#include "pair_cutoffs.h"

struct KeptArguments {
    const real *rows, *points, *cutoff, *steps;
    const int *idx, *count, *codes, *slots, *starts, *lengths, *order, *systems;
    int m, n, capacity, images, closed;
};
// Threads of the CPU hand themselves chunks of rows from `info`; CUDA reads nothing there.
struct MaskArguments : KeptArguments {
    int* mask;
    real* distances;
    int* info;
};
struct KeptSlopesArguments : KeptArguments {
    const real *distances, *slopes;
    real *sums, *parts;
    int* info;
};
struct KeptSumsArguments : KeptArguments {
    const real *shared_values, *own_values;
    real *sums, *totals, *errors;
    int* info;
};

template <bool WIDE>
struct NumberOfSlots {
    typedef Math::f32 type;
};
template <>
struct NumberOfSlots<true> {
    typedef Math::f64 type;
};
typedef NumberOfSlots<DOUBLE>::type Number;  // one, or LANES of them

constexpr bool CODED = PERIODIC == 2;
constexpr int TURNS = DIM + OTHERS, RADIUS = TURNS + (CODED ? DIM : 0);  // where they stand among the numbers of a source
constexpr int OWN_TURNS = DIM, OWN_RADIUS = OWN_TURNS + (CODED ? DIM : 0), OWN_LENGTH = OWN_RADIUS + DIFFER;

// Derivatives by positions (KeptSlopes): each slot has the slope of a function by its distance, and (CUDA) in `slots` the slot of the
// pair the other way round: what both give to the row is along x_j - x_i. Distances below this, whose reciprocal is no float, give
// nothing.
constexpr real LEAST_DISTANCE = DOUBLE ? real(0x1p-1022) : real(0x1p-126f);

struct Kept : KeptArguments, Space {
    Band<real> in_space;  // of pairs of points as they are, where all cutoffs are one
    real moved;           // the most that a shift of 1 along each axis adds up to in a component
    real most;            // the largest number of a shift for which pairs are decided
    // Where lattice vectors lie along the axes: their lengths, the reciprocals (0 where space is open), and a little less than their
    // halves (there: infinity). No store can change them.
    real sides[3], units[3], halves[3];

    int system;  // whose lattice it is

    // `row` is the first one that is looked at.
    JFRNN_MEMBER explicit Kept(const KeptArguments& given, int row = 0)
        : KeptArguments(given), Space(numbers_of(given, row)), moved(0), most(0), system(BOXES ? given.systems[row] : 0) {
        in_space = Bands::of_one(step_radius, real(0), Bands::ONE);
        measure_lattice();
        if constexpr (SHIFTED)
            most = cutoff[LATTICE_END];
    }
    JFRNN_FUNCTION const real* numbers_of(const KeptArguments& given, int row) {
        return given.cutoff + (BOXES ? (LATTICE_END + 1ll) * given.systems[row] : 0);
    }
    // Goes to the lattice of a row.
    JFRNN_MEMBER void enter(int row) {
        if (!BOXES || systems[row] == system)
            return;
        system = systems[row];
        lattice = Lattice(numbers_of(*this, row));
        measure_lattice();
    }
    JFRNN_MEMBER void measure_lattice() {
        moved = 0;
        for (int k = 0; SHIFTED && k < DIM; ++k) {
            real sum = 0;
            for (int l = 0; l < DIM; ++l)
                sum += size_of(lattice.vector(l, k));
            moved = sum > moved ? sum : moved;
        }
        for (int k = 0; k < 3; ++k) {
            const bool turns = SHIFTED && !SKEWED && k < DIM && lattice.periodic(k);
            sides[k] = turns ? lattice.vector(k, k) : real(0);
            units[k] = turns ? lattice.transform(k, k) : real(0);
            halves[k] = turns ? real(0.49) * sides[k] : Bits::not_finite();
        }
    }
    JFRNN_MEMBER real scale() const { return SCALED ? step_scale : real(1); }  // which is known where it is 1
    JFRNN_INLINE static Number larger(Number x, Number y) { return Math::select(Math::gt(x, y), x, y); }

    JFRNN_MEMBER int code_at(long long slot) const { return image_code(codes, slot); }
    // The source and the image code that an entry of a row names: the id in a slot of the list, or (REVERSED) a slot.
    JFRNN_MEMBER void read_entry(long long entry, int& source, int& code) const {
        const long long slot = REVERSED ? slots[entry] : entry;
        source = REVERSED ? (int)(slot / capacity) : idx[entry];
        code = !CODED ? 0 : REVERSED ? images - 1 - code_at(slot) : code_at(slot);
    }
    JFRNN_MEMBER long long first_entry(int row) const { return REVERSED ? starts[row] : (long long)row * capacity; }
    JFRNN_MEMBER int entries(int row) const { return REVERSED ? lengths[row] : count[row] < capacity ? count[row] : capacity; }

    // What a term reads of a row: its own numbers, or (MIRRORED) those of the source of that number.
    JFRNN_MEMBER const real* own_numbers(const real* own_values, int row) const {
        return MIRRORED ? points + (long long)LENGTH * row + DIM : own_values + (long long)OWN * row;
    }
    // What is known of a row.
    struct OwnPoint {
        real q[3], turn[3], radius;
    };
    JFRNN_MEMBER OwnPoint own_point(int row) const {
        OwnPoint own{{0, 0, 0}, {0, 0, 0}, 0};
        const real* const from = OWN_ROWS ? points + (long long)LENGTH * row : rows + (long long)OWN_LENGTH * row;
        for (int k = 0; k < DIM; ++k) {
            own.q[k] = from[k];
            if constexpr (CODED)
                own.turn[k] = from[(OWN_ROWS ? TURNS : OWN_TURNS) + k];
        }
        if constexpr (DIFFER)
            own.radius = from[OWN_RADIUS];
        return own;
    }

    // Images are the nearest ones along the axes. Most pairs lie apart from the faces of the box, and are then decided as in open space.
    static constexpr bool NEAREST = SHIFTED && !CODED && !SKEWED;
    // (NEAREST) May the nearest image of a source be another one than the source itself? Not of slots that are not used.
    JFRNN_INLINE Math::flag may_turn(const OwnPoint& own, const Number* numbers) const {
        Math::flag found = Math::gt(Math::abs(numbers[0] - own.q[0]), Math::of(halves[0]));
        for (int k = 1; k < DIM; ++k)
            found = Math::either(found, Math::gt(Math::abs(numbers[k] - own.q[k]), Math::of(halves[k])));
        return found;
    }

    // What is found out about slots: the lattice shift, x_j - x_i with it, and whether it is a pair.
    struct Verdict {
        Number shift[3], vector[3];
        Math::flag sure, open;
    };
    // `step` (CODED): the shift of the image code of each slot; `other` (APART, ITSELF): the source of a slot is not its row. Slots that
    // are not used hold no numbers (NaN), so they are neither sure nor open, unless nothing is DECIDED. HOME: none may turn.
    template <bool HOME>
    JFRNN_INLINE Verdict judge(const OwnPoint& own, const Number* numbers, const Number* step, Math::flag other) const {
        constexpr bool MOVED = SHIFTED && !HOME;
        Math::flag used = Math::eq(Number{}, Number{});
        Number d[3], square{};
        Verdict found{};
        for (int k = 0; k < DIM; ++k)
            d[k] = numbers[k] - own.q[k];
        Number off{}, spans{};
        if constexpr (MOVED) {
            Number size{};
            for (int k = 0; k < DIM; ++k) {
                if constexpr (CODED || SKEWED)
                    found.shift[k] =
                        lattice.periodic(k) ? (CODED ? step[k] + own.turn[k] - numbers[TURNS + k] : nearest(d, k)) : Number{};
                else
                    found.shift[k] = -Math::round_even(d[k] * units[k]);
                spans = larger(Math::abs(found.shift[k]), spans);
                size = larger(Math::abs(d[k]), size);
            }
            used = Math::both(used, Math::le(spans, Math::of(most)));
            if constexpr (APART)
                used = Math::both(used, Math::either(other, Math::gt(spans, Number{})));
            // twice the most that a component is off by (jfrnn/_geometry/lattice.py)
            off = (size + (spans + real(1)) * moved) * (16 * step_eps * scale());
            for (int k = 0; k < DIM; ++k)
                d[k] = d[k] + translation(found.shift, k);
        } else if constexpr (APART)
            used = other;
        for (int k = 0; k < DIM; ++k)
            found.vector[k] = d[k];
        if constexpr (!DECIDED) {
            found.sure = used;
            return found;
        }
        for (int k = 0; k < DIM; ++k) {  // as terms add squares, so that they are taken once
            const Number scaled = d[k] * scale();
            square = k > 0 ? square + scaled * scaled : scaled * scaled;
        }
        Band<Number> band{Math::of(in_space.inside), Math::of(in_space.outside)};
        if constexpr (DIFFER)
            band = Bands::bounds_of(Number(cutoff_of(own, numbers) * scale()), off);
        else if constexpr (MOVED)
            band = Bands::of_one(Math::of(step_radius), off, Bands::IMAGES);
        Math::flag itself = Math::both(used, Math::both(Math::inverse(other), Math::eq(square, square)));
        found.sure = Math::both(used, Math::lt(square, band.inside));
        if constexpr (ITSELF) {
            if constexpr (MOVED)
                itself = Math::both(itself, Math::le(spans, Number{}));
            found.sure = Math::either(found.sure, itself);
        }
        found.open = Math::both(Math::both(used, Math::le(square, band.outside)), Math::inverse(found.sure));
        return found;
    }
    // The length of a vector: squares of very small ones would underflow, so these are taken in a unit of their own.
    JFRNN_INLINE Number length_of(const Number* vector) const {
        constexpr real SMALL = DOUBLE ? real(0x1p-480) : real(0x1p-50f), LARGE_UNIT = DOUBLE ? real(0x1p700) : real(0x1p90f);
        Number size{}, square{};
        for (int k = 0; k < DIM; ++k)
            size = larger(Math::abs(vector[k]), size);
        const Math::flag small = Math::lt(size * scale(), Math::of(SMALL));
        for (int k = 0; k < DIM; ++k) {
            const Number plain = vector[k] * scale(), scaled = Math::select(small, plain * LARGE_UNIT, plain);
            square = square + scaled * scaled;
        }
        const Number length = Math::sqrt(square);
        return Math::select(small, length / LARGE_UNIT, length) / scale();
    }
    // Where vectors of the lattice do not lie along the axes: the shift of the nearest image along one of them.
    JFRNN_INLINE Number nearest(const Number* d, int k) const {
        Number along = d[0] * lattice.transform(0, k);
        for (int l = 1; l < DIM; ++l)
            along = along + d[l] * lattice.transform(l, k);
        return -Math::round_even(along);
    }
    JFRNN_INLINE Number translation(const Number* shift, int k) const {
        Number sum = shift[k] * (SKEWED ? lattice.vector(k, k) : sides[k]);
        if constexpr (SKEWED)
            for (int l = 0; l < DIM; ++l)
                if (l != k)
                    sum = sum + shift[l] * lattice.vector(l, k);
        return sum;
    }
    JFRNN_INLINE Number cutoff_of(const OwnPoint& own, const Number* numbers) const {
        const Number mine = Math::of(own.radius);
        if constexpr (RULE == TABLE) {
            const Number place = mine + numbers[RADIUS];
            Number found{};
#if JFRNN_SCALAR
            found = cutoff_at(place);
#else
            for (int l = 0; l < LANES; ++l)
                found[l] = cutoff_at(place[l]);
#endif
            return found;
        }
        return PairCutoffs::of_pair(mine, numbers[DIFFER ? RADIUS : 0]);
    }
    // The cutoff of two species, given its place in the table; of slots that are not used, that may be anything.
    JFRNN_MEMBER real cutoff_at(real place) const {
        const real* const kinds = steps + (CODED ? DIM * images : 1);
        return place >= 0 && place < kinds[0] ? kinds[1 + (int)place] : real(-1);
    }
    // Decides exactly about a source at `p`, whose cutoff is `theirs`.
    JFRNN_MEMBER bool is_exact_pair(const OwnPoint& own, const real* p, real theirs, const int* shift) const {
        real r = radius, more = 0;
        if constexpr (DIFFER) {
            r = RULE == TABLE ? cutoff_at(own.radius + theirs) : SUM ? own.radius / 2 : PairCutoffs::of_pair(own.radius, theirs);
            more = SUM ? theirs / 2 : real(0);
        }
        if constexpr (!SHIFTED)
            return exact_pair(own.q, p, r, more, closed);
        int whole_numbers[3] = {shift[0], shift[1], shift[2]};
        for (int k = 0; SKEWED && k < DIM; ++k) {
            whole_numbers[k] = 0;
            for (int l = 0; l < DIM; ++l)
                whole_numbers[k] += shift[l] * lattice.number(l, k);
        }
        return Exact::image_pair(own.q, p, r, more, closed, whole_numbers, lattice);
    }
};
