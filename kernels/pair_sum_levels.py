"""Sums over pairs on the CPU, without a list, where cutoffs differ from particle to particle.

Queries meet their candidates one by one, as in `jfrnn.kernels.levels`. What the term reads of the pairs is put down until there are
ROOM of them, or the query has no more; then the term is evaluated for 16 of them at a time.
"""

import functools
from string import Template

import warp as wp
from jfrnn.kernels._native import FLUSH, KEEP, SPACES
from jfrnn.kernels.levels import CHUNK, native_text
from jfrnn.kernels.pair_sum_cpu import (
    CHUNK_DONE,
    TermText,
    begin_query,
    beginning,
    constants_of,
    evaluation,
    reduction_of,
)

ROOM = 256  # a multiple of 16


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // CHUNK)


_BEGIN = r"""
struct Points { number p[3]; };
alignas(128) real near_points[3][CANDIDATES];
alignas(128) real near_column[OTHERS + STEPS + 1][CANDIDATES];
memset(near_points, 0, sizeof near_points);
memset(near_column, 0, sizeof near_column);
int candidate_ids[SUMS == 2 ? CANDIDATES : 1], candidate_images[SUMS == 2 ? CANDIDATES : 1];
memset(candidate_ids, 0, sizeof candidate_ids);
memset(candidate_images, 0, sizeof candidate_images);
constexpr bool several = true;
const int image = home;
"""
_BEGIN_QUERY = Template(r"""
    int hits = 0;
    bool fresh = true;
    auto add = [&](bool finished) __attribute__((noinline)) {
        $flush
        $begin
        for (int b = 0; b < hits; b += LANES) {
            const Math::flag real_lanes = lanes_of(hits - b < LANES ? (1u << (hits - b)) - 1 : (1u << LANES) - 1);
            Points points;
            for (int k = 0; k < DIM; ++k)
                points.p[k] = *(const number*)(near_points[k] + b);
            $each
        }
        $after
        $keep
        fresh = false;
        hits = 0;
    };
""")
_PAIR = r"""
                for (int k = 0; !PERIODIC && k < DIM; ++k)
                    near_points[k][hits] = axes.data[k * stride + c];
                for (int s = 0; s < OTHERS; ++s)
                    memcpy(&near_column[s][hits], columns.data + (long long)s * n + c, sizeof(real));
"""
_STEP = Template(r"""
                near_column[OTHERS + $c][hits] = real(shift[$axis] - Lattice::turn(columns.data[(long long)OTHERS * n + c], $axis));
""")
_END_PAIR = r"""
                if constexpr (SUMS == 2) {
                    candidate_ids[hits] = other;
                    candidate_images[hits] = image;
                }
                if (++hits == CANDIDATES)
                    add(false);
"""


@functools.cache
def query_kernel(
    term: TermText, key: str, dim: int, double: bool, rule: str, groups: int, halvings: int, compensated: bool, periodic: int = 0,
    batched: bool = False, extremes: bool = False,
) -> wp.Kernel:  # fmt: skip
    """Return the kernel that sums a term, launched with dim = 1 once per thread; `info` is zeros at first.

    `key` and `extremes` are those of `jfrnn.kernels.pair_sum_cpu.query_kernel`, the rest those of `jfrnn.kernels.levels`.
    """
    scalar = wp.float64 if double else wp.float32
    variant = f"{dim}d_{'f64' if double else 'f32'}_{rule}{'_compensated' * compensated}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}{'_extremes' * extremes}_{key}"
    points, reals, ints = wp.array2d(dtype=scalar), wp.array(dtype=scalar), wp.array(dtype=wp.int32)
    reduction = reduction_of(term, extremes)
    begin = _BEGIN_QUERY.substitute(
        flush=FLUSH, keep=KEEP, begin=begin_query(term, double) + reduction.before, after=reduction.after,
        each=evaluation(term, reduction, double, "*(const number*)(near_column[{}] + b)", "b + l"),
    )  # fmt: skip
    steps = "".join(_STEP.substitute(c=c, axis=step.axis) for c, step in enumerate(term.steps))
    text = native_text(
        dim, double, rule, groups, halvings,
        begin=beginning(term, double, extremes) + _BEGIN, begin_query=begin, pair=_PAIR + steps + _END_PAIR, end_query="add(true);",
        end_chunk=CHUNK_DONE, PERIODIC=periodic, BATCHED=batched, CANDIDATES=ROOM, **constants_of(term, compensated, extremes),
    )  # fmt: skip

    def native(
        positions: points, queries: points, axes: reals, radii: reals, ids: ints, keys: ints, top: ints, table: ints, header: ints,
        cutoff: reals, query_axes: reals, query_radii: reals, query_ids: ints, query_top: ints, places: ints,
        shared_values: reals, own_values: points, columns: reals, sums: points, totals: reals, errors: reals, info: ints,
        n: int, m: int, own_queries: int, closed: int, drop_self: int, later_only: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"pair_sum_levels_{variant}_native"
    function = wp.func_native(text)(native)

    def query(
        positions: points, queries: points, axes: reals, radii: reals, ids: ints, keys: ints, top: ints, table: ints, header: ints,
        cutoff: reals, query_axes: reals, query_radii: reals, query_ids: ints, query_top: ints, places: ints,
        shared_values: reals, own_values: points, columns: reals, sums: points, totals: reals, errors: reals, info: ints,
        n: int, m: int, own_queries: int, closed: int, drop_self: int, later_only: int,
    ):  # fmt: skip
        function(
            positions, queries, axes, radii, ids, keys, top, table, header, cutoff,
            query_axes, query_radii, query_ids, query_top, places, shared_values, own_values, columns, sums, totals, errors, info,
            n, m, own_queries, closed, drop_self, later_only,
        )  # fmt: skip

    module = wp.get_module(f"jfrnn.kernels.pair_sum_levels.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    return wp.kernel(query, name=f"query_{variant}", module=module, grid_stride=False)
