// What programs take of the C library. Compilers for CUDA know its functions by themselves.
#pragma once

#if defined(__CUDACC__)
extern "C" __device__ void cudaGraphSetConditional(unsigned long long condition, unsigned int value);  // the driver links it
#else
extern "C" {
void* memcpy(void*, const void*, __SIZE_TYPE__);
void* memset(void*, int, __SIZE_TYPE__);
void* malloc(__SIZE_TYPE__);
void free(void*);
float fabsf(float), sqrtf(float), floorf(float), ceilf(float), roundf(float), rintf(float);
float asinf(float), acosf(float), atanf(float), cbrtf(float), erff(float), erfcf(float), expf(float), exp2f(float), logf(float);
float tanhf(float), sinf(float), cosf(float), tanf(float), sinhf(float), coshf(float);
float atan2f(float, float), fmodf(float, float), powf(float, float);
double fabs(double), sqrt(double), floor(double), ceil(double), round(double), rint(double);
double asin(double), acos(double), atan(double), cbrt(double), erf(double), erfc(double), exp(double), exp2(double), log(double);
double tanh(double), sin(double), cos(double), tan(double), sinh(double), cosh(double);
double atan2(double, double), fmod(double, double), pow(double, double);
}
#endif
