"""Sums over pairs on the CPU, without a list: the term is evaluated where its pairs are found, 8 or 16 at a time.

`jfrnn.kernels.cells_cpu` sorts the sources by cell (`build`). `sort_values` puts what a term reads of them into the same order, a
column each; then `query` walks over all queries as a search does, with these columns beside the coordinates of the candidates.
Sums stay in vector registers while the pairs of one query are added. Terms of few operations are evaluated for all candidates of
a vector, others for pairs alone, which are gathered first.
"""

import functools
import re
from typing import NamedTuple

import warp as wp
from jfrnn.kernels._math import VECTOR
from jfrnn.kernels._native import CELLS, ENTER, EXACT, FLUSH, KEEP, LEAVE, snippet
from jfrnn.kernels._walk_cpu import CHUNK, walk
from jfrnn.kernels.cells_cpu import LAYOUT

CACHE_BYTES = 24 << 10  # for candidates, of a first-level cache of 32 KiB
MOST_CANDIDATES = 1024
LITTLE_WORK = 100  # operations up to which the term is evaluated for candidates that are no pairs, too
_SERIES = 20  # operations that a function like exp takes
_SERIES_NAMES = ("exp", "log", "pow", "sin", "cos", "tan", "cbrt", "erf", "logistic", "rem")  # and what holds them in its name

_NAMES = {"float32": "f32", "float64": "f64", "int32": "i32", "int64": "i64", "bool": "flag"}


class Value(NamedTuple):
    """What a term reads: its name in the text, and its dtype."""

    name: str
    dtype: str


class Sum(NamedTuple):
    """What is added up: its name in the text, of the dtype of positions; over the neighbors of each i, or (`total`) all pairs."""

    name: str
    total: bool


class TermText(NamedTuple):
    """A term as native text: `text` defines the `sums` from what it reads, of what all pairs share, of i and of j; columns each."""

    text: str
    shared: tuple[Value, ...]
    own: tuple[Value, ...]
    others: tuple[Value, ...]
    sums: tuple[Sum, ...]


class Kernels(NamedTuple):
    """`sort_values` (where there are any) and `query`, each launched with dim = 1 once per thread."""

    sort_values: wp.Kernel
    query: wp.Kernel


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // CHUNK)


_SORT_VALUES = r"""
for (;;) {
    const int chunk = __atomic_fetch_add(&shared.next_sorted, 1, __ATOMIC_RELAXED);
    if ((long long)chunk * CHUNK >= n)
        break;
    const int begin = chunk * CHUNK, end = n - begin < CHUNK ? n : begin + CHUNK;
    const long long width = others.shape[1];
    for (int place = begin; place < end; ++place)
        for (int c = 0; c < width; ++c)
            columns.data[(long long)c * n + place] = others.data[width * ids[place] + c];
}
"""

# What adds up lanes; `errors` is what rounding took, in sums that are carried in twice the precision.
_ADD = r"""
typedef Math::NUMBER_LANES number;
auto lanes_of = [](unsigned int bits) -> Math::flag {
    Math::flag lanes;
    __builtin_memcpy(&lanes, &bits, sizeof lanes);
    return lanes;
};
auto bits_of = [](const real& x) {
    whole bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
};
auto two_sum = [](auto& sum, auto& error, auto x) {  // Knuth 1969
    const auto s = sum + x, b = s - sum;
    error = error + ((sum - (s - b)) + (x - b));
    sum = s;
};
auto add_lanes = [&](number sum, number error, real& total, real& carried) {  // always in the same order
    real s[LANES], e[LANES];
    memcpy(s, &sum, sizeof s);
    memcpy(e, &error, sizeof e);
    for (int size = LANES / 2; size > 0; size /= 2)
        for (int l = 0; l < size; ++l)
            if constexpr (COMPENSATED) {
                two_sum(s[l], e[l], s[l + size]);
                e[l] += e[l + size];
            } else
                s[l] += s[l + size];
    if constexpr (COMPENSATED) {
        two_sum(total, carried, s[0]);
        carried += e[0];
    } else
        total += s[0];
};
alignas(64) real column[OTHERS + 1][CANDIDATES + LANES];
memset(column, 0, sizeof column);
memset(candidate, 0, sizeof candidate);
real total[TOTALS + 1], total_carried[TOTALS + 1];
for (int t = 0; t <= TOTALS; ++t)
    total[t] = total_carried[t] = 0;
"""

_COPY = r"""
            for (int c = 0; c < OTHERS; ++c)
                for (int s = 0; s < size; ++s)
                    column[c][filled + s] = columns.data[(long long)c * n + from + s];
"""

_NO_SUM = r"""
            for (int r = 0; r < ROW_SUMS; ++r)
                sums.data[(long long)id * ROW_SUMS + r] = 0;
"""

_CHUNK_DONE = r"""
    for (int t = 0; t < TOTALS; ++t) {
        totals.data[(2ll * chunk) * TOTALS + t] = total[t];
        totals.data[(2ll * chunk + 1) * TOTALS + t] = total_carried[t];
        total[t] = total_carried[t] = 0;
    }
"""


def _loaded(value: Value, lanes: str, bits: str, double: bool) -> str:
    """Return a statement that defines a value from `lanes` of the dtype of positions, or from their `bits`.

    Integers of the same width travel as their bits; in float64, integers of 32 bits as their values, and so do truths in both.
    """
    kind = _NAMES[value.dtype]
    same, whole = ("f64", "i64") if double else ("f32", "i32")
    made = lanes if kind == same else bits if kind == whole else f"Math::to_{kind}({lanes})"
    return f"const Math::{kind} {value.name} = {made};\n"


