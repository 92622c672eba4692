"""The engines, each a way to find the same pairs, and how XLA calls their kernels."""

from jfrnn._engine.auto import ARRAYS, ENGINES, WARP, check_backend, choose_engine, default_platform, fastest_engine, platform_of
from jfrnn._engine.cores import ask_for_huge_pages, on_every_core, on_one_core
from jfrnn._engine.cuda import Command, multiprocessors_of
from jfrnn._engine.launch import Kernel, kernel
from jfrnn._engine.operands import MOST_IN_BOX, as_float
from jfrnn._engine.problem import Engine, Filter, Inputs, Kind, Options, Search, hide_inactive, is_decidable, prepare_search
from jfrnn._engine.rows import count_rows, fold_pairs, list_rows
from jfrnn._engine.runs import FOLD_GROUP, Block, Slots, Visit
from jfrnn._engine.serving import on_cpu, on_cuda
from jfrnn._engine.start import WarpArray, WarpKernel, kernels_of, level_of_caller, load_warp
from jfrnn._engine.warp import PLATFORMS
from jfrnn._engine.warp_sums import pair_sums
