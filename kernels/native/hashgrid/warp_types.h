// What Warp's own header of `wp.HashGrid` takes of others.
#pragma once
#include "device.h"

#if defined(__CUDACC__)
#define CUDA_CALLABLE __device__
#else
#define CUDA_CALLABLE
#endif
#if !defined(INT_MAX)
#define INT_MAX 2147483647
#define INT_MIN (-INT_MAX - 1)
#endif

namespace wp {
typedef long long int64;
typedef unsigned int uint32_t;
typedef unsigned long long uint64_t;

template <unsigned LENGTH, class Type>
struct vec_t {
    Type c[LENGTH];
    CUDA_CALLABLE Type operator[](int k) const { return c[k]; }
};
struct half {  // of which no grid is made
    CUDA_CALLABLE operator float() const { return 0; }
};
}  // namespace wp
