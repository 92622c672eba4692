// What the id of a candidate tells: its source and, where space is periodic, its image.
#pragma once
#include "warp.cuh"

JFRNN_FUNCTION Place load(const Place* from) {
    if constexpr (DOUBLE) {
        const double2 a = __ldg((const double2*)from), b = __ldg((const double2*)from + 1);
        return Place{{(real)a.x, (real)a.y, (real)b.x}, (real)b.y};
    } else {
        const float4 a = __ldg((const float4*)from);
        return Place{{(real)a.x, (real)a.y, (real)a.z}, (real)a.w};
    }
}
// Loads a place by a predicate. Sums need no id, so it is not loaded: its register would be given to another value, which would wait
// for the load.
template <class AnyPlace>
JFRNN_FUNCTION void load_if(bool is_loaded, const Place* from, AnyPlace& to) {
    if constexpr (sizeof(to.id) == 8) {
        if (is_loaded)
            to = load(from);
    } else if constexpr (SUMS)
        asm volatile(
            "{.reg .pred is; setp.ne.u32 is, %3, 0; @is ld.global.nc.f32 %0, [%4];"
            "@is ld.global.nc.f32 %1, [%4 + 4]; @is ld.global.nc.f32 %2, [%4 + 8];}"
            : "+f"(to.p[0]), "+f"(to.p[1]), "+f"(to.p[2])
            : "r"((unsigned int)is_loaded), "l"(__cvta_generic_to_global(from)));
    else
        asm volatile("{.reg .pred is; setp.ne.u32 is, %4, 0; @is ld.global.nc.v4.f32 {%0, %1, %2, %3}, [%5];}"
            : "+f"(to.p[0]), "+f"(to.p[1]), "+f"(to.p[2]), "+f"(to.id)
            : "r"((unsigned int)is_loaded), "l"(__cvta_generic_to_global(from)));
}

// A search whose candidates are images of sources or, where terms are summed, images of places: all that is known of a source then
// stands at its place. The code of an image counts shifts along the axes, the last one fastest. An id holds it in the upper bits or,
// where images are told apart in lists, as lists do.
struct ImageSearch : Search {
    // Inside, no row of cells leaves the box: all that is near is at home, nothing is moved.
    static constexpr bool INSIDE = !CROSSING;
    static constexpr int ID_BITS = 27;
    static constexpr int IDS = (PERIODIC == 1 || SUMS) && INSIDE ? 0 : PERIODIC;  // 0: ids tell no image, 1: in the upper bits
    static constexpr int TABLED = 32;                                             // codes whose shifts stand in a table
    int codes, home;        // how many codes there are, and the one of no shift
    unsigned int per_code;  // (IDS is 2) 2^32 / n, rounded down

