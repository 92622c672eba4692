// How threads of the CPU share work: they hand themselves chunks of it from a counter.
#pragma once

#if !defined(__CUDACC__)
// Calls `serve(from, to, chunk)` for each chunk of `size` numbers below `count` that this thread gets, until none is left.
template <class Serve>
void each_chunk(int& next, int count, int size, Serve serve) {
    for (;;) {
        const int chunk = __atomic_fetch_add(&next, 1, __ATOMIC_RELAXED);
        if ((long long)chunk * size >= count)
            break;
        const int from = chunk * size;
        serve(from, count - from < size ? count : from + size, chunk);
    }
}
#endif
