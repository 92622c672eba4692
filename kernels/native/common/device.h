// What functions are for each compiler: Clang on the CPU, NVRTC or nvcc on CUDA.
#pragma once
#include "c_library.h"

#if defined(__CUDACC__)
#define JFRNN_FUNCTION static __device__ __forceinline__
#define JFRNN_MEMBER __device__ __forceinline__
#define JFRNN_INLINE JFRNN_MEMBER
#define JFRNN_CALL static __device__ __noinline__
#define JFRNN_MATH static __device__ __forceinline__
#define JFRNN_TABLE static __device__ constexpr
constexpr unsigned int ALL = 0xffffffffu;  // lanes of a warp
static __device__ __forceinline__ long long thread_index() { return (long long)blockIdx.x * blockDim.x + threadIdx.x; }
#else
#pragma clang fp contract(off)
#define JFRNN_FUNCTION static
#define JFRNN_MEMBER
#define JFRNN_INLINE __attribute__((always_inline))
#define JFRNN_CALL static __attribute__((noinline))
#define JFRNN_APART __attribute__((noinline))  // of members: inlined wherever they are called, they would take the compiler seconds
#define JFRNN_MATH static inline __attribute__((always_inline))
#define JFRNN_TABLE constexpr
static inline long long thread_index() { return 0; }
#endif
#define JFRNN_GENERIC  \
    template <class T> \
    JFRNN_MATH

// One of two types.
template <bool, class Yes, class No>
struct Choice {
    using Type = Yes;
};
template <class Yes, class No>
struct Choice<false, Yes, No> {
    using Type = No;
};