    JFRNN_MEMBER explicit ImageSearch(const SearchArguments& given) : Search(given), codes(1), home(0), per_code(0) {
        if constexpr (IDS) {
            codes = count_codes();
            home = (codes - 1) / 2;
        }
        if constexpr (IDS == 2)
            per_code = 0xffffffffu / (unsigned int)n;
        if constexpr (CROSSING) {
            int shift[3] = {0, 0, 0};
            count_shift(lane, shift);
            shared_warp().shifts[lane] = (shift[0] & 255) | (shift[1] & 255) << 8 | (shift[2] & 255) << 16;
            __syncwarp();
        }
    }
    JFRNN_MEMBER int count_codes() const {
        int codes = 1;
        for (int k = 0; PERIODIC && k < DIM; ++k)
            codes *= 2 * lattice.images(k) + 1;
        return codes;
    }
    JFRNN_MEMBER int fill_value() const { return PERIODIC == 2 ? n * codes : n; }
    JFRNN_MEMBER int id_of_image(int source, int code) const {
        const unsigned int upper = (unsigned int)(code ^ home) << ID_BITS;  // none at home
        return IDS == 0 ? source : IDS == 1 ? (int)((unsigned int)source | upper) : source + n * code;
    }
    JFRNN_MEMBER int source_of(int id) const {
        return IDS == 0 ? id : IDS == 1 ? id & ((1 << ID_BITS) - 1) : id - n * quotient_by_n(id);
    }
    JFRNN_MEMBER int image_of(int id) const { return IDS == 1 ? (int)((unsigned int)id >> ID_BITS) ^ home : quotient_by_n(id); }
    // id / n, where that is the product with what is rounded down, or one more
    JFRNN_MEMBER int quotient_by_n(int id) const {
        const unsigned int most = __umulhi((unsigned int)id, per_code);
        return (int)(most + (id - (int)most * n >= n));
    }
    JFRNN_MEMBER void shift_of(int code, int* shift) const {
        if (!CROSSING || (PERIODIC == 2 && codes > TABLED))
            return count_shift(code, shift);
        const int packed = shared_warp().shifts[code];
        for (int k = 0; k < DIM; ++k)
            shift[k] = packed << (24 - 8 * k) >> 24;
    }
    JFRNN_MEMBER void count_shift(int code, int* shift) const {
        for (int k = DIM - 1; k >= 0; --k) {
            const int each = 2 * lattice.images(k) + 1;
            shift[k] = code % each - lattice.images(k);
            code /= each;
        }
    }
    // Finds by how much the image of a code is moved.
    JFRNN_MEMBER void translate(int code, real* moved) const {
        int shift[3] = {0, 0, 0};
        shift_of(code, shift);
        for (int k = 0; k < DIM; ++k)
            moved[k] = lattice.translation(shift[0], shift[1], shift[2], k);
    }
    JFRNN_MEMBER int source_named(int id) const { return SUMS ? id_of(__ldg(&sorted[source_of(id)].id)) : source_of(id); }
    // The same, loaded now: the compiler would put it off until it is used.
    JFRNN_MEMBER int source_named_now(int id) const {
        if constexpr (!SUMS)
            return source_of(id);
        int name;
        asm volatile("ld.global.nc.b32 %0, [%1];" : "=r"(name) : "l"(__cvta_generic_to_global(&sorted[source_of(id)].id)));
        return name;
    }
    // How rows of what queries exclude name a candidate of a source (excluded.h).
    JFRNN_MEMBER int excluded_id(int id, int source) const {
        if constexpr (EXCLUDING == 2)
            return Excluded::id_of(source, IDS ? image_of(id) : (count_codes() - 1) / 2, n);
        return source;
    }
    // Loads where a candidate is. It is moved by the same operations wherever it is loaded, so that it is always in the same place.
    JFRNN_MEMBER void load_image(int id, real* p) const {
        if constexpr (SUMS) {
            const Place here = load(sorted + source_of(id));
            for (int k = 0; k < DIM; ++k)
                p[k] = here.p[k];
        } else
            point_of(positions + (long long)ROW * source_of(id), p);
        if constexpr (!INSIDE) {
            real moved[3];
            translate(image_of(id), moved);
            for (int k = 0; k < DIM; ++k)
                p[k] = Lattice::add(p[k], moved[k]);
        }
    }
    // The order of candidates that half lists go by: by source, then, of one source, its images behind, at home, ahead.
    JFRNN_MEMBER int order_of(int id) const {
        if constexpr (PERIODIC != 2)
            return source_of(id);
        const int code = image_of(id);
        return 3 * source_of(id) + (code > home) - (code < home);
    }
    JFRNN_MEMBER int first_after(int my_id) const { return PERIODIC == 2 ? 3 * my_id + drop_self : my_id + drop_self; }
    JFRNN_MEMBER Place load_query(int at) const {
        if (own)
            return load(sorted + at);
        Place q;
        const int i = query_order[at];
        point_of(queries + (long long)ROW * i, q.p);
        q.id = bits_as_real(i);
        return q;
    }
};
