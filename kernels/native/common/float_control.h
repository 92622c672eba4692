// How the processor treats denormals.
//
// XLA's threads flush denormals to zero on the CPU. While native code runs they are kept, since they decide about pairs; what users
// compute in between is flushed, as XLA does, and for its speed. CUDA has no such mode.
#pragma once
#include "device.h"

struct FloatControl {
#if defined(__SSE__) && !defined(__CUDACC__)
    unsigned int before;
    FloatControl() : before(__builtin_ia32_stmxcsr()) { keep(); }
    ~FloatControl() { __builtin_ia32_ldmxcsr(before); }
    void keep() const { __builtin_ia32_ldmxcsr(before & ~0x8040u); }
    void flush() const { __builtin_ia32_ldmxcsr(before | 0x8040u); }
#elif defined(__aarch64__) && !defined(__CUDACC__)
    unsigned long long before;
    FloatControl() {
        asm volatile("mrs %0, fpcr" : "=r"(before));
        keep();
    }
    ~FloatControl() { asm volatile("msr fpcr, %0" : : "r"(before)); }
    void keep() const { asm volatile("msr fpcr, %0" : : "r"(before & ~(1ull << 24))); }
    void flush() const { asm volatile("msr fpcr, %0" : : "r"(before | (1ull << 24))); }
#else
    JFRNN_MEMBER void keep() const {}
    JFRNN_MEMBER void flush() const {}
#endif
};
