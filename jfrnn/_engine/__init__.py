"""The engines, each a way to find the same pairs, and how their kernels are launched."""

from jfrnn._engine.auto import WARP_ENGINES, choose_engine, default_platform, fastest_engine, level_of_caller, platform_of
from jfrnn._engine.backends import (
    Inputs,
    Options,
    count_rows,
    fold_pairs,
    is_decidable,
    levels_of,
    list_rows,
    prepared,
    without_inactive,
)
from jfrnn._engine.cuda import Command
from jfrnn._engine.launch import Kernel, kernel
from jfrnn._engine.levels_warp import level_sums
from jfrnn._engine.runs import FOLD_GROUP, Block, Filter, Slots, Visit
from jfrnn._engine.start import load_warp
from jfrnn._engine.warp import (
    MOST_IN_BOX,
    PLATFORMS,
    as_float,
    ask_for_huge_pages,
    kernels_of,
    on_cpu,
    on_cuda,
    on_every_core,
    on_one_core,
    pair_sums,
    scratch_bytes,
)

__all__ = [
    "FOLD_GROUP",
    "MOST_IN_BOX",
    "PLATFORMS",
    "WARP_ENGINES",
    "Block",
    "Command",
    "Filter",
    "Inputs",
    "Kernel",
    "Options",
    "Slots",
    "Visit",
    "as_float",
    "ask_for_huge_pages",
    "choose_engine",
    "count_rows",
    "default_platform",
    "fastest_engine",
    "fold_pairs",
    "is_decidable",
    "kernel",
    "kernels_of",
    "level_of_caller",
    "level_sums",
    "levels_of",
    "list_rows",
    "load_warp",
    "on_cpu",
    "on_cuda",
    "on_every_core",
    "on_one_core",
    "pair_sums",
    "platform_of",
    "prepared",
    "scratch_bytes",
    "without_inactive",
]
