// Rows of neighbors, or their counts, on CUDA.
#pragma once
#include "held.cuh"
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

struct Rows : Walk<Rows> {
    JFRNN_MEMBER explicit Rows(const SearchArguments& given) : Walk(given) {}
    JFRNN_MEMBER void open(int) {}
    JFRNN_MEMBER void none(int id) {
        if (LIST)
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
            atomicMax(&info[0], longest_row);
            if (LIST && longest_row > capacity)
                atomicOr(&info[1], 1);
        }
    }
    // Writes the pairs that are held into the rows.
    JFRNN_MEMBER void settle(const Group& group, const Pairs& pairs, bool finished) {
        Warp& warp = shared_warp();
        // Behind the last block stands one of fill values, with which all rows are filled up, or one that nobody has met.
        warp.hits[pairs.tested / 32][lane] = finished ? ALL : 0;
        if (finished)
            warp.ids[pairs.tested + lane] = fill_value();
        RowList row(lane);
        __syncwarp();
        HeldPairs held(pairs, lane);
        const unsigned int last_ids = finished ? 1 : held.words + held.to_ids + 4 * pairs.tested;
        held.advance();
        for (bool more = true; more;) {
            row.number(held, last_ids);
            const unsigned int ready = row.waiting >= LISTED ? LISTED : held.ids == last_ids ? row.waiting & ~3u : 0;
            const int before = lane < group.size && ready > 0 ? row.written : capacity;
            __syncwarp();
            write(before, group.my_id);
            __syncwarp();
            row.advance(ready);
            more = __any_sync(ALL, finished ? lane < group.size && row.written < capacity : held.ids != last_ids);
        }
        if (!finished)
            row.leave(lane);
    }
    // Writes what waits for the rows behind the first `before` slots of each: eight lanes write one row, and maybe more than waits,
    // that will be written again.
    JFRNN_MEMBER void write(int before, int my_id) {
        if ((capacity & 3) == 0) {  // only then rows begin where 16 bytes may be stored at once
#pragma unroll
            for (int k = 0; k < 32; k += 4) {
                int room;
                int* const out = slots_of(k + lane / 8, before, my_id, room);
                const int4 four = load_four(k + lane / 8);
                if (room > 0)
                    asm volatile("st.global.v4.s32 [%0], {%1, %2, %3, %4};"
                        :
                        : "l"(out), "r"(four.x), "r"(four.y), "r"(four.z), "r"(four.w)
                        : "memory");
            }
        } else {
#pragma unroll 1
            for (int k = 0; k < 32; k += 4) {
                int room;
                int* const out = slots_of(k + lane / 8, before, my_id, room);
                const int4 four = load_four(k + lane / 8);
                if (room > 0)
                    out[0] = four.x;
                if (room > 1)
                    out[1] = four.y;
                if (room > 2)
                    out[2] = four.z;
                if (room > 3)
                    out[3] = four.w;
            }
        }
    }
    // Loads the four ids of a row that this lane writes.
    JFRNN_MEMBER int4 load_four(int row) const {
        const unsigned short* const from = (const unsigned short*)shared_warp().lists[row] + lane % 8 * 4;
        const int4 four = make_int4(load_id(from[0]), load_id(from[1]), load_id(from[2]), load_id(from[3]));
        if constexpr (IDS == 1)
            return make_int4(source_of(four.x), source_of(four.y), source_of(four.z), source_of(four.w));
        else
            return four;
    }
    // Returns where this lane writes to in a row, of which `before` slots are written, and how much room there is.
    JFRNN_MEMBER int* slots_of(int row, int before, int my_id, int& room) const {
        const unsigned int row_before = __shfl_sync(ALL, before, row), row_id = __shfl_sync(ALL, my_id, row);
        room = capacity - lane % 8 * 4 - (int)row_before;
        const unsigned int row_bytes = 4u * (unsigned int)capacity;
        char* const column = (char*)(idx + lane % 8 * 4);
        return (int*)(column + (unsigned long long)row_id * row_bytes + (unsigned long long)row_before * 4);
    }
};
