"""`jfrnn.search` with the backend `warp` in every step of a scan: what `warp-update` is to be compared with."""

from functools import partial

import warp as wp  # without it this method is missing, which is no failure

from experiments.methods._moving import STEPS, follow_list, plan_list
from experiments.methods._moving import read_list as read

follow = partial(follow_list, skin=0.0)
plan = partial(plan_list, skin=0.0)
