// How queries meet their candidates on CUDA: what listing, counting and summing share. A block is one warp.
//
// A warp serves its share of the queries in groups. What becomes of the pairs is said by the struct that derives from `Walk`, by
// these members:
//   BY_BLOCK         whether what comes of a block must come from one warp
//   open(block)      comes before the queries of a block of shares; there may be none
//   none(id)         a query that is not finite has no candidates
//   settle(group, pairs, finished)  of pairs that are held, what is done with them: those of blocks of candidates below
//                    `pairs.tested`, whose ids stand in `ids` of the warp, and bits in `hits`; `pairs.met_in` says in which blocks.
//                    `finished`: they are the last ones of the group
//   done(group, found)  comes after the last pairs of a group
#pragma once
#include "meet.cuh"

template <class Query>
struct Walk : PairSearch {
    JFRNN_MEMBER explicit Walk(const SearchArguments& given) : PairSearch(leave_if_idle(given)) {}
    JFRNN_MEMBER Query& query() { return *static_cast<Query*>(this); }

    // Ends a warp for which `run` has no queries, before it finds out what others have to know. Where queries are many, to ask takes
    // longer than it saves.
    JFRNN_FUNCTION const SearchArguments& leave_if_idle(const SearchArguments& given) {
        if constexpr (TREE || QUERY_LANES == 1)
            return given;
        const Scratch scratch(given.scratch, given.n, given.m, given.own, given.table);
        const int block = blockIdx.x, of = block - ((int)gridDim.x - Shares(given.m).query_blocks);
        bool idle = false;
        if constexpr (CROSSING)
            idle = block >= scratch.shared.crossing + (scratch.shared.scattered << (5 - PART_BITS));  // parts, at most
        else if (of < 0)
            idle = scratch.shared.scattered == 0;
        else if (PERIODIC)
            idle = scratch.crosses[of];
        if (idle)
            asm volatile("exit;");
        return given;
    }
    JFRNN_MEMBER void run() {
        if constexpr (TREE) {
            serve(block, 0, 32);
            return;
        }
        if constexpr (!PARTED) {
            if constexpr (CROSSING)
                for (int turn = block; turn < shared.crossing; turn += (int)(threads / 32))
                    serve(crossing[turn], 0, 32);
            else if (!PERIODIC || !crosses[block])
                serve(block, 0, 32);
            return;
        }
        // Behind whole blocks, each of which has a warp of its own, or a turn where queries cross, come parts of the scattered ones,
        // unless there are many: to spare warps, which begin before the others.
        const int warps = (int)(threads / 32), spare = CROSSING ? warps : warps - query_blocks;
        const bool has_one = block >= spare, parted = !Query::BY_BLOCK && own && may_part && shared_known().grid.dense &&
                                                      shared.scattered <= query_blocks / 8;
        const int bits = share_bits - PART_BITS, blocks = CROSSING ? shared.crossing : 0;
        const int parts = parted ? shared.scattered << bits : 0;
#pragma unroll 1
        for (int turn = block; has_one || turn < blocks + parts; turn += spare) {
            const bool whole = has_one || turn < blocks;
            const int part = turn - blocks, of = has_one ? block - spare : whole ? crossing[turn] : scattered[part >> bits];
            const bool is_mine = !PERIODIC || (crosses[of] != 0) == CROSSING, is_split = parts > 0 && is_scattered[of];
            if (is_mine && is_split != whole)
                serve(of, whole ? 0 : (part & ((1 << bits) - 1)) * PART_OF_BLOCK, whole ? 32 : PART_OF_BLOCK);
            if (has_one)
                break;
        }
    }
    // Serves queries of a block: from one of them on, at most so many. Those with the largest cutoffs of all may lie far from each other
    // and have many candidates each: no block serves two of them. In a tree they come first; of cells it is those that these are not
    // made for.
    JFRNN_MEMBER void serve(int block, int from, int most) {
        constexpr int MOST_APART = TREE ? 32 : 0;
        const int share = 1 << share_bits, first_ones = query_blocks < MOST_APART ? query_blocks : MOST_APART;
        const int apart = LONG ? shared_known().longs : first_ones;
        const long long begin = ((long long)block << share_bits) + from, end = begin + (share < most ? share : most);
        served = block;
        query().open(block);
#pragma unroll 1
        for (bool alone = block < apart && from == 0;; alone = false) {
            const int rest = begin < first_ones ? first_ones : begin < m ? (int)begin : m;
            const int place = !alone ? rest : LONG ? shared.long_places[block] : block;
            if (place >= 0)
                serve_queries(place, alone ? place + 1 : end < m ? (int)end : m, alone);
            if (!alone)
                break;
        }
    }
    // Serves the queries from a place on, group by group.
    JFRNN_MEMBER void serve_queries(int place, int stop, bool alone) {
        bool loose = false;  // of a tree: whether some have been far from each other
        while (place < stop) {
            Group group(*this, place, stop);
            if (group.is_long && !alone) {
                place += group.size;
                continue;
            }
            if (group.size == 0) {
                if (TREE && lane == 0)
                    atomicOr(bits, 2);
                query().none(id_of(load_query(place).id));
                ++place;
                continue;
            }
            walk(group, loose);
            place += group.size;
            __syncwarp();
        }
    }
    JFRNN_MEMBER void walk(Group& group, bool& loose) {
        if constexpr (DIFFER)
            this->take_cutoffs(group.my_id, lane < group.size);
        const bool is_query = lane < group.size;
        const Excluded mine(excluded_starts, excluded, is_query ? group.my_id : 0, 0);  // it takes long to load
        group.enclose(*this);
        const Excluded::Kept kept = mine.kept();
        Runs runs(*this, group, loose);
        if constexpr (EXCLUDING)
            keep_excluded(mine, kept, is_query);
        Pairs pairs{0, 0, 0, 0, own && drop_self, true};
        if constexpr (LIST)
            shared_warp().written[lane] = 0;
        Matrix matrix;
        keep_queries(group, matrix, pairs);
        Candidates candidates;
        Aside aside;
        for (bool finished = false; !finished;) {
            if (candidates.are_fetched() && runs.are_left()) {
                candidates.begin(runs.find(*this, group));
                candidates.fetch(*this, group);
            }
            if (!candidates.are_fetched())
                candidates.keep_near(*this, group, pairs);
            const bool last_ones = candidates.are_fetched() && !runs.are_left();
            __syncwarp();
            while ((!HELD || pairs.tested < 32 * BLOCKS) && pairs.kept >= pairs.tested + (last_ones ? 1 : 32))
                meet_block(*this, group, matrix, candidates, aside, pairs);
            __syncwarp();
            finished = last_ones && pairs.tested >= pairs.kept;
            if constexpr (HELD)
                if (finished || pairs.tested == 32 * BLOCKS) {
                    if (!finished)
                        aside.put(candidates, matrix);
                    query().settle(group, pairs, finished);
                    pairs.met_in = 0;
                    pairs.fresh = false;
                    if (finished)
                        break;
                    aside.take_back(candidates, matrix);
                    keep_untested(*this, group, pairs);
                }
        }
        query().done(group, pairs.found);
    }
    // Keeps what the queries exclude.
    JFRNN_MEMBER void keep_excluded(const Excluded& mine, const Excluded::Kept& kept, bool is_query) {
        Warp& warp = shared_warp();
        using OfAny = Excluded::OfAny;
        unsigned int* const words = warp.excluded_by_any.bits;
        const bool any_is_long = __any_sync(ALL, mine.end - mine.begin > Excluded::SHORT);
        warp.excluded[lane] = kept;
        for (int w = lane; w < OfAny::WORDS; w += 32)
            words[w] = any_is_long ? ALL : 0;
        __syncwarp();
        auto add = [&](int id) { atomicOr(words + OfAny::word_of(id), OfAny::bit_of(id)); };
        if (is_query && kept.are_many())
            for (const int* id = mine.begin; !any_is_long && id < mine.end; ++id)
                add(*id);
        else if (is_query)
            for (int k = 0; k < Excluded::MOST_KEPT; ++k)
                if (kept.ids[k] != Excluded::NOBODY)
                    add(kept.ids[k]);
        __syncwarp();
    }
    // Makes rows of a matrix of the queries and, if they are sources, keeps them as the first candidates: the number is the lane.
    JFRNN_MEMBER void keep_queries(const Group& group, Matrix& matrix, Pairs& pairs) {
        real x[3] = {0, 0, 0};
#pragma unroll
        for (int a = 0; a < DIM; ++a)
            x[a] = lane < group.size ? group.from_center(group.mine.p[a], group.box.center[a]) : 0;
        if constexpr (MATRIX)
            matrix.make(*this, x, group, lane);
        if (own) {
            Place at_home = group.mine;
            if constexpr (PERIODIC == 2 || SUMS)
                at_home.id = bits_as_real(id_of_image(SUMS ? group.place + lane : group.my_id, home));
            keep(*this, lane < group.size, at_home, x, lane);
            pairs.kept = group.size;
        }
    }
};
