// How many numbers stand side by side: as many as a register of the CPU holds, 1 on CUDA.
#pragma once
#include "constants.h"
#include "device.h"

#if defined(__CUDACC__)
#define JFRNN_SCALAR 1
constexpr int LANES = 1;
#else
#define JFRNN_SCALAR 0
#if defined(__AVX512F__) && defined(__AVX512VL__)
constexpr int LANES = DOUBLE ? 8 : 16;
#else
constexpr int LANES = DOUBLE ? 4 : 8;
#endif
#endif
