"""`NeighborList.update`, backend `warp`: a list with a skin of a tenth of the cutoff, made anew when something moved half of it."""

from functools import partial

import warp as wp  # without it this method is missing, which is no failure

from experiments.methods._moving import SKIN, STEPS, follow_list, plan_list
from experiments.methods._moving import read_list as read

follow = partial(follow_list, skin=SKIN)
plan = partial(plan_list, skin=SKIN)
