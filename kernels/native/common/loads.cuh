// What is read from global memory at once.
#pragma once
#include "constants.h"
#include "device.h"

// What is loaded here comes in the order of the text, all of several pairs before any of it is used: else the compiler saves
// registers, and every pair waits for its own.
template <class Words>
JFRNN_FUNCTION void load_words(const void* from, Words* to) {
    static_assert(sizeof(Words) == 4 || sizeof(Words) == 8 || sizeof(Words) == 16, "what is loaded at once");
    unsigned int w[4];
    const size_t at = __cvta_generic_to_global(from);
    if constexpr (sizeof(Words) == 16)
        asm volatile("ld.global.nc.v4.b32 {%0, %1, %2, %3}, [%4];" : "=r"(w[0]), "=r"(w[1]), "=r"(w[2]), "=r"(w[3]) : "l"(at));
    else if constexpr (sizeof(Words) == 8)
        asm volatile("ld.global.nc.v2.b32 {%0, %1}, [%2];" : "=r"(w[0]), "=r"(w[1]) : "l"(at));
    else
        asm volatile("ld.global.nc.b32 %0, [%1];" : "=r"(w[0]) : "l"(at));
    memcpy(to, w, sizeof(Words));
}
// Loads LENGTH numbers, as many at once as 16 bytes hold.
template <int LENGTH>
JFRNN_FUNCTION void load_numbers(const void* from, real* to) {
    constexpr int TOGETHER = LENGTH * sizeof(real) < 16 ? LENGTH : 16 / sizeof(real);
    struct Part {
        real at[TOGETHER];
    };
#pragma unroll
    for (int p = 0; p < LENGTH / TOGETHER; ++p) {
        Part part;
        load_words((const Part*)from + p, &part);
#pragma unroll
        for (int c = 0; c < TOGETHER; ++c)
            to[TOGETHER * p + c] = part.at[c];
    }
}
