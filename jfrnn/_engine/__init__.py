"""The engines, each a way to find the same pairs, and how XLA calls their kernels."""

from jfrnn._engine.auto import ARRAYS, ENGINES, WARP, choose_engine, default_platform, fastest_engine, parse_backend, platform_of
from jfrnn._engine.kept_warp import KeptList, kept_distances, kept_mask, kept_slopes, kept_sums
from jfrnn._engine.launch import Call, Shapes, begins_cold, kernel
from jfrnn._engine.near_warp import find_bits, prepare_for_kernels
from jfrnn._engine.operands import MOST_IN_BOX, as_float, side_by_side
from jfrnn._engine.plans import Clear, Launch, Plan, ask_for_huge_pages, share
from jfrnn._engine.problem import (
    Engine,
    Features,
    Filter,
    Inputs,
    Options,
    Search,
    hide_inactive,
    rows_asked,
    take_present,
)
from jfrnn._engine.renew_warp import BoxNumbers, KeptRows, can_ask, can_renew, find_box_numbers, has_moved, renew_list
from jfrnn._engine.reverse_warp import collect_slots, flatten_slots, reverse_slots, slots_by_source
from jfrnn._engine.rows import add_up, count_rows, find_rows, fold_pairs, length_of_rows, list_flat, list_rows, mark_counts
from jfrnn._engine.runs import FOLD_GROUP, Block, Slots, Visit
from jfrnn._engine.start import compiler, level_of_caller
from jfrnn._engine.structure import Structure, count_few, find_structure_pairs
from jfrnn._engine.sum_results import FoundSums, Summed, Values
from jfrnn._engine.warp import PLATFORMS, has_order
from jfrnn._engine.warp_sums import pair_sums
