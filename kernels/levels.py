"""Search with a cutoff per particle: queries one by one, on the CPU in chunks on every core, on CUDA one per thread.

What `jfrnn._levels` sorts, `query` walks: top cells as wide as the largest cutoff, within them groups of cutoffs, within those a
Morton curve. A query finds the candidates of a group in the cells around it that are as wide as what the group reaches.
"""

import functools
from collections.abc import Mapping
from types import MappingProxyType

import warp as wp
from jfrnn.kernels._native import SPACES, bind, program

PADDING = 16  # sources behind the last one, which nobody meets: the CPU tests so many at a time
CHUNK = 256  # queries that a thread of the CPU takes at a time
BLOCK = 128  # threads of CUDA
RULES = ("gather", "scatter", "either", "both", "mean")


def level_program(
    dim: int, double: bool, rule: str, groups: int, halvings: int, header: str, given: Mapping[str, str] = MappingProxyType({}),
    **constants: int,
) -> str:  # fmt: skip
    """Return the text of a kernel in which queries meet their candidates; a header says what becomes of the pairs.

    Args:
        dim: 2 or 3.
        double: Whether positions are float64.
        rule: One of `RULES`.
        groups: Of cutoffs.
        halvings: Of a top cell.
        header: A file of `kernels/native`.
        given: Texts in place of some files.
        constants: Further ones, such as PERIODIC and BATCHED of `jfrnn.kernels._native.program`.
    """
    constants |= {"RULE": RULES.index(rule), "SUM": rule == "mean", "GROUPS": groups, "HALVINGS": halvings}
    constants |= {"SCALED": True, "PADDING": PADDING, "CHUNK": CHUNK, "ONE_BY_ONE": True}
    return program(double, dim, header, given=given, **constants)


@wp.kernel(enable_backward=False)
def clear(info_out: wp.array(dtype=wp.int32)):
    """Write zeros (launch: dim = its length)."""
    info_out[wp.tid()] = 0


@functools.cache
def query_kernel(
    dim: int, double: bool, lists: bool, rule: str, groups: int, halvings: int, periodic: int = 0, batched: bool = False
) -> wp.Kernel:
    """Return the kernel for a dimension, a dtype and a rule, for lists or counts alone.

    It is launched on the CPU with dim = 1, once per thread, on CUDA once, with a thread per query. `info`, zeros at first, gets the
    longest row. `periodic` and `batched` are those of `jfrnn.kernels._native.program`.
    """
    scalar = wp.float64 if double else wp.float32
    variant = f"{dim}d_{'f64' if double else 'f32'}_{rule}{'_list' * lists}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}"
    constants = {"LIST": lists, "PERIODIC": periodic, "BATCHED": batched}
    text = level_program(dim, double, rule, groups, halvings, "level_rows.h", **constants)
    module = wp.get_module(f"jfrnn.kernels.levels.{variant}")
    wp.set_module_options({"enable_backward": False, "fuse_fp": False, "max_unroll": 1}, module)
    points = wp.array2d(dtype=scalar)
    reals, ints, rows = wp.array(dtype=scalar), wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)

    def native(
        positions: points, queries: points, axes: reals, radii: reals, ids: ints, keys: ints, top: ints, table: ints, header: ints,
        cutoff: reals, query_axes: reals, query_radii: reals, query_ids: ints, query_top: ints, places: ints,
        idx: rows, count: ints, info: ints, n: int, m: int, capacity: int,
        own_queries: int, closed: int, drop_self: int, later_only: int,
    ): ...  # fmt: skip

    native.__name__ = native.__qualname__ = f"query_{variant}_native"
    function = bind(native, module, "LevelRows.run", text)

    def query(
        positions: points, queries: points, axes: reals, radii: reals, ids: ints, keys: ints, top: ints, table: ints, header: ints,
        cutoff: reals, query_axes: reals, query_radii: reals, query_ids: ints, query_top: ints, places: ints,
        idx: rows, count: ints, info: ints, n: int, m: int, capacity: int,
        own_queries: int, closed: int, drop_self: int, later_only: int,
    ):  # fmt: skip
        function(
            positions, queries, axes, radii, ids, keys, top, table, header, cutoff,
            query_axes, query_radii, query_ids, query_top, places, idx, count, info, n, m, capacity,
            own_queries, closed, drop_self, later_only,
        )  # fmt: skip

    return wp.kernel(query, name=f"query_{variant}", module=module, grid_stride=False)
