// --- part: keep

#if defined(__SSE__) && !defined(__CUDA_ARCH__)
__builtin_ia32_ldmxcsr(float_control & ~0x8040u);
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
asm volatile("msr fpcr, %0" : : "r"(float_control & ~(1ull << 24)));
#endif
// --- part: flush

#if defined(__SSE__) && !defined(__CUDA_ARCH__)
__builtin_ia32_ldmxcsr(float_control | 0x8040u);
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
asm volatile("msr fpcr, %0" : : "r"(float_control | (1ull << 24)));
#endif
// --- part: enter

#if defined(__SSE__) && !defined(__CUDA_ARCH__)
const unsigned int float_control = __builtin_ia32_stmxcsr();
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
unsigned long long float_control;
asm volatile("mrs %0, fpcr" : "=r"(float_control));
#endif
// --- part: leave

#if defined(__SSE__) && !defined(__CUDA_ARCH__)
__builtin_ia32_ldmxcsr(float_control);
#elif defined(__aarch64__) && !defined(__CUDA_ARCH__)
asm volatile("msr fpcr, %0" : : "r"(float_control));
#endif
