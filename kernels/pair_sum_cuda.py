"""Sums over pairs on CUDA, without a list: the term is evaluated where its pairs are found, by the lane of their query.

The stages of `jfrnn.kernels.cells_cuda` sort the sources by cell. `sort_values` puts what a term reads of them, but for
coordinates, into the same order, a row each. Then the walk of that module finds pairs as a search does, and holds their bits for
22 blocks of candidates. A lane goes through the bits of its query and reads coordinates and row of each neighbor through the
first-level cache, which the 31 other lanes share.

Of a million particles with 108 neighbors (float32), 32 queries meet 570 candidates near their box. Evaluating the term for all of
them would take 570 steps of the warp; for the pairs of one block of 32 at a time 345, as lanes wait for the one with most; for
those of 22 blocks 116, or 62 of two pairs each. Such a step of a density (10 operations) is 55 instructions of sm_90, one of its
gradient 122: 3400 and 7600 in all, beside some 6300 that finding the pairs takes. Prediction for an H200, from a search that
writes lists (9300 instructions, 0.4 ms) and its stages (0.09 ms): a density 0.5 ms, its gradient 0.7 ms. Bytes do not bound it:
40 per particle are 0.01 ms.
"""

import functools
from string import Template
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._math import SCALAR
from jfrnn.kernels._native import CELLS, EXACT, snippet
from jfrnn.kernels.cells_cuda import GRID, HELD_PAIRS, LAYOUT, QUERY_BLOCK, Launch, cell_kernels, walk
from jfrnn.kernels.cells_cuda import Kernels as CellKernels
from jfrnn.kernels.pair_sum_cpu import LITTLE_WORK, TermText, Value, loaded, placed, work

_SWEEP_BLOCKS = 4224  # blocks of the kernel that walks over all values


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // QUERY_BLOCK)


