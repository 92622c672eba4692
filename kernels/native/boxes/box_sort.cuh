// How sources are sorted by system and cell on CUDA, where each system has a box of its own: six launches, the last one in the order of
// the numbers of sources, so that it is the same in every run.
#pragma once
#include "box_space.h"
#include "scan.cuh"

// `turning` has a bit per periodic axis of each system, `systems` has those of the sources, `boxed` is how many there are. What is
// written is that of box_pairs.cuh; `size` is how many cells there may be.
struct BoxSortArguments {
    const real *positions, *boxes;
    const int *systems, *turning;
    real* axes;
    int *ids, *cells, *start, *scratch;
    int n, boxed, stride, size;
};

struct BoxSort : BoxSortArguments, BoxSpace {
    static constexpr unsigned int EVERY = 0xffffffffu;
    static constexpr int HEADER = 16;     // as in jfrnn/kernels/boxes.py, where the words of the scratch are counted
    int *const next_tile, *const behind;  // tiles of the scan that have begun, sources without a cell so far
    unsigned long long* const tile_state;
    int *const members, *const key, *const slot, *const unsorted;
    const long long i;  // the number of a source, of a place

    JFRNN_MEMBER explicit BoxSort(const BoxSortArguments& a)
        : BoxSortArguments(a),
          BoxSpace(a.boxes),
          next_tile(a.scratch),
          behind(a.scratch + 1),
          tile_state((unsigned long long*)(a.scratch + HEADER)),
          members(a.scratch + HEADER + 2 * (a.size / TILE + 1)),
          key(members + a.boxed),
          slot(key + a.n),
          unsorted(slot + a.n),
          i(thread_index()) {}

    // Counts the sources of each system; one lane for all of its warp that are of the same one.
    JFRNN_MEMBER void count_members() {
        const bool is_there = i < n && !Bits::negative(positions[ROW * i + DIM]);
        const unsigned int there = __ballot_sync(EVERY, is_there);
        if (!is_there)
            return;
        const unsigned int alike = __match_any_sync(there, systems[i]);
        if (__ffs(alike) - 1 == (int)(threadIdx.x & 31))
            atomicAdd(members + systems[i], __popc(alike));
    }
    // Divides the box of each system into cells, and lets those of one follow those of another: a block alone.
    JFRNN_MEMBER void lay_out() {
        __shared__ int sums[32], carried;
        const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
        if (threadIdx.x == 0)
            carried = 0;
        for (int begin = 0; begin < boxed; begin += blockDim.x) {
            __syncthreads();
            const int s = begin + threadIdx.x, total = s < boxed ? divide(s) : 0;
            int before = carried - total, inclusive = total;
            for (int step = 1; step < 32; step *= 2) {
                const int other = __shfl_up_sync(EVERY, inclusive, step);
                inclusive += lane >= step ? other : 0;
            }
            if (lane == 31)
                sums[warp] = inclusive;
            __syncthreads();
            before += inclusive;
            for (int w = 0; w < warp; ++w)
                before += sums[w];
            if (s < boxed)
                cells[5ll * s + 3] = before;
            if (threadIdx.x == blockDim.x - 1)
                carried = before + total;
        }
    }
    // Finds how many cells a system has along each axis, at most as many as its cutoff asks for and its sources fill, and in all.
    JFRNN_MEMBER int divide(int s) {
        constexpr int FILL = 4;  // as in jfrnn/_geometry/box_cells.py
        enter(boxes, s, turning[s]);
        const int room = members[s] / FILL > 1 ? members[s] / FILL : 1;
        const double most = room * (1 - 1e-6);
        double along[3] = {1, 1, 1}, all = 1;
        for (int k = 0; k < DIM; ++k) {
            const double wanted = is_turning(k) ? floor(1 / (double)lattice.reach(k)) : most;
            along[k] = wanted > 1 ? fmin(floor(wanted), (double)room) : 1.0;  // what is no number is 1
            all *= along[k];
        }
        for (int turn = 0; turn < DIM; ++turn) {  // an axis that is down to one cell leaves the rest to the others
            int longer = 0;
            for (int k = 0; k < DIM; ++k)
                longer += along[k] > 1;
            const double scale = all > most && longer > 0 ? pow(most / all, 1.0 / longer) : 1.0;
            all = 1;
            for (int k = 0; k < DIM; ++k) {
                along[k] = along[k] > 1 ? fmax(floor(along[k] * scale), 1.0) : 1.0;
                all *= along[k];
            }
        }
        for (int k = 0; k < 3; ++k)
            cells[5ll * s + k] = k < DIM ? (int)along[k] : 1;
        cells[5ll * s + 4] = axes_turning;
        return (int)all;
    }
    // Counts every source in its cell.
    JFRNN_MEMBER void count_cells() {
        if (i >= n)
            return;
        const int s = systems[i];
        const int* const mine = cells + 5ll * s;
        enter(boxes, s, mine[4]);
        real p[3] = {0, 0, 0};
        point_of(positions + ROW * i, p);
        int cell = 0;
        for (int k = DIM - 1; k >= 0; --k) {
            counts[k] = mine[k];
            int at = cell_along(k, p, 0);
            if (is_turning(k))
                at = at < 0 ? 0 : at < counts[k] ? at : counts[k] - 1;
            else
                at -= floor_of(at, counts[k]) * counts[k];
            cell = cell * counts[k] + at;
        }
        const bool is_there = finite_point(p);
        key[i] = is_there ? mine[3] + cell : -1;
        slot[i] = atomicAdd(is_there ? start + key[i] : behind, 1);
    }
    // Turns counts into first places; one more entry is the end of the last cell.
    JFRNN_MEMBER void scan_counts() { scan_in_place(start, size + 1, tile_state, next_tile); }
    JFRNN_MEMBER void scatter() {
        if (i < n)
            unsorted[(key[i] >= 0 ? start[key[i]] : n - *behind) + slot[i]] = (int)i;
    }
    // Ranks sources by their numbers within a cell.
    JFRNN_MEMBER void rank() {
        if (i >= n && i < stride)
            ids[i] = 0;
        if (i >= n)
            return;
        const int id = unsorted[i], cell = key[id];
        int to = (int)i;
        if (cell >= 0) {
            to = start[cell];
            for (int other = start[cell]; other < start[cell + 1]; ++other)
                to += unsorted[other] < id;
        }
        ids[to] = id;
        real p[3];
        lattice = Lattice(boxes + (long long)LATTICE_END * systems[id]);
        point_of(positions + (long long)ROW * id, p);
        for (int k = 0; k < DIM; ++k)
            axes[(long long)k * stride + to] = p[k];
    }
};
