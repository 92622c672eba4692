// A term of pairs, as an example: `jfrnn.kernels.pair_sum_cpu` puts what a user's function becomes in place of this file.
#pragma once
#include "lattice.h"
#include "math.h"

typedef Math::f32 number;
// Is a summand added up over all pairs, or over the neighbors of each i? And which one of these sums is it?
JFRNN_TABLE bool IS_TOTAL[] = {true, false};
JFRNN_TABLE int PLACE[] = {0, 0};
// Is the sum NaN, not 0, where the position of i is not finite? One for each sum over neighbors.
JFRNN_TABLE bool MARKED[] = {true};
JFRNN_TABLE int STEP_AXES[] = {0};
// Which axis has a column of j as its coordinate, if that is one: -1.
JFRNN_TABLE int COLUMN_AXES[] = {-1};
// And which of the columns that are no coordinates it is: -1 for one that is.
JFRNN_TABLE int COLUMN_NUMBERS[] = {0};

struct Term {
    struct Own {};  // what is read of i
    JFRNN_MEMBER explicit Term(const real*) {}
    JFRNN_MEMBER Own own(const real*, const real*) const { return {}; }
    template <bool AT_HOME>
    JFRNN_MEMBER Own own(const real*, const real*, const real*) const {
        return {};
    }
    // The summands of pairs: of i, of those j whose coordinates are `p` and whose numbers are `column(c)`.
    template <class Column>
    JFRNN_MEMBER void evaluate(const Own&, const number* p, Column column, number* summand) const {
        const auto v = p[0] * column(0);
        summand[0] = v;
        summand[1] = v * v;
    }
    template <bool AT_HOME, class Column>
    JFRNN_MEMBER void evaluate(const Own& own, const number* p, Column column, number* summand) const {
        evaluate(own, p, column, summand);
    }
};
