// Rows of neighbors, or their counts, on the CPU.
#pragma once
#include "query_walk_cpu.h"
#include "row_places.h"

typedef int eight_ints __attribute__((vector_size(32)));

struct RowArguments : SearchArguments, RowsOut {};

template <template <class> class Way>
struct RowsBy : Way<RowsBy<Way>>, RowsOut {
    typedef Way<RowsBy<Way>> Base;
    using Base::filled, Base::m, Base::n, Base::lattice, Base::row;
    static constexpr bool FLUSHED = false;
    int most;  // of a row that this thread has found
    int fill_value;
    bool past_caches;  // rows are so many that they will not be read from the caches

    explicit RowsBy(const RowArguments& a) : Base(a), RowsOut(a), most(0), past_caches((long long)m * capacity >= 1 << 20) {
        int codes = 1;  // of images
        for (int k = 0; PERIODIC == 2 && k < DIM; ++k)
            codes *= 2 * lattice.images(k) + 1;
        fill_value = n * codes;
    }

    void meet(const real* q, int id, bool fresh, bool finished) {
        const int before = fresh ? 0 : count[id];
        int hits;
        if (LIST && !FLAT && !past_caches) {  // what is written to the caches is written in place: nothing waits for it
            int* const out = idx + (long long)id * capacity;
            if (fresh)
                fill(out);
            hits = this->template scan<true>(q, id, filled, out + before, capacity - before);
        } else {
            hits = this->template scan<false>(q, id, filled, row, 0);
            if constexpr (LIST)
                write_row(id, before, hits, finished);
        }
        count[id] = before + hits;
        most = before + hits > most ? before + hits : most;
    }
    void expect(int) const {}
    void none(int id) {
        count[id] = 0;
        if constexpr (LIST)
            write_row(id, 0, 0, true);
    }
    void copied(int, unsigned int) {}
    void chunk_done(int) {}
    void finish() {
        int known = __atomic_load_n(longest, __ATOMIC_RELAXED);
        while (known < most && !__atomic_compare_exchange_n(longest, &known, most, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {}
        if (LIST && !FLAT && most > capacity)
            __atomic_fetch_or(bits, 1, __ATOMIC_RELAXED);
    }

    void fill(int* out) const {
        const ints filling = ints{} + fill_value;
        for (int s = 0; s + LANES <= capacity; s += LANES)
            __builtin_memcpy(out + s, &filling, sizeof filling);
        if (capacity >= LANES)
            __builtin_memcpy(out + capacity - LANES, &filling, sizeof filling);
        for (int s = 0; capacity < LANES && s < capacity; ++s)
            out[s] = fill_value;
    }

    // Writes `hits` ids from `row` into the slots of a row from `from` on, and behind the last ones the fill value.
    JFRNN_APART void write_row(int id, int from, int hits, bool last) {
        const long long begin = row_begin(starts, id, capacity);
        int* const out = idx + begin;
        const int room = row_room(starts, id, capacity), stop = from + hits < room ? from + hits : room;
        if (!FLAT && from == 0 && last && (capacity & 7) == 0 && ((unsigned long long)idx & 31) == 0) {
            past_caches ? write_whole_row<true>(out, stop) : write_whole_row<false>(out, stop);
            return;
        }
        for (int s = from; s < stop; ++s)
            out[s] = row[s - from];
        for (int s = from; FLAT && s < stop; ++s)
            receivers[begin + s] = id;
        if (!FLAT && last)
            for (int s = stop; s < capacity; ++s)
                out[s] = fill_value;
    }
    template <bool PAST_CACHES>
    static void store(eight_ints eight, int* to) {
        if constexpr (PAST_CACHES)
            __builtin_nontemporal_store(eight, (eight_ints*)to);
        else
            *(eight_ints*)to = eight;
    }
    // Writes a row eight slots at a time.
    template <bool PAST_CACHES>
    void write_whole_row(int* out, int stop) {
        const eight_ints filled_up = eight_ints{} + fill_value;
        int s = 0;
        for (; s + 8 <= stop; s += 8)
            store<PAST_CACHES>(*(const eight_ints*)(row + s), out + s);
        if (s < stop) {
            eight_ints mixed = *(const eight_ints*)(row + s);
            for (int e = 0; e < 8; ++e)
                mixed[e] = s + e < stop ? mixed[e] : fill_value;
            store<PAST_CACHES>(mixed, out + s);
            s += 8;
        }
        for (; s < capacity; s += 8)
            store<PAST_CACHES>(filled_up, out + s);
    }
};
struct Rows {
    const RowArguments& given;
    explicit Rows(const RowArguments& given) : given(given) {}
    void run() { walk<RowsBy>(given); }
};
