"""Search with cutoffs that differ widely on CUDA: queries one by one, one per thread. Those that are alike ride `cells_cuda`.

What `jfrnn._levels` sorts, `query` walks: top cells as wide as the largest cutoff, within them groups of cutoffs, within those a
Morton curve. A query finds the candidates of a group in the cells around it that are as wide as what the group reaches.
"""

import functools
from collections.abc import Mapping
from types import MappingProxyType

from jfrnn.kernels._native import RULES, SPACES, program
from jfrnn.kernels._program import Entry, Kernel, declare

PADDING = 16  # sources behind the last one, which nobody meets: the CPU tests so many at a time
BLOCK = 128  # threads of CUDA


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
    constants |= {"SCALED": True, "PADDING": PADDING}
    return program(double, dim, header, given=given, **constants)


@functools.lru_cache(512)
def query_kernel(
    dim: int, double: bool, lists: bool, rule: str, groups: int, halvings: int, periodic: int = 0, batched: bool = False,
    excluding: int = 0, flat: bool = False,
) -> Kernel:  # fmt: skip
    """Return the kernel for a dimension, a dtype and a rule, for lists or counts alone.

    There is a thread per query. `info`, zeros at first, gets the longest row.
    `periodic`, `batched`, `excluding` and `flat` are those of `jfrnn.kernels._native.program`.
    """
    variant = f"{dim}d_{'f64' if double else 'f32'}_{rule}{'_list' * lists}{'_flat' * flat}"
    variant += f"{SPACES[periodic]}{'_batched' * batched}{'_excluding' * excluding}"
    constants = {"LIST": lists, "FLAT": flat, "PERIODIC": periodic, "BATCHED": batched, "EXCLUDING": excluding}
    text = level_program(dim, double, rule, groups, halvings, "level_rows.cuh", **constants)
    entry = Entry("LevelRows.run", BLOCK)
    return declare(f"levels_cuda_{variant}", text, entry, cuda=True)[0]
