// The bits of floats, and their size.
#pragma once
#include "constants.h"
#include "device.h"

JFRNN_FUNCTION real size_of(real x) { return x < 0 ? -x : x; }
struct Bits {  // of floats
    enum { MANTISSA = DOUBLE ? 52 : 23, EXPONENTS = DOUBLE ? 0x7ff : 0xff, BIAS = DOUBLE ? 1023 : 127 };
    JFRNN_FUNCTION unsigned long long of(real x) {
        if constexpr (DOUBLE) {
            unsigned long long b;
            memcpy(&b, &x, 8);
            return b;
        } else {
            unsigned int b;
            memcpy(&b, &x, 4);
            return b;
        }
    }
    JFRNN_FUNCTION int exponent(real x) { return (int)(of(x) >> MANTISSA) & EXPONENTS; }
    JFRNN_FUNCTION bool finite(real x) { return exponent(x) != EXPONENTS; }
    JFRNN_FUNCTION bool negative(real x) { return of(x) >> (DOUBLE ? 63 : 31) & 1; }
    JFRNN_FUNCTION real not_finite() {
        const unsigned long long b = (unsigned long long)EXPONENTS << MANTISSA;
        real x;
        memcpy(&x, &b, sizeof(real));
        return x;
    }
    JFRNN_FUNCTION real no_number() {
        const unsigned long long b = (2ull * EXPONENTS + 1) << (MANTISSA - 1);
        real x;
        memcpy(&x, &b, sizeof(real));
        return x;
    }
    JFRNN_FUNCTION double power_of_two(int e) {
        const unsigned long long b = (unsigned long long)(e + 1023) << 52;
        double x;
        memcpy(&x, &b, 8);
        return x;
    }
    // power of two that brings r into [1, 4) and is itself a normal float
    JFRNN_FUNCTION double unit_scale(real r) {
        const int e = exponent(r) - BIAS, largest = BIAS - 1;
        return power_of_two(e > largest ? -largest : -e);
    }
};
// The bits of a number, as an integer of its width.
JFRNN_FUNCTION whole bits_of_number(real x) {
    whole bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}