def _spread(value: Value, at: str, double: bool) -> str:
    """Return a statement that defines a value, the same in all lanes, from a number."""
    return _loaded(value, f"Math::of({at})", f"Math::of(bits_of({at}))", double)


def _evaluation(term: TermText, double: bool, gathered: bool) -> str:
    """Return the text that adds the pairs of one query to its sums."""

    def each(lanes: str) -> str:
        names = [lanes.format(c) for c in range(len(term.others))]
        return "".join(_loaded(value, x, f"Math::bits({x})", double) for value, x in zip(term.others, names, strict=True))

    lines = [_spread(v, f"own_values.data[(long long)id * {len(term.own)} + {c}]", double) for c, v in enumerate(term.own)]
    lines += [f"number sum{k} = {{}}, error{k} = {{}};\n" for k in range(len(term.sums))]
    if gathered:
        lines.append("for (int e = 0; e < LANES; ++e)\n    row[hits + e] = hits > 0 ? row[0] : 0;\n")
        lines.append("for (int b = 0; b < hits; b += LANES) {\n")
        lines.append("const Math::flag real_lanes = lanes_of(hits - b < LANES ? (1u << (hits - b)) - 1 : ~0u);\n")
        for c in range(len(term.others)):
            lines.append(f"number lanes{c};\nfor (int l = 0; l < LANES; ++l)\n    lanes{c}[l] = column[{c}][row[b + l]];\n")
        lines.append(each("lanes{}"))
    else:
        lines.append("for (int b = 0, v = 0; b < filled; b += LANES, ++v) {\n")
        lines.append("if (found[v] == 0)\n    continue;\n")
        lines.append("const Math::flag real_lanes = lanes_of(found[v]);\n")
        lines.append(each("*(const number*)(column[{}] + b)"))
    lines.append(term.text)
    for k, part in enumerate(term.sums):
        summand = f"Math::select(real_lanes, {part.name}, number{{}})"
        lines.append(f"if constexpr (COMPENSATED)\n    two_sum(sum{k}, error{k}, {summand});\nelse\n    sum{k} += {summand};\n")
    lines.append("}\n")
    return "".join([FLUSH, *lines, *_stored(term), KEEP])


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
    constants = {"SCALED": 0, "REACH": 1, "REACH_X": 1, "CHUNK": CHUNK}
    text = snippet("double" if double else "float", dim, CELLS, LAYOUT, _SORT_VALUES, **constants)
    function = wp.func_native(ENTER + text + LEAVE)(sort_native)

    def sort_values(others: table_of, cutoff: reals, columns: reals, scratch: ints, n: int, m: int, own: int, table: int):
        function(others, cutoff, columns, scratch, n, m, own, table)

    module = wp.get_module(f"jfrnn.kernels.pair_sum_cpu.sort_values_{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    return wp.kernel(sort_values, module=module)


def _work(text: str) -> int:
    """Return roughly how many operations a text takes."""
    called = re.findall(r"Math::(\w+)\(", text)
    return text.count("const auto v") + _SERIES * sum(any(name in call for name in _SERIES_NAMES) for call in called)


def _candidates(term: TermText, dim: int, double: bool) -> int:
    """Return how many candidates are held at a time, in the first-level cache."""
    width = 8 if double else 4
    fitting = CACHE_BYTES // (width * (dim + len(term.others)) + 8)
    return max(64, min(fitting, MOST_CANDIDATES) // 64 * 64)


@functools.cache
def query_kernel(
    term: TermText, key: str, dim: int, double: bool, scaled: bool, compensated: bool, periodic: int = 0, batched: bool = False,
    gathered: bool | None = None,
) -> wp.Kernel:  # fmt: skip
    """Return the kernel that sums a term; `key` tells it from all others in the names of programs.

    `gathered`: the term is evaluated for pairs alone, not for other candidates; None: as is faster.
    """
    scalar = wp.float64 if double else wp.float32
    rows, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    gathered = _work(term.text) > LITTLE_WORK if gathered is None else gathered
    variant = f"{dim}d_{'f64' if double else 'f32'}{'_scaled' * scaled}{'_compensated' * compensated}"
    variant += f"{('', '_nearest', '_images')[periodic]}{'_batched' * batched}_{key}"
    totals = sum(part.total for part in term.sums)
    constants = {"SCALED": scaled, "LIST": gathered, "MASKS": not gathered, "SUMS": 1, "REACH": 1, "REACH_X": 1, "EXACTLY": 1}
    constants |= {"PERIODIC": periodic, "BATCHED": batched, "CHUNK": CHUNK, "CANDIDATES": _candidates(term, dim, double)}
    constants |= {"OTHERS": len(term.others), "TOTALS": totals, "ROW_SUMS": len(term.sums) - totals, "COMPENSATED": compensated}
    shared = "".join(_spread(v, f"shared_values.data[{c}]", double) for c, v in enumerate(term.shared))
    text = walk(
        begin="".join([VECTOR, _ADD.replace("NUMBER_LANES", "f64" if double else "f32"), shared]),
        scan="scan(q, id, filled, All{})",
        found=_evaluation(term, double, gathered),
        none=_NO_SUM,
        copied=_COPY,
        chunk_done=_CHUNK_DONE,
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
