"""`jfrnn.search` with the backend `hashgrid`: a padded full list inside `jax.jit`, found with `wp.HashGrid` as Warp ships it."""

import warp as wp  # without it this method is missing, which is no failure

from experiments.methods._padded import of_backend, read

allocate, prepare, plan = of_backend("hashgrid", kernels=True)
