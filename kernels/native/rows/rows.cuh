// Rows of neighbors, or their counts, on CUDA.
#pragma once
#include "held.cuh"
#include "row_places.h"
#include "walk.cuh"

// The neighbors of a query on their way into its row: their ids are numbered by their addresses, up to LISTED at a time.
struct RowList {
    int written;           // neighbors that stand in the row, a multiple of four
    unsigned int waiting;  // those that are numbered, but not written
    unsigned int* const list;

    // Begins with what was left over when pairs were settled before.
    JFRNN_MEMBER explicit RowList(int lane)
        : written((int)(shared_warp().written[lane] & ~3u)),
          waiting(shared_warp().written[lane] & 3),
          list(shared_warp().lists[lane]) {
        Warp& warp = shared_warp();
        list[0] = shared_address(&warp.left[0][lane]) | shared_address(&warp.left[1][lane]) << 16;
#pragma unroll
        for (int k = 1; k < LISTED / 2 + 2; ++k)  // what is read, whether it is written or not
            list[k] = shared_address(&warp.left[2][lane]) * 0x10001u;
    }
    // Numbers the next neighbors, while there are any, and room.
    JFRNN_MEMBER void number(HeldPairs& held, unsigned int last_ids) {
        constexpr int AT_ONCE = 4;  // that a lane numbers
        const unsigned int list_begin = shared_address(list), list_end = list_begin + 2 * LISTED;
        unsigned int list_at = list_begin + 2 * waiting;
        while (list_at < list_end && held.ids != last_ids) {
            held.advance();
            const unsigned int taken = __popc(held.hits) < AT_ONCE ? __popc(held.hits) : AT_ONCE;
#pragma unroll
            for (int k = 0; k < AT_ONCE; ++k) {
                const unsigned int address = held.take();
                asm volatile("st.shared.u16 [%0], %1;" : : "r"(list_at + 2 * k), "h"((unsigned short)address) : "memory");
            }
            list_at += 2 * taken;
        }
        waiting = (list_at - list_begin) / 2;
    }
    // Goes on behind those that were written; up to three more stay.
    JFRNN_MEMBER void advance(unsigned int ready) {
        written += ready;
        waiting -= ready;
        const unsigned int one = list[ready / 2], two = list[ready / 2 + 1];
        list[0] = one;
        list[1] = two;
    }
    // Leaves over what is not written until pairs are settled again.
    JFRNN_MEMBER void leave(int lane) const {
        Warp& warp = shared_warp();
        warp.written[lane] = (unsigned int)written | waiting;
        const int ids[3] = {load_word(list[0] & 0xffff), load_word(list[0] >> 16), load_word(list[1] & 0xffff)};
#pragma unroll
        for (int k = 0; k < 3; ++k)
            warp.left[k][lane] = ids[k];
    }
};

// Where the row of a query begins, if rows are those of a flat list, and how many slots it has.
struct RowPlace {
    int id, begin, room;
};

