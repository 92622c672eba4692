"""Sums over pairs on the CPU, without a list, where cutoffs differ from particle to particle.

Queries meet their candidates one by one, as in `jfrnn.kernels.levels`. What the term reads of the pairs is put down until there are
ROOM of them, or the query has no more; then the term is evaluated for 16 of them at a time.
"""

import functools

import warp as wp
from jfrnn.kernels._native import SPACES, bind
from jfrnn.kernels.levels import CHUNK, level_program
from jfrnn.kernels.pair_sum_cpu import TermText, constants_of, term_header

ROOM = 256  # a multiple of 16


def slots(queries: int) -> int:
    """Return the number of partial sums that make up a sum over all pairs."""
    return -(-queries // CHUNK)


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
    constants = {"PERIODIC": periodic, "BATCHED": batched, "CANDIDATES": ROOM, **constants_of(term, compensated, extremes)}
    given = term_header(term, double)
    text = level_program(dim, double, rule, groups, halvings, "level_sums.h", given, **constants)
    module = wp.get_module(f"jfrnn.kernels.pair_sum_levels.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)

    def native(
        positions: points, queries: points, axes: reals, radii: reals, ids: ints, keys: ints, top: ints, table: ints, header: ints,
        cutoff: reals, query_axes: reals, query_radii: reals, query_ids: ints, query_top: ints, places: ints,
        shared_values: reals, own_values: points, columns: reals, sums: points, totals: reals, errors: reals, info: ints,
        n: int, m: int, own_queries: int, closed: int, drop_self: int, later_only: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"pair_sum_levels_{variant}_native"
    function = bind(native, module, "LevelSumsKernel.run", text)

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

    return wp.kernel(query, name=f"query_{variant}", module=module, grid_stride=False)
