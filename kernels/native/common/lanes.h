// Vectors of Clang: as many numbers side by side as a register of the CPU holds.
#pragma once
#include "lane_count.h"

typedef real vec __attribute__((vector_size(LANES * sizeof(real))));
typedef int ints __attribute__((vector_size(LANES * 4)));
typedef bool flags __attribute__((ext_vector_type(LANES)));

struct Below {
    enum { value = 17 };
};
struct BelowOrAt {
    enum { value = 18 };
};
// One bit per lane: is it below its bound, or at it?
template <class Comparison>
static unsigned int mask_of(vec a, vec bounds, Comparison) {
#if defined(__AVX512F__) && defined(__AVX512VL__)
    typedef float floats __attribute__((vector_size(64)));
    typedef double doubles __attribute__((vector_size(64)));
    if constexpr (DOUBLE)
        return (unsigned char)__builtin_ia32_cmppd512_mask((doubles)a, (doubles)bounds, Comparison::value, -1, 4);
    else
        return (unsigned short)__builtin_ia32_cmpps512_mask((floats)a, (floats)bounds, Comparison::value, -1, 4);
#else
    const auto lanes = Comparison::value == 18 ? a <= bounds : a < bounds;
    const flags f = __builtin_convertvector(lanes, flags);
    unsigned char bits;
    __builtin_memcpy(&bits, &f, 1);
    return LANES == 4 ? bits & 15 : bits;
#endif
}
template <class Comparison>
static unsigned int mask_of(vec a, real bound, Comparison c) {
    return mask_of(a, vec{} + bound, c);
}
// One bit per lane of flags.
static unsigned int bits_of_flags(flags f) {
    unsigned short bits = 0;
    __builtin_memcpy(&bits, &f, LANES == 16 ? 2 : 1);
    return bits & ((1u << LANES) - 1);
}
// And back.
static flags flags_of(unsigned int bits) {
    flags lanes;
    __builtin_memcpy(&lanes, &bits, sizeof lanes);
    return lanes;
}
static unsigned int lanes_before(int count) { return count < LANES ? (1u << count) - 1 : (1u << LANES) - 1; }

// Stores the lanes of a mask one after the other; up to LANES elements at `to` are overwritten.
template <class Vector, class Element>
static void pack(Vector from, Element* to, unsigned int mask) {
#if defined(__AVX512F__) && defined(__AVX512VL__)
    typedef int ints8 __attribute__((vector_size(32)));
    typedef int ints16 __attribute__((vector_size(64)));
    typedef double doubles8 __attribute__((vector_size(64)));
    if constexpr (sizeof(Element) == 8)
        from = (Vector)__builtin_ia32_compressdf512_mask((doubles8)from, doubles8{}, mask);
    else if constexpr (LANES == 8)
        from = (Vector)__builtin_ia32_compresssi256_mask((ints8)from, ints8{}, mask);
    else
        from = (Vector)__builtin_ia32_compresssi512_mask((ints16)from, ints16{}, mask);
    __builtin_memcpy(to, &from, sizeof from);
#else
    for (; mask; mask &= mask - 1)
        *to++ = from[__builtin_ctz(mask)];
#endif
}
// As `pack`, but nothing beyond the first `room` elements at `to` is overwritten: lanes for which there is none are left out.
template <class Vector>
static void pack_within(Vector from, int* to, unsigned int mask, int room) {
    const int count = __builtin_popcount(mask), stored = count < room ? count : room;
#if defined(__AVX512F__) && defined(__AVX512VL__)
    typedef int ints8 __attribute__((vector_size(32)));
    typedef int ints16 __attribute__((vector_size(64)));
    const unsigned int first = stored > 0 ? (1u << stored) - 1 : 0;
    if constexpr (LANES == 8)
        __builtin_ia32_storedqusi256_mask((ints8*)to, (ints8)__builtin_ia32_compresssi256_mask((ints8)from, ints8{}, mask), first);
    else
        __builtin_ia32_storedqusi512_mask(to, (ints16)__builtin_ia32_compresssi512_mask((ints16)from, ints16{}, mask), first);
#else
    for (int k = 0; k < stored; ++k, mask &= mask - 1)
        to[k] = from[__builtin_ctz(mask)];
#endif
}
// What `from` holds at the places `numbers`; the processor's instructions that gather take longer.
static vec gathered(const real* from, const int* numbers) {
    vec lanes;
    for (int l = 0; l < LANES; ++l)
        lanes[l] = from[numbers[l]];
    return lanes;
}
// What a table of LANES entries holds at numbers below LANES.
static vec looked_up(vec table, ints numbers) {
#if defined(__AVX512F__) && defined(__AVX512VL__)
    typedef float floats __attribute__((vector_size(64)));
    typedef double doubles8 __attribute__((vector_size(64)));
    typedef long long longs8 __attribute__((vector_size(64)));
    int __attribute__((vector_size(32))) eight{};
    int __attribute__((vector_size(64))) sixteen{};
    __builtin_memcpy(&eight, &numbers, sizeof eight);
    __builtin_memcpy(&sixteen, &numbers, sizeof numbers);
    if constexpr (DOUBLE)
        return (vec)__builtin_ia32_permvardf512((doubles8)table, __builtin_convertvector(eight, longs8));
    else
        return (vec)__builtin_ia32_permvarsf512((floats)table, sixteen);
#else
    vec lanes;
    for (int l = 0; l < LANES; ++l)
        lanes[l] = ((const real*)&table)[numbers[l]];
    return lanes;
#endif
}
// A vector of numbers from anywhere.
template <class Element>
static auto lanes_from(const Element* from) {
    Element __attribute__((vector_size(LANES * sizeof(Element)))) lanes;
    __builtin_memcpy(&lanes, from, sizeof lanes);
    return lanes;
}
static ints first_numbers() {
    ints numbers;
    for (int l = 0; l < LANES; ++l)
        numbers[l] = l;
    return numbers;
}
