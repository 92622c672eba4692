"""`jfrnn.search` with the backend `warp`: a padded full list inside `jax.jit`, filled by fused kernels."""

from functools import partial

import warp as wp  # without it this method is missing, which is no failure

from experiments.methods._padded import allocate_backend, plan_backend, prepare_backend, read

allocate = partial(allocate_backend, backend="warp")
prepare = partial(prepare_backend, backend="warp", kernels=True)
plan = partial(plan_backend, backend="warp")
