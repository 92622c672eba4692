"""Sums over pairs on CUDA, without a list: the term is evaluated where its pairs are found, by the lane of their query.

The stages of `jfrnn.kernels.cells_cuda` sort the sources by cell. `sort_values` puts what a term reads of them into the same
order, a row each. Then the walk of that module finds pairs as a search does, and holds their bits for 22 blocks of candidates. A
lane goes through the bits of its query and reads the row of each neighbor through the first-level cache, which the 31 other lanes
share: of a few pairs at a time, while it evaluates the term for those before. In a periodic box turns stand behind what is read of
i and j, packed as in `jfrnn._box`: with the image of a neighbor they make its lattice shift S. In place of sums it can find the
largest summands, and whose they are.

Of a million particles with 108 neighbors (float32), 32 queries meet 570 candidates near their box. Evaluating the term for all
of them would take 570 steps of the warp; for the pairs of one block of 32 at a time 345, as lanes wait for the one with most;
for those of 22 blocks 116. On an H200 a warp executes 9400 instructions for a density, 3600 of them for the pairs it found,
1900 in tensor cores and around them; schedulers issue in 64 % of their cycles; a fifth of the time warps wait for what they
load (ncu). 0.84 ms became 0.63 when rows were loaded ahead and numbers were multiplied by reciprocals, 0.60 when two sets of
rows took turns and candidates were kept by predicate. What bounds it is the first-level cache, busy in 89 % of the cycles: rows of
32 lanes stand in as many places, and to gather them takes it about 18. With rows held in shared memory, 15, but pairs of half as
many blocks then fit, and 12 % more instructions are executed: 0.59 to 0.65 ms, the gradient 1.51 to 1.67 instead of 1.43
(experiments/results/h200/density). Bytes of memory do not bound it: 40 per particle are 0.01 ms.
"""

import functools
from string import Template
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._math import SCALAR
from jfrnn.kernels._native import SPACES, bind, program
from jfrnn.kernels._text import read_part
from jfrnn.kernels.cells_cuda import (
    GRID,
    HELD_PAIRS,
    MOST_IN_STRIDES,
    QUERY_BLOCK,
    Launch,
    load_walks,
    query_blocks,
    walk,
    walks,
)
from jfrnn.kernels.pair_sum_cpu import LITTLE_WORK, TermText, Value, loaded, placed, work


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return query_blocks(queries)


def sorted_numbers(term: TermText, sources: int, dim: int, double: bool) -> int:
    """Return how many numbers the sorted values of all sources take."""
    return sources * row_length(term, dim, double)