struct Rows : Walk<Rows> {
    static constexpr bool BY_BLOCK = false;
    static constexpr int STEP = FLAT ? 8 : 1;  // between slots that a lane writes: those of a flat list one by one
    JFRNN_MEMBER explicit Rows(const SearchArguments& given) : Walk(given) {}
    JFRNN_MEMBER void open(int) {}
    JFRNN_MEMBER void none(int id) {
        if (LIST && !FLAT)
            for (int s = lane; s < capacity; s += 32)
                idx[(long long)id * capacity + s] = fill_value();
        if (lane == 0)
            count[id] = 0;
    }
    JFRNN_MEMBER void done(const Group& group, int found) {
        if (lane < group.size)
            count[group.my_id] = found;
        const int longest_row = __reduce_max_sync(ALL, lane < group.size ? found : 0);
        if (lane == 0 && longest_row > shared_known().longest_before) {
            atomicMax(longest, longest_row);
            if (LIST && !FLAT && longest_row > capacity)
                atomicOr(bits, 1);
        }
    }
    // Writes the pairs that are held into the rows.
    JFRNN_MEMBER void settle(const Group& group, const Pairs& pairs, bool finished) {
        if constexpr (QUERY_LANES >= 4) {
            settle_few(group, pairs, finished);
            return;
        }
        Warp& warp = shared_warp();
        // Behind the last block stands one of fill values, with which all rows are filled up, or one that no query has met.
        warp.hits[pairs.tested / 32][lane] = finished ? ALL : 0;
        if (finished)
            warp.ids[pairs.tested + lane] = fill_value();
        RowList row(lane);
        const bool is_query = lane < group.size;
        const RowPlace place{group.my_id, FLAT && is_query ? starts[group.my_id] : 0,
            FLAT && !is_query ? 0 : row_room(starts, group.my_id, capacity)};
        __syncwarp();
        HeldPairs held(pairs, lane);
        const unsigned int last_ids = finished ? 1 : held.words + held.to_ids + 4 * pairs.tested;
        held.advance();
        for (bool more = true; more;) {
            row.number(held, last_ids);
            const unsigned int ready = row.waiting >= LISTED ? LISTED : held.ids == last_ids ? row.waiting & ~3u : 0;
            const int before = is_query && ready > 0 ? row.written : place.room;
            __syncwarp();
            write(before, place);
            __syncwarp();
            row.advance(ready);
            more = __any_sync(ALL, finished ? is_query && row.written < place.room : held.ids != last_ids);
        }
        if (!finished)
            row.leave(lane);
    }
    // The same of few queries, one after the other: a lane has one candidate of each block, where it would else have a query, or none.
    JFRNN_MEMBER void settle_few(const Group& group, const Pairs& pairs, bool finished) {
        Warp& warp = shared_warp();
        __syncwarp();
#pragma unroll 1
        for (int query = 0; query < group.size; ++query) {
            const int row = __shfl_sync(ALL, group.my_id, query), room = row_room(starts, row, capacity);
            const long long begin = row_begin(starts, row, capacity);
            int written = (int)warp.written[query];
#pragma unroll 4
            for (unsigned int block = 0; block < pairs.tested / 32; ++block) {
                const unsigned int hits = warp.hits[block][query];
                const int slot = written + __popc(hits & ((1u << lane) - 1)), id = warp.ids[32 * block + lane];
                if ((hits >> lane & 1) && slot < room)
                    write_slot(idx, receivers, begin + slot, IDS == 1 ? source_of(id) : id, row);
                written += __popc(hits);
            }
            for (int slot = written + lane; finished && slot < room; slot += 32)
                write_slot(idx, receivers, begin + slot, fill_value(), row);
            if (lane == 0)
                warp.written[query] = written;
        }
        __syncwarp();
    }
    // Writes what waits for the rows behind the first `before` slots of each: eight lanes write one row, and maybe more than waits,
    // that will be written again.
    JFRNN_MEMBER void write(int before, const RowPlace& mine) {
        if (!FLAT && (capacity & 3) == 0) {  // only then rows begin where 16 bytes may be stored at once
#pragma unroll
            for (int k = 0; k < 32; k += 4) {
                RowPlace left;
                int* const out = slots_of(k + lane / 8, before, mine, left);
                const int4 four = load_four(k + lane / 8);
                if (left.room > 0)
                    asm volatile("st.global.v4.s32 [%0], {%1, %2, %3, %4};"
                        :
                        : "l"(out), "r"(four.x), "r"(four.y), "r"(four.z), "r"(four.w)
                        : "memory");
            }
        } else {
#pragma unroll 1
            for (int k = 0; k < 32; k += 4) {
                RowPlace left;
                const long long out = slots_of(k + lane / 8, before, mine, left) - idx;
                const int4 four = load_four(k + lane / 8);
                if (left.room > 0)
                    write_slot(idx, receivers, out, four.x, left.id);
                if (left.room > STEP)
                    write_slot(idx, receivers, out + STEP, four.y, left.id);
                if (left.room > 2 * STEP)
                    write_slot(idx, receivers, out + 2 * STEP, four.z, left.id);
                if (left.room > 3 * STEP)
                    write_slot(idx, receivers, out + 3 * STEP, four.w, left.id);
            }
        }
    }
    // Loads the four ids of a row that this lane writes.
    JFRNN_MEMBER int4 load_four(int row) const {
        const unsigned short* const from = (const unsigned short*)shared_warp().lists[row] + first_of_lane();
        const int4 four = make_int4(load_id(from[0]), load_id(from[STEP]), load_id(from[2 * STEP]), load_id(from[3 * STEP]));
        if constexpr (IDS == 1)
            return make_int4(source_of(four.x), source_of(four.y), source_of(four.z), source_of(four.w));
        else
            return four;
    }
    JFRNN_MEMBER int first_of_lane() const { return FLAT ? lane % 8 : lane % 8 * 4; }
    // Returns where this lane writes to in a row, of which `before` slots are written; `left` becomes that row with the room there is.
    JFRNN_MEMBER int* slots_of(int row, int before, const RowPlace& mine, RowPlace& left) const {
        const unsigned int row_before = __shfl_sync(ALL, before, row), row_id = __shfl_sync(ALL, mine.id, row);
        left.id = (int)row_id;
        left.room = (FLAT ? __shfl_sync(ALL, mine.room, row) : capacity) - first_of_lane() - (int)row_before;
        int* const column = idx + first_of_lane();
        if constexpr (FLAT)
            return column + (long long)__shfl_sync(ALL, mine.begin, row) + row_before;
        const unsigned int row_bytes = 4u * (unsigned int)capacity;
        return (int*)((char*)column + (unsigned long long)row_id * row_bytes + (unsigned long long)row_before * 4);
    }
};
