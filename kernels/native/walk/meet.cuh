// How the queries of a group meet a block of 32 candidates: a neighbor is a bit.
#pragma once
#include "candidates.cuh"

// Bits of a block, one per candidate: those that are surely near the query of this lane, and those that are decided one by one.
struct BlockBits {
    unsigned int hits, open;
};
// Meets the block on tensor cores (float32).
JFRNN_FUNCTION BlockBits meet_as_matrix(const Matrix& matrix, unsigned int first_candidate, int lane) {
    unsigned int closest = 0x7fffffff, open = 0;
    const unsigned int hits = matrix.meet(first_candidate, 0, closest, lane);
    const unsigned int until = __float_as_uint((float)shared_warp().box.half[3]);
    if (__any_sync(ALL, (int)closest <= (int)until))
        open = matrix.meet(first_candidate, until + 1, closest, lane) & ~hits;
    return {hits, open};
}
// Meets the block one by one (float64).
JFRNN_FUNCTION BlockBits meet_one_by_one(const PairSearch& search, const real* q, unsigned int first_candidate) {
    const Warp& warp = shared_warp();
    unsigned int hits = 0, open = 0, closest = 0x7fffffff;
    constexpr int ALONG = 16 / sizeof(real);  // candidates whose coordinate one load brings
#pragma unroll
    for (int j = 32 - ALONG; j >= 0; j -= ALONG) {
        struct alignas(16) Loaded {
            real x[ALONG];
        } loaded[DIM];
#pragma unroll
        for (int a = 0; a < DIM; ++a)
            loaded[a] = *(const Loaded*)(warp.candidates[a] + first_candidate + j);
#pragma unroll
        for (int e = ALONG - 1; e >= 0; --e) {
            real p[DIM];
#pragma unroll
            for (int a = 0; a < DIM; ++a)
                p[a] = loaded[a].x[e];
            const unsigned int over = upper_word(search.excess(q, p));
            hits = __funnelshift_l(over, hits, 1);
            closest = min(closest, over);
        }
    }
    if (__any_sync(ALL, (int)closest <= (int)upper_word(2 * search.band)))
#pragma unroll 4
        for (int j = 0; j < 32; ++j) {
            real p[DIM];
#pragma unroll
            for (int a = 0; a < DIM; ++a)
                p[a] = warp.candidates[a][first_candidate + j];
            const real over = search.excess(q, p);
            open |= over >= 0 && over <= 2 * search.band ? 1u << j : 0;
        }
    return {hits, open};
}
// Meets the block one by one, each candidate by the cutoffs of both.
JFRNN_FUNCTION BlockBits meet_by_cutoffs(const PairSearch& search, const real* q, unsigned int first_candidate) {
    const Warp& warp = shared_warp();
    unsigned int hits = 0, beyond = 0;
    constexpr bool ONE_BAND = RULE == MEAN && !TREE;  // of all candidates: in cells, cutoffs are alike
    const real mine = search.own_radius / 2 * search.step_scale, band = ONE_BAND ? search.mean_band() : real(0);
    constexpr int ALONG = 16 / sizeof(real);
#pragma unroll
    for (int j = 32 - ALONG; j >= 0; j -= ALONG) {
        struct alignas(16) Loaded {
            real x[ALONG];
        } loaded[DIM + OF_CUTOFFS];
#pragma unroll
        for (int a = 0; a < DIM + OF_CUTOFFS; ++a)
            loaded[a] = *(const Loaded*)(warp.candidates[a] + first_candidate + j);
#pragma unroll
        for (int e = ALONG - 1; e >= 0; --e) {
            real known[2] = {0, 0}, square = 0;
#pragma unroll
            for (int k = 0; k < OF_CUTOFFS; ++k)
                known[k] = loaded[DIM + k].x[e];
#pragma unroll
            for (int a = 0; a < DIM; ++a) {
                const real d = (loaded[a].x[e] - q[a]) * search.step_scale;
                square += d * d;
            }
            if constexpr (ONE_BAND) {
                const real mean = mine + known[0], over = square - mean * mean;
                hits = __funnelshift_l(upper_word(over + band), hits, 1);
                beyond = __funnelshift_l(upper_word(band - over), beyond, 1);
            } else {
                const auto bounds = search.bounds_with(known);
                hits = __funnelshift_l(upper_word(square - bounds.inside), hits, 1);
                beyond = __funnelshift_l(upper_word(bounds.outside - square), beyond, 1);
            }
        }
    }
    return {hits, ~(hits | beyond)};
}
// Returns the candidates of a block that a query may meet at all: those that there are, not itself, and of half lists later ones.
JFRNN_FUNCTION unsigned int find_met(const PairSearch& search, const Group& group, Pairs& pairs, const int* ids) {
    const unsigned int here = pairs.kept - pairs.tested < 32 ? pairs.kept - pairs.tested : 32;
    unsigned int met = search.lane < group.size ? ALL >> (32 - here) : 0;
    if (pairs.meets_itself)
        met &= ~(1u << search.lane);
    pairs.meets_itself = false;
    if constexpr (LATER) {
        unsigned int earlier = 0;
        const int first = search.first_after(group.my_id);
#pragma unroll
        for (int j = 28; j >= 0; j -= 4) {
            const int4 four = *(const int4*)(ids + j);
            earlier = __funnelshift_l((unsigned int)(search.order_of(four.w) - first), earlier, 1);
            earlier = __funnelshift_l((unsigned int)(search.order_of(four.z) - first), earlier, 1);
            earlier = __funnelshift_l((unsigned int)(search.order_of(four.y) - first), earlier, 1);
            earlier = __funnelshift_l((unsigned int)(search.order_of(four.x) - first), earlier, 1);
        }
        met &= ~earlier;
    }
    return met;
}
// Returns which of the neighbors in a block of candidates a query does not exclude. Few candidates stand in the row of any query of the
// group: the others are told apart by one lane each, which has the name of one, or NOBODY.
JFRNN_FUNCTION unsigned int drop_excluded(const PairSearch& search, const Group& group, int name, unsigned int hits) {
    const Warp& warp = shared_warp();
    const bool by_any = name != Excluded::NOBODY && warp.excluded_by_any.may_have(name);
    for (unsigned int rest = __ballot_sync(ALL, by_any); rest; rest &= rest - 1) {
        const int j = __ffs(rest) - 1, id = __shfl_sync(ALL, name, j);
        if (!(hits >> j & 1))
            continue;
        const Excluded::Kept& kept = warp.excluded[search.lane];
        const bool found =
            kept.are_many() ? Excluded(search.excluded_starts, search.excluded, group.my_id, kept.filter()).has(id) : kept.has(id);
        hits &= found ? ~(1u << j) : ALL;
    }
    return hits;
}
// Decides what is open of a single query, a candidate per lane: one that is far from all others may have tens of thousands.
JFRNN_FUNCTION void decide_together(
    const PairSearch& search, const Group& group, const Place& query, const int* ids, unsigned int& open, unsigned int& hits) {
    const unsigned int who = __ballot_sync(ALL, open != 0);
    if (who & (who - 1))
        return;
    const int leader = __ffs((int)who) - 1, my_id = __shfl_sync(ALL, group.my_id, leader);
    const real own = __shfl_sync(ALL, search.own_radius, leader);
    real q[3] = {0, 0, 0}, p[3];
    for (int a = 0; a < DIM; ++a)
        q[a] = __shfl_sync(ALL, query.p[a], leader);
    bool is_pair = __shfl_sync(ALL, open, leader) >> search.lane & 1;
    if (is_pair) {
        search.load_image(ids[search.lane], p);
        is_pair = search.is_neighbor_by_cutoffs(q, p, my_id, ids[search.lane], own);
    }
    const unsigned int found = __ballot_sync(ALL, is_pair);
    hits |= search.lane == leader ? found : 0;
    open = 0;
}
// Lets the queries meet the next block of candidates.
JFRNN_FUNCTION void meet_block(
    const PairSearch& search, const Group& group, Matrix& matrix, Candidates& candidates, Aside& aside, Pairs& pairs) {
    Warp& warp = shared_warp();
    const unsigned int first_candidate = pairs.tested % RING;
    const int* const ids = HELD ? warp.ids + pairs.tested : warp.candidate_ids + first_candidate;
    const unsigned int met = find_met(search, group, pairs, ids);
    int name = Excluded::NOBODY;  // of the candidate of this lane, if there is one
    if (EXCLUDING && pairs.tested + search.lane < pairs.kept)
        name = search.excluded_id(ids[search.lane], search.source_named_now(ids[search.lane]));
    BlockBits block;
    if constexpr (VARY && !MATRIX)
        block = meet_by_cutoffs(search, group.mine.p, first_candidate);
    else if constexpr (DOUBLE)
        block = meet_one_by_one(search, group.mine.p, first_candidate);
    else
        block = meet_as_matrix(matrix, first_candidate, search.lane);
    unsigned int hits = block.hits & met, open = block.open & met;
    if constexpr (DIFFER) {
        const bool itself = search.own && !search.drop_self && pairs.fresh && pairs.tested == 0;
        const unsigned int sure = itself && search.lane < group.size ? 1u << search.lane : 0;  // whatever its cutoff
        if (RULE == TABLE && MATRIX && !search.few_kinds()) {
            open |= hits;
            hits = 0;
        }
        open &= ~sure;
        hits |= sure;
    }
    if (__any_sync(ALL, open)) {
        aside.put(candidates, matrix);
        const bool has_it = !MATRIX || CROSSING;
        const Place query = has_it ? group.mine : open ? search.load_query(group.place + search.lane) : Place{{0, 0, 0}, 0};
        if constexpr (TREE || LONG)
            decide_together(search, group, query, ids, open, hits);
        for (; open; open &= open - 1) {
            const int j = __ffs(open) - 1;
            hits |= search.is_neighbor(query.p, group.my_id, ids[j]) ? 1u << j : 0;
        }
        aside.take_back(candidates, matrix);
    }
    if constexpr (EXCLUDING)
        hits = drop_excluded(search, group, name, hits);
    pairs.found += __popc(hits);
    if constexpr (HELD) {
        warp.hits[pairs.tested / 32][search.lane] = hits;
        pairs.met_in |= hits ? 1u << pairs.tested / 32 : 0;
    }
    pairs.tested += 32;
}
