// The lattice of a periodic box: its numbers stand behind the radius in the array `cutoff` (see jfrnn/kernels/_native.py).
#pragma once
#include "bits.h"

constexpr int ROW = DIM + (PERIODIC ? 1 : 0) + BATCHED;         // numbers per particle
constexpr int LATTICE_END = PERIODIC ? (SKEWED ? 48 : 30) : 1;  // numbers in `cutoff`, but for the last one of a batch

struct Lattice {
    enum { GIVEN = SKEWED ? 30 : 1, NUMBERS = GIVEN + 9 };  // where vectors that were given stand, and how many of them make one
    enum { NONE = 512 | 512 << 10 | (DIM == 3 ? 512 << 20 : 0) };  // packed turns of what lies in the cell
#if defined(__CUDACC__)
    const real* numbers;
    JFRNN_MEMBER explicit Lattice(const real* cutoff) : numbers(cutoff) {}
    JFRNN_MEMBER Lattice() : numbers(nullptr) {}
    typedef Lattice Argument;
#else
    real numbers[LATTICE_END];  // copies of the caller's: no store of the kernel can change them, which spares the compiler loads
    explicit Lattice(const real* cutoff) {
        for (int k = 0; PERIODIC && k < LATTICE_END; ++k)
            numbers[k] = cutoff[k];
    }
    Lattice() {}
    typedef const Lattice& Argument;
#endif
    JFRNN_MEMBER real vector(int l, int k) const { return numbers[1 + 3 * l + k]; }
    // the vectors that the caller gave, in which pairs are decided, and how many of each there are in vector l
    JFRNN_MEMBER real given(int l, int k) const { return numbers[GIVEN + 3 * l + k]; }
    JFRNN_MEMBER int number(int l, int k) const { return SKEWED ? (int)numbers[NUMBERS + 3 * l + k] : l == k; }
    JFRNN_MEMBER real transform(int k, int axis) const { return numbers[10 + 3 * k + axis]; }
    JFRNN_MEMBER real origin(int k) const { return numbers[19 + k]; }
    JFRNN_MEMBER real reach(int axis) const { return numbers[22 + axis]; }
    // Where systems have boxes of their own, images are numbered alike in all of them: an axis that is open in one has -images there.
    JFRNN_MEMBER int images(int axis) const {
        const int told = (int)numbers[25 + axis];
        return BOXES && told < 0 ? -told : told;
    }
    JFRNN_MEMBER real slack() const { return numbers[PERIODIC ? 28 : 0]; }
    // at least the most lattice vectors between the cell and any particle along an axis, and less than twice as many; 1 is exact
    JFRNN_MEMBER real most_turns() const { return PERIODIC ? numbers[29] : real(0); }
    JFRNN_MEMBER bool periodic(int axis) const { return numbers[25 + axis] > 0; }
    // uncontracted, so that a coordinate is the same wherever it is computed
#if defined(__CUDA_ARCH__)
    JFRNN_FUNCTION real add(real a, real b) {
        if constexpr (DOUBLE)
            return __dadd_rn(a, b);
        else
            return __fadd_rn(a, b);
    }
    JFRNN_FUNCTION real mul(real a, real b) {
        if constexpr (DOUBLE)
            return __dmul_rn(a, b);
        else
            return __fmul_rn(a, b);
    }
#else
    JFRNN_FUNCTION real add(real a, real b) { return a + b; }
    JFRNN_FUNCTION real mul(real a, real b) { return a * b; }
#endif
    // turns of a row: how many lattice vectors lie between the cell and the particle
    JFRNN_FUNCTION int packed_turns(real last) {
        int packed;
        if constexpr (DOUBLE)
            packed = (int)last;
        else
            memcpy(&packed, &last, 4);
        return packed;
    }
    JFRNN_FUNCTION int turn(real last, int axis) { return ((packed_turns(last) >> (10 * axis)) & 1023) - 512; }
#if !defined(__CUDACC__)
    template <class Ints, class Lanes>
    static Ints turns_of(Lanes last, int axis) {
        Ints packed;
        if constexpr (DOUBLE)
            packed = __builtin_convertvector(last, Ints);
        else
            memcpy(&packed, &last, sizeof packed);
        return ((packed >> (10 * axis)) & 1023) - 512;
    }
#endif
    // component k of S·A
    JFRNN_MEMBER real translation(int sx, int sy, int sz, int k) const {
        if constexpr (!SKEWED)  // its vectors lie along the axes, and what others would add is 0
            return mul(real(k == 0 ? sx : k == 1 ? sy : sz), vector(k, k));
        real sum = mul(real(sx), vector(0, k));
        sum = add(sum, mul(real(sy), vector(1, k)));
        return DIM == 3 ? add(sum, mul(real(sz), vector(2, k))) : sum;
    }
    // a row of positions brought into the cell; one that is too far away for that is not finite
    JFRNN_MEMBER void wrap(const real* numbers, real* p) const {
        struct alignas(ROW % 4 ? sizeof(real) : 16) Row {
            real numbers[ROW];
        };  // loaded at once, if it can be
        const Row loaded = *(const Row*)numbers;
        const real* row = loaded.numbers;
        if (packed_turns(row[DIM]) == NONE) {  // as nearly everywhere
            for (int k = 0; k < DIM; ++k)
                p[k] = row[k];
            return;
        }
        const int t[3] = {turn(row[DIM], 0), turn(row[DIM], 1), DIM == 3 ? turn(row[DIM], 2) : 0};
        for (int k = 0; k < DIM; ++k)
            p[k] = t[0] | t[1] | t[2] ? add(row[k], -translation(t[0], t[1], t[2], k)) : row[k];
        if (Bits::negative(row[DIM]))
            p[0] = Bits::not_finite();
    }
    // coordinate of a wrapped point along an axis of cells: a fraction where that is periodic, else a length
    JFRNN_MEMBER real along(int axis, const real* p) const {
        real sum = mul(add(p[axis], -origin(axis)), transform(axis, axis));
        if constexpr (SKEWED) {
            sum = mul(add(p[0], -origin(0)), transform(0, axis));
            for (int k = 1; k < DIM; ++k)
                sum = add(sum, mul(add(p[k], -origin(k)), transform(k, axis)));
        }
        if (!periodic(axis))
            return sum;
        return sum < 0 ? real(0) : sum > 1 ? real(1) : sum;
    }
};