def row_length(columns: int, double: bool) -> int:
    """Return how many numbers of each source the sorted values have, a row: 16 bytes are loaded at once, if there are so many."""
    at_once = 2 if double else 4
    return next((length for length in (0, 1, 2) if columns <= length <= at_once), -(-columns // at_once) * at_once)


_SORT_VALUES = r"""
for (long long t = thread; t < (long long)ROW_LENGTH * n; t += threads) {
    const long long place = t / ROW_LENGTH;
    const int c = (int)(t % ROW_LENGTH);
    values.data[t] = c < OTHERS ? others.data[(long long)OTHERS * id_of(sorted[place].id) + c] : real(0);
}
"""

_OPENED = r"""
for (int t = lane; turn < query_blocks && t < 2 * TOTALS; t += 32)
    totals.data[2ll * TOTALS * turn + t] = 0;
"""

_NO_SUM = r"""
for (int r = lane; r < ROW_SUMS; r += 32)
    sums.data[(long long)id * ROW_SUMS + r] = 0;
"""

# Sums, and what rounding took of them, which is added in the end, or goes on as they do.
_ADD = r"""
auto two_sum = [](real& sum, real& error, real x) {  // Knuth 1969
    const real s = Lattice::add(sum, x), b = Lattice::add(s, -sum);
    error = Lattice::add(error, Lattice::add(Lattice::add(sum, -Lattice::add(s, -b)), Lattice::add(x, -b)));
    sum = s;
};
auto add = [&](real& sum, real& error, bool is_pair, real x) {
    if constexpr (COMPENSATED)
        two_sum(sum, error, is_pair ? x : real(0));
    else
        sum = is_pair ? sum + x : sum;
};
auto store = [&](long long at, real sum, real error, bool fresh, bool finished) {
    real all = fresh ? real(0) : sums.data[at], carried = fresh || !COMPENSATED ? real(0) : errors.data[at];
    add(all, carried, true, sum);
    carried += error;
    if (COMPENSATED && finished && Bits::finite(all))
        all += carried;
    if (COMPENSATED && !finished)
        errors.data[at] = carried;
    sums.data[at] = all;
};
auto add_total = [&](int t, real sum, real error) {  // of all lanes, always in the same order
    for (int step = 16; step > 0; step /= 2) {
        const real other = __shfl_down_sync(ALL, sum, step), other_error = __shfl_down_sync(ALL, error, step);
        two_sum(sum, error, other);
        error += other_error;
    }
    if (lane == 0) {
        real* const part = totals.data + 2ll * TOTALS * turn + t;
        two_sum(part[0], part[TOTALS], sum);
        part[TOTALS] += error;
    }
};
struct Row { real at[ROW_LENGTH]; };
auto load_row = [&](int place) -> Row {
    constexpr int TOGETHER = ROW_LENGTH * sizeof(real) < 16 ? ROW_LENGTH : 16 / sizeof(real);
    struct alignas(TOGETHER * sizeof(real)) Part { real at[TOGETHER]; };
    Row row;
#pragma unroll
    for (int p = 0; p < ROW_LENGTH / TOGETHER; ++p) {
        const Part part = *((const Part*)(values.data + (long long)ROW_LENGTH * place) + p);
#pragma unroll
        for (int c = 0; c < TOGETHER; ++c)
            row.at[TOGETHER * p + c] = part.at[c];
    }
    return row;
};
"""

_ADD_PAIRS = Template(r"""
bool fresh = true;  // there are no sums of this group yet
auto add_pairs = [&](bool finished) {
    const unsigned int behind = 1u << tested / 32;  // the block behind the last one: nobody has met it
    warp.hits[tested / 32][lane] = 0;
    met_in |= behind;
    // a lane that has no pair left reads the id behind a block's, and nothing comes of it; but it must be a place
    if (lane < 2 && kept <= tested + 32 * lane)
        warp.ids[tested + 32 * lane] = 0;
    __syncwarp();
    const long long own_at = (long long)my_id * OWN, at = (long long)my_id * ROW_SUMS;
    $values
    $sums
    $held_pairs
    advance();
    for (advance(); __any_sync(ALL, hits != 0); advance()) {
#pragma unroll
        for (int k = 0; k < TAKEN; ++k) {
            const bool is_pair = hits != 0;
            const unsigned int below = hits - 1;
            const int source = load_id(ids + 4 * __popc(below & ~hits));
            hits &= below;
            $row
            $term
        }
    }
    $stored
    met_in = 0;
    fresh = false;
};
""")


class Kernels(NamedTuple):
    """The stages of a search that sort particles, the kernel that sorts values (None: there are none), and the one that sums."""

    stages: CellKernels
    sort_values: wp.Kernel | None
    query: wp.Kernel

    @property
    def summing(self) -> tuple[wp.Kernel | None, wp.Kernel]:
        """Those that take the arguments of a sum; the stages take those of a search."""
        return self.sort_values, self.query

    def launches(self, n: int, m: int, own: bool) -> list[Launch]:
        """Return what is launched, in order, for n sources and m queries."""
        *stages, query = self.stages.launches(n, m, own)
        blocks = min(-(-n // QUERY_BLOCK), _SWEEP_BLOCKS)
        sorting = [] if self.sort_values is None else [Launch(self.sort_values, blocks * QUERY_BLOCK, QUERY_BLOCK, False)]
        return [*stages, *sorting, query._replace(kernel=self.query)]

    def load(self, device: wp.DeviceLike) -> None:
        """Compile and load what a launch needs: nothing is left to do while a CUDA graph is recorded."""
        self.stages._replace(query=self.query).load(device)


def _evaluation(term: TermText, double: bool) -> str:
    """Return the text that defines `add_pairs`: it adds the pairs that are held to the sums of their queries."""

    def defined(values: tuple[Value, ...], column: str, point: str) -> str:
        numbers = placed(values, column, f"{point}.p[{{}}]")
        return "".join(loaded(value, x, f"Math::bits({x})", double) for value, x in zip(values, numbers, strict=True))

    def point(values: tuple[Value, ...], name: str, place: str) -> str:
        return f"const Place {name} = {place};\n" if any(value.axis is not None for value in values) else ""

    added, rows, totals = [], [], []
    for k, part in enumerate(term.sums):
        added.append(f"add(sum{k}, error{k}, is_pair, {part.name});\n")
        if part.total:
            totals.append(f"add_total({len(totals)}, sum{k}, error{k});\n")
        else:
            rows.append(f"store(at + {len(rows)}, sum{k}, error{k}, fresh, finished);\n")
    here = point(term.own, "here", "lane < group ? load_query(place + lane) : Place{{0, 0, 0}, 0}")
    shared = defined(term.shared, "shared_values.data[{}]", "")
    row = ["const Row row = load_row(source);\n"] if term.source_columns else []
    return _ADD_PAIRS.substitute(
        values="".join([shared, here, defined(term.own, "own_values.data[own_at + {}]", "here")]),
        sums="".join(f"real sum{k} = 0, error{k} = 0;\n" for k in range(len(term.sums))),
        held_pairs=HELD_PAIRS,
        row="".join([point(term.others, "there", "load(sorted + source)"), *row]),
        term="".join([defined(term.others, "row.at[{}]", "there"), term.text, *added]),
        stored="".join(["if (lane < group) {\n", *rows, "}\n", *totals]),
    )


@functools.cache
def sum_kernels(
    term: TermText, key: str, dim: int, double: bool, scaled: bool, compensated: bool, batched: bool = False,
    blocks: int | None = None, taken: int | None = None,
) -> Kernels:  # fmt: skip
    """Return the kernels that sum a term; `key` tells it from all others in the names of programs.

    The rest is there to be measured: `blocks` per multiprocessor bound the registers, `taken` is how many pairs a lane adds before
    it looks for the next block; None: as seems best.
    """
    cheap = work(term.text) <= LITTLE_WORK
    taken = taken or (2 if cheap else 1)
    blocks = blocks or (16 if double or not cheap else 20)
    totals = sum(part.total for part in term.sums)
    kind = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_compensated' * compensated}{'_batched' * batched}"
    module = f"{kind}_b{blocks}_t{taken}_{key}"
    constants = {**GRID, "BATCHED": batched, "SCALED": scaled, "LIST": 0, "SUMS": 1, "LATER": 0, "EXACTLY": 1, "CROSSING": 0}
    columns, own = term.source_columns, sum(value.axis is None for value in term.own)
    constants |= {"OTHERS": columns, "ROW_LENGTH": max(row_length(columns, double), 1), "OWN": own}
    constants |= {"TOTALS": totals, "ROW_SUMS": len(term.sums) - totals, "COMPENSATED": compensated, "TAKEN": taken}
    text = SCALAR + walk(opened=_OPENED, none=_NO_SUM, begun=_ADD + _evaluation(term, double), settled="add_pairs(finished);")
    query = _kernel("pair_sum", module, dim, double, blocks, constants, EXACT, text)
    sorting = _kernel("sort_values", module, dim, double, 32, constants, _SORT_VALUES) if columns else None
    return Kernels(cell_kernels(dim, double, scaled, False, batched=batched), sorting, query)


def _kernel(name: str, module: str, dim: int, double: bool, blocks: int, constants: dict[str, int], *pieces: str) -> wp.Kernel:
    scalar = wp.float64 if double else wp.float32
    table_of, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)

    def native(
        positions: table_of, queries: table_of, cutoff: reals, shared_values: reals, own_values: table_of, others: table_of,
        sums: table_of, totals: reals, errors: reals, values: reals, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, closed: int, drop_self: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"{name}_{module}_native"
    text = snippet("double" if double else "float", dim, CELLS, LAYOUT, *pieces, **constants)
    function = wp.func_native(text)(native)

    def kernel(
        positions: table_of, queries: table_of, cutoff: reals, shared_values: reals, own_values: table_of, others: table_of,
        sums: table_of, totals: reals, errors: reals, values: reals, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, closed: int, drop_self: int,
    ):  # fmt: skip
        function(
            positions, queries, cutoff, shared_values, own_values, others, sums, totals, errors, values, info, scratch,
            n, m, own, table, closed, drop_self,
        )  # fmt: skip

    home = wp.get_module(f"jfrnn.kernels.pair_sum_cuda.{module}")
    wp.set_module_options({"enable_backward": False, "max_unroll": 1}, home)
    return wp.kernel(kernel, name=f"{name}_{module}", module=home, grid_stride=False, launch_bounds=(QUERY_BLOCK, blocks))
