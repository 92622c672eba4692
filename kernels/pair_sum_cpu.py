"""Sums over pairs on the CPU, without a list: the term is evaluated where its pairs are found, 8 or 16 at a time.

`jfrnn.kernels.cells_cpu` sorts the sources by cell (`build`). `sort_values` puts what a term reads of them into the same order, a
column each; then `query` walks over all queries as a search does, with these columns beside the coordinates of the candidates. In a
periodic box turns stand behind what is read of i and j, packed as in `jfrnn._box`: with the image of a candidate they make S.
Sums stay in vector registers while the pairs of one query are added. Terms of few operations are evaluated for all candidates of
a vector, others for those that are near, which are packed first. In place of sums `query` can find the largest summands, and whose
they are.
"""

import functools
import itertools
import re
from collections.abc import Callable
from string import Template
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._math import VECTOR
from jfrnn.kernels._native import CELLS, ENTER, EXACT, FLUSH, KEEP, LEAVE, SPACES, snippet
from jfrnn.kernels._text import read_part
from jfrnn.kernels._walk_cpu import CHUNK, walk
from jfrnn.kernels.cells_cpu import GRID, LAYOUT

CACHE_BYTES = 40 << 10  # for candidates: most of a first-level cache, and a little of the second
MOST_CANDIDATES = 1024
MOST_LANES = 16
LITTLE_WORK = 50  # operations up to which the term is evaluated for candidates that are no pairs, too
VERY_LITTLE_WORK = 20  # up to which it is, though none of a vector is a pair
_SERIES = 20  # operations that a function like exp takes
_SERIES_NAMES = ("exp", "log", "pow", "sin", "cos", "tan", "cbrt", "erf", "logistic", "rem")  # and what holds them in its name

