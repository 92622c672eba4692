"""`jfrnn.search` with the backend `hashgrid`: a padded full list inside `jax.jit`, found with `wp.HashGrid` as Warp ships it."""

from functools import partial

import warp as wp  # without it this method is missing, which is no failure

from experiments.methods._padded import allocate_backend, plan_backend, prepare_backend, read

allocate = partial(allocate_backend, backend="hashgrid")
prepare = partial(prepare_backend, backend="hashgrid", kernels=True)
plan = partial(plan_backend, backend="hashgrid")