def row_length(term: TermText, dim: int, double: bool) -> int:
    """Return how many numbers of each source the sorted values have, a row: 16 bytes are loaded at once, if there are so many.

    Coordinates come first, where a term reads them and something else.
    """
    columns = term.source_columns + _placed_columns(term, dim)
    at_once = 2 if double else 4
    return next((length for length in (0, 1, 2) if columns <= length <= at_once), -(-columns // at_once) * at_once)


_SUMS = read_part("pair_sum.cuh", "sums")

_OPENED = read_part("pair_sum.cuh", "opened")

_NO_SUM = read_part("pair_sum.cuh", "no_sum")
_NO_EXTREME = read_part("pair_sum.cuh", "no_extreme")

# Sums, and what rounding took of them, which is added in the end, or goes on as they do.
_ADD = read_part("pair_sum.cuh", "add")
_TAKE_LARGER = read_part("pair_sum.cuh", "take_larger")
_KEEP_LARGEST = read_part("pair_sum.cuh", "keep_largest")

# What is loaded here comes in the order of the text, all of several pairs before any of it is used: else the compiler saves
# registers, and every pair waits for its own.
_LOAD_ROW = read_part("pair_sum.cuh", "load_row")

_ADD_PAIRS = Template(read_part("pair_sum.cuh", "add_pairs"))


class Kernels(NamedTuple):
    """The kernel that sorts values (None: there are none), and those that sum; `crossing` as in a search."""

    sort_values: wp.Kernel | None
    query: wp.Kernel
    crossing: wp.Kernel | None

    def launches(self, n: int, m: int) -> list[Launch]:
        """Return what is launched, in order, for n sources and m queries, which are sorted already."""
        threads = min(-(-n // QUERY_BLOCK) * QUERY_BLOCK, MOST_IN_STRIDES)
        sorting = [] if self.sort_values is None else [Launch(self.sort_values, threads, QUERY_BLOCK, False)]
        return sorting + walks(self.query, self.crossing, m)

    def load(self, device: wp.DeviceLike) -> None:
        """Compile and load what a launch needs: nothing is left to do while a CUDA graph is recorded."""
        load_walks(self.query, self.crossing, device)


class _Reduction(NamedTuple):
    """What becomes of summands: text before the pairs that are held, for each of them (`is_pair`), and after the last one.

    `kept` is for queries, `totalled` for all lanes.
    """

    started: str
    each: str
    kept: str
    totalled: str = ""


def _added(term: TermText) -> _Reduction:
    """Return text that adds summands to what the query has already, and to the totals of the block."""
    started, each, rows, totals = [], [], [], []
    for k, part in enumerate(term.sums):
        started.append(f"real sum{k} = 0, error{k} = 0;\n")
        each.append(f"add(sum{k}, error{k}, is_pair, {part.name});\n")
        if part.total:
            totals.append(f"add_total({len(totals)}, sum{k}, error{k});\n")
        else:
            rows.append(f"store(at + {len(rows)}, sum{k}, error{k}, fresh, finished);\n")
    return _Reduction(*("".join(lines) for lines in (started, each, rows, totals)))


def _largest(term: TermText) -> _Reduction:
    """Return text that keeps the largest summands of a query, their sources and their images."""
    started, kept = [], []
    each = ["const int source = id_of(there.id), code = CROSSING ? image_of(id) : code_at_home;\n"]
    for k, part in enumerate(term.sums):
        started.append(f"real best{k} = -INF;\nint of{k} = n, code{k} = 0;\n")
        each.append(f"take_larger({part.name}, source, code, is_pair, best{k}, of{k}, code{k});\n")
        kept.append(f"keep_largest(at + {k}, best{k}, of{k}, code{k}, fresh);\n")
    return _Reduction(*("".join(lines) for lines in (started, each, kept)))


def _evaluation(term: TermText, double: bool, extremes: bool) -> str:
    """Return the text that defines `add_pairs`: it reduces the pairs that are held to what their queries get."""

    def defined(values: tuple[Value, ...], column: str, axis: str) -> str:
        numbers = placed(values, column, axis)
        return "".join(loaded(value, x, f"Math::bits({x})", double) for value, x in zip(values, numbers, strict=True))

    def has_positions(values: tuple[Value, ...]) -> bool:
        return any(value.axis is not None for value in values)

    reduction = _largest(term) if extremes else _added(term)
    values = [defined(term.shared, "shared_values[{}]", "")]
    if has_positions(term.own):
        values.append("const Place here = lane < group ? load_query(place + lane) : Place{{0, 0, 0}, 0};\n")
    values.append(defined(term.own, "own_values[own_at + {}]", "here.p[{}]"))
    from_place = has_positions(term.others) and not term.source_columns
    numbers = defined(term.others, "row.at[PLACED + {}]", "there.p[{}]" if from_place else "row.at[{}]")
    fields, arrays, row = [], [], []

    def ahead(kind: str, name: str, loaded: str) -> None:
        fields.append(f"{kind} {name}[TAKEN];\n")
        arrays.append(f"#pragma unroll\nfor (int k = 0; k < TAKEN; ++k)\n    taken.{name}[k] = {loaded};\n")
        row.append(f"const {kind} {name} = now.{name}[k];\n")

    ahead("int", "id", "load_id_now(at[k])")
    if extremes or from_place:
        ahead("Place", "there", "load_place(source_of(taken.id[k]))")
    if term.source_columns:
        ahead("Row", "row", "load_row(source_of(taken.id[k]))")
    if term.steps:  # inside of a box there are none
        turns = f"own_values[own_at + {_own_columns(term) - 1}]"
        values += [f"const int turn{c} = Lattice::turn({turns}, {step.axis});\n" for c, step in enumerate(term.steps)]
        row.append("int shift[3] = {0, 0, 0};\nif constexpr (CROSSING)\n    shift_of(image_of(id), shift);\n")
        for c, (name, axis) in enumerate(term.steps):
            step = f"shift[{axis}] - Lattice::turn(row.at[PLACED + {term.columns}], {axis}) + turn{c}"
            row.append(f"const real {name} = CROSSING ? real({step}) : real(0);\n")
    return _ADD_PAIRS.substitute(
        values="".join(values),
        started=reduction.started,
        held_pairs=HELD_PAIRS,
        fields="".join(fields),
        loaded="".join(arrays),
        row="".join(row),
        term="".join([numbers, term.text, reduction.each]),
        stored="".join(["if (lane < group) {\n", reduction.kept, "}\n", reduction.totalled]),
    )


def _placed_columns(term: TermText, dim: int) -> int:
    """Return how many coordinates of j stand before its columns."""
    return dim if term.source_columns and any(value.axis is not None for value in term.others) else 0


def _own_columns(term: TermText) -> int:
    """Return how many numbers of i have a column, turns among them."""
    return sum(value.axis is None for value in term.own) + bool(term.steps)


@functools.cache
def sum_kernels(
    term: TermText, key: str, dim: int, double: bool, scaled: bool, compensated: bool, periodic: int = 0, batched: bool = False,
    extremes: bool = False,
) -> Kernels:  # fmt: skip
    """Return the kernels that sum a term; `key` tells it from all others in the names of programs.

    `extremes`: they find the largest summands instead; `errors` [m, width, 2] then gets their sources (n: there is none), and the
    codes of their images, as integers travel among floats.
    """
    # `taken` is how many pairs a lane adds before it looks for the next block; `blocks` per multiprocessor bound registers. Both
    # are what was fastest on an H200: rows of several loads wait in registers, and are 1.3 times slower if four are loaded ahead.
    cheap = work(term.text) <= LITTLE_WORK and row_length(term, dim, double) <= 4
    taken = 4 if cheap else 2
    blocks = 16 if double or not cheap else 20
    totals, columns = sum(part.total for part in term.sums), term.source_columns
    kind = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_compensated' * compensated}"
    kind += f"{SPACES[periodic]}{'_batched' * batched}{'_extremes' * extremes}"
    module = f"{kind}_b{blocks}_t{taken}_{key}"
    constants = {**GRID, "PERIODIC": periodic, "BATCHED": batched, "SCALED": scaled}
    constants |= {"LIST": 0, "SUMS": 1, "LATER": 0, "COMPENSATED": compensated, "TAKEN": taken}
    constants |= {"OTHERS": columns, "ROW_LENGTH": max(row_length(term, dim, double), 1), "OWN": _own_columns(term)}
    constants |= {"PLACED": _placed_columns(term, dim)}
    constants |= {"TOTALS": totals, "ROW_SUMS": len(term.sums) - totals}
    query = walk(
        "Sums",
        opened=_OPENED + (f"typedef Math::{'f64' if double else 'f32'} number;\n" + _TAKE_LARGER + _KEEP_LARGEST) * extremes,
        none=_NO_SUM + _NO_EXTREME * extremes,
        begun="".join([_ADD, _LOAD_ROW, _evaluation(term, double, extremes)]),
        settled="add_pairs(finished);",
    )

    def kernel_of(name: str, call: str, crossing: bool = False, text: str = "") -> wp.Kernel:
        where = {"CROSSING": crossing, "SHIFTED": periodic if crossing else 0}
        whole = program(double, dim, "cells.cuh", "exact.h", "math.h", given={"math.h": SCALAR}, **constants | where)
        return _kernel(name, module, double, 32 if call == "Sums.sort_values" else blocks, call, whole + _SUMS + text)

    return Kernels(
        kernel_of("sort_values", "Sums.sort_values") if columns else None,
        kernel_of("pair_sum", "Query.run", text=query),
        kernel_of("crossing_pair_sum", "Query.run", crossing=True, text=query) if periodic else None,
    )


def _kernel(name: str, module: str, double: bool, blocks: int, call: str, text: str) -> wp.Kernel:
    scalar = wp.float64 if double else wp.float32
    table_of, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)

    def native(
        positions: table_of, queries: table_of, cutoff: reals, shared_values: reals, own_values: table_of, others: table_of,
        sums: table_of, totals: reals, errors: reals, values: reals, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, closed: int, drop_self: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"{name}_{module}_native"
    home = wp.get_module(f"jfrnn.kernels.pair_sum_cuda.{module}")
    wp.set_module_options({"enable_backward": False, "max_unroll": 1}, home)
    function = bind(native, home, call, text)

    def kernel(
        positions: table_of, queries: table_of, cutoff: reals, shared_values: reals, own_values: table_of, others: table_of,
        sums: table_of, totals: reals, errors: reals, values: reals, info: ints, scratch: ints,
        n: int, m: int, own: int, table: int, closed: int, drop_self: int,
    ):  # fmt: skip
        function(
            positions, queries, cutoff, shared_values, own_values, others, sums, totals, errors, values, info, scratch,
            n, m, own, table, closed, drop_self,
        )  # fmt: skip

    return wp.kernel(kernel, name=f"{name}_{module}", module=home, grid_stride=False, launch_bounds=(QUERY_BLOCK, blocks))