_NAMES = {"float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "bool": "flag"}


class Value(NamedTuple):
    """What a term reads: its name in the text, its dtype, and of positions the axis; what is none of them has a column."""

    name: str
    dtype: str
    axis: int | None = None


class Sum(NamedTuple):
    """What is added up: its name in the text, of the dtype of positions; over the neighbors of each i, or (`total`) all pairs."""

    name: str
    total: bool


class Step(NamedTuple):
    """What a term reads of the lattice shift S of a pair: its name in the text, of the dtype of positions, and the axis."""

    name: str
    axis: int


class TermText(NamedTuple):
    """A term as native text: `text` defines the `sums` from what it reads, of S, of what all pairs share, of i and of j.

    A column of numbers stands for each value of the last three, and with `steps` one of turns behind those of i and of j.
    """

    text: str
    steps: tuple[Step, ...]
    shared: tuple[Value, ...]
    own: tuple[Value, ...]
    others: tuple[Value, ...]
    sums: tuple[Sum, ...]

    @property
    def columns(self) -> int:
        """How many numbers of j have a column, but for turns."""
        return sum(value.axis is None for value in self.others)

    @property
    def source_columns(self) -> int:
        """How many columns are read of the sources."""
        return self.columns + bool(self.steps)


class Kernels(NamedTuple):
    """`sort_values` (where there are any) and `query`, each launched with dim = 1 once per thread."""

    sort_values: wp.Kernel
    query: wp.Kernel


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // CHUNK)


def sorted_numbers(term: TermText, sources: int, dim: int, double: bool) -> int:
    """Return how many numbers the sorted values of all sources take: one of each for each column, and behind them a vector."""
    del dim, double
    return sources * term.source_columns + (MOST_LANES if term.source_columns else 0)


_SORT_VALUES = read_part("pair_sum_cpu.h", "sort_values")

# What adds up lanes; `errors` is what rounding took, in sums that are carried in twice the precision.
ADD = read_part("pair_sum_cpu.h", "add")
_CANDIDATES = read_part("pair_sum_cpu.h", "candidates")

# What finds the largest. NaN is larger than all; of equal ones comes first the smallest source, then the smallest image.
TAKE_LARGER = read_part("pair_sum_cpu.h", "take_larger")
KEEP_LARGEST = read_part("pair_sum_cpu.h", "keep_largest")

_COPY = read_part("pair_sum_cpu.h", "copy")

_COPY_STEP = Template(read_part("pair_sum_cpu.h", "copy_step"))

_NO_SUM = read_part("pair_sum_cpu.h", "no_sum")

_NO_EXTREME = read_part("pair_sum_cpu.h", "no_extreme")

CHUNK_DONE = read_part("pair_sum_cpu.h", "chunk_done")


def loaded(value: Value, lanes: str, bits: str, double: bool) -> str:
    """Return a statement that defines a value from `lanes` of the dtype of positions, or from their `bits`.

    Integers of the same width travel as their bits; in float64, integers of 32 bits as their values, and so do truths in both.
    """
    kind = _NAMES[value.dtype]
    same, whole = ("f64", "i64") if double else ("f32", "i32")
    made = lanes if kind == same else bits if kind == whole else f"Math::to_{kind}({lanes})"
    return f"const Math::{kind} {value.name} = {made};\n"


def _spread(value: Value, at: str, double: bool) -> str:
    """Return a statement that defines a value, the same in all lanes, from a number."""
    return loaded(value, f"Math::of({at})", f"Math::of(bits_of({at}))", double)


def placed(values: tuple[Value, ...], column: str, axis: str) -> list[str]:
    """Return where values are: those that have a column, and positions along an axis."""
    numbers = itertools.count()
    return [column.format(next(numbers)) if value.axis is None else axis.format(value.axis) for value in values]


# How a query meets its candidates. In place: the term is evaluated for vectors of candidates as they are, under a mask; those in
# doubt follow. Packed: what is near comes together first, so that the term is evaluated for hardly more than the pairs.
_IN_PLACE = Template(read_part("pair_sum_cpu.h", "in_place"))
_PACKED = Template(read_part("pair_sum_cpu.h", "packed"))


class Reduction(NamedTuple):
    """What becomes of summands: text before all pairs of a query, for a vector of them (`real_lanes`) whose numbers are in a place.

    `after`: when all of these candidates have been met.
    """

    before: str
    each: Callable[[str], str]
    after: str


def constants_of(term: TermText, compensated: bool, extremes: bool) -> dict[str, int]:
    """Return the named integers that the text of a term needs, but for CANDIDATES, how many pairs are held."""
    totals = sum(part.total for part in term.sums)
    found = {"OTHERS": term.columns, "STEPS": len(term.steps), "TOTALS": totals, "ROW_SUMS": len(term.sums) - totals}
    return found | {"COMPENSATED": compensated, "SUMS": 1 + extremes}


def beginning(term: TermText, double: bool, extremes: bool) -> str:
    """Return the text that comes before all queries."""
    shared = "".join(_spread(v, f"shared_values.data[{c}]", double) for c, v in enumerate(term.shared))
    add = ADD.replace("NUMBER_LANES", "f64" if double else "f32")
    return "".join([VECTOR, add, (TAKE_LARGER + KEEP_LARGEST) * extremes, shared])


def reduction_of(term: TermText, extremes: bool) -> Reduction:
    """Return how summands are added up, or (`extremes`) how the largest are found."""
    return _largest(term) if extremes else _added(term)


def begin_query(term: TermText, double: bool) -> str:
    """Return the text that reads what is known of a query, `id` at `q`."""
    numbers = sum(value.axis is None for value in term.own)
    column = f"own_values.data[(long long)id * {numbers + bool(term.steps)} + {{}}]"
    lines = [_spread(value, at, double) for value, at in zip(term.own, placed(term.own, column, "q[{}]"), strict=True)]
    turns = [f"real(Lattice::turn({column.format(numbers)}, {step.axis}))" for step in term.steps]
    return "".join([*lines, *(f"const number turned{c} = Math::of({x});\n" for c, x in enumerate(turns))])


def evaluation(term: TermText, reduction: Reduction, double: bool, column: str, number: str) -> str:
    """Return the text that reduces a vector of pairs: of `points`, of what stands in `column`, each candidate by its `number`."""
    lanes = placed(term.others, column, "points.p[{}]")
    lines = [loaded(value, x, f"Math::bits({x})", double) for value, x in zip(term.others, lanes, strict=True)]
    steps = ((step.name, column.format(term.columns + c)) for c, step in enumerate(term.steps))
    lines += [f"const number {name} = {x} + turned{c};\n" for c, (name, x) in enumerate(steps)]
    return "".join([*lines, term.text, reduction.each(number)])


def _meet(term: TermText, reduction: Reduction, double: bool, packed: bool, flushed: bool) -> str:
    """Return the text that reduces the pairs of a query with its candidates."""
    modes = {"flush": FLUSH, "keep": KEEP} if flushed else {"flush": "", "keep": ""}
    of_pairs = functools.partial(evaluation, term, reduction, double)
    begin = begin_query(term, double) + reduction.before
    if packed:
        of_packed = of_pairs("*(const number*)(near_column[{}] + b)", "doubtful[b + l]")
        return begin + _PACKED.substitute(modes, of_packed=of_packed)
    skip = "if (hit == 0)\n    continue;" if work(term.text) > VERY_LITTLE_WORK else ""
    in_place = of_pairs("*(const number*)(column[{}] + b)", "b + l")
    of_doubtful = of_pairs("gathered(column[{}], doubtful + b)", "doubtful[b + l]")
    return begin + _IN_PLACE.substitute(modes, skip=skip, in_place=in_place, of_doubtful=of_doubtful)


def _largest(term: TermText) -> Reduction:
    """Return text that keeps the largest summands of a query, their sources and their images."""
    before, taken, after, width = [], [], [], len(term.sums)
    for k, part in enumerate(term.sums):
        before.append(f"number best{k} = Math::of(-Bits::not_finite());\nMath::i32 of{k} = Math::i32{{}} + n, code{k} = {{}};\n")
        taken.append(f"take_larger({part.name}, source, code, real_lanes, best{k}, of{k}, code{k});\n")
        after.append(f"keep_largest(best{k}, of{k}, code{k}, (long long)id * {width} + {k}, fresh);\n")

    def each(number: str) -> str:
        whose = f"Math::i32 source, code;\nfor (int l = 0; l < LANES; ++l) {{\n    source[l] = candidate_ids[{number}];\n"
        whose += f"    code[l] = PERIODIC && several ? candidate_images[{number}] : image;\n}}\n"
        return "".join([whose, *taken])

    return Reduction("".join(before), each, "".join(after))


def _added(term: TermText) -> Reduction:
    """Return text that adds summands to what the query has already, and to the totals of the chunk."""
    before = "".join(f"number sum{k} = {{}}, error{k} = {{}};\n" for k in range(len(term.sums)))
    lines = []
    for k, part in enumerate(term.sums):
        summand = f"Math::select(real_lanes, {part.name}, number{{}})"
        lines.append(f"if constexpr (COMPENSATED)\n    two_sum(sum{k}, error{k}, {summand});\nelse\n    sum{k} += {summand};\n")
    return Reduction(before, lambda _: "".join(lines), "".join(_stored(term)))


def _stored(term: TermText) -> list[str]:
    """Return text that adds lanes to what the query has already, and to the totals of the chunk."""
    lines, rows, totals = [], 0, 0
    count = sum(not part.total for part in term.sums)
    for k, part in enumerate(term.sums):
        if part.total:
            lines.append(f"{{\nreal all = 0, carried = 0;\nadd_lanes(sum{k}, error{k}, all, carried);\n")
            lines.append(f"two_sum(total[{totals}], total_carried[{totals}], all);\ntotal_carried[{totals}] += carried;\n}}\n")
            totals += 1
            continue
        lines.append(f"{{\nconst long long at = (long long)id * {count} + {rows};\n")
        lines.append("real all = fresh ? real(0) : sums.data[at];\n")
        lines.append("real carried = fresh || !COMPENSATED ? real(0) : errors.data[at];\n")
        lines.append(f"add_lanes(sum{k}, error{k}, all, carried);\n")
        lines.append("if (COMPENSATED && finished && Bits::finite(all))\n    all += carried;\n")
        lines.append("if (COMPENSATED && !finished)\n    errors.data[at] = carried;\n")
        lines.append("sums.data[at] = all;\n}\n")
        rows += 1
    return lines


@functools.cache
def sort_kernel(dim: int, double: bool) -> wp.Kernel:
    """Return the kernel that puts values of the sources [n, width] in the order of cells: columns [width * n]."""
    scalar = wp.float64 if double else wp.float32
    table_of, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    variant = f"{dim}d_{'f64' if double else 'f32'}"

    def sort_native(others: table_of, cutoff: reals, columns: reals, scratch: ints, n: int, m: int, own: int, table: int): ...

    sort_native.__name__ = sort_native.__qualname__ = f"sort_values_{variant}"
    constants = {"SCALED": 0, **GRID, "CHUNK": CHUNK}
    text = snippet("double" if double else "float", dim, CELLS, LAYOUT, _SORT_VALUES, **constants)
    function = wp.func_native(ENTER + text + LEAVE)(sort_native)

    def sort_values(others: table_of, cutoff: reals, columns: reals, scratch: ints, n: int, m: int, own: int, table: int):
        function(others, cutoff, columns, scratch, n, m, own, table)

    module = wp.get_module(f"jfrnn.kernels.pair_sum_cpu.sort_values_{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    return wp.kernel(sort_values, module=module)


def work(text: str) -> int:
    """Return roughly how many operations a text takes."""
    called = re.findall(r"Math::(\w+)\(", text)
    return text.count("const auto v") + _SERIES * sum(any(name in call for name in _SERIES_NAMES) for call in called)


def _candidates(term: TermText, dim: int, double: bool) -> int:
    """Return how many candidates are held at a time, in the first-level cache."""
    width = 8 if double else 4
    fitting = CACHE_BYTES // (width * (dim + term.columns + len(term.steps)) + 8)
    return max(64, min(fitting, MOST_CANDIDATES) // 64 * 64)


@functools.cache
def query_kernel(
    term: TermText, key: str, dim: int, double: bool, scaled: bool, compensated: bool, periodic: int = 0, batched: bool = False,
    extremes: bool = False, packed: bool | None = None,
) -> wp.Kernel:  # fmt: skip
    """Return the kernel that sums a term; `key` tells it from all others in the names of programs.

    `extremes`: it finds the largest summands instead; `errors` [m, width, 2] then gets their sources (n: there is none), and the
    codes of their images, as integers travel among floats.
    `packed`: the term is evaluated for what is near alone, not for other candidates; None: as is faster.
    """
    scalar = wp.float64 if double else wp.float32
    rows, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    packed = work(term.text) > LITTLE_WORK if packed is None else packed
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_compensated' * compensated}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}{'_extremes' * extremes}_{key}"
    constants = {"SCALED": scaled, "LIST": 0, **GRID, **constants_of(term, compensated, extremes)}
    constants |= {"PERIODIC": periodic, "BATCHED": batched, "CHUNK": CHUNK, "CANDIDATES": _candidates(term, dim, double)}
    reduction = reduction_of(term, extremes)
    text = walk(
        begin=beginning(term, double, extremes) + _CANDIDATES,
        meet=_meet(term, reduction, double, packed, flushed=not scaled),
        met=reduction.after,
        none=_NO_SUM + _NO_EXTREME * extremes,
        copied="".join([_COPY, *(_COPY_STEP.substitute(c=c, axis=step.axis) for c, step in enumerate(term.steps))]),
        chunk_done=CHUNK_DONE,
        flushed=not scaled,  # where cutoffs are so small that they are scaled, so may be what decides
    )

    def query_native(
        positions: rows, queries: rows, cutoff: reals, shared_values: reals, own_values: rows, columns: reals,
        sums: rows, totals: reals, errors: reals, scratch: ints,
        n: int, m: int, own: int, table: int, closed: int, drop_self: int,
    ): ...  # fmt: skip

    query_native.__name__ = query_native.__qualname__ = f"pair_sum_{variant}"
    native_text = snippet("double" if double else "float", dim, CELLS, LAYOUT, EXACT, text, **constants)
    function = wp.func_native(ENTER + native_text + LEAVE)(query_native)

    def query(
        positions: rows, queries: rows, cutoff: reals, shared_values: reals, own_values: rows, columns: reals,
        sums: rows, totals: reals, errors: reals, scratch: ints,
        n: int, m: int, own: int, table: int, closed: int, drop_self: int,
    ):  # fmt: skip
        function(
            positions, queries, cutoff, shared_values, own_values, columns, sums, totals, errors, scratch,
            n, m, own, table, closed, drop_self,
        )  # fmt: skip

    module = wp.get_module(f"jfrnn.kernels.pair_sum_cpu.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    return wp.kernel(query, module=module)
