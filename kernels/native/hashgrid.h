// Whether a pair that step 1 leaves open is one, for the kernels around `wp.HashGrid`.
#pragma once
#include "exact.h"

template <class Vector>
JFRNN_FUNCTION bool decide_pair(const Vector& query, const Vector& source, const real* cutoff, int closed) {
    const FloatControl floats{};  // denormals are kept
    const real p[3] = {query[0], query[1], query[2]}, s[3] = {source[0], source[1], source[2]};
    return exact_pair(p, s, cutoff[0], 0, closed);
}
