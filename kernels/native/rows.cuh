// --- part: begin_write_rows

auto write_rows = [&](bool finished) {
    constexpr int TAKEN = 4;  // neighbors that a lane numbers at a time
    // behind the last block one of all n, which fill the rows up, or one that nobody has met
    const unsigned int behind = 1u << tested / 32;
    warp.hits[tested / 32][lane] = finished ? ALL : 0;
    if (finished)
        warp.ids[tested + lane] = fill_value;
    met_in |= behind;
    int written = (int)(warp.written[lane] & ~3u);
    unsigned int waiting = warp.written[lane] & 3;
    unsigned int* const list = warp.lists[lane];
    list[0] = shared_address(&warp.left[0][lane]) | shared_address(&warp.left[1][lane]) << 16;
#pragma unroll
    for (int k = 1; k < CHUNK / 2 + 2; ++k)  // what is read, whether it is written or not
        list[k] = shared_address(&warp.left[2][lane]) * 0x10001u;
    __syncwarp();
// --- part: write_rows

    const unsigned int list_begin = shared_address(list), list_end = list_begin + 2 * CHUNK;
    const unsigned int last_ids = finished ? 1 : words + to_ids + 4 * tested;
    advance();
    for (bool more = true; more;) {
        // every lane numbers its next neighbors
        unsigned int list_at = list_begin + 2 * waiting;
        while (list_at < list_end && ids != last_ids) {
            advance();
            const unsigned int taken = __popc(hits) < TAKEN ? __popc(hits) : TAKEN;
#pragma unroll
            for (int k = 0; k < TAKEN; ++k) {
                const unsigned int below = hits - 1, address = ids + 4 * __popc(below & ~hits);
                hits &= below;
                asm volatile("st.shared.u16 [%0], %1;" : : "r"(list_at + 2 * k), "h"((unsigned short)address) : "memory");
            }
            list_at += 2 * taken;
        }
        waiting = (list_at - list_begin) / 2;
        // eight lanes write what waits for one row, and maybe more that will be written again
        const unsigned int ready = waiting >= CHUNK ? CHUNK : ids == last_ids ? waiting & ~3u : 0;
        const int before = lane < group && ready > 0 ? written : capacity;
        __syncwarp();
        auto row_of = [&](int k) { return k + lane / 8; };
        char* const column = (char*)(idx + lane % 8 * 4);
        const unsigned int row_bytes = 4u * (unsigned int)capacity;
        auto four_of = [&](int k) {
            const unsigned short* const from = (const unsigned short*)warp.lists[row_of(k)] + lane % 8 * 4;
            const int4 four = make_int4(load_id(from[0]), load_id(from[1]), load_id(from[2]), load_id(from[3]));
            if constexpr (IDS == 1)
                return make_int4(source_of(four.x), source_of(four.y), source_of(four.z), source_of(four.w));
            else
                return four;
        };
        auto out_of = [&](int k, int& room) {
            const unsigned int row_before = __shfl_sync(ALL, before, row_of(k)), row_id = __shfl_sync(ALL, my_id, row_of(k));
            room = capacity - lane % 8 * 4 - (int)row_before;
            return (int*)(column + (unsigned long long)row_id * row_bytes + (unsigned long long)row_before * 4);
        };
        if ((capacity & 3) == 0) {  // only then rows begin where 16 bytes may be stored at once
#pragma unroll
            for (int k = 0; k < 32; k += 4) {
                int room;
                int* const out = out_of(k, room);
                const int4 four = four_of(k);
                if (room > 0)
                    asm volatile("st.global.v4.s32 [%0], {%1, %2, %3, %4};"
                                 : : "l"(out), "r"(four.x), "r"(four.y), "r"(four.z), "r"(four.w) : "memory");
            }
        } else {
#pragma unroll 1
            for (int k = 0; k < 32; k += 4) {
                int room;
                int* const out = out_of(k, room);
                const int4 four = four_of(k);
                if (room > 0) out[0] = four.x;
                if (room > 1) out[1] = four.y;
                if (room > 2) out[2] = four.z;
                if (room > 3) out[3] = four.w;
            }
        }
        __syncwarp();
        written += ready;
        waiting -= ready;
        const unsigned int one = list[ready / 2], two = list[ready / 2 + 1];  // of up to three more
        list[0] = one;
        list[1] = two;
        more = __any_sync(ALL, finished ? lane < group && written < capacity : ids != last_ids);
    }
    if (!finished) {
        warp.written[lane] = (unsigned int)written | waiting;
        const int ids[3] = {load_word(list[0] & 0xffff), load_word(list[0] >> 16), load_word(list[1] & 0xffff)};
#pragma unroll
        for (int k = 0; k < 3; ++k)
            warp.left[k][lane] = ids[k];
    }
    met_in = 0;
};
// --- part: no_row

if (LIST)
    for (int s = lane; s < capacity; s += 32)
        idx[(long long)id * capacity + s] = fill_value;
if (lane == 0)
    count[id] = 0;
// --- part: row_done

if (lane < group)
    count[my_id] = found;
const int longest_row = __reduce_max_sync(ALL, lane < group ? found : 0);
if (lane == 0 && longest_row > longest_before) {
    atomicMax(&info[0], longest_row);
    if (LIST && longest_row > capacity)
        atomicOr(&info[1], 1);
}
