"""Sums over pairs on the CPU, without a list: the term is evaluated where its pairs are found, 8 or 16 at a time.

`jfrnn.kernels.cells_cpu` sorts the sources by cell (`build`). `sort_values` puts what a term reads of them into the same order, a
column each; then `query` walks over all queries as a search does, with these columns beside the coordinates of the candidates. In a
periodic box, positions and turns, which make S with the image of a candidate, are read of rows of particles, and have no columns.
Sums stay in vector registers while the pairs of one query are added. Terms of few operations are evaluated for all candidates of
a vector, others for those that are near, which are packed first. In place of sums `query` can find the largest summands, and whose
they are.
"""

import functools
import itertools
import re
from typing import NamedTuple

from jfrnn.kernels import tree_cpu
from jfrnn.kernels._native import Kind, declare_kind
from jfrnn.kernels._program import Kernel
from jfrnn.kernels.cells_cpu import CHUNKS, GRID, QUERY_CHUNK, TOGETHER

CACHE_BYTES = 40 << 10  # for candidates: most of a first-level cache, and a little of the second
MOST_CANDIDATES = 1024
MOST_LANES = 16
LITTLE_WORK = 50  # operations up to which the term is evaluated for candidates that are no pairs, too
VERY_LITTLE_WORK = 20  # up to which it is, though none of a vector is a pair
TOGETHER_AT_WORK = 4  # as `TOGETHER`, where it takes longer to evaluate a term for farther candidates than to copy nearer ones
_SERIES = 20  # operations that a function like exp takes
_SERIES_NAMES = ("exp", "log", "pow", "sin", "cos", "tan", "cbrt", "erf", "logistic", "rem")  # and what holds them in its name

