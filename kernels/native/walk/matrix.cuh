// Queries and candidates as matrices of halves, which tensor cores multiply (float32).
#pragma once
#include "group.cuh"

constexpr unsigned int ONES = 0x3c003c00;  // two halves

// Returns factor * x as a sum of two halves: exact but for 2^-22 of it and what is too small for a half.
JFRNN_FUNCTION unsigned int halves(float x, float factor) {
    const float high = __uint_as_float(__float_as_uint(x) & 0xffffe000u), low = x - high;
    unsigned int word;
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(word) : "f"(factor * low), "f"(factor * high));
    return word;
}

// What most pairs are decided by. With a and b from the center, |b - a|^2 - r^2 + coarse_band is
// -2 a.b + |b|^2 * 1 + 1 * (|a|^2 - r^2 + coarse_band): products of rows and columns, in which a number is two halves, high and low.
// The tensor cores multiply them exactly and add in single precision at least, in whatever order, flushing or not flushing halves
// that are denormal (PTX ISA, mma). In units of reach^2, 16 sums of terms that add up to 6.5 lose less than 1.3e-5, flushing
// (reach > 120, or it does not matter) less than 4e-6, splitting and scaling less than 2e-6: less than the band of 2e-5. Negative: surely closer than
// the cutoff; beyond 2 coarse_band: surely not; between: decided one by one. On a lattice squares are whole numbers of squared units,
// of which that band is less than a quarter, and the limit lies in the middle between two of them: all signs are sure.
//
// Where species are few, r^2 is a product, too: that of a row with r^2 of the query for each species, and of a column with a 1 at the
// species of the candidate. These are three sums more, of terms that add up to 7.5: less than 1.8e-5 is lost, and the band is 3e-5.
struct Matrix {
    unsigned int high[4], low[4];                  // rows, the queries of a quad of lanes, whose lanes hold one column each
    unsigned int of_kinds[RULE == TABLE ? 4 : 1];  // and of a species each

    JFRNN_MEMBER Matrix() : high{0, 0, 0, 0}, low{0, 0, 0, 0}, of_kinds{0} {}
    // Makes rows of the queries; `x` is this lane's, from the center.
    JFRNN_MEMBER void make(const PairSearch& search, const real* x, const Group& group, int lane) {
        constexpr int SETS = RULE == TABLE ? 3 : 2;
        const float coarse_square = group.coarse_square;
        Warp& warp = shared_warp();
        unsigned int words[SETS][4];
        float square = 0;
#pragma unroll
        for (int a = 0; a < 3; ++a) {
            square += (float)x[a] * (float)x[a];
            const unsigned int word = halves((float)x[a], -2);
            words[0][a] = __byte_perm(word, 0, 0x1010);
            words[1][a] = __byte_perm(word, 0, 0x3232);
        }
        words[0][3] = ONES;
        words[1][3] = halves(square - coarse_square, 1);
#pragma unroll
        for (int k = 0; k < 4 && RULE == TABLE; ++k) {
            const real r = search.few_kinds() && k < search.kinds ? search.of_kinds[k] : real(0);
            const float scaled = (float)(r * group.scale * group.unit);
            constexpr float NONE = 57600;  // as far as anything near is
            words[SETS - 1][k] = !search.few_kinds() ? 0 : halves(r > 0 ? -(scaled * scaled) : NONE, 1);
        }
        unsigned int* const columns = (unsigned int*)warp.candidates;
#pragma unroll
        for (int k = 0; k < 4 * SETS; ++k)
            columns[33 * k + lane] = words[k / 4][k % 4];
        __syncwarp();
#pragma unroll
        for (int i = 0; i < 4; ++i) {
            high[i] = columns[33 * (lane % 4) + (lane & 28) + i];
            low[i] = columns[33 * (lane % 4 + 4) + (lane & 28) + i];
            if constexpr (RULE == TABLE)
                of_kinds[i] = columns[33 * (lane % 4 + 8) + (lane & 28) + i];
        }
        __syncwarp();
    }
    // Returns one bit per candidate of a block, those from `first_candidate` on: the sum's bits, less `from`, are negative. `closest`
    // becomes the least of the sums' bits.
    JFRNN_MEMBER unsigned int meet(unsigned int first_candidate, unsigned int from, unsigned int& closest, int lane) const {
        const uint4 loaded = *(const uint4*)(shared_warp().candidates[DOUBLE ? 0 : lane % 4] + first_candidate + lane / 4 * 4);
        const unsigned int column[4] = {loaded.x, loaded.y, loaded.z, loaded.w};
        uint4 kinds{0, 0, 0, 0};
        if constexpr (RULE == TABLE)
            kinds = *(const uint4*)(shared_warp().candidates[DOUBLE ? 0 : 4] + first_candidate + lane / 4 * 4);
        const unsigned int kind[4] = {kinds.x, kinds.y, kinds.z, kinds.w};
        unsigned int nibbles[4][2] = {{0, 0}, {0, 0}, {0, 0}, {0, 0}};
#pragma unroll
        for (int j = 3; j >= 0; --j) {
            const unsigned int again = lane % 4 == 3 ? ONES : column[j];  // meets the low halves
#pragma unroll
            for (int half = 0; half < 2; ++half) {
                float sum[4];
                asm volatile(
                    "mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9},"
                    "{%10, %10, %10, %10};"
                    : "=f"(sum[0]), "=f"(sum[1]), "=f"(sum[2]), "=f"(sum[3])
                    : "r"(high[2 * half]), "r"(high[2 * half + 1]), "r"(low[2 * half]), "r"(low[2 * half + 1]), "r"(column[j]),
                    "r"(again), "f"(0.0f));
                if constexpr (RULE == TABLE)
                    asm volatile(
                        "mma.sync.aligned.m16n8k8.row.col.f32.f16.f16.f32 {%0, %1, %2, %3}, {%4, %5}, {%6}, {%0, %1, %2, %3};"
                        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
                        : "r"(of_kinds[2 * half]), "r"(of_kinds[2 * half + 1]), "r"(kind[j] == lane % 4 ? ONES : 0u));
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
    }
};
