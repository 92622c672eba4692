// Which slots of a list hold a pair now, on CUDA: a byte for each, and (MEASURED) how far apart the two are.
#pragma once
#include "kept.cuh"

struct KeptMask : KeptLane {
    unsigned char* const mask;
    real* const distances;

    JFRNN_MEMBER explicit KeptMask(const MaskArguments& a) : KeptLane(a), mask((unsigned char*)a.mask), distances(a.distances) {}

    JFRNN_MEMBER void run() const {
        if (!is_row)
            return;
        unsigned char* const out = mask + (long long)row * capacity;
        real* const out_lengths = MEASURED ? distances + (long long)row * capacity : distances;
        const int all = entries(row);
        // where several slots are written at once, those behind the last pair may be among them
        for (int place = ALIGNED ? (all + AT_A_TIME - 1) / AT_A_TIME * AT_A_TIME + lane : all + lane; place < capacity;
            place += LANES_PER_ROW) {
            out[place] = 0;
            if constexpr (MEASURED)
                out_lengths[place] = 0;
        }
        auto nothing = [](auto, int, int, const real*, const Verdict&, bool) {};
        walk(own_point(row), nothing, [&](int place, unsigned int pairs, const real* lengths) {
            unsigned char bits[AT_A_TIME];
            real length[AT_A_TIME];
#pragma unroll
            for (int k = 0; k < AT_A_TIME; ++k) {
                bits[k] = pairs >> k & 1;
                length[k] = MEASURED && bits[k] ? lengths[k] : real(0);
            }
            write(bits, out, place);
            if constexpr (MEASURED)
                write(length, out_lengths, place);
        });
    }
    // Writes what belongs to the slots of a row from `place` on, as `read_slots` reads it.
    template <class Element>
    JFRNN_MEMBER void write(const Element* from, Element* row, int place) const {
        struct alignas(sizeof(Element) * AT_A_TIME) Words {
            Element at[AT_A_TIME];
        } words;
#pragma unroll
        for (int k = 0; k < AT_A_TIME; ++k)
            if (ALIGNED)
                words.at[k] = from[k];
            else if (place + k < capacity)
                row[place + k] = from[k];
        if constexpr (ALIGNED)
            *(Words*)(row + place) = words;
    }
};