_NAMES = {"float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "bool": "flag"}


class Value(NamedTuple):
    """What a term reads: its name in the text, its dtype, and of positions the axis; what is none of them has a column.

    So have positions in a box, where kernels hold wrapped ones; `column_axis` is their axis.
    """

    name: str
    dtype: str
    axis: int | None = None
    column_axis: int | None = None


class Sum(NamedTuple):
    """What is added up: its name in the text, of the dtype of positions; over the neighbors of each i, or (`total`) all pairs.

    Where it is marked, sums of an i whose position is not finite are NaN, otherwise 0.
    """

    name: str
    total: bool
    mark: bool


class Step(NamedTuple):
    """What a term reads of the lattice shift S of a pair: its name in the text, of the dtype of positions, and the axis."""

    name: str
    axis: int


class TermText(NamedTuple):
    """A term as native text: `text` defines the `sums` from what it reads, of S, of what all pairs share, of i and of j.

    A column of numbers stands for each value of the last three, and with `steps` one of turns behind those of i and of j. The
    `first` ones of the sums of each i stand in an array of their own; 0: all stand in one. `unshifted` is the text for S = 0 of a
    term that reads S, and positions, for nothing but x_j - x_i + S·A; otherwise it is empty.
    """

    text: str
    steps: tuple[Step, ...]
    shared: tuple[Value, ...]
    own: tuple[Value, ...]
    others: tuple[Value, ...]
    sums: tuple[Sum, ...]
    first: int = 0
    unshifted: str = ""

    @property
    def columns(self) -> int:
        """How many numbers of j have a column, but for turns."""
        return sum(value.axis is None for value in self.others)

    @property
    def source_columns(self) -> int:
        """How many columns are read of the sources."""
        return self.columns + bool(self.steps)

    @property
    def other_columns(self) -> list[int]:
        """Which columns of j hold what rows of particles do not."""
        return _beside_rows(self.others)

    @property
    def own_columns(self) -> list[int]:
        """Which columns of i do so."""
        return _beside_rows(self.own)

    @property
    def reads_rows(self) -> int:
        """Whether it reads of j what rows of particles in a box hold, positions and turns: 1, or 2 where any turn is not -1, 0, 1.

        The displacement of particles that lie in the boxes beside is that of wrapped positions, hardly rounded.
        """
        reads = bool(self.steps) or any(value.column_axis is not None for value in self.others)
        return reads * (1 + bool(self.unshifted))


def _beside_rows(values: tuple[Value, ...]) -> list[int]:
    return [k for k, value in enumerate(value for value in values if value.axis is None) if value.column_axis is None]


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // QUERY_CHUNK)


def sorted_numbers(term: TermText, sources: int, dim: int, double: bool) -> int:
    """Return how many numbers the sorted values of all sources take: columns, those of what is read of rows, and a vector."""
    del double
    columns = len(term.other_columns) + (dim + 1 if term.reads_rows else 0)
    return sources * columns + (MOST_LANES if columns else 0)


def load_value(value: Value, lanes: str, bits: str, double: bool) -> str:
    """Return a statement that defines a value from `lanes` of the dtype of positions, or from their `bits`."""
    return f"const Math::{_NAMES[value.dtype]} {value.name} = {_convert_lanes(value, lanes, bits, double)};\n"


def _convert_lanes(value: Value, lanes: str, bits: str, double: bool) -> str:
    """Return what a value is in terms of `lanes` of the dtype of positions, or of their `bits`.

    Integers of the same width travel as their bits; in float64, integers of 32 bits as their values, and so do truths in both.
    """
    kind = _NAMES[value.dtype]
    same, whole = ("f64", "i64") if double else ("f32", "i32")
    return lanes if kind == same else bits if kind == whole else f"Math::to_{kind}({lanes})"


def _spread(value: Value, at: str, double: bool) -> str:
    """Return what a value is in terms of a number, the same in all lanes."""
    return _convert_lanes(value, f"Math::of({at})", f"Math::of(bits_of_number({at}))", double)


def place_values(values: tuple[Value, ...], column: str, axis: str) -> list[str]:
    """Return where values are: those that have a column, and positions along an axis."""
    numbers = itertools.count()
    return [column.format(next(numbers)) if value.axis is None else axis.format(value.axis) for value in values]


def constants_of(term: TermText, kind: Kind, turned: bool = True, by_rows: bool = False) -> dict[str, int]:
    """Return the named integers that a program with a term needs, but for CANDIDATES, how many pairs are held.

    `turned`: a column of turns stands behind those of i, if the term reads lattice shifts. `by_rows`: rows of particles hold these,
    and positions in a box.
    """
    totals = sum(part.total for part in term.sums)
    found = {"OTHERS": term.columns, "STEPS": len(term.steps), "TOTALS": totals, "ROW_SUMS": len(term.sums) - totals}
    found["FIRST_SUMS"] = term.first or found["ROW_SUMS"]
    own = sum(value.axis is None for value in term.own) + (turned and bool(term.steps))
    own = len(term.own_columns) if by_rows else own
    return found | {"OWN": own, "COMPENSATED": kind.compensated, "SUMS": 1 + kind.extremes}


def term_header(term: TermText, double: bool, turned: bool = True, by_rows: bool = False) -> dict[str, str]:
    """Return the header of a program with a term: `term.h` holds the struct `Term`, as in the example of that name.

    `turned`: the lattice shift of a pair is what stands in its columns, and turns of i are added to that. `by_rows`: these turns,
    and positions of i in a box, are those of its row of particles.
    """
    order = [itertools.count(), itertools.count()]
    places = [next(order[part.total]) for part in term.sums]
    lines = [f"typedef Math::{'f64' if double else 'f32'} number;"]
    lines += [f"JFRNN_TABLE bool IS_TOTAL[] = {{{', '.join(str(int(part.total)) for part in term.sums)}}};"]
    lines += [f"JFRNN_TABLE int PLACE[] = {{{', '.join(map(str, places))}}};"]
    marks = [str(int(part.mark)) for part in term.sums if not part.total]
    lines += [f"JFRNN_TABLE bool MARKED[] = {{{', '.join(marks or ['0'])}}};"]
    axes = [str(-1 if value.column_axis is None else value.column_axis) for value in term.others if value.axis is None]
    lines += [f"JFRNN_TABLE int COLUMN_AXES[] = {{{', '.join(axes or ['-1'])}}};"]
    lines += [f"JFRNN_TABLE int COLUMN_NUMBERS[] = {{{', '.join(_numbers(axes))}}};"]
    lines += [f"JFRNN_TABLE int STEP_AXES[] = {{{', '.join([str(step.axis) for step in term.steps] or ['0'])}}};"]
    lines += ["struct Term {", *_members(term.shared), "struct Own {", *_members(term.own)]
    lines += [*(f"number turned{c};" for c in range(len(term.steps) if turned else 0)), "};"]
    lines += [*_of_shared(term, double), *(_own_by_rows(term, double) if by_rows else _of_own(term, double, turned))]
    text = "\n".join([*lines, *_evaluation(term, double, turned, by_rows or not turned), "};", ""])
    return {"term.h": '#include "lattice.h"\n#include "math.h"\n' + text}


def _numbers(axes: list[str]) -> list[str]:
    """Return which of the columns that are no coordinates each one is, -1: it is one."""
    numbers = itertools.count()
    return [str(next(numbers)) if axis == "-1" else "-1" for axis in axes] or ["-1"]


def _members(values: tuple[Value, ...]) -> list[str]:
    return [f"Math::{_NAMES[value.dtype]} {value.name};" for value in values]


def _of_shared(term: TermText, double: bool) -> list[str]:
    """Return the lines that read what all pairs share."""
    made = [f"{value.name} = {_spread(value, f'shared_values[{c}]', double)};" for c, value in enumerate(term.shared)]
    return ["JFRNN_MEMBER explicit Term(const real* shared_values) {", *made, "}"]


def _of_own(term: TermText, double: bool, turned: bool) -> list[str]:
    """Return the lines that read what is known of a query at `q`, of its row of numbers."""
    column = sum(value.axis is None for value in term.own)
    turns = [f"real(Lattice::turn(row[{column}], {step.axis}))" for step in term.steps if turned]
    places = place_values(term.own, "row[{}]", "q[{}]")
    return ["JFRNN_MEMBER Own own(const real* row, const real* q) const {", *_assign_own(term, places, turns, double)]


def _own_by_rows(term: TermText, double: bool) -> list[str]:
    """Return the lines that read it where positions and turns are those of a row of particles, if there is one."""
    numbers, places = itertools.count(), []
    for value in term.own:
        axis = value.column_axis
        given = (
            f"row[{next(numbers)}]"
            if axis is None and value.axis is None
            else f"(AT_HOME || !particle ? q[{axis}] : particle[{axis}])"
        )
        places.append(given if value.axis is None else f"q[{value.axis}]")
    turns = [f"AT_HOME || !particle ? real(0) : real(Lattice::turn(particle[DIM], {step.axis}))" for step in term.steps]
    head = ["template <bool AT_HOME>", "JFRNN_MEMBER Own own(const real* row, const real* q, const real* particle) const {"]
    return [*head, *_assign_own(term, places, turns, double)]


def _assign_own(term: TermText, places: list[str], turns: list[str], double: bool) -> list[str]:
    lines = [f"own.{value.name} = {_spread(value, at, double)};" for value, at in zip(term.own, places, strict=True)]
    lines += [f"own.turned{c} = Math::of({x});" for c, x in enumerate(turns)]
    return ["Own own;", *lines, "return own;", "}"]


def _evaluation(term: TermText, double: bool, turned: bool, apart: bool) -> list[str]:
    """Return the lines that evaluate a term for a vector of pairs; `apart`: in two ways, of which one, AT_HOME, is for S = 0."""
    lines = ["template <bool AT_HOME, class Column>" if apart else "template <class Column>"]
    lines += ["JFRNN_MEMBER void evaluate(const Own& own, const number* p, Column column, number* summand) const {"]
    lines += [f"const Math::{_NAMES[value.dtype]} {value.name} = own.{value.name};" for value in term.own]
    numbers = place_values(term.others, "column({})", "p[{}]")
    lines += [load_value(value, x, f"Math::bits({x})", double) for value, x in zip(term.others, numbers, strict=True)]
    for c, step in enumerate(term.steps):
        shift = f"column({term.columns + c})" + f" + own.turned{c}" * turned
        lines.append(f"const number {step.name} = SHIFTED ? {shift} : number{{}};")
    put = [f"summand[{k}] = {part.name};" for k, part in enumerate(term.sums)]
    if apart and term.unshifted:
        lines += ["if constexpr (AT_HOME) {", term.unshifted, *put, "return;", "}"]
    return [*lines, term.text, *put, "}"]


@functools.cache
def sort_kernel(dim: int, double: bool) -> Kernel:
    """Return the kernel that puts values of the sources [n, width] in the order of cells: columns [width * n].

    Behind these stand columns of the coordinates and turns of the sources, if `reads_rows`, where any particle has turns.
    """
    constants: dict[str, int] = {**GRID, **CHUNKS}
    return declare_kind(Kind(dim, double), "sort_values", "sort_values.h", "SortValues.run", constants=constants)[0]


def work(text: str) -> int:
    """Return roughly how many operations a text takes."""
    called = re.findall(r"Math::(\w+)\(", text)
    return text.count("const auto v") + _SERIES * sum(any(name in call for name in _SERIES_NAMES) for call in called)


def _candidates(term: TermText, dim: int, double: bool) -> int:
    """Return how many candidates are held at a time, in the first-level cache."""
    width = 8 if double else 4
    fitting = CACHE_BYTES // (width * (dim + term.columns + len(term.steps)) + 8)
    return max(64, min(fitting, MOST_CANDIDATES) // 64 * 64)


@functools.lru_cache(512)
def query_kernel(kind: Kind, term: TermText, key: str) -> Kernel:
    """Return the kernel that sums a term; `key` tells it from all others in the names of programs.

    For extremes, `errors` [m, width, 2] gets the sources of the largest summands (n: there is none), and the codes of their images,
    as integers travel among floats. Where cutoffs differ, sources stand in a tree (`jfrnn.kernels.tree_cpu`).
    """
    operations = work(term.unshifted or term.text)
    works = operations > VERY_LITTLE_WORK
    constants = {"LIST": 0, **GRID, **constants_of(term, kind, by_rows=True)}
    constants |= {"COLUMNS": len(term.other_columns), "READS_ROWS": term.reads_rows, **CHUNKS}
    constants |= {"CANDIDATES": _candidates(term, kind.dim, kind.double), "PACKED": operations > LITTLE_WORK}
    constants |= {"SKIPPED": works, "TOGETHER": TOGETHER_AT_WORK if works else TOGETHER, **(tree_cpu.TREE if kind.rule else {})}
    given = term_header(term, kind.double, by_rows=True) | (tree_cpu.PROVIDER if kind.rule else {})
    return declare_kind(kind.compiled(), f"pair_sum_cpu_{key}", "pair_sum_cpu.h", "Sums.run", given=given, constants=constants)[0]
